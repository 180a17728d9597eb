// Reading a run's configuration: every error at once, and the resolved form repeats it; which device a run gets.

#include "config/settings/run_config.h"

#include <cstdlib>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "config/config_tree.h"
#include "config/config_words.h"
#include "config/explain.h"
#include "config/settings/choices.h"
#include "core/rng.h"
#include "core/view.h"
#include "eval/evaluator.h"
#include "model/render_rules.h"
#include "scene/loading/frame_source.h"
#include "tests/analytic_scene.h"
#include "tests/session/oracle.h"
#include "tests/session/step_configs.h"
#include "train/assembly.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string errors_of(const std::string& yaml) {
  Diagnostics diagnostics;
  read_run_config(parse_config_text(yaml, "room.yaml"), all_plugins(), diagnostics);
  return texts(diagnostics);
}

// What a preset leaves to the device; numbers that are written stay.
TEST(RunConfig, TheDeviceChoosesSizesThatAreLeftOpen) {
  const auto chosen = [&](const std::string& levels, Device device, const std::string& ends = "",
                          const std::string& far = "background") {
    const std::string yaml =
        "scene: {type: analytic_room}\npasses:\n  - sampler: {type: occupancy_grid, max_samples: 0" + ends +
        "}\n    position: {type: hash_grid, levels: " + levels +
        "}\n    field: {type: tiny_mlp}\ntrain: {rays: 0}\nrendering: {far: " + far + "}\n";
    RunConfig config = run_config_of(parse_config_text(yaml, "room.yaml"), all_plugins());
    const std::size_t lines = choose_for_device(config, device).size();
    const std::string resolved = write_config(resolved_config(config));
    return std::to_string(config.train.rays) + " " + std::to_string(lines) + "\n" + resolved;
  };
  EXPECT_HAS(chosen("0", Device::cpu), "1024 3\n", "levels: 8", "max_samples: 128");
  EXPECT_HAS(chosen("0", Device::cuda), "8192 3\n", "levels: 16", "max_samples: 256");
  EXPECT_HAS(chosen("5", Device::cuda), "8192 2\n", "levels: 5");
  EXPECT_HAS(chosen("0", Device::cuda, "", "open"), "32768 3\n");
  EXPECT_HAS(chosen("0", Device::cpu, ", keep_last: true"), "max_samples: 48");
  EXPECT_HAS(chosen("0", Device::cuda, ", keep_last: true"), "max_samples: 128");
  EXPECT_HAS(chosen("0", Device::cuda, ", keep_last: true, growth: 0.01"), "max_samples: 512");
}

TEST(RunConfig, KeysOfOlderVersionsAreRefusedWithTheWayOut) {
  const std::string text = errors_of(hash_config("runtime: {gemm: auto}\n"));
  EXPECT_HAS(text, "room.yaml:11:", "gemm is gone", "remove the key");
  EXPECT_LACKS(text, "unknown key");
}

TEST(RunConfig, DensityOfRunsOf1_0IsPerMetre) {
  const ConfigNode now = resolved_config(open_text(hash_config()).config);
  EXPECT_NEAR(run_config_of(now, all_plugins()).rendering.unit_m, 1, 0.3) << "half of what the cameras see afar";
  const ConfigNode* rendering = now.find("rendering");
  const auto unit_of = [&](const ConfigNode& tree) { return run_config_of(tree, all_plugins()).rendering.unit_m; };
  EXPECT_EQ(unit_of(now.with("rendering", rendering->with("unit_m", ConfigNode::make_scalar("2.5", false, {})))), 2.5);
  const ConfigNode then = now.with("rendering", rendering->without("unit_m"));
  EXPECT_EQ(unit_of(then), 1) << "the resolved configuration of a run";
  EXPECT_EQ(unit_of(then.without("base_dir")), 0) << "one that is written by hand asks the scene";
}

