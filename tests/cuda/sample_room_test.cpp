// Room for samples on a device: how it follows what steps use, and that a step with too little of it is made again.
#include "cuda/steps/sample_room.h"

#include <gtest/gtest.h>

#include <cmath>

#include "cuda/stream_executor.h"
#include "session/trainer.h"
#include "tests/cuda/device_fixture.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;
using cuda::SampleRoom;

TEST(SampleRoom, FollowsWhatStepsUseWithAQuarterToSpare) {
  constexpr std::int64_t kMost = 8192 * 1024;
  SampleRoom room;
  room.begin(kMost);
  EXPECT_EQ(room.rows(), 0);
  EXPECT_FALSE(room.saw(kMost));
  EXPECT_EQ(room.rows(), 0);
  EXPECT_TRUE(room.saw(200'000));
  const std::int64_t first = room.rows();
  EXPECT_GE(first, 250'000);
  EXPECT_LE(first, 285'000);
  EXPECT_FALSE(room.saw(180'000));  // hardly less
  EXPECT_FALSE(room.saw(230'000));
  EXPECT_EQ(room.rows(), first);
  EXPECT_TRUE(room.saw(first - 1000));  // the next step might need more
  EXPECT_GT(room.rows(), first);
  EXPECT_TRUE(room.saw(100));
  EXPECT_EQ(room.rows(), 8192);
  EXPECT_TRUE(room.saw(kMost - 1));
  EXPECT_EQ(room.rows(), 0);
}

TEST(SampleRoom, OfASamplerThatUsesItAllIsNeverLess) {
  SampleRoom room;
  room.begin(0);
  EXPECT_FALSE(room.saw(10));
  EXPECT_EQ(room.rows(), 0);
}

std::string roomy_config() {
  std::string yaml = hash_config();
  return yaml.replace(yaml.find("max_samples: 96"), 15, "max_samples: 512, step_m: 0.1");
}

struct Subject {
  Subject(const std::string& more, Registry& registry)
      : session(open_text(roomy_config() + "runtime: {device: cuda" + more + "}\n", registry)) {}
  SampleRoom& room() { return dynamic_cast<cuda::StreamExecutor&>(session.pipeline->executor()).sample_room(); }
  std::uint32_t bits() {
    trainer.collect();
    return fingerprint(session.pipeline->store());
  }

  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
};

// Several steps are queued; room is short from the first, and later ones change nothing until it is made again.
TEST(CudaSampleRoom, AStepWithTooLittleIsMadeAgainToTheSameBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject plain(", deterministic: true", registry), limited(", deterministic: true", registry);
  for (const std::int64_t given : {64, 300}) {
    limited.room().give(given);
    const std::span<const StepLosses> a = plain.trainer.advance_many(2);
    const std::vector<StepLosses> want(a.begin(), a.end());
    const std::span<const StepLosses> got = limited.trainer.advance_many(2);
    ASSERT_EQ(got.size(), want.size());
    for (std::size_t i = 0; i < got.size(); ++i) {
      EXPECT_GT(want[i].samples, 8 * given);
      EXPECT_EQ(got[i].samples, want[i].samples);
      EXPECT_EQ(got[i].total, want[i].total);
    }
    EXPECT_EQ(limited.trainer.step(), plain.trainer.step());
    EXPECT_EQ(limited.bits(), plain.bits());
    EXPECT_EQ(limited.room().rows(), 0);
  }
}

TEST(CudaSampleRoom, ShrinksWhereMostIsUnusedAndTrainingGoesOn) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject run(", precision: bf16", registry), exact(", precision: bf16, deterministic: true", registry);
  double color = 0, same = 0;
  while (run.trainer.step() < 160) {
    for (const StepLosses& losses : run.trainer.advance_many(160 - run.trainer.step())) color = losses.color;
    for (const StepLosses& losses : exact.trainer.advance_many(run.trainer.step() - exact.trainer.step()))
      same = losses.color;
  }
  EXPECT_GT(run.room().rows(), 0);
  EXPECT_LT(run.room().rows(), 192 * 512);
  EXPECT_EQ(exact.room().rows(), 0);
  EXPECT_LT(std::abs(color - same), 0.3 * same);
}

}  // namespace
}  // namespace semfield
