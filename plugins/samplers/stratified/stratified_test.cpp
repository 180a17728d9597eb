// Tests of the stratified sampler: quadrature rules, rounding, spacings, laws; cases B09, B10 and B12 of tests/numerics
// have its strata and limits.
#include "samplers/stratified/stratified.h"

#include <gtest/gtest.h>

#include "testkit/laws.h"

namespace semfield {
namespace {

SamplerBuild room() { return SamplerBuild{.bounds = {{-2, -2, -1}, {3, 2, 2}}, .near_m = 0.1, .far_m = 6}; }

template <class Real>
Stratified<Real> make(std::int64_t samples, Quadrature quadrature, SampleSpacing spacing = SampleSpacing::linear) {
  static const KernelTables tables = [] {
    KernelTables t;
    stratified_kernels(t);
    return t;
  }();
  return Stratified<Real>({samples, quadrature, spacing}, room(), tables);
}

// Rays with given limits; the sampler looks at nothing else.
template <class Real>
struct Batch {
  explicit Batch(std::vector<double> limits, std::int64_t capacity) : near_far(std::move(limits)) {
    rays = static_cast<std::int64_t>(near_far.size()) / 2;
    origin.assign(static_cast<std::size_t>(3 * rays), 0.0);
    direction.assign(static_cast<std::size_t>(3 * rays), 0.0);
    for (std::int64_t r = 0; r < rays; ++r) direction[3 * r] = 1;
    t.resize(static_cast<std::size_t>(capacity));
    delta.resize(t.size());
    ray.resize(t.size());
    first.resize(static_cast<std::size_t>(rays + 1));
    out = {View<Real>(t.data(), capacity, 1), View<Real>(delta.data(), capacity, 1),
           View<std::int32_t>(ray.data(), capacity, 1), View<std::int32_t>(first.data(), rays + 1, 1), 0};
  }
  Rays<Real> view() const {
    return {View<const double>(origin.data(), rays, 3), View<const double>(direction.data(), rays, 3),
            View<const double>(near_far.data(), rays, 2)};
  }
  std::int64_t rays = 0;
  std::vector<double> origin, direction, near_far;
  std::vector<Real> t, delta;
  std::vector<std::int32_t> ray, first;
  Samples<Real> out;
};

StepContext training_at(std::int64_t step) { return StepContext{.seed = 4, .step = step, .training = true}; }

TEST(Stratified, QuadratureRules) {
  for (const bool training : {false, true}) {
    for (const auto rule : {Quadrature::paper, Quadrature::midpoint, Quadrature::stratified_bin}) {
      const auto sampler = make<double>(8, rule);
      Batch<double> batch({1, 5}, 8);
      StepContext ctx = training_at(3);
      ctx.training = training;
      sampler.sample(ctx, {}, batch.view(), nullptr, batch.out);
      for (std::size_t k = 0; k < 8; ++k) {
        if (rule == Quadrature::paper) {
          EXPECT_NEAR(batch.delta[k], (k == 7 ? 5 : batch.t[k + 1]) - batch.t[k], 1e-14);
        } else {
          EXPECT_DOUBLE_EQ(batch.delta[k], 0.5);
        }
        const double centre = 1.25 + 0.5 * static_cast<double>(k);
        if (!training || rule == Quadrature::midpoint) {
          EXPECT_DOUBLE_EQ(batch.t[k], centre);
        } else {
          EXPECT_NE(batch.t[k], centre);
        }
      }
    }
  }
}

// Optical depth of sigma = e^-t over [0, 1], by each rule without jitter: the error's order in 1 / N.
double order_of(Quadrature rule) {
  double error[2];
  for (int i = 0; i < 2; ++i) {
    const std::int64_t n = i == 0 ? 64 : 256;
    const auto sampler = make<double>(n, rule);
    Batch<double> batch({0, 1}, n);
    sampler.sample({}, {}, batch.view(), nullptr, batch.out);
    double tau = 0;
    for (std::size_t k = 0; k < static_cast<std::size_t>(n); ++k) tau += std::exp(-batch.t[k]) * batch.delta[k];
    error[i] = std::abs(tau - (1 - std::exp(-1.0)));
  }
  return std::log(error[0] / error[1]) / std::log(4.0);
}

TEST(Stratified, OrdersOfTheRules) {
  EXPECT_NEAR(order_of(Quadrature::paper), 1, 0.05);
  EXPECT_NEAR(order_of(Quadrature::midpoint), 2, 0.05);
}

TEST(Stratified, DisparityPutsEachSampleIntoItsBinOfDisparity) {
  const auto sampler = make<double>(16, Quadrature::stratified_bin, SampleSpacing::disparity);
  for (std::int64_t step = 0; step < 20; ++step) {
    Batch<double> batch({0.2, 5, 2, 3}, 32);
    sampler.sample(training_at(step), {}, batch.view(), nullptr, batch.out);
    for (std::size_t r = 0; r < 2; ++r) {
      const double near_m = r == 0 ? 0.2 : 2, far_m = r == 0 ? 5 : 3;
      double sum = 0;
      for (std::size_t k = 0; k < 16; ++k) {
        const double s = (1 / batch.t[16 * r + k] - 1 / near_m) / (1 / far_m - 1 / near_m) * 16;
        EXPECT_GE(s, static_cast<double>(k) - 1e-9);
        EXPECT_LE(s, static_cast<double>(k + 1) + 1e-9);
        const double at = static_cast<double>(k) / 16, next = static_cast<double>(k + 1) / 16;
        const auto border = [&](double x) { return 1 / (1 / near_m + x * (1 / far_m - 1 / near_m)); };
        EXPECT_NEAR(batch.delta[16 * r + k], border(next) - border(at), 1e-12);
        sum += batch.delta[16 * r + k];
      }
      EXPECT_NEAR(sum, far_m - near_m, 1e-12) << "the bins fill the ray";
    }
  }
}

TEST(Stratified, DisparityFromTheEyeItselfStaysOnTheRay) {
  for (const auto rule : {Quadrature::paper, Quadrature::midpoint, Quadrature::stratified_bin}) {
    const auto sampler = make<float>(64, rule, SampleSpacing::disparity);
    Batch<float> batch({0, 5}, 64);
    sampler.sample(training_at(1), {}, batch.view(), nullptr, batch.out);
    double before = 0, sum = 0;
    for (std::size_t k = 0; k < 64; ++k) {
      EXPECT_GE(static_cast<double>(batch.t[k]), before);
      EXPECT_GT(batch.delta[k], 0.F);
      before = static_cast<double>(batch.t[k]);
      sum += static_cast<double>(batch.delta[k]);
    }
    EXPECT_LE(before, 5);
    EXPECT_NEAR(sum, rule == Quadrature::paper ? 5 - static_cast<double>(batch.t[0]) : 5, 1e-5);
  }
}

}  // namespace
}  // namespace semfield
