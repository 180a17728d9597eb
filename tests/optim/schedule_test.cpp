// Learning-rate schedules at their corners.
#include "optim/schedule.h"

#include <gtest/gtest.h>

#include <cmath>

namespace semfield {
namespace {

TEST(Schedule, Exponential) {  // E07
  const ScheduleParams params;
  EXPECT_EQ(schedule_factor(params, 0), 1);
  EXPECT_NEAR(schedule_factor(params, 125000), std::sqrt(0.1), 1e-12);
  EXPECT_NEAR(schedule_factor(params, 250000), 0.1, 1e-13);
  EXPECT_NEAR(schedule_factor(params, 250001), 0.1 * std::pow(0.1, 4e-6), 1e-13);
  EXPECT_NEAR(schedule_factor(params, 500000), 0.01, 1e-13);
}

TEST(Schedule, CosineEndsAtTheFactorAndStays) {
  ScheduleParams params;
  params.kind = ScheduleKind::cosine;
  params.decay_steps = 1000;
  EXPECT_EQ(schedule_factor(params, 0), 1);
  EXPECT_NEAR(schedule_factor(params, 500), 0.55, 1e-12);
  EXPECT_NEAR(schedule_factor(params, 1000), 0.1, 1e-12);
  EXPECT_NEAR(schedule_factor(params, 1001), 0.1, 1e-12);
}

TEST(Schedule, WarmUpRisesFromOneStep) {
  ScheduleParams params;
  params.kind = ScheduleKind::constant;
  params.warmup_steps = 4;
  EXPECT_EQ(schedule_factor(params, 0), 0.25);
  EXPECT_EQ(schedule_factor(params, 3), 1);
  EXPECT_EQ(schedule_factor(params, 4), 1);
  EXPECT_EQ(schedule_factor(params, 1000000), 1);
}

}  // namespace
}  // namespace semfield