TEST(RunConfig, PrecisionAutoIsSettledWhenASessionOpens) {
  Session s = open_text(hash_config("runtime: {device: cpu, precision: auto}\n"));
  EXPECT_EQ(s.config.runtime.precision, bf16_is_faster() ? Precision::bf16 : Precision::fp32);
  const std::string said = bf16_is_faster() ? "precision: bf16" : "precision: fp32";
  EXPECT_HAS(write_config(resolved_config(s.config)), said);
  s.config.runtime.precision = Precision::bf16;
  EXPECT_EQ(precision_of(s.config, all_plugins(), {Device::cpu, 0}), Precision::bf16) << "a named one stays";
}

TEST(RunConfig, ADeviceIsNamedByKindAndOrdinal) {
  EXPECT_EQ(device_of("cpu"), DeviceId{});
  for (const char* first : {"cuda", "cuda:0"}) EXPECT_EQ(device_of(first), (DeviceId{Device::cuda, 0}));
  EXPECT_EQ(device_of("cuda:12"), (DeviceId{Device::cuda, 12}));
  const auto of = [](const std::string& device) {
    return errors_of(hash_config("runtime: {threads: 1, device: " + device + "}\n"));
  };
  for (const char* device : {"auto", "cpu", "cuda", "cuda:1"}) EXPECT_EQ(of(device), "") << device;
  for (const char* device : {"gpu", "'cuda:'", "cuda:x", "cuda1", "cuda:-1", "cuda:1000", "Cuda", "''"}) {
    const std::string text = of(device);
    EXPECT_HAS(text, "room.yaml:11:", "expected one of auto, cpu, cuda") << device << ": " << text;
    EXPECT_HAS(text, "auto, cpu, cuda, or cuda:N");
  }
}

TEST(RunConfig, ResolvedFormReadsBackTheSame) {
  for (const StepCase& step : kStepCases) {
    SCOPED_TRACE(step.name);
    const RunConfig first = run_config_of(parse_config_text(step.config(step.more), "/tmp/a.yaml"), all_plugins());
    const ConfigNode resolved = resolved_config(first);
    const RunConfig second =
        run_config_of(parse_config_text(write_config(resolved), "/elsewhere/run.yaml"), all_plugins());
    EXPECT_TRUE(config_differences(resolved, resolved_config(second)).empty());
    EXPECT_EQ(second.base_dir, first.base_dir);
  }
}

TEST(RunConfig, WhatIsChosenFromTheSceneStandsInTheResolvedForm) {
  const Session first = open_text(
      replaced(hash_config(), "log2_entries: 11, finest_resolution: 64", "log2_entries: 0, finest_resolution: 0"));
  ASSERT_EQ(first.chosen.size(), 2u);
  EXPECT_EQ(first.chosen[0].rfind("passes.main.position: finest_resolution ", 0), 0u) << first.chosen[0];
  EXPECT_EQ(first.chosen[1].rfind("passes.main.position: log2_entries ", 0), 0u) << first.chosen[1];
  EXPECT_HAS(describe_session(first), "chosen    " + first.chosen[0]);
  const std::string resolved = write_config(resolved_config(first.config));
  EXPECT_LACKS(resolved, "finest_resolution: 0");
  const Session second = open_text(resolved);
  EXPECT_TRUE(second.chosen.empty());
  EXPECT_EQ(fingerprint(first.pipeline->store()), fingerprint(second.pipeline->store()));
}

// Those of sweeps and of tune are read by their tests.
TEST(RunConfig, EveryShippedConfigReadsAndSettlesItsPrecision) {
  int read = 0, with_networks = 0;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(SEMFIELD_SOURCE_DIR "/configs")) {
    const std::string path = entry.path().string();
    if (entry.path().extension() != ".yaml" || path.find(".classes.") != std::string::npos) continue;
    const ConfigNode tree = compose_config(path, {});
    if (tree.find("passes") != nullptr) {
      ++with_networks;
      const ConfigNode* runtime = tree.find("runtime");
      EXPECT_TRUE(runtime != nullptr && runtime->find("precision") != nullptr) << path;
    }
    const auto is_in = [&](const char* folder) { return path.find(folder) != std::string::npos; };
    if (is_in("/presets/") || is_in("/experiments/") || is_in("/tune/")) continue;
    EXPECT_NO_THROW(load_run_config(path, {}, all_plugins())) << path;
    ++read;
  }
  EXPECT_GT(read, 0);
  EXPECT_GE(with_networks, 18);
}

