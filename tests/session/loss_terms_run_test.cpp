// Terms of the list `losses` in a run: read from the configuration, held against the scene, trained with.
#include "compute/parallel.h"
#include "config/compose.h"
#include "eval/evaluator.h"
#include "run/run_loop.h"
#include "session/settings/run_config.h"
#include "session/trainer.h"
#include "testkit/analytic_scene.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

const char* const kEveryTerm =
    "losses: [{type: depth, weight: 0.3}, {type: distortion, weight: 0.2, from_step: 0}, {type: near_density, weight: "
    "0.1, from_step: 0, distance_m: 0.8}, {type: generalised_cross_entropy, weight: 0.3}]\n";

std::string errors_of(const std::string& losses) {
  Registry registry = make_registry();
  Diagnostics diagnostics;
  read_run_config(parse_config_text(hash_config(losses), "room.yaml"), registry, diagnostics);
  std::string text;
  for (const Diagnostic& finding : diagnostics.all()) text += finding.text() + "\n";
  return text;
}

void expect_says(const std::string& text, const std::vector<std::string>& parts) {
  for (const std::string& part : parts) EXPECT_HAS(text, part) << "missing: " << part << "\nin:\n" << text;
}

TEST(LossConfig, MistakesAreNamedWithPlaceAndRemedy) {
  expect_says(errors_of("losses: [{type: distorsion}]\n"),
              {"room.yaml:",
               "no loss named 'distorsion'; known: cosine_distance, depth, distortion, generalised_cross_entropy, "
               "near_density, silhouette",
               "did you mean 'distortion'?"});
  expect_says(errors_of("losses: [{type: depth, weight: -1}]\n"),
              {"room.yaml:", "losses.0.weight: expected number in [0, 1000000], got -1"});
  expect_says(errors_of("losses: [{type: depth, from_step: 2000}]\n"),
              {"losses.0.from_step: expected number in [0, 1], got 2000"});
  expect_says(errors_of("losses: [{type: depth, wieght: 1}]\n"), {"unknown key 'wieght'", "did you mean 'weight'?"});
  expect_says(errors_of("losses: [{weight: 1}]\n"),
              {"losses.0: key 'type' is missing", "choose one of cosine_distance, depth, distortion"});
  expect_says(errors_of("losses: {type: depth}\n"), {"losses: expected a list of terms", "write losses: [{type:"});
  const std::string twice = errors_of("losses:\n  - {type: depth}\n  - {type: distortion}\n  - {type: depth}\n");
  expect_says(twice, {"losses.2: the term 'depth' is already at room.yaml:", "keep one of them"});
}

TEST(LossConfig, StandsInTheResolvedFormAndOnlyThere) {
  Registry registry = make_registry();
  Diagnostics diagnostics;
  const RunConfig with = read_run_config(parse_config_text(hash_config(kEveryTerm), "a.yaml"), registry, diagnostics);
  const RunConfig without = read_run_config(parse_config_text(hash_config(), "a.yaml"), registry, diagnostics);
  const std::string text = write_config(resolved_config(with));
  expect_says(text, {"losses:", "type: distortion", "space: linear", "from_step: 0.0", "distance_m: 0.8"});
  EXPECT_EQ(resolved_config(without).find("losses"), nullptr) << "old runs keep their identity";
  const RunConfig again = read_run_config(parse_config_text(text, "run.yaml"), registry, diagnostics);
  EXPECT_FALSE(diagnostics.has_errors());
  EXPECT_EQ(write_config(resolved_config(again)), text);
}

std::string without_depth_images(std::string yaml) {
  const std::string scene = "{type: analytic_room";
  return yaml.replace(yaml.find(scene), scene.size(), scene + ", with_depth: false");
}

