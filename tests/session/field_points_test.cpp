// The field at points: what rays are made of, in float64 too, the same bits in any grouping.
#include "eval/field_points.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "core/rng.h"
#include "execution/lane_executor.h"
#include "execution/point_query.h"
#include "session/training.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

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

TEST(FieldPoints, FloatAgreesWithDouble) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Oracle oracle(yaml, registry);
    oracle.pipeline->derive(0);
    const Session& s = oracle.session;
    const std::vector<Vec3d> places = points_in(s.scene.bounds, 200), seen = directions(200);
    const auto logits = static_cast<std::int32_t>(s.plan.class_of_logit.size());
    struct Answers {
      std::vector<double> sigma, color, logits;
    };
    const auto answers = [&]<class Real>(Pipeline<Real>& pipeline) {
      std::vector<Real> sigma(200), color(600), values(200 * static_cast<std::size_t>(logits));
      PointQuery<Real> query;
      query.position = {&places.data()->x, 200, 3};
      query.direction = {&seen.data()->x, 200, 3};
      query.sigma = {sigma.data(), 200, 1};
      query.color = {color.data(), 200, 3};
      query.logits = {values.data(), 200, logits};
      query_points(pipeline, query);
      return Answers{{sigma.begin(), sigma.end()}, {color.begin(), color.end()}, {values.begin(), values.end()}};
    };
    const Answers single = answers(*s.pipeline), exact = answers(*oracle.pipeline);
    const auto near = [](const std::vector<double>& a, const std::vector<double>& b) {
      double largest = 1e-6;
      for (const double v : b) largest = std::max(largest, std::abs(v));
      for (std::size_t i = 0; i < a.size(); ++i) ASSERT_NEAR(a[i], b[i], 1e-4 * largest) << i;
    };
    near(single.sigma, exact.sigma);
    near(single.color, exact.color);
    near(single.logits, exact.logits);
  }
}

// A ray is the sum over its samples, so points tell what it renders.
TEST(FieldPoints, AreWhatRaysAreMadeOf) {
  Registry registry = make_registry();
  const std::string yaml =
      stratified_config("type: analytic_room", "", "rays: 128, steps: 60, adam: {learning_rate: 0.02}");
  Training training(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry);
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
    const std::int64_t capacity = pass.capacity_per_ray(0);
    Samples<float> samples;
    samples.t = ctx.workspace->take<float>(capacity, 1);
    samples.delta = ctx.workspace->take<float>(capacity, 1);
    samples.ray_of_sample = ctx.workspace->take<std::int32_t>(capacity, 1);
    samples.first = ctx.workspace->take<std::int32_t>(2, 1);
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
    RenderJob<float> job;
    job.origin = {origin.data(), 1, 3};
    job.direction = {direction.data(), 1, 3};
    job.near_far = {near_far.data(), 1, 2};
    job.color = {rendered.data(), 1, 3};
    job.depth = {depth.data(), 1, 1};
    s.pipeline->render(job);
    EXPECT_NEAR(depth[0], distance, 1e-3);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(rendered[static_cast<std::size_t>(c)], color[c], 1e-3);
  }
}

TEST(FieldPoints, SameBitsInAnyGroupingAndProbabilitiesAreOnes) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Training training(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry);
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
      const auto add = [](auto& to, const auto& more) { to.insert(to.end(), more.begin(), more.end()); };
      add(parts.sigma, part.sigma);
      add(parts.rgb, part.rgb);
      add(parts.label, part.label);
      add(parts.probability, part.probability);
      add(parts.entropy, part.entropy);
      begin = end;
    }
    EXPECT_EQ(all.sigma, parts.sigma);
    EXPECT_EQ(all.rgb, parts.rgb);
    EXPECT_EQ(all.label, parts.label);
    EXPECT_EQ(all.probability, parts.probability);
    EXPECT_EQ(all.entropy, parts.entropy);
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
  Registry registry = make_registry();
  const Session s = open_text(hash_config(), registry);
  ASSERT_TRUE(s.limits.clip);
  const Vec3d middle = s.limits.bounds.center();
  const FieldPoints found = ask(s, {middle, middle + Vec3d{100, 0, 0}}, {});
  EXPECT_GT(found.sigma[0], 0);
  EXPECT_EQ(found.sigma[1], 0);
  EXPECT_TRUE(found.rgb.empty());
  EXPECT_TRUE(ask(s, {}, {}).sigma.empty());
  try {
    (void)ask(s, {middle, {0, std::numeric_limits<double>::quiet_NaN(), 0}}, {});
    ADD_FAILURE() << "a position that is no number";
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what()).find("position 1: (0, nan, 0) is not finite"), std::string::npos)
        << error.what();
  }
}

}  // namespace
}  // namespace semfield