// Where a run trains whose parts lack kernels for the device; the device itself is not needed.

/// A run with a term of the loss, and a registry that has CUDA tables of every part but `without`.
struct PartsRun {
  explicit PartsRun(const std::string& device, const std::string& without = "") : registry(make_registry()) {
    const std::string more = "losses: [{type: near_density}]\nruntime: {device: " + device + "}\n";
    config = run_config_of(parse_config_text(hash_config(more), "test.yaml"), registry);
    static constexpr int kTable = 0;
    for (const PluginEntry* entry : registry.entries()) {
      const std::string owner = std::string(kind_name(entry->kind)) + " '" + entry->name + "'";
      if (owner != without) registry.kernels().add(Device::cuda, owner, &kTable);
    }
  }
  /// What is said of slow paths on `device` in `precision`.
  std::string slow_paths(DeviceId device, Precision precision, bool bf16_instructions = true) {
    config.runtime.precision = precision;
    Diagnostics found;
    say_slow_paths(config, registry, device, bf16_instructions, found);
    return texts(found);
  }
  ChosenDevice choose() { return device_for_parts(config, registry, said); }
  Registry registry;
  RunConfig config;
  Diagnostics said;
};

std::string refusal_of(PartsRun& run) {
  return error_of(ErrorKind::unavailable, [&] { run.choose(); });
}

TEST(DeviceForParts, IsTheDeviceWhereEveryPartHasKernels) {
  EXPECT_EQ(PartsRun("auto").choose().device.kind, Device::cuda);
  EXPECT_EQ(PartsRun("cuda").choose().device.kind, Device::cuda);
}

TEST(DeviceForParts, APartWithoutKernelsLeavesTheRunOnTheProcessorWithANote) {
  PartsRun plugin("auto", "encoder 'hash_grid'"), loss("auto");
  loss.config.losses[0].type = "glow";  // which the build has no kernels of
  for (const auto& [run, part] : {std::pair{&plugin, "encoder 'hash_grid'"}, std::pair{&loss, "loss 'glow'"}}) {
    const ChosenDevice chosen = run->choose();
    EXPECT_EQ(chosen.device.kind, Device::cpu);
    EXPECT_EQ(chosen.no_cuda, part + std::string(" has no cuda kernels"));
    ASSERT_EQ(run->said.all().size(), 1u);
    EXPECT_EQ(run->said.all()[0].severity, Severity::warning);
    EXPECT_HAS(run->said.all()[0].text(), "runtime.device", part, "`semfield plugins list --devices`");
  }
}

TEST(DeviceForParts, CudaAskedForIsRefusedByNameWithARemedy) {
  PartsRun plugin("cuda", "field 'tiny_mlp'");
  EXPECT_HAS(refusal_of(plugin), "tiny_mlp", "cuda kernels");
  PartsRun term("cuda");
  term.config.losses[0].type = "glow";
  EXPECT_HAS(refusal_of(term), "glow", "cuda kernels");
}

constexpr DeviceId kCpu{Device::cpu, 0}, kGpu{Device::cuda, 0};

