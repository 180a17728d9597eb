// The model of steps on many devices: its limits, what must grow, and sums that can be done by hand.
#include "studies/scale_model.h"

#include <gtest/gtest.h>

#include <array>
#include <cmath>

#include "core/error.h"

namespace semfield {
namespace {

ScaleSystem chain() { return {"hosts of 4", ScaleExchange::chain, 4, {"near", 2e-6, 5e9}, {"far", 10e-6, 1e9}, 1e6}; }
ScaleSystem all_reduce() {
  return {"hosts of 8", ScaleExchange::all_reduce, 8, {"near", 4e-6, 300e9}, {"far", 10e-6, 11e9}, 1};
}
ScaleSystem free_of_charge(ScaleExchange how) {
  return {"free", how, 4, {"near", 0, INFINITY}, {"far", 0, INFINITY}, 1e6};
}
ScaleStep paper() {
  ScaleStep step;
  step.fixed_s = 0.01;
  step.split_s_per_ray = 7e-3;
  step.gradient_bytes = 5e6;
  return step;
}

TEST(ScaleModel, OneDeviceTakesWhatItTakes) {
  ScaleStep step = paper();
  step.repeated_s_per_ray = 1e-3;
  step.gathered_bytes_per_ray = 4000;
  step.lanes = 48;
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    const ScaleTime time = predict_step(step, system, 1, 100);
    EXPECT_DOUBLE_EQ(time.step_s(), 0.01 + 100 * 8e-3);
    EXPECT_EQ(time.exchange_s, 0);
    EXPECT_DOUBLE_EQ(predict_speedup(step, system, 1, 100, true), 1);
    EXPECT_DOUBLE_EQ(predict_speedup(step, system, 1, 100, false), 1);
  }
}

TEST(ScaleModel, WithoutCostOfExchangeTheSplitPartScalesPerfectly) {
  for (const ScaleExchange how : {ScaleExchange::chain, ScaleExchange::all_reduce}) {
    const ScaleSystem system = free_of_charge(how);
    for (const int devices : {2, 3, 16, 1000}) {
      EXPECT_NEAR(predict_step(paper(), system, devices, 1000).step_s(), 0.01 + 7.0 / devices, 1e-12);
      ScaleStep split = paper();
      split.fixed_s = 0;
      EXPECT_NEAR(predict_speedup(split, system, devices, 1000, true), devices, 1e-9);
      EXPECT_NEAR(predict_speedup(split, system, devices, 1000, false), devices, 1e-9);
    }
  }
}

TEST(ScaleModel, WhatEveryDeviceRepeatsBoundsTheSpeedUp) {
  ScaleStep step;
  step.split_s_per_ray = 9e-3;
  step.repeated_s_per_ray = 1e-3;
  const ScaleSystem system = free_of_charge(ScaleExchange::chain);
  EXPECT_NEAR(predict_speedup(step, system, 1 << 20, 1000, true), 10, 1e-3);
  EXPECT_NEAR(predict_speedup(step, system, 1 << 20, 1000, false), 10, 1e-3);
}

TEST(ScaleModel, AChainTakesItsHopsAndThenTheOtherMessages) {
  // 5 messages of 1 MB: 2 us + 0.2 ms each. 3 hops there, 2 levels back, 4 messages behind the first each time.
  const double each = 2e-6 + 1e6 / 5e9;
  EXPECT_NEAR(sum_seconds(chain(), 4, 5e6), (3 + 4) * each + (2 + 4) * each, 1e-12);
  // On two hosts one hop is a far one, and the others follow at its pace.
  const double far = 10e-6 + 1e6 / 1e9;
  EXPECT_NEAR(sum_seconds(chain(), 8, 5e6), (6 * each + far + 4 * far) + (2 * each + far + 4 * far), 1e-12);
}

TEST(ScaleModel, ARingMovesTwiceTheShareOfAllOthers) {
  const double bytes = 100e6;  // latency does not count
  for (const int devices : {2, 4, 8}) {
    EXPECT_NEAR(sum_seconds(all_reduce(), devices, bytes), 2.0 * (devices - 1) * (4e-6 + bytes / devices / 300e9),
                1e-12);
  }
  // Few bytes on many hosts go by a tree, whose latency grows with the logarithm.
  const double small = sum_seconds(all_reduce(), 1024, 8);
  EXPECT_LT(small, 2 * 7 * 10e-6 + 2 * 7 * 4e-6 + 1e-6);
  EXPECT_GT(small, 2 * 7 * 10e-6);
}

TEST(ScaleModel, GatheredRowsComeFromAllOthers) {
  EXPECT_NEAR(gather_seconds(chain(), 4, 4e6), 3 * (2e-6 + 1e6 / 5e9), 1e-12);
  EXPECT_EQ(gather_seconds(chain(), 1, 4e6), 0);
}

TEST(ScaleModel, MoreBytesSlowerLinksAndMoreDevicesNeverExchangeFaster) {
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    ScaleSystem slower = system;
    slower.inside.bytes_per_s /= 2;
    slower.between.latency_s *= 3;
    double before = 0;
    for (int devices = 2; devices <= 1024; devices *= 2) {
      const double now = sum_seconds(system, devices, 5e6);
      EXPECT_GE(now, before) << devices;
      EXPECT_GE(sum_seconds(system, devices, 6e6), now) << devices;
      EXPECT_GT(sum_seconds(slower, devices, 5e6), now) << devices;
      before = now;
    }
  }
}

