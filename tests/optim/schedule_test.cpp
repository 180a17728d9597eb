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
  EXPECT_EQ(schedule_factor(params, 12345), std::pow(0.1, 12345.0 / 250000.0)) << "to the bit";
}

TEST(Schedule, TheFactorIsHeldAfterDecaySteps) {
  for (const ScheduleKind kind : {ScheduleKind::exponential, ScheduleKind::cosine}) {
    ScheduleParams params;
    params.kind = kind;
    params.factor = 0.3;
    params.decay_steps = 1000;
    EXPECT_GT(schedule_factor(params, 999), 0.3);
    for (const std::int64_t step : {1000, 1001, 2000, 1000000})
      EXPECT_NEAR(schedule_factor(params, step), 0.3, 1e-15) << step;
  }
}

TEST(Schedule, TheRateIsHeldBeforeItFallsAndWhileItsEndIsUnknown) {
  ScheduleParams params;
  params.decay_steps = 0;
  for (const std::int64_t step : {0, 1, 99999}) EXPECT_EQ(schedule_factor(params, step), 1) << step;
  params.hold_steps = 100;
  params.decay_steps = 300;
  for (const std::int64_t step : {0, 50, 100}) EXPECT_EQ(schedule_factor(params, step), 1) << step;
  EXPECT_NEAR(schedule_factor(params, 200), std::sqrt(0.1), 1e-15);
  EXPECT_NEAR(schedule_factor(params, 300), 0.1, 1e-15);
  params.hold_steps = 300;
  EXPECT_EQ(schedule_factor(params, 300), 1) << "nothing is left to fall in";
  EXPECT_EQ(schedule_factor(params, 301), 0.1);
}

TEST(Schedule, ALegHasItsOwnRateHoldAndEnd) {
  for (const ScheduleKind kind : {ScheduleKind::exponential, ScheduleKind::cosine}) {
    ScheduleParams params;
    params.kind = kind;
    params.decay_steps = 100;
    params.legs = {{150, 0.5, 160, 200, 0}, {300, 0.4, 300, 0, 60}};
    EXPECT_NEAR(schedule_factor(params, 149), 0.1, 1e-15);
    EXPECT_EQ(schedule_factor(params, 150), 0.5);
    EXPECT_EQ(schedule_factor(params, 160), 0.5);
    EXPECT_LT(schedule_factor(params, 161), 0.5);
    EXPECT_GT(schedule_factor(params, 199), 0.1);
    EXPECT_NEAR(schedule_factor(params, 250), 0.1, 1e-15);
    EXPECT_EQ(schedule_factor(params, 300), 0.4);
    EXPECT_EQ(schedule_factor(params, 5000), 0.4) << "its end is not settled";
  }
}

TEST(Schedule, AShareOfTheRunBeginsAtItsStepAndNotBeforeTheRateFalls) {
  ScheduleParams params;
  EXPECT_EQ(step_of_share(0, 0, params), 0);
  EXPECT_EQ(step_of_share(0.2, 100, params), 20);
  EXPECT_EQ(step_of_share(0.201, 100, params), 21);
  EXPECT_GT(step_of_share(0.2, 0, params), 1000000000) << "nobody knows how long the run is";
  params.hold_steps = 30;
  EXPECT_EQ(step_of_share(0.2, 100, params), 30);
  EXPECT_EQ(step_of_share(0.5, 100, params), 50);
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