// A preset names the term for every scene; where no frame has a depth it is left out, bit for bit.
TEST(LossConfig, DepthIsLeftOutWhereNoTrainingFrameHasIt) {
  const std::string yaml = without_depth_images(hash_config("losses:\n  - {type: depth}\n"));
  const Session s = open_text(yaml);
  EXPECT_TRUE(s.config.losses.empty());
  EXPECT_EQ(resolved_config(s.config).find("losses"), nullptr);
  const auto& rows = s.plan.left_out;
  const auto row = std::find_if(rows.begin(), rows.end(), [](const LeftOut& r) { return r.component == "loss_depth"; });
  ASSERT_NE(row, rows.end());
  EXPECT_EQ(row->evidence, "no training frame has a depth image");
  EXPECT_EQ(row->proof, ProofClass::bitwise);
  const Session kept = open_text(yaml, {"loss_depth"});
  EXPECT_EQ(kept.plan.kept, std::vector<std::string>{"loss_depth"});
  ASSERT_EQ(kept.config.losses.size(), 1u);
  const std::uint32_t out = train_fingerprint(yaml, 2, 30);
  EXPECT_EQ(out, train_fingerprint(yaml + "runtime: {keep: [loss_depth]}\n", 2, 30));
  EXPECT_EQ(out, train_fingerprint(without_depth_images(hash_config()), 2, 30));
}

TEST(LossConfig, WhatBecomesOfDepthImagesIsSaid) {
  LoadedScene scene;
  for (const Split split : {Split::train, Split::train, Split::test}) {
    FrameInfo info{.split = split, .has_depth = true};
    scene.info.frames.push_back(info);
  }
  scene.depth_pixels = {0, 7, 9};
  Registry registry = make_registry();
  Diagnostics diagnostics;
  const auto use = [&](const std::string& losses, const TrainingDepth& depth) {
    const RunConfig config = read_run_config(parse_config_text(hash_config(losses), "a.yaml"), registry, diagnostics);
    return depth_use(config.losses, depth, diagnostics);
  };
  const std::string term = "losses: [{type: depth}]\n";
  EXPECT_EQ(use(term, training_depth(scene)), "depth images of 2 training frames will be used");
  EXPECT_EQ(use("losses: []\n", training_depth(scene)),
            "depth images of 2 training frames give bounds and distances; no loss reads them");
  EXPECT_EQ(use("losses: []\n", {}), "");
  EXPECT_EQ(use(term, {}), "no training frame has a depth image; colour alone teaches geometry");
  EXPECT_TRUE(diagnostics.all().empty());
  scene.depth_pixels = {0, 0, 9};
  EXPECT_EQ(use(term, training_depth(scene)), "depth images of 2 training frames have no valid pixel");
  ASSERT_EQ(diagnostics.all().size(), 1u);
  EXPECT_EQ(diagnostics.all()[0].text(),
            "losses: the depth images of all 2 training frames have no valid pixel, so no term can read them; export "
            "z-depth that is finite and above 0, or set losses: []");
  BuildRequest request;
  LossTraits reads_depth;
  reads_depth.targets = {channel::depth};
  request.losses = {{"depth", "memory", true, reads_depth}, {"distortion", "walks", true, {}}};
  request.depth_frames = 2;
  request.depth_px = 0;
  const BuildPlan plan = plan_build({}, request, {});
  EXPECT_EQ(plan.no_losses, std::vector<std::string>{"depth"});
  request.depth_px = 7;
  EXPECT_TRUE(plan_build({}, request, {}).no_losses.empty());
}

TEST(LossConfig, DepthThatATermReadsIsHeldAndCounted) {
  Registry registry = make_registry();
  const auto opened = [&](const std::string& losses) {
    Diagnostics diagnostics;
    return open_session(read_run_config(parse_config_text(hash_config(losses), "a.yaml"), registry, diagnostics),
                        registry, {}, diagnostics);
  };
  const Session with = opened("losses: [{type: depth}]\n"), without = opened("");
  std::size_t bytes = 0;
  for (const int f : with.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    EXPECT_EQ(with.scene.frames[i].depth_m.size(), with.scene.frames[i].rgb.size() / 3);
    EXPECT_TRUE(without.scene.frames[i].depth_m.empty());
    EXPECT_GT(without.scene.depth_pixels[i], 0) << "counted, kept or not";
    bytes += with.scene.frames[i].depth_m.bytes();
  }
  EXPECT_EQ(with.memory_facts.frames, without.memory_facts.frames + bytes);
}