TEST(ScaleModel, NoSpeedUpAboveTheNumberOfDevices) {
  for (const ScaleSystem& system : {chain(), all_reduce()}) {
    for (int devices = 1; devices <= 1024; ++devices) {
      for (const bool strong : {true, false})
        EXPECT_LE(predict_speedup(paper(), system, devices, 1024, strong), devices * (1 + 1e-12));
    }
  }
}

TEST(ScaleModel, LanesAreDealtOutWhole) {
  ScaleStep step;
  step.split_s_per_ray = 1e-3;
  step.lanes = 48;
  EXPECT_DOUBLE_EQ(largest_share(step, 16), 3.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 32), 2.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 48), 1.0 / 48);
  EXPECT_DOUBLE_EQ(largest_share(step, 1024), 1.0 / 48);
  const ScaleSystem system = free_of_charge(ScaleExchange::chain);
  EXPECT_NEAR(predict_speedup(step, system, 1024, 1000, true), 48, 1e-9);
  EXPECT_EQ(scale_limits(step, system, 1000, true, 1024).fastest, 48);
  EXPECT_EQ(scale_limits(step, system, 1000, true, 1024).half_efficient, 96);
}

TEST(ScaleModel, OverlapHidesNoMoreThanThereIsToDo) {
  ScaleStep step = paper();
  const ScaleSystem system = chain();
  const ScaleTime open = predict_step(step, system, 4, 1000);
  EXPECT_DOUBLE_EQ(open.exposed_s, open.exchange_s);
  step.overlapped_share = 0.5;
  step.hiding_share = 0.5;
  const ScaleTime hidden = predict_step(step, system, 4, 1000);  // 0.9 s of work over some ms
  EXPECT_NEAR(hidden.exposed_s, sum_seconds(system, 4, 2.5e6), 1e-12);
  step.split_s_per_ray = 1e-9;
  const ScaleTime nothing_to_do = predict_step(step, system, 4, 1000);
  EXPECT_NEAR(nothing_to_do.exposed_s, nothing_to_do.exchange_s, 1e-6);
  EXPECT_LT(nothing_to_do.exposed_s, nothing_to_do.exchange_s);
}