TEST(SlowPaths, AreSaidWhereTheyAreTaken) {
  PartsRun both("auto"), fp32_alone("auto"), cpu("cpu");
  static constexpr int kTable = 0;
  both.registry.kernels().add(Device::cuda, "field 'tiny_mlp'", &kTable, Precision::bf16);
  EXPECT_HAS(both.slow_paths(kGpu, Precision::fp32), "runtime.precision: fp32", "set runtime.precision: auto");
  EXPECT_EQ(both.slow_paths(kGpu, Precision::bf16), "");
  EXPECT_EQ(both.slow_paths(kCpu, Precision::fp32), "");
  EXPECT_EQ(precision_of(fp32_alone.config, fp32_alone.registry, kGpu), Precision::fp32);
  EXPECT_HAS(fp32_alone.slow_paths(kGpu, Precision::fp32), "field 'tiny_mlp' has no kernels of bf16");
  EXPECT_HAS(cpu.slow_paths(kCpu, Precision::bf16, false), "they are emulated");
  EXPECT_EQ(cpu.slow_paths(kCpu, Precision::bf16, true), "");
}

// Terms of the list `losses` in a run: read from the configuration, held against the scene, trained with.

const char* const kEveryTerm =
    "losses: [{type: depth, weight: 0.3}, {type: distortion, weight: 0.2, from_step: 0}, {type: near_density, weight: "
    "0.1, from_step: 0, distance_m: 0.8}, {type: generalised_cross_entropy, weight: 0.3}]\n";

std::string without_depth_images(const std::string& yaml) {
  return replaced(yaml, "{type: analytic_room", "{type: analytic_room, with_depth: false");
}