// Every preset of a kind of scene teaches geometry by depth images; the shipped room and the experiments only score by
// them.
TEST(ShippedConfigurations, PresetsNameTheDepthTerm) {
  const auto losses_of = [](const std::string& file) {
    const ConfigNode tree = compose_config(SEMFIELD_SOURCE_DIR "/configs/" + file, {});
    const ConfigNode* losses = tree.find("losses");
    return losses == nullptr ? std::string("none") : write_config_inline(*losses);
  };
  const std::string depth = "{type: depth, weight: 0.02}";
  EXPECT_EQ(losses_of("presets/room.yaml"), "[" + depth + "]");
  EXPECT_EQ(losses_of("presets/object.yaml"), "[" + depth + ", {type: silhouette, weight: 0.1}]");
  EXPECT_EQ(losses_of("presets/unbounded.yaml"), "[" + depth +
                                                     ", {type: distortion, weight: 0.03, from_step: 0}, {type: "
                                                     "near_density, weight: 0.01, from_step: 0}]");
  EXPECT_EQ(losses_of("scenes/replica.yaml"), "[{type: depth, weight: 0.02}]");
  for (const char* file : {"quickstart.yaml", "quickstart_frequency.yaml", "experiments/editions/gpu_fast.yaml"})
    EXPECT_EQ(losses_of(file), "[]") << file;
}

TEST(LossConfig, LeaveOutSaysOfEachTermWhyItIsNotThere) {
  const auto rows = [&](const std::string& losses) {
    std::vector<std::string> found;
    for (const LeftOut& row : open_text(hash_config(losses)).plan.left_out) {
      if (row.component.starts_with("loss_")) found.push_back(row.component + ": " + row.evidence);
      if (row.component == kTrainingDepth) found.push_back(row.component);
    }
    return found;
  };
  const std::string no_channel = "loss_cosine_distance: `losses` names no term of type cosine_distance";
  EXPECT_EQ(rows(""),
            (std::vector<std::string>{kTrainingDepth, no_channel, "loss_depth: `losses` names no term of type depth",
                                      "loss_distortion: `losses` names no term of type distortion",
                                      "loss_generalised_cross_entropy: `losses` names no term of type "
                                      "generalised_cross_entropy",
                                      "loss_near_density: `losses` names no term of type near_density",
                                      "loss_silhouette: `losses` names no term of type silhouette"}));
  EXPECT_EQ(rows(std::string(kEveryTerm).insert(std::string(kEveryTerm).rfind(']'), ", {type: silhouette}")),
            (std::vector<std::string>{no_channel, "loss_silhouette: no training frame has 'alpha'"}));
}

TEST(RaySourceDepth, IsTheDistanceAlongTheRayToTheFirstSurface) {
  const Session session = open_text(hash_config(kEveryTerm));
  BatchBuffers batch;
  session.make_ray_source()->fill(5, batch);
  ASSERT_EQ(batch.of(channel::depth).size(), batch.label.size());
  double largest_angle = 0;
  for (std::size_t r = 0; r < batch.of(channel::depth).size(); ++r) {
    const double* o = &batch.origin[3 * r];
    const double* d = &batch.direction[3 * r];
    const auto hit = testkit::intersect_analytic_room({o[0], o[1], o[2]}, {d[0], d[1], d[2]});
    if (batch.of(channel::depth)[r] == 0) {  // the surface lies at the end of the ray, where the bounds cut it off
      EXPECT_NEAR(hit.t_m, batch.near_far[2 * r + 1], 0.02);
      continue;
    }
    EXPECT_NEAR(batch.of(channel::depth)[r], hit.t_m, 2e-3) << "ray " << r;
    largest_angle = std::max(largest_angle, std::abs(d[2]));
  }
  EXPECT_GT(largest_angle, 0.2) << "rays far from the axis tell z-depth from distance";
  const Session plain = open_text(hash_config());
  plain.make_ray_source()->fill(5, batch);
  EXPECT_TRUE(batch.more.empty()) << "no term asks for it";
  EXPECT_TRUE(batch.view(true).targets.more[channel::depth].empty());
}

