// The exact savings change no function and no gradient, by finite differences too; the field's points make its rays.

#include <algorithm>
#include <cmath>

#include "config/settings/choices.h"
#include "core/rng.h"
#include "eval/evaluator.h"
#include "model/camera_corrections.h"
#include "model/render_rules.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/session/oracle.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using namespace testing_train;

// Rows of one are hard labels; spread over classes, the loss is the cross-entropy with that spread.
TEST(Parity, SoftRowsOfOneTrainAsHardLabels) {
  Oracle hard(two_pass_config()), soft(two_pass_config());
  const std::int32_t logits = static_cast<std::int32_t>(soft.session.plan.class_of_logit.size());
  BatchBuffers& batch = soft.batch;
  batch.more = {{std::string(channel::soft_label), logits, {}}};
  batch.of(channel::soft_label).assign(batch.label.size() * static_cast<std::size_t>(logits), 0.0F);
  const auto label_with = [&](float own, float next) {
    for (std::size_t r = 0; r < batch.label.size(); ++r) {
      if (batch.label[r] == kVoid) continue;
      float* row = &batch.of(channel::soft_label)[r * static_cast<std::size_t>(logits)];
      row[batch.label[r]] = own;
      row[(batch.label[r] + 1) % logits] = next;
    }
  };
  label_with(1, 0);
  const StepLosses a = hard.gradients(), b = soft.gradients();
  EXPECT_EQ(a.labelled, b.labelled);
  EXPECT_GT(a.labelled, 0);
  EXPECT_NEAR(a.semantic, b.semantic, 1e-12);
  for (const Tensor<double>& t : hard.pipeline->store().all()) {
    const Tensor<double>* other = soft.pipeline->store().find(t.name);
    for (std::int64_t i = 0; i < t.size() && t.learned(); ++i)
      ASSERT_NEAR(t.grad.data()[i], other->grad.data()[i], 1e-12) << t.name;
  }
  // Half of each label moved to another class: another loss, another gradient.
  label_with(0.5F, 0.5F);
  const StepLosses c = soft.gradients();
  EXPECT_EQ(c.labelled, a.labelled);
  EXPECT_NE(c.semantic, a.semantic);
}

TEST(Parity, LanesAndTilesOnlyChangeTheOrderOfSums) {
  expect_same_gradients(two_pass_config("runtime: {lanes: 1, tile_rays: 64}\n"),
                        two_pass_config("runtime: {lanes: 3, tile_rays: 4}\n"));
  const std::string hash = replaced(
      hash_config(), "{type: occupancy_grid, resolution: 32, warmup_steps: 32, max_samples: 96, keep_last: true}",
      "{type: stratified, samples: 24}");
  expect_same_gradients(hash + "runtime: {lanes: 1, tile_rays: 192}\n", hash + "runtime: {lanes: 5, tile_rays: 8}\n");
}

// What networks of layers save: Mlp of tests/plugin.
TEST(Parity, DeferredClassLayer) {
  expect_same_gradients(two_pass_config(), two_pass_config("runtime: {deferred_class_layer: false}\n"));
}

// Matter so dense that most samples lie in the dark, which hides nothing but rounding.
TEST(Parity, SamplesThatLightDoesNotReachAreLeftOut) {
  const std::string all = replaced(hash_config(), "rendering: {", "rendering: {density_bias: 15, unit_m: 0.25, ");
  const std::string reached = replaced(all, "rendering: {", "rendering: {training_stop: 1e-14, ");
  expect_same_gradients(reached, all);
  Oracle few(reached), many(all);
  const std::int64_t samples = few.gradients().samples;
  EXPECT_GT(samples, 0);
  EXPECT_LT(2 * samples, many.gradients().samples);
}

TEST(PipelineGradient, OfBothNetworksWithSemantics) {
  expect_finite_differences(one_pass_config(), 2e-4);
  expect_finite_differences(stratified_config("type: analytic_room", "", "rays: 24"), 2e-4);
}

TEST(Parity, StoppedSemanticGradientLeavesTheDensityLayerAlone) {
  const std::string stop = replaced(one_pass_config(), "weight: 0.5", "weight: 0.5, stop_gradient_to_density: true");
  Oracle stopped(stop), flowing(one_pass_config());
  Oracle none(with_scene(one_pass_config(), "{type: analytic_room, with_labels: false}"));
  ASSERT_FALSE(none.pipeline->has_semantics());
  stopped.gradients();
  none.gradients();
  flowing.gradients();
  const auto density_gradient = [](Oracle& o) {
    const Tensor<double>* t = o.pipeline->store().find("main/field/density/bias");
    EXPECT_NE(t, nullptr);
    return t == nullptr ? NAN : t->grad.data()[0];
  };
  EXPECT_EQ(density_gradient(stopped), density_gradient(none));
  EXPECT_NE(density_gradient(flowing), density_gradient(none));
}