// A preset names the term for every scene; where no frame has a depth it is left out, bit for bit.
TEST(LossConfig, DepthIsLeftOutWhereNoTrainingFrameHasIt) {
  const std::string yaml = without_depth_images(hash_config("losses:\n  - {type: depth}\n"));
  const Session s = open_text(yaml);
  EXPECT_TRUE(s.config.losses.empty());
  EXPECT_EQ(resolved_config(s.config).find("losses"), nullptr);
  EXPECT_EQ(left_out_row(s, "loss_depth").evidence, "no training frame has a depth image");
  EXPECT_EQ(left_out_row(s, "loss_depth").proof, ProofClass::bitwise);
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
  Diagnostics diagnostics;
  const auto use = [&](const std::string& losses, const TrainingDepth& depth) {
    const RunConfig config = run_config_of(parse_config_text(hash_config(losses), "a.yaml"), all_plugins());
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
  EXPECT_HAS(diagnostics.all()[0].text(), "read them");
  const LossTraits reads_depth{.targets = {channel::depth}};
  BuildRequest request{.depth_frames = 2, .depth_px = 0};
  request.losses = {{"depth", "memory", true, reads_depth}, {"distortion", "walks", true, {}}};
  EXPECT_EQ(plan_build({}, request, {}).no_losses, std::vector<std::string>{"depth"});
  request.depth_px = 7;
  EXPECT_TRUE(plan_build({}, request, {}).no_losses.empty());
}

TEST(LossConfig, DepthThatATermReadsIsHeldAndCounted) {
  const Session with = open_text(hash_config("losses: [{type: depth}]\n")), without = open_text(hash_config());
  for (const int f : with.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    EXPECT_EQ(with.scene.frames[i].depth_m.size(), with.scene.frames[i].rgb.size() / 3);
    EXPECT_TRUE(without.scene.frames[i].depth_m.empty());
    EXPECT_GT(without.scene.depth_pixels[i], 0) << "counted, kept or not";
  }
}

TEST(LossConfig, LeaveOutSaysOfEachTermWhyItIsNotThere) {
  const Session none = open_text(hash_config()), with = open_text(hash_config(kEveryTerm));
  for (const char* term : {"cosine_distance", "depth", "distortion", "generalised_cross_entropy", "near_density"})
    EXPECT_HAS(left_out_row(none, "loss_" + std::string(term)).evidence, "names no term of type ", term);
  EXPECT_NO_THROW(left_out_row(none, kTrainingDepth));
  EXPECT_THROW(left_out_row(with, "loss_depth"), Error);
  const Session seen = open_text(hash_config("losses: [{type: silhouette}]\n"));
  EXPECT_EQ(left_out_row(seen, "loss_silhouette").evidence, "no training frame has 'alpha'");
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
  std::string yaml =
      replaced(hash_config(kEveryTerm), "train: {",
               "train: {ray_source: label_balanced, labelled_share: 0.5, label_rays_teach_color: false, ");
  const Session session = open_text(yaml);
  BatchBuffers batch;
  session.make_ray_source()->fill(5, batch);
  const auto tile = static_cast<std::size_t>(session.pipeline->tile_rays());
  for (std::size_t r = 0; r < tile / 2; ++r) EXPECT_EQ(batch.of(channel::depth)[r], 0) << r;
  const std::vector<float>& depth = batch.of(channel::depth);
  EXPECT_TRUE(std::any_of(depth.begin(), depth.end(), [](float t) { return t > 0; }));
}

TEST(PipelineGradient, WithEveryTermOfTheLoss) { expect_finite_differences(one_pass_config(kEveryTerm), 2e-4); }

TEST(Parity, LanesAndTilesOnlyChangeTheOrderOfSumsWithTermsToo) {
  expect_same_gradients(two_pass_config(std::string("runtime: {lanes: 1, tile_rays: 64}\n") + kEveryTerm),
                        two_pass_config(std::string("runtime: {lanes: 3, tile_rays: 4}\n") + kEveryTerm));
}

TEST(LossTerms, OneThatHasNotBegunChangesNoBit) {
  const std::string late = "losses: [{type: distortion, from_step: 0.5}]\n";  // of 3000 steps or more
  EXPECT_EQ(train_fingerprint(hash_config(late), 2, 20), train_fingerprint(hash_config(), 2, 20));
}

// The head's own place is taken: no gradient of the cross-entropy is left, and its value is still reported.
TEST(LossTerms, ALossOnLogitsStandsBesideTheCrossEntropyOrInItsPlace) {
  const std::string term = "losses: [{type: generalised_cross_entropy, weight: 0.5}]\n";
  const auto semantic_gradient = [&](const std::string& weight, const std::string& more) {
    std::string yaml = replaced(two_pass_config(more), "weight: 0.3", "weight: " + weight);
    Oracle oracle(yaml);
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
  std::string yaml = replaced(hash_config("losses: [{type: generalised_cross_entropy}]\n"), "{type: analytic_room",
                              "{type: analytic_room, labels: {frames: none}");
  const Session s = open_text(yaml);
  EXPECT_TRUE(s.config.losses.empty());
  EXPECT_EQ(left_out_row(s, "loss_generalised_cross_entropy").rule, "there are no semantics");
}

TEST(LossTerms, MetricsNameEachAndSayNothingBeforeItBegins) {
  const TempDir dir;
  const std::string yaml = hash_config(
      "losses: [{type: depth}, {type: distortion, from_step: 0.5}]\nreport: {log_every_steps: 10, eval_every_s: 0}\n");
  RunConfig config = run_config_of(parse_config_text(yaml, "a.yaml"), all_plugins());
  config.train.steps = 40;
  TrainRequest request{.out_dir = dir / "run"};
  TrainProgress last;
  HookListener hooks;
  hooks.on_progress = [&last](const TrainProgress& progress) { last = progress; };
  run_training(std::move(config), all_plugins(), request, &hooks);
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

// How often opening a session makes each part of its network, and the bounds that a short training finds.

using Counts = std::map<std::string, int>;

// Counts what a maker makes under the name of its plugin.
template <class Maker>
void count_calls(Maker& maker, const std::string& name, const std::shared_ptr<Counts>& counts) {
  if (!maker) return;
  maker = [inner = maker, name, counts](const auto&... arguments) {
    ++(*counts)[name];
    return inner(arguments...);
  };
}

// make_registry(), where each encoder, field and sampler NAME has a twin counted_NAME.
struct CountingRegistry {
  Registry registry = make_registry();
  std::shared_ptr<Counts> counts = std::make_shared<Counts>();

  CountingRegistry() {
    std::vector<PluginEntry> twins;
    for (const PluginEntry* entry : registry.entries()) {
      PluginEntry twin = *entry;
      count_calls(twin.encoder32, entry->name, counts);
      count_calls(twin.field32, entry->name, counts);
      count_calls(twin.sampler32, entry->name, counts);
      twin.name = "counted_" + entry->name;
      twins.push_back(std::move(twin));
    }
    for (PluginEntry& twin : twins) registry.add(std::move(twin));
  }

  // What opening makes of `yaml`, whose slots name twins.
  Counts opened(const std::string& yaml, bool probe = false) {
    counts->clear();
    Diagnostics diagnostics;
    EXPECT_TRUE(open_text(yaml, registry, SessionOptions{.probe = probe}, diagnostics).pipeline);
    return *counts;
  }
};

std::string with_twins(std::string yaml, const std::vector<std::string>& names) {
  for (const std::string& name : names)
    for (std::size_t at = 0; (at = yaml.find("type: " + name, at)) != std::string::npos; at += 6)
      yaml.replace(at, 6, "type: counted_");
  return yaml;
}

TEST(Constructions, APartIsMadeOnce) {
  CountingRegistry counting;
  const Counts made =
      counting.opened(with_twins(hash_config(), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}));
  EXPECT_EQ(made, (Counts{{"hash_grid", 1}, {"occupancy_grid", 1}, {"spherical_harmonics", 1}, {"tiny_mlp", 1}}));
}

// The probe's tables and grids are sized by the bounds that it is to replace.
TEST(Constructions, AProbeOfTheBoundsHasANetworkOfItsOwn) {
  CountingRegistry counting;
  std::string yaml =
      with_scene(hash_config(), "{type: analytic_room, with_depth: false, with_labels: false, load: {probe_steps: 8}}");
  const Counts made = counting.opened(
      with_twins(std::move(yaml), {"hash_grid", "spherical_harmonics", "tiny_mlp", "occupancy_grid"}), true);
  EXPECT_EQ(made, (Counts{{"hash_grid", 2}, {"occupancy_grid", 2}, {"spherical_harmonics", 2}, {"tiny_mlp", 2}}));
}

// The map from the world to encoders: affine inside, all of space drawn in outside, against its own inverse.

const Box kBounds{{-1, 2, 3}, {3, 4, 5}};  // longest side 4, centre (1, 3, 4)

DomainMap contracted() { return DomainMap::make(Domain::unit_cube, kBounds, 0, true); }

// Addressed places from `least` to `most` radii (2 each) away, in all directions.
Vec3d place(int i, double least, double most) {
  const auto random = [i](int k) {
    return static_cast<double>(uniform01({5, 0, 2}, static_cast<std::uint64_t>(8 * i + k)));
  };
  const Vec3d way = normalized(Vec3d{random(0) - 0.5, random(1) - 0.5, random(2) - 0.5});
  return kBounds.center() + way * (2 * least * std::pow(most / least, random(3)));
}

double reach(Vec3d p) {
  const Vec3d q = p - kBounds.center();
  return std::max({std::abs(q.x), std::abs(q.y), std::abs(q.z)});
}

TEST(DomainMap, WithoutContractionItIsAffine) {
  const DomainMap map = DomainMap::make(Domain::unit_cube, kBounds, 0);
  EXPECT_EQ(map.radius, 0);
  const Vec3d far = map({101, 3, 4});
  EXPECT_EQ(far.x, 25.5);
  EXPECT_EQ(DomainMap::make(Domain::metric, kBounds, 0.1)({7, 8, 9}).y, 8 * 0.1);
}

TEST(DomainMap, BoundsTakeTheInnerHalfAndKeepTheirShape) {
  const DomainMap map = contracted();
  EXPECT_EQ(map({-1, 3, 4}), (Vec3d{0.25, 0.5, 0.5}));
  EXPECT_EQ(map({3, 4, 5}), (Vec3d{0.75, 0.625, 0.625}));
  const DomainMap metric = DomainMap::make(Domain::metric, kBounds, 0.1, true);
  EXPECT_EQ(metric({3, 3, 4}), (Vec3d{0.5, 0, 0}));
}

TEST(DomainMap, AllOfSpaceFitsTheCube) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d x = map(place(i, 1e-3, 1e12));
    for (int a = 0; a < 3; ++a) {
      EXPECT_GE(x[a], 0);
      EXPECT_LE(x[a], 1);
    }
  }
  EXPECT_EQ(map({1e300, 3, 4}).x, 1);  // as good as infinity: the face, and no NaN
  EXPECT_EQ(map({-1e300, -1e300, 1e300}), (Vec3d{0, 0, 1}));
}

