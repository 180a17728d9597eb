// Degradations on Replica frames, where they are at hand: the figures that the page of experiments states.
#include "datasets/replica/replica.h"
#include "loading/frame_source.h"
#include "tests/labels/degradation_testing.h"

namespace semfield {
namespace {

using namespace testing_degrade;

TEST(DegradationRealData, ReplicaApartment) {
  const std::string root = std::string(SEMFIELD_SOURCE_DIR) + "/../shared/data/replica_apartment0";
  if (!std::filesystem::exists(root)) GTEST_SKIP() << "the optional Replica frames are not at hand";
  ReplicaParams p;
  p.root = root;
  p.train_step = 2;
  p.test_step = 2;
  p.test_offset = 1;
  Replica replica(p, {});
  Diagnostics d;
  SceneLoadOptions o;
  o.width_px = 160;
  o.with_instances = true;
  Case clean;
  clean.scene = load_scene(replica, o, d);
  ASSERT_FALSE(d.has_errors());
  clean.labels.resize(clean.scene.frames.size());
  for (const int f : clean.scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    clean.labels[i].hard = clean.scene.frames[i].label.expand();
  }
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    Case c = clean;
    const double right =
        std::stod(fact(c.apply(*step("simulated_predictions", "{output: hard}"), seed), "pixel accuracy"));
    EXPECT_GT(right, 0.785);
    EXPECT_LT(right, 0.82);
  }
  Case noisy = clean;
  const StepFacts facts = noisy.apply(*step("pixel_noise", "{ratio: 0.9}"));
  EXPECT_EQ(fact(facts, "pixels drawn"), std::to_string(35 * 160 * 160 * 9 / 10));
  EXPECT_EQ(fact(facts, "classes drawn from, beside void"), "29") << "of the table's 101";
  Case chairs = clean;
  const StepFacts flipped = chairs.apply(*step("region_noise", "{classes: [chair], ratio: 0.5}"));
  EXPECT_EQ(fact(flipped, "pixels changed"), fact(flipped, "pixels of flipped regions"));
  EXPECT_GT(std::stoi(fact(flipped, "views flipped")), 5);
}

}  // namespace
}  // namespace semfield