std::string frequency_config(const std::string& semantics, const std::string& rendering, int rays, int samples,
                             const std::string& field, const std::string& precision) {
  return "scene: {type: analytic_room}\nsemantics: {" + semantics + "}\nrendering: {" + rendering +
         "}\ntrain: {rays: " + std::to_string(rays) +
         "}\npasses:\n  - sampler: {type: stratified, samples: " + std::to_string(samples) +
         "}\n    position: {type: frequency, frequencies: 3}\n" +
         "    direction: {type: frequency, frequencies: 2}\n    field: " + field +
         "\nruntime: {device: cpu, precision: " + precision + "}\n";
}

// Widths that are multiples of 32 hand the feature on in bf16, 24 and 16 in full.
TEST(Parity, GradientsInBf16AreTheOraclesWithinItsPrecision) {
  for (const std::string field : {"{type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 24}",
                                  "{type: nerf_mlp, depth: 2, width: 24, skip_at: 0, view_width: 32}",
                                  "{type: tiny_mlp, hidden_width: 64, color_width: 24}",
                                  "{type: tiny_mlp, hidden_width: 24, feature: geometry}"}) {
    const auto yaml = [&](const std::string& precision) {
      return frequency_config("hidden_width: 32, weight: 3", "density_activation: softplus", 48, 24, field, precision);
    };
    Oracle oracle(yaml("fp32"));
    oracle.gradients();
    Session rounded = open_text(yaml("bf16"));
    ParamStore<float>& store = rounded.pipeline->store();
    rounded.pipeline->derive(3);
    const StepLosses losses = rounded.pipeline->lanes().gradients(3, oracle.batch.view(true));
    EXPECT_GT(losses.labelled, 0);
    int compared = 0;
    for (const Tensor<double>& t : oracle.pipeline->store().all()) {
      if (!t.learned()) continue;
      const Tensor<float>* other = store.find(t.name);
      ASSERT_NE(other, nullptr) << t.name;
      double difference = 0, size = 0;
      for (std::int64_t i = 0; i < t.size(); ++i) {
        difference += std::pow(static_cast<double>(other->grad.data()[i]) - t.grad.data()[i], 2);
        size += std::pow(t.grad.data()[i], 2);
      }
      EXPECT_LT(std::sqrt(difference), 0.03 * std::sqrt(size)) << field << ", " << t.name;
      ++compared;
    }
    EXPECT_GE(compared, 12) << field;
  }
}

/// Colour and logits of the batch's rays, as rendering makes them.
std::vector<float> rendered(Session& session, const BatchBuffers& batch) {
  Workspace arena;
  StepContext ctx{.seed = session.pipeline->options().seed, .workspace = &arena};
  const RayBatch rows = batch.view(true);
  const Pass<float>& pass = session.pipeline->passes().front();
  const PassTrace<float> trace =
      pass.forward(ctx, kMainGradient, {rows.origin, rows.direction, rows.near_far}, nullptr, 0, {rows.origin.rows});
  std::vector<float> values(trace.color.data, trace.color.data + trace.color.size());
  values.insert(values.end(), trace.semantic.rows.data, trace.semantic.rows.data + trace.semantic.rows.size());
  return values;
}

// Rays that may stop early take their samples in rounds, and hand hidden activations on from each, in bf16 too.
TEST(Parity, RoundsOfRenderingGiveWhatOneEvaluationGives) {
  for (const std::string precision : {"fp32", "bf16"}) {
    const auto open = [&](const std::string& stop) {
      const std::string rendering = "density_activation: softplus, early_stop: " + stop;
      return open_text(
          frequency_config("hidden_width: 32", rendering, 24, 40, "{type: tiny_mlp, hidden_width: 64}", precision));
    };
    Session rounds = open("1e-12"), whole = open("0");
    rounds.pipeline->derive(0);
    whole.pipeline->derive(0);
    BatchBuffers batch;
    rounds.make_ray_source()->fill(3, batch);
    const std::vector<float> a = rendered(rounds, batch), b = rendered(whole, batch);
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) ASSERT_NEAR(a[i], b[i], 1e-6) << precision << ", value " << i;
  }
}