TEST(DomainMap, ExpandIsTheInverse) {
  const DomainMap map = contracted();
  for (int i = 0; i < 3000; ++i) {
    const Vec3d p = place(i, 1e-2, 1e4), back = map.expand(map.contract(p));
    // An ulp near the face of the cube is a large part of the distance to it.
    const double steep = std::max(1.0, reach(p) / map.radius);
    EXPECT_LT(length(back - p), 1e-14 * steep * length(p)) << i;
  }
}

// A short training finds where a scene is whose bounds only the cameras show; and rays that go on beyond the bounds.

std::string without_depth(const std::string& more) {
  const std::string yaml = replaced(hash_config(more), "steps: 200", "steps: 512");
  return with_scene(
      yaml, "{type: analytic_room, with_depth: false, with_labels: false, frames: 24, load: {probe_steps: 128}}");
}

Session open_probing(const std::string& yaml, Registry& registry, Diagnostics& diagnostics) {
  return open_text(yaml, registry, SessionOptions{.probe = true}, diagnostics);
}

double volume(const Box& box) { return box.size().x * box.size().y * box.size().z; }

// The probe borrows the frames: their channels must come back as they were, for the run to find its axes in them.
TEST(BoundsProbe, LeavesHeadsAndTheirChannelsToTheRun) {
  Diagnostics d;
  const std::string heads =
      "heads:\n  - {type: feature_map, channel: albedo, width: 2, branch: {position: {type: frequency, "
      "frequencies: 2}, field: {type: tiny_mlp, hidden_width: 8, hidden_layers: 1}}}\n"
      "losses: [{type: cosine_distance, channel: albedo}]\n";
  const std::string yaml = replaced(without_depth(heads), "with_depth: false", "with_depth: false, with_albedo: true");
  const Session s = open_probing(yaml, channel_plugins(), d);
  ASSERT_EQ(s.scene.bounds_from, "a probe of 128 steps");
  const View<const float> axes = s.pipeline->passes().back().axes("albedo");
  ASSERT_EQ(axes.rows, 3);
  for (std::int32_t a = 0; a < 2; ++a) {
    for (std::int32_t b = 0; b < 2; ++b) {
      double dot = 0;
      for (std::int64_t row = 0; row < 3; ++row) dot += static_cast<double>(axes(row, a) * axes(row, b));
      EXPECT_NEAR(dot, a == b ? 1 : 0, 1e-5) << a << " " << b;
    }
  }
  const auto train = static_cast<std::size_t>(s.scene.frames_of(Split::train).front());
  EXPECT_EQ(s.scene.frames[train].channels.at(0).cols, 2);
}

