// Class probabilities of rays and of whole frames: softmax of composited logits, the same bits in any grouping of rays.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "compute/parallel.h"
#include "eval/evaluator.h"
#include "session/training.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string with_scene(std::string yaml, const std::string& scene) {
  return yaml.replace(yaml.find("{type: analytic_room}"), 21, scene);
}

// Rays through pixels of a session's first frame, row by row.
struct FrameRays {
  FrameRays(const Session& s, std::int64_t rays) : count(rays) {
    const auto size = static_cast<std::size_t>(rays);
    origin.resize(3 * size);
    direction.resize(3 * size);
    near_far.resize(2 * size);
    const FrameInfo& info = s.scene.info.frames.front();
    for (std::size_t k = 0; k < size; ++k) {
      const auto i = static_cast<std::int32_t>(k);
      cast_ray({info.camera, info.world_from_camera, true}, s.limits, i % info.camera.width_px,
               i / info.camera.width_px, &origin[3 * k], &direction[3 * k], &near_far[2 * k]);
    }
  }
  template <class Real>
  RenderJob<Real> job(std::vector<Real>& probability, std::size_t logits) const {
    probability.assign(static_cast<std::size_t>(count) * logits, Real(-1));
    RenderJob<Real> job;
    job.origin = {origin.data(), count, 3};
    job.direction = {direction.data(), count, 3};
    job.near_far = {near_far.data(), count, 2};
    job.probability = {probability.data(), count, static_cast<std::int32_t>(logits)};
    return job;
  }
  std::int64_t count;
  std::vector<double> origin, direction, near_far;
};

TEST(Probability, OfAFrameSumsToOneAndItsLargestIsTheLabelsConfidence) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config(),
                                  with_scene(hash_config(),
                                             "{type: analytic_room, frames: 4, absent_class: 1, labels: "
                                             "{frames: 1}}")}) {
    Training training(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry);
    training.train(40);
    const Session& s = training.session();
    const FrameInfo& info = s.scene.info.frames.front();
    FrameOptions asked;
    asked.probability = true;
    asked.stride = 3;
    const RenderedFrame plain = training.render(info.camera, info.world_from_camera, {3, nullptr});
    const RenderedFrame frame = training.render(info.camera, info.world_from_camera, asked);
    EXPECT_TRUE(plain.probability.empty());
    EXPECT_EQ(plain.rgb, frame.rgb);
    EXPECT_EQ(plain.label, frame.label);
    EXPECT_EQ(plain.entropy, frame.entropy);
    EXPECT_EQ(plain.confidence, frame.confidence);
    const auto classes = static_cast<std::size_t>(s.classes());
    ASSERT_EQ(frame.probability.size(), classes * frame.label.size());
    std::vector<double> mass(classes, 0);
    for (std::size_t i = 0; i < frame.label.size(); ++i) {
      const float* const row = &frame.probability[classes * i];
      ASSERT_NEAR(std::accumulate(row, row + classes, 0.0), 1, 1e-5) << "pixel " << i;
      const float* const best = std::max_element(row, row + classes);
      ASSERT_EQ(best - row, frame.label[i]) << "pixel " << i;
      ASSERT_EQ(*best, frame.confidence[i]) << "pixel " << i;
      for (std::size_t c = 0; c < classes; ++c) mass[c] += static_cast<double>(row[c]);
    }
    const ClassOfLogit& has = s.plan.class_of_logit;
    for (std::size_t c = 0; c < classes; ++c)
      EXPECT_EQ(mass[c] > 0, std::find(has.begin(), has.end(), static_cast<int>(c)) != has.end()) << "class " << c;
    EXPECT_EQ(has.size() < classes, yaml.find("absent_class") != std::string::npos);
  }
}

TEST(Probability, IsTheSameForAnyGroupingOfRays) {
  Registry registry = make_registry();
  Session s = open_text(hash_config(), registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  while (trainer.step() < 60) trainer.advance();
  const FrameRays rays(s, 500);
  const auto render = [&](std::int64_t chunk) {
    std::vector<float> out;
    const RenderJob<float> job = rays.job(out, s.plan.class_of_logit.size());
    for (std::int64_t begin = 0; begin < rays.count; begin += chunk)
      s.pipeline->render(job.rows(begin, std::min(chunk, rays.count - begin)));
    return out;
  };
  const std::vector<float> whole = render(rays.count);
  EXPECT_EQ(std::count(whole.begin(), whole.end(), -1.0F), 0);
  EXPECT_EQ(whole, render(7));
  EXPECT_EQ(whole, render(129));
  set_thread_count(1);
  EXPECT_EQ(whole, render(64));
  set_thread_count(0);
}

// The float pipeline against the same parameters in double, and those against the sum of exponentials of its logits.
TEST(Probability, AgreesWithTheOracleInDouble) {
  Registry registry = make_registry();
  Session s = open_text(two_pass_config(), registry);
  const auto source = s.make_ray_source();
  Trainer trainer(*s.pipeline, *source, s.config.adam, s.config.schedule);
  while (trainer.step() < 600) trainer.advance();
  const auto oracle = assemble<double>(s.config, registry, s.plan, s.extent, {}, true);
  for (Tensor<double>& t : oracle->store().all()) {
    const Tensor<float>* const from = s.pipeline->store().find(t.name);
    ASSERT_NE(from, nullptr) << t.name;
    std::copy_n(from->value.data(), t.value.size(), t.value.data());
  }
  oracle->derive(600);
  const FrameRays rays(s, 300);
  const std::size_t logits = s.plan.class_of_logit.size();
  std::vector<float> found;
  std::vector<double> wanted, entropy(300);
  s.pipeline->render(rays.job(found, logits));
  RenderJob<double> job = rays.job(wanted, logits);
  job.entropy = {entropy.data(), rays.count, 1};
  oracle->render(job);
  double widest = 0, of_rows = 0;
  for (std::size_t i = 0; i < found.size(); ++i) {
    ASSERT_NEAR(static_cast<double>(found[i]), wanted[i], 1e-4) << "ray " << i / logits << ", logit " << i % logits;
    widest = std::max(widest, wanted[i]);
  }
  EXPECT_GT(widest, 0.5) << "rows that are nearly even would show little";
  for (std::size_t r = 0; r < entropy.size(); ++r) {
    of_rows = 0;
    for (std::size_t k = 0; k < logits; ++k) of_rows -= wanted[logits * r + k] * std::log(wanted[logits * r + k]);
    ASSERT_NEAR(of_rows, entropy[r], 1e-12) << "ray " << r;
  }
}

}  // namespace
}  // namespace semfield