TEST(ScaleModel, LimitsAreThoseOfEveryNumberOfDevices) {
  const ScaleLimits limits = scale_limits(paper(), chain(), 1024, true, 200);
  for (int devices = 1; devices <= 200; ++devices) {
    const double speedup = predict_speedup(paper(), chain(), devices, 1024, true);
    const double best = predict_speedup(paper(), chain(), limits.fastest, 1024, true);
    EXPECT_LE(0.99 * speedup, best) << devices;
    if (devices < limits.fastest) {
      EXPECT_LT(speedup, best) << devices;
    }
    if (devices > limits.half_efficient) {
      EXPECT_LT(speedup, 0.5 * devices) << devices;
    }
  }
  EXPECT_GE(predict_speedup(paper(), chain(), limits.half_efficient, 1024, true), 0.5 * limits.half_efficient);
}

TEST(ScaleModel, AFitFindsTheCostThatMadeTheSamples) {
  std::vector<ScaleSample> samples;
  for (const double rays : {16.0, 256.0, 1024.0}) samples.push_back({rays, 0.02 + 5e-3 * rays});
  const ScaleStep step = fit_step(samples);
  EXPECT_NEAR(step.fixed_s, 0.02, 1e-9);
  EXPECT_NEAR(step.split_s_per_ray, 5e-3, 1e-12);
}

TEST(ScaleModel, AFitIsNeverNegative) {
  const std::array<ScaleSample, 2> more_than_linear{{{100, 0.5}, {200, 2}}};
  const ScaleStep none_fixed = fit_step(more_than_linear);
  EXPECT_EQ(none_fixed.fixed_s, 0);
  EXPECT_GT(none_fixed.split_s_per_ray, 0.5 / 100);
  EXPECT_LT(none_fixed.split_s_per_ray, 2.0 / 200);
  const std::array<ScaleSample, 2> falling{{{100, 2}, {200, 1}}};
  const ScaleStep all_fixed = fit_step(falling);
  EXPECT_EQ(all_fixed.split_s_per_ray, 0);
  EXPECT_GT(all_fixed.fixed_s, 1);
  EXPECT_LT(all_fixed.fixed_s, 2);
  const std::array<ScaleSample, 1> one{{{100, 2}}};
  EXPECT_DOUBLE_EQ(fit_step(one).split_s_per_ray, 0.02);
  EXPECT_EQ(fit_step(one).fixed_s, 0);
  EXPECT_THROW(fit_step({}), Error);
}

TEST(ScaleModel, WhatIsRepeatedIsFoundFromTwoRanks) {
  ScaleStep truth;
  truth.fixed_s = 1e-3;
  truth.split_s_per_ray = 2e-5;
  truth.repeated_s_per_ray = 1e-5;
  truth.gradient_bytes = 1e5;
  truth.gathered_bytes_per_ray = 4560;
  const ScaleSample two{1024, predict_step(truth, chain(), 2, 1024).step_s()};
  ScaleStep known = truth;  // what one rank tells: not who repeats what
  known.split_s_per_ray = 3e-5;
  known.repeated_s_per_ray = 0;
  const ScaleStep found = with_repeated(known, chain(), 2, two);
  EXPECT_NEAR(found.repeated_s_per_ray, 1e-5, 1e-10);
  EXPECT_NEAR(found.split_s_per_ray, 2e-5, 1e-10);
  EXPECT_EQ(with_repeated(known, chain(), 2, {1024, 1e-6}).repeated_s_per_ray, 0);     // faster than can be
  EXPECT_DOUBLE_EQ(with_repeated(known, chain(), 2, {1024, 1e6}).split_s_per_ray, 0);  // slower than can be
}

TEST(ScaleModel, NoDevicesAndNoRaysAreRefused) {
  EXPECT_THROW(predict_step(paper(), chain(), 0, 10), Error);
  EXPECT_THROW(predict_step(paper(), chain(), 2, 0), Error);
  EXPECT_THROW(predict_step(paper(), chain(), 2, NAN), Error);
}

}  // namespace
}  // namespace semfield