// The room is 4 m x 3 m x 2 m.
TEST(BoundsProbe, ShrinksWhatTheCamerasGuessToTheRoom) {
  Diagnostics d;
  const Session guessed = open_text(without_depth(""));
  EXPECT_TRUE(guessed.scene.extent_is_guessed);
  EXPECT_GT(volume(guessed.extent.bounds), 15 * 24);
  std::vector<std::size_t> told;
  const LoadProgress progress = [&](std::string_view doing, std::size_t done, std::size_t total) {
    if (doing != "looking for the bounds") return;
    told.push_back(done);
    EXPECT_EQ(total, 128u);
  };
  WorkSettings work{.load_progress = &progress};
  const WorkScope scope(work);
  const Session s = open_probing(without_depth(""), all_plugins(), d);
  EXPECT_EQ(s.scene.bounds_from, "a probe of 128 steps");
  EXPECT_GT(told.size(), 3u) << "a probe says how far it is";
  EXPECT_TRUE(std::is_sorted(told.begin(), told.end()));
  EXPECT_LT(volume(s.extent.bounds), volume(guessed.extent.bounds) / 10);
  for (int a = 0; a < 3; ++a) {
    const double half = 2 - 0.5 * a;
    EXPECT_LT(s.extent.bounds.lo[a], -0.75 * half) << a;
    EXPECT_GT(s.extent.bounds.hi[a], 0.75 * half) << a;
  }
  EXPECT_LT(s.extent.far_m, guessed.extent.far_m);
  EXPECT_GT(s.extent.far_m, 3);
  // Part of the run: whoever opens it again takes these and probes no more.
  EXPECT_EQ(box_of(s.config.load.bounds).hi, s.extent.bounds.hi);
  EXPECT_FALSE(s.scene.extent_is_guessed && s.config.load.probe_steps > 0);
  ASSERT_FALSE(d.all().empty());
  EXPECT_HAS(d.all().back().text(), "a probe of 128 steps");
}

