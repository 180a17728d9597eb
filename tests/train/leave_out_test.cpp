// What is left out changes no bit of what is kept: pairs of runs, one with the component forced back in.
#include <gtest/gtest.h>

#include <cstring>

#include "core/parallel.h"
#include "tests/train/train_testing.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using namespace testing_train;

struct Trained {
  Session session;
  std::unique_ptr<RaySource> rays;
  std::unique_ptr<Trainer> trainer;
  double loss_color = 0;
};

Trained train(const std::string& yaml, Registry& registry, const std::vector<std::string>& keep, int steps) {
  Trained run{open_text(yaml, registry, keep), nullptr, nullptr, 0};
  run.rays = run.session.make_ray_source();
  run.trainer =
      std::make_unique<Trainer>(*run.session.pipeline, *run.rays, run.session.config.adam, run.session.config.schedule);
  for (int i = 0; i < steps; ++i) run.loss_color = run.trainer->advance().color;
  return run;
}

bool left_out(const Session& s, const std::string& component) {
  for (const LeftOut& row : s.plan.left_out) {
    if (row.component == component) return true;
  }
  return false;
}

// Every tensor that both runs have is bitwise the same.
void expect_shared_tensors_equal(Session& a, Session& b) {
  int shared = 0;
  for (const Tensor<float>& t : a.pipeline->store().all()) {
    const Tensor<float>* other = b.pipeline->store().find(t.name);
    if (other == nullptr || !t.learned()) continue;
    EXPECT_EQ(0, std::memcmp(t.value.data(), other->value.data(), sizeof(float) * static_cast<std::size_t>(t.size())))
        << t.name;
    EXPECT_EQ(0,
              std::memcmp(t.moment2.data(), other->moment2.data(), sizeof(float) * static_cast<std::size_t>(t.size())))
        << t.name;
    ++shared;
  }
  EXPECT_GT(shared, 8);
}

TEST(LeaveOut, UnlabelledRaysAreSkippedBitwise) {
  Registry registry = make_registry();
  const std::string yaml =
      "scene: {type: analytic_room, labels: {frames: 2}}\n" + hash_config().substr(hash_config().find('\n') + 1);
  Trained out = train(yaml, registry, {}, 40);
  Trained kept = train(yaml, registry, {"unlabelled_rays"}, 40);
  ASSERT_TRUE(left_out(out.session, "unlabelled_rays"));
  ASSERT_FALSE(left_out(kept.session, "unlabelled_rays"));
  expect_shared_tensors_equal(out.session, kept.session);
}

TEST(LeaveOut, UndistortionOfAPinholeIsBitwise) {
  Registry registry = make_registry();
  Trained out = train(hash_config(), registry, {}, 20);
  Trained kept = train(hash_config(), registry, {"undistortion"}, 20);
  ASSERT_TRUE(left_out(out.session, "undistortion"));
  expect_shared_tensors_equal(out.session, kept.session);
}

TEST(LeaveOut, CoarsePassBeforeASinglePassSamplerIsBitwise) {
  Registry registry = make_registry();
  std::string yaml = hash_config();
  yaml.insert(yaml.find("  - name: main\n"),
              "  - name: coarse\n"
              "    sampler: {type: stratified, samples: 4}\n"
              "    position: {type: frequency, frequencies: 2}\n"
              "    direction: {type: spherical_harmonics, degree: 2}\n"
              "    field: {type: tiny_mlp, hidden_width: 16, color_width: 16}\n");
  Trained out = train(yaml, registry, {}, 20);
  ASSERT_TRUE(left_out(out.session, "coarse_passes"));
  EXPECT_EQ(out.session.pipeline->store().find("coarse/field/density_0/weight"), nullptr);
  Trained kept = train(yaml, registry, {"coarse_passes"}, 20);
  EXPECT_EQ(kept.session.pipeline->passes().size(), 2U);
  // The tile of rays must be the same for the pair, or the sums have another order.
  ASSERT_EQ(out.session.pipeline->tile_rays(), kept.session.pipeline->tile_rays());
  expect_shared_tensors_equal(out.session, kept.session);
}

TEST(LeaveOut, ASceneWithoutLabelsBuildsNoHead) {
  Registry registry = make_registry();
  std::string yaml = hash_config();
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: analytic_room, with_labels: false}");
  Session s = open_text(yaml, registry);
  EXPECT_TRUE(left_out(s, "semantics"));
  EXPECT_FALSE(s.pipeline->has_semantics());
  for (const Tensor<float>& t : s.pipeline->store().all())
    EXPECT_EQ(t.name.find("semantic"), std::string::npos) << t.name;
}

TEST(LeaveOut, SemanticsWithNoSelectedLabelIsBitwiseTheRunWithAHead) {
  Registry registry = make_registry();
  std::string yaml = hash_config();
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: analytic_room, labels: {frames: none}}");
  Trained out = train(yaml, registry, {}, 40);
  Trained kept = train(yaml, registry, {"semantics"}, 40);
  ASSERT_TRUE(left_out(out.session, "semantics"));
  ASSERT_TRUE(kept.session.pipeline->has_semantics());
  EXPECT_EQ(out.loss_color, kept.loss_color);
  expect_shared_tensors_equal(out.session, kept.session);
}

TEST(LeaveOut, AbsentClassesGetNoLogit) {
  Registry registry = make_registry();
  std::string yaml = hash_config();
  yaml.replace(yaml.find("{type: analytic_room}"), 21, "{type: analytic_room, frames: 4, labels: {frames: 1}}");
  Session s = open_text(yaml, registry);
  int present = 0;
  for (const std::int64_t pixels : s.manifest.train_class_pixels) present += pixels > 0 ? 1 : 0;
  EXPECT_EQ(static_cast<int>(s.plan.class_of_logit.size()), present);
  EXPECT_EQ(s.pipeline->passes().back().parts().head->classes(), present);
}

TEST(LeaveOut, KeepRefusesAnUnknownName) {
  Registry registry = make_registry();
  try {
    open_text(hash_config(), registry, {"undistorsion"});
    FAIL() << "no error";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::usage);
    EXPECT_NE(std::string(error.what()).find("did you mean 'undistortion'?"), std::string::npos) << error.what();
  }
}

}  // namespace
}  // namespace semfield