// The field at points: what rays are made of, in float64 too, the same bits in any grouping.

std::vector<Vec3d> points_in(const Box& box, int count) {
  std::vector<Vec3d> out;
  const RandomAddress address{1, 0, stream_id("test/points")};
  for (int i = 0; i < count; ++i) {
    Vec3d p;
    for (int axis = 0; axis < 3; ++axis)
      p[axis] = box.lo[axis] + (box.hi[axis] - box.lo[axis]) *
                                   static_cast<double>(uniform01(address, static_cast<std::uint64_t>(3 * i + axis)));
    out.push_back(p);
  }
  return out;
}

std::vector<Vec3d> directions(std::size_t count) {
  std::vector<Vec3d> out;
  for (std::size_t i = 0; i < count; ++i) {
    const double a = 0.7 * static_cast<double>(i), z = std::sin(1.3 * static_cast<double>(i));
    out.push_back({std::cos(a) * std::sqrt(1 - z * z), std::sin(a) * std::sqrt(1 - z * z), z});
  }
  return out;
}

FieldPoints ask(const Session& s, const std::vector<Vec3d>& places, const std::vector<Vec3d>& seen) {
  return field_at(*s.pipeline, places, seen, s.limits, s.plan.class_of_logit, s.classes());
}

// A ray is the sum over its samples, so points show what it renders.
TEST(FieldPoints, AreWhatRaysAreMadeOf) {
  const std::string yaml =
      stratified_config("type: analytic_room", "", "rays: 128, steps: 60, adam: {learning_rate: 0.02}");
  Trainer training(run_config_of(parse_config_text(yaml, "test.yaml"), all_plugins()), all_plugins());
  training.train(60);
  const Session& s = training.session();
  const Pass<float>& pass = s.pipeline->passes().back();
  const FrameInfo& frame = s.scene.info.frames.front();
  for (const std::int32_t column : {3, 11, 20}) {
    std::vector<double> origin(3), direction(3), near_far(2);
    cast_ray({frame.camera, frame.world_from_camera, true}, s.limits, column, 7, origin.data(), direction.data(),
             near_far.data());
    const Rays<float> ray{{origin.data(), 1, 3}, {direction.data(), 1, 3}, {near_far.data(), 1, 2}};
    const StepContext ctx = s.pipeline->lanes().context(0, false);
    const Workspace::Scope scope(*ctx.workspace);
    const std::int64_t capacity = pass.capacity_per_ray(0, ctx.training);
    Samples<float> samples{.t = ctx.workspace->take<float>(capacity, 1),
                           .delta = ctx.workspace->take<float>(capacity, 1),
                           .ray_of_sample = ctx.workspace->take<std::int32_t>(capacity, 1),
                           .first = ctx.workspace->take<std::int32_t>(2, 1)};
    pass.sample(ctx, ray, nullptr, samples);
    ASSERT_GT(samples.count, 4);
    std::vector<Vec3d> places;
    const Vec3d from{origin[0], origin[1], origin[2]}, along{direction[0], direction[1], direction[2]};
    for (std::int64_t i = 0; i < samples.count; ++i)
      places.push_back(from + along * static_cast<double>(samples.t(i, 0)));
    const FieldPoints points = ask(s, places, std::vector<Vec3d>(places.size(), along));
    double left = 1, distance = 0;
    Vec3d color;
    for (std::size_t i = 0; i < places.size(); ++i) {
      const auto row = static_cast<std::int64_t>(i);
      const bool last = i + 1 == places.size();  // far: background
      const double opacity =
          last ? 1 : 1 - std::exp(-static_cast<double>(points.sigma[i]) * static_cast<double>(samples.delta(row, 0)));
      const double weight = left * opacity;
      left *= 1 - opacity;
      distance += weight * static_cast<double>(samples.t(row, 0));
      for (int c = 0; c < 3; ++c)
        color[c] += weight * static_cast<double>(points.rgb[3 * i + static_cast<std::size_t>(c)]);
    }
    std::vector<float> rendered(3), depth(1);
    RenderJob<float> job{.origin = {origin.data(), 1, 3},
                         .direction = {direction.data(), 1, 3},
                         .near_far = {near_far.data(), 1, 2},
                         .color = {rendered.data(), 1, 3},
                         .depth = {depth.data(), 1, 1}};
    s.pipeline->executor().render(job);
    EXPECT_NEAR(depth[0], distance, 1e-3);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(rendered[c], color[c], 1e-3);
  }
}