TEST(RaySourceDepth, RaysThatAreThereForTheirLabelsTellNone) {
  std::string yaml = hash_config(kEveryTerm);
  yaml.replace(yaml.find("train: {"), 8,
               "train: {ray_source: label_balanced, labelled_share: 0.5, label_rays_teach_color: false, ");
  const Session session = open_text(yaml);
  BatchBuffers batch;
  session.make_ray_source()->fill(5, batch);
  const auto tile = static_cast<std::size_t>(session.pipeline->tile_rays());
  for (std::size_t r = 0; r < tile / 2; ++r) EXPECT_EQ(batch.of(channel::depth)[r], 0) << r;
  const std::vector<float>& depth = batch.of(channel::depth);
  EXPECT_TRUE(std::any_of(depth.begin(), depth.end(), [](float t) { return t > 0; }));
}

TEST(PipelineGradient, WithEveryTermOfTheLoss) {
  expect_finite_differences(
      std::string("scene: {type: analytic_room}\nsemantics: {hidden_width: 8, weight: 0.5}\nrendering: "
                  "{density_activation: softplus}\npasses:\n  - sampler: {type: stratified, samples: 12}\n"
                  "    position: {type: frequency, frequencies: 3}\n    direction: {type: spherical_harmonics, degree: "
                  "2}\n    field: {type: nerf_mlp, depth: 3, width: 12, skip_at: 1, view_width: 8}\ntrain: {rays: "
                  "24}\n") +
          kEveryTerm,
      2e-4);
}

TEST(Parity, LanesAndTilesOnlyChangeTheOrderOfSumsWithTermsToo) {
  expect_same_gradients(two_pass_config(std::string("runtime: {lanes: 1, tile_rays: 64}\n") + kEveryTerm),
                        two_pass_config(std::string("runtime: {lanes: 3, tile_rays: 4}\n") + kEveryTerm));
}

TEST(Determinism, RunsWithTermsAreTheSameForAnyThreadCount) {
  const std::uint32_t one = train_fingerprint(hash_config(kEveryTerm), 1, 60);
  EXPECT_EQ(one, train_fingerprint(hash_config(kEveryTerm), 2, 60));
  EXPECT_EQ(one, train_fingerprint(hash_config(kEveryTerm), 4, 60));
  EXPECT_NE(one, train_fingerprint(hash_config(), 1, 60));
}

TEST(LossTerms, OneThatHasNotBegunChangesNoBit) {
  const std::string late = "losses: [{type: distortion, from_step: 0.5}]\n";  // of 3000 steps or more
  EXPECT_EQ(train_fingerprint(hash_config(late), 2, 20), train_fingerprint(hash_config(), 2, 20));
}

// The head's own place is taken: no gradient of the cross-entropy is left, and its value is still reported.
TEST(LossTerms, ALossOnLogitsStandsBesideTheCrossEntropyOrInItsPlace) {
  Registry registry = make_registry();
  const std::string term = "losses: [{type: generalised_cross_entropy, weight: 0.5}]\n";
  const auto semantic_gradient = [&](const std::string& weight, const std::string& more) {
    std::string yaml = two_pass_config(more);
    yaml.replace(yaml.find("weight: 0.3"), 11, "weight: " + weight);
    Oracle oracle(yaml, registry);
    const StepLosses losses = oracle.gradients();
    EXPECT_GT(losses.semantic, 0) << more;
    std::vector<double> values;
    for (const Tensor<double>& t : oracle.pipeline->store().all())
      if (t.learned() && t.name.find("/semantic/") != std::string::npos)
        values.insert(values.end(), t.grad.data(), t.grad.data() + t.size());
    return values;
  };
  const std::vector<double> both = semantic_gradient("0.5", term);
  const std::vector<double> entropy = semantic_gradient("0.5", "");
  const std::vector<double> alone = semantic_gradient("0", term);
  const std::vector<double> none = semantic_gradient("0", "");
  ASSERT_GT(both.size(), 100u);
  double largest = 0;
  for (std::size_t i = 0; i < both.size(); ++i) {
    largest = std::max(largest, std::abs(alone[i]));
    EXPECT_EQ(none[i], 0);
    ASSERT_NEAR(both[i], entropy[i] + alone[i], 1e-12);
  }
  EXPECT_GT(largest, 1e-4);
}