TEST(BoundsProbe, GivesTheSameBitsForAnyThreadsAndOnResuming) {
  Diagnostics d;
  const std::string more = "runtime: {threads: 1}\n";
  const Session one = open_probing(without_depth(more), all_plugins(), d);
  const Session two = open_probing(without_depth("runtime: {threads: 2}\n"), all_plugins(), d);
  EXPECT_EQ(one.config.load.bounds, two.config.load.bounds);
  EXPECT_EQ(one.config.load.far_m, two.config.load.far_m);
  const Session again = open_probing(write_config(resolved_config(one.config)), all_plugins(), d);
  EXPECT_EQ(again.config.load.bounds, one.config.load.bounds);
  EXPECT_EQ(again.extent.pixel_footprint_m, one.extent.pixel_footprint_m);
  EXPECT_EQ(fingerprint(again.pipeline->store()), fingerprint(one.pipeline->store()));
}

TEST(BoundsProbe, IsMadeOnlyWhereItHelps) {
  Diagnostics d;
  EXPECT_FALSE(open_probing(hash_config(), all_plugins(), d).scene.extent_is_guessed);  // depth shows it
  for (const auto& [from, to] : {std::pair{"probe_steps: 128", "probe_steps: 0"}, {"steps: 512", "steps: 511"}})
    EXPECT_TRUE(open_probing(replaced(without_depth(""), from, to), all_plugins(), d).scene.extent_is_guessed) << to;
}

TEST(Contraction, RaysGoOnBeyondTheBounds) {
  std::string yaml = replaced(replaced(without_depth(""), "far: background", "far: background, outside: contracted"),
                              "resolution: 32", "resolution: 32, cascades: 7, growth: 0.02");
  const Session s = open_text(yaml);
  EXPECT_FALSE(s.scene.extent_is_guessed);
  EXPECT_FALSE(s.limits.clip);
  EXPECT_EQ(s.extent.far_m, 64 * s.extent.bounds.size().x);
  const DomainMap& map = s.pipeline->passes().front().parts().domain;
  EXPECT_EQ(map.radius, 0.5 * s.extent.bounds.size().x);
  const std::unique_ptr<RaySource> rays = s.make_ray_source();
  BatchBuffers batch;
  rays->fill(0, batch);
  for (std::size_t r = 0; r < batch.label.size(); ++r) EXPECT_EQ(batch.near_far[2 * r + 1], s.extent.far_m);
}

}  // namespace
}  // namespace semfield