TEST(FieldPoints, SameBitsInAnyGroupingAndProbabilitiesAreOnes) {
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Trainer training(run_config_of(parse_config_text(yaml, "test.yaml"), all_plugins()), all_plugins());
    training.train(30);
    const Session& s = training.session();
    const std::vector<Vec3d> places = points_in(s.scene.bounds, 1500), seen = directions(1500);
    const FieldPoints all = ask(s, places, seen);
    const auto classes = static_cast<std::size_t>(s.classes());
    FieldPoints parts;
    for (std::size_t begin = 0; begin < places.size();) {
      const std::size_t end = std::min(places.size(), begin + 1 + begin % 611);
      const auto cut = [&](const std::vector<Vec3d>& from) {
        return std::vector<Vec3d>(from.begin() + static_cast<std::ptrdiff_t>(begin),
                                  from.begin() + static_cast<std::ptrdiff_t>(end));
      };
      const FieldPoints part = ask(s, cut(places), cut(seen));
      for (const auto values :
           {&FieldPoints::sigma, &FieldPoints::rgb, &FieldPoints::probability, &FieldPoints::entropy})
        (parts.*values).insert((parts.*values).end(), (part.*values).begin(), (part.*values).end());
      parts.label.insert(parts.label.end(), part.label.begin(), part.label.end());
      begin = end;
    }
    for (const auto values : {&FieldPoints::sigma, &FieldPoints::rgb, &FieldPoints::probability, &FieldPoints::entropy})
      EXPECT_EQ(all.*values, parts.*values);
    EXPECT_EQ(all.label, parts.label);
    EXPECT_GT(*std::max_element(all.sigma.begin(), all.sigma.end()), 0);
    for (std::size_t i = 0; i < places.size(); ++i) {
      const auto row = all.probability.begin() + static_cast<std::ptrdiff_t>(i * classes);
      double sum = 0;
      for (std::size_t c = 0; c < classes; ++c) sum += static_cast<double>(row[static_cast<std::ptrdiff_t>(c)]);
      ASSERT_NEAR(sum, 1, 1e-5);
      ASSERT_EQ(std::max_element(row, row + static_cast<std::ptrdiff_t>(classes)) - row, all.label[i]);
      ASSERT_NEAR(all.entropy[i], entropy_nats({&*row, classes}), 1e-4);
    }
  }
}

TEST(FieldPoints, NothingIsOutsideTheBoundsAndWhatIsNotFiniteIsRefused) {
  const Session s = open_text(hash_config());
  ASSERT_TRUE(s.limits.clip);
  const Vec3d middle = s.limits.bounds.center();
  const FieldPoints found = ask(s, {middle, middle + Vec3d{100, 0, 0}}, {});
  EXPECT_GT(found.sigma[0], 0);
  EXPECT_EQ(found.sigma[1], 0);
  EXPECT_TRUE(found.rgb.empty());
  EXPECT_TRUE(ask(s, {}, {}).sigma.empty());
  const std::vector<Vec3d> bad{middle, {0, std::numeric_limits<double>::quiet_NaN(), 0}};
  EXPECT_HAS(error_of([&] { (void)ask(s, bad, {}); }), "position 1: (0, nan, 0) is not finite");
}

// Corrections of training cameras: formulas and gradients against finite differences, the mean that stays, and poses
// and colours that are found again.

const std::string kLearned =
    "cameras: {poses: learned, colors: learned, pose_rate: 0.5, color_rate: 0.5, from_step: 0}, ";

std::string learned(std::string yaml, const std::string& cameras = kLearned) {
  return replaced(yaml, "train: {", "train: {" + cameras);
}

void expect_near(Vec3d a, Vec3d b, double tolerance) {
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(a[i], b[i], tolerance) << "axis " << i;
}

// A quarter turn about z, and a small angle by its series.
TEST(CameraMath, RotatesByTheVectorsLength) {
  expect_near(rotated({0, 0, std::acos(0.0)}, {1, 0, 0}), {0, 1, 0}, 1e-15);
  const Vec3d small{3e-5, -2e-5, 1e-5}, v{0.3, -0.5, 0.81};
  expect_near(rotated(small, v), v + cross(small, v) + cross(small, cross(small, v)) * 0.5, 1e-13);
  EXPECT_NEAR(length(rotated({1.2, -2, 0.4}, v)), length(v), 1e-14);
}