TEST(LossTerms, ALossOnLogitsIsLeftOutWithoutLabels) {
  std::string yaml = hash_config("losses: [{type: generalised_cross_entropy}]\n");
  yaml.replace(yaml.find("{type: analytic_room"), 20, "{type: analytic_room, labels: {frames: none}");
  const Session s = open_text(yaml);
  EXPECT_TRUE(s.config.losses.empty());
  const auto& rows = s.plan.left_out;
  const auto row = std::find_if(rows.begin(), rows.end(),
                                [](const LeftOut& r) { return r.component == "loss_generalised_cross_entropy"; });
  ASSERT_NE(row, rows.end());
  EXPECT_EQ(row->rule, "there are no semantics");
}

double abs_rel(const std::string& losses) {
  Session s = open_text(hash_config(losses));
  const auto rays = s.make_ray_source();
  Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule, s.config.train.steps);
  while (trainer.step() < 200) trainer.advance();
  return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit)
      .depth.abs_rel()
      .value_or(1);
}

TEST(LossTerms, DepthImagesMakeDepthBetter) {
  const double without = abs_rel(""), with = abs_rel("losses: [{type: depth, weight: 0.1}]\n");
  EXPECT_LT(with, 0.7 * without) << "without " << without;
  EXPECT_LT(abs_rel("losses: [{type: depth, kind: line_of_sight, weight: 0.02}]\n"), 0.9 * without);
}

TEST(LossTerms, MetricsNameEachAndSayNothingBeforeItBegins) {
  const TempDir dir;
  Registry registry = make_registry();
  Diagnostics diagnostics;
  const std::string yaml = hash_config(
      "losses: [{type: depth}, {type: distortion, from_step: 0.5}]\nreport: "
      "{log_every_steps: 10, eval_every_s: 0}\n");
  RunConfig config = read_run_config(parse_config_text(yaml, "a.yaml"), registry, diagnostics);
  ASSERT_FALSE(diagnostics.has_errors()) << diagnostics.all().front().text();
  config.train.steps = 40;
  TrainRequest request{.out_dir = dir / "run"};
  TrainProgress last;
  HookListener hooks;
  hooks.on_progress = [&last](const TrainProgress& progress) { last = progress; };
  run_training(std::move(config), registry, request, &hooks);
  ASSERT_EQ(last.terms.size(), 2u);
  EXPECT_EQ(last.terms[0].first, "depth");
  EXPECT_EQ(last.terms[1].first, "distortion");
  EXPECT_GT(last.terms[1].second, 0);
  int rows = 0;
  for (const MetricsRow& row : read_metrics(dir / "run/metrics.jsonl")) {
    if (row.kind != "train") continue;
    ++rows;
    EXPECT_GT(row.get("loss_depth").value_or(0), 0) << row.step;
    EXPECT_EQ(row.get("loss_distortion").has_value(), row.step > 20) << row.step;
    const double sum = *row.get("loss_color") + 0.002 * row.get("loss_semantic").value_or(0) +
                       0.1 * *row.get("loss_depth") + 0.002 * row.get("loss_distortion").value_or(0);
    EXPECT_NEAR(*row.get("loss"), sum, 1e-6 * sum) << row.step;
  }
  EXPECT_EQ(rows, 4);
}

}  // namespace
}  // namespace semfield
