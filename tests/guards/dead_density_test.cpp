// A density that is 0 everywhere gets no gradient: the run says so within 200 steps, and no healthy run does.
#include <gtest/gtest.h>

#include <cstdio>

#include "tests/guards/poison.h"

namespace semfield {
namespace {

using namespace testing_guards;

std::string relu_yaml(int seed, const char* bias) {
  return "scene: {type: analytic_room, frames: 4, width_px: 16, height_px: 12, with_labels: false}\n"
         "rendering: {density_activation: relu, density_bias: " +
         std::string(bias) +
         "}\n"
         "passes:\n"
         "  - name: main\n"
         "    sampler: {type: stratified, samples: 6}\n"
         "    position: {type: frequency, frequencies: 2}\n"
         "    direction: {type: frequency, frequencies: 1}\n"
         "    field: {type: nerf_mlp, depth: 2, width: 8, skip_at: 0, view_width: 8}\n"
         "runtime: {seed: " +
         std::to_string(seed) +
         "}\n"
         "train: {steps: 200, rays: 16}\n";
}

struct Course {
  std::string message;
  std::int64_t stopped_at = -1;
  StepLosses last;
};

Course run(const std::string& yaml, Registry& registry, int steps) {
  Subject subject(yaml, registry, 0);
  Course course;
  for (int i = 0; i < steps && course.message.empty(); ++i) {
    const Snapshot before(subject);
    try {
      course.last = subject.trainer->advance();
    } catch (const Error& error) {
      course.message = error.what();
      course.stopped_at = subject.trainer->step();
      EXPECT_TRUE(Snapshot(subject) == before);
    }
  }
  return course;
}

// Seeds 0..99 with a start below zero: none has density anywhere.
TEST(DeadDensity, EverySeedIsStoppedWithin200Steps) {
  Registry registry = testing_train::make_registry();
  int stopped = 0, recovered = 0;
  for (int seed = 0; seed < 100; ++seed) {
    const Course course = run(relu_yaml(seed, "-2"), registry, 200);
    if (course.message.empty()) {
      recovered += course.last.dense_passes == 1 ? 1 : 0;
      continue;
    }
    EXPECT_NE(course.message.find("pass 'main' had no density at any sample of the last 100 steps"), std::string::npos)
        << course.message;
    EXPECT_NE(course.message.find("set rendering.density_activation to softplus"), std::string::npos);
    EXPECT_LT(course.stopped_at, 200);
    ++stopped;
  }
  std::printf("seeds stopped: %d, recovered: %d of 100\n", stopped, recovered);
  EXPECT_EQ(stopped + recovered, 100);
  EXPECT_GT(stopped, 90) << "the start was meant to be dead";
}

// Without a bias the seed decides. Whoever has no density is stopped; whoever has some is let alone.
TEST(DeadDensity, AnOpenStartIsStoppedOnlyWhenItDies) {
  Registry registry = testing_train::make_registry();
  int stopped = 0;
  for (int seed = 0; seed < 100; ++seed) {
    const Course course = run(relu_yaml(seed, "0"), registry, 200);
    stopped += course.message.empty() ? 0 : 1;
    if (course.message.empty()) {
      EXPECT_EQ(course.last.dense_passes, 1U) << "seed " << seed;
    }
  }
  std::printf("seeds stopped without a bias: %d of 100\n", stopped);
  EXPECT_LT(stopped, 100);
}

TEST(DeadDensity, RemediesOfTheMessageRevive) {
  Registry registry = testing_train::make_registry();
  std::string yaml = relu_yaml(3, "-2");
  yaml.replace(yaml.find("activation: relu"), 16, "activation: softplus");
  EXPECT_EQ(run(yaml, registry, 200).message, "");
  EXPECT_EQ(run(relu_yaml(3, "1"), registry, 200).message, "");
}

// Nothing to see and nothing seen: a black scene in front of a black background needs no density.
TEST(DeadDensity, HealthyRunsAreLetAlone) {
  Registry registry = testing_train::make_registry();
  for (const std::string& yaml : {testing_train::hash_config(), testing_train::two_pass_config()}) {
    const Course course = run(yaml, registry, 220);
    EXPECT_EQ(course.message, "");
  }
  std::string unlabelled = testing_train::hash_config();
  unlabelled.replace(unlabelled.find("{type: analytic_room}"), 21, "{type: analytic_room, labels: {frames: none}}");
  EXPECT_EQ(run(unlabelled, registry, 220).message, "");
}

TEST(DeadDensity, AnEmptySceneIsNoFault) {
  Registry registry = testing_train::make_registry();
  Subject subject(relu_yaml(1, "-2"), registry, 0);
  FrameBuffer black;
  black.width_px = 16;
  black.height_px = 12;
  black.rgb.assign(576, 0);
  const StoredFrame stored(black);
  const FrameInfo& info = subject.session.scene.info.frames[0];
  RaySourceOptions options;
  options.train.rays = 16;
  options.tile_rays = subject.session.pipeline->tile_rays();
  const RaySource source({{{info.camera, info.world_from_camera, false}, &stored, nullptr, ""}}, {},
                         subject.session.limits, options);
  Trainer trainer(*subject.session.pipeline, source, subject.session.config.adam, subject.session.config.schedule);
  for (int i = 0; i < 220; ++i) ASSERT_EQ(trainer.advance().dense_passes, 0U);
}

}  // namespace
}  // namespace semfield