TEST(CameraMath, GradientsOfARotationAreThoseOfFiniteDifferences) {
  const Vec3d v{0.3, -0.5, 0.81}, d{1.3, 0.2, -0.7};
  for (const double size : {0.0, 1e-4, 9e-4, 1.1e-3, 0.3, 2.5}) {
    const Vec3d w = Vec3d{0.48, -0.6, 0.64} * size;
    const Vec3d found = rotation_gradient(w, rotated(w, v), d);
    for (int axis = 0; axis < 3; ++axis) {
      Vec3d up = w, down = w;
      up[axis] += 1e-6, down[axis] -= 1e-6;
      EXPECT_NEAR(found[axis], dot(rotated(up, v) - rotated(down, v), d) / 2e-6, 1e-8) << size << " axis " << axis;
    }
  }
}

TEST(CameraMath, GradientsOfTheDomainMapAreThoseOfFiniteDifferences) {
  const Box bounds{{-1, -2, 0}, {2, 1, 2}};
  const Vec3d d{1.3, 0.2, -0.7};
  for (const bool contracted : {false, true}) {
    const DomainMap map = DomainMap::make(Domain::unit_cube, bounds, 0, contracted);
    for (const Vec3d p : {Vec3d{0.4, 0.1, 1.2}, Vec3d{9, -3, 4}, Vec3d{-3, 0.5, 70}, Vec3d{1, -8, 2}}) {
      const Vec3d found = map.gradient(p, d);
      for (int axis = 0; axis < 3; ++axis) {
        Vec3d up = p, down = p;
        up[axis] += 1e-5, down[axis] -= 1e-5;
        EXPECT_NEAR(found[axis], dot(map(up) - map(down), d) / 2e-5, 1e-9) << contracted << " axis " << axis;
      }
    }
  }
}

// `yaml` with another value of the slot of its pass; without that line where there is none.
std::string with_line(std::string yaml, const std::string& slot, const std::string& value = "") {
  const std::string begin = "    " + slot + ": ";
  const std::size_t at = yaml.find(begin), end = yaml.find('\n', at) + 1;
  return yaml.replace(at, end - at, value.empty() ? "" : begin + value + "\n");
}

// A table's encoder, and one that learns nothing. Positions alone: what the view direction says of colours teaches no
// pose, so that neither field sees one here.
TEST(CameraCorrections, GradientsAreThoseOfFiniteDifferences) {
  const std::string tables =
      with_line(stratified_config("type: analytic_room", "", kLearned + "rays: 24"), "direction");
  for (const std::string& yaml : {tables, with_line(tables, "position", "{type: frequency, frequencies: 3}")}) {
    SCOPED_TRACE(yaml);
    Oracle oracle(yaml);
    ASSERT_NE(oracle.pipeline->cameras(), nullptr);
    for (const char* name : {"cameras/pose/learned", "cameras/color/learned"}) {
      Tensor<double>* table = oracle.pipeline->store().find(name);
      ASSERT_NE(table, nullptr) << name;
      for (std::int64_t i = 0; i < table->size(); ++i)
        table->value.data()[i] = 0.02 * std::sin(static_cast<double>(i + 1));
    }
    expect_finite_differences(oracle, 2e-3, "cameras/", 6);
  }
}

TEST(CameraCorrections, TilesAndLanesChangeNoGradient) {
  const std::string yaml = stratified_config("type: analytic_room", "", kLearned + "rays: 24");
  expect_same_gradients(yaml + "runtime: {lanes: 1, tile_rays: 24}\n", yaml + "runtime: {lanes: 3, tile_rays: 4}\n");
}

TEST(CameraCorrections, KeepTheMeanAndAreAbsentWhereNobodyAsks) {
  TestRun run(learned(hash_config()));
  run.to(20);
  for (const char* name : {"cameras/pose/used", "cameras/color/used"}) {
    const Tensor<float>* used = run.store().find(name);
    ASSERT_NE(used, nullptr) << name;
    double largest = 0;
    for (std::int32_t c = 0; c < used->spec.cols; ++c) {
      double sum = 0;
      for (std::int64_t r = 0; r < used->spec.rows; ++r) {
        const double value = used->value.data()[r * used->spec.cols + c];
        sum += value;
        largest = std::max(largest, std::abs(value));
      }
      EXPECT_NEAR(sum, 0, 1e-5) << name << " column " << c;
    }
    EXPECT_GT(largest, 1e-4) << name;
  }
  Session plain = open_text(hash_config());
  EXPECT_EQ(plain.pipeline->cameras(), nullptr);
  EXPECT_EQ(plain.pipeline->store().find("cameras/pose/learned"), nullptr);
}

// Until then the field is fog, whose gradients would move right poses.
TEST(CameraCorrections, MoveAfterTheirShareOfTheRun) {
  TestRun run(learned(hash_config(), "cameras: {poses: learned, from_step: 0.1}, "));
  const Tensor<float>* pose = run.store().find("cameras/pose/learned");
  ASSERT_NE(pose, nullptr);
  const auto moved = [&] {
    return std::any_of(pose->value.data(), pose->value.data() + pose->size(), [](float x) { return x != 0; });
  };
  run.to(run.session.config.train.steps / 10);
  EXPECT_FALSE(moved());
  run.to(run.session.config.train.steps / 10 + 2);
  EXPECT_TRUE(moved());
}

const char* const kAuto = "cameras: {poses: auto, colors: auto}, ";

TEST(CameraChoices, FollowTheEvidence) {
  const auto chosen = [](CameraTrust asked, bool tracked, std::optional<double> exposure,
                         std::optional<bool> fits = {}) {
    CameraParams cameras{.poses = asked, .colors = asked};
    const CameraReasons why = choose_cameras(cameras, {tracked, exposure, fits});
    EXPECT_EQ(why.poses.empty() || why.colors.empty(), asked != CameraTrust::automatic);
    return std::pair{cameras.poses == CameraTrust::learned, cameras.colors == CameraTrust::learned};
  };
  using Both = std::pair<bool, bool>;
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02), (Both{true, false}));
  EXPECT_EQ(chosen(CameraTrust::automatic, false, 1.12), (Both{false, true}));
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02, true), (Both{false, false})) << "photographs fit its poses";
  EXPECT_EQ(chosen(CameraTrust::automatic, true, 1.02, false), (Both{true, false}));
  EXPECT_EQ(chosen(CameraTrust::automatic, false, 1.02, false), (Both{false, false})) << "for prepare to fix";
  EXPECT_EQ(chosen(CameraTrust::automatic, false, {}), (Both{false, false})) << "nothing known";
  EXPECT_EQ(chosen(CameraTrust::given, true, 1.12), (Both{false, false})) << "what is asked for stands";
  EXPECT_EQ(chosen(CameraTrust::learned, false, {}), (Both{true, true}));
}

// What the scene decides is written out, with its reason; --keep brings in what it leaves out.
TEST(CameraChoices, AreSettledWhenASceneIsOpened) {
  const Session phone = open_text(with_scene(learned(hash_config(), kAuto), "{type: analytic_room, tracked: true}"));
  EXPECT_EQ(phone.config.cameras.poses, CameraTrust::learned);
  EXPECT_EQ(phone.config.cameras.colors, CameraTrust::given);
  EXPECT_FALSE(phone.eval_job({}).fit_colors);
  EXPECT_NE(phone.pipeline->store().find("cameras/pose/learned"), nullptr);
  EXPECT_EQ(phone.pipeline->store().find("cameras/color/learned"), nullptr);
  const std::vector<std::string> said = phone.choices();
  EXPECT_EQ(std::count(said.begin(), said.end(),
                       "train.cameras.poses: learned, because poses are a phone's, whose tracker drifts"),
            1);
  const Session exposed = open_text(learned(hash_config(), "cameras: {colors: learned}, "));
  EXPECT_TRUE(exposed.eval_job({}).fit_colors) << "scores have a second PSNR";
  const Session other = open_text(learned(hash_config(), kAuto));
  EXPECT_EQ(other.pipeline->cameras(), nullptr);
  EXPECT_EQ(left_out_row(other, "camera_poses").evidence, "poses are not those of a phone's tracker");
  const Session kept = open_text(learned(hash_config(), kAuto), {"camera_poses"});
  EXPECT_NE(kept.pipeline->store().find("cameras/pose/learned"), nullptr);
  EXPECT_EQ(kept.plan.kept, std::vector<std::string>{"camera_poses"});
}

// An encoder whose tables learn must say that it gives gradients of positions alone: another would write into
// gradients that are not there.
TEST(CameraCorrections, AnEncoderThatCannotIsRefusedByName) {
  Registry registry = make_registry();
  toy::register_into(registry);
  const std::string yaml =
      with_line(stratified_config("type: analytic_room", "", kLearned + "rays: 24"), "position", "{type: toy}");
  EXPECT_HAS(error_of(ErrorKind::config, [&] { (void)open_text(yaml, registry); }),
             "encoder 'toy' has learned tensors and gives no gradient of positions by itself");
}

}  // namespace
}  // namespace semfield
