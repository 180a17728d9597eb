// Tests of the importance sampler: inverse CDF at its corners, union with the previous samples, laws.
#include "samplers/importance/importance.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "samplers/importance/importance_math.h"
#include "testkit/laws.h"

namespace semfield {
namespace {

SamplerBuild room() {
  SamplerBuild build;
  build.bounds = {{-2, -2, -1}, {3, 2, 2}};
  build.near_m = 0.1;
  build.far_m = 6;
  return build;
}

template <class Real>
Importance<Real> make(const ImportanceParams& params) {
  static const KernelTables tables = [] {
    KernelTables t;
    importance_kernels(t);
    return t;
  }();
  return Importance<Real>(params, room(), tables);
}

// One ray over [near, far] with previous samples at bin centres.
template <class Real>
struct OneRay {
  OneRay(double near_in, double far_in, std::vector<Real> weights, std::int64_t capacity)
      : near_far{near_in, far_in}, weight(std::move(weights)) {
    const std::size_t n = weight.size();
    for (std::size_t k = 0; k < n; ++k) {
      old_t.push_back(
          static_cast<Real>(near_in + (far_in - near_in) * (static_cast<double>(k) + 0.5) / static_cast<double>(n)));
    }
    old_first = {0, static_cast<std::int32_t>(n)};
    const auto rows = static_cast<std::int64_t>(n);
    old = {View<Real>(old_t.data(), rows, 1),
           View<Real>(old_t.data(), rows, 1),
           {},
           View<std::int32_t>(old_first.data(), 2, 1),
           rows};
    proposal = {&old, View<const Real>(weight.data(), rows, 1)};
    t.resize(static_cast<std::size_t>(capacity));
    delta.resize(t.size());
    ray.resize(t.size());
    out = {View<Real>(t.data(), capacity, 1), View<Real>(delta.data(), capacity, 1),
           View<std::int32_t>(ray.data(), capacity, 1), View<std::int32_t>(first, 2, 1), 0};
  }
  void run(const Importance<Real>& sampler, bool training = false, std::int64_t step = 0) {
    StepContext ctx;
    ctx.seed = 6;
    ctx.step = step;
    ctx.training = training;
    ctx.workspace = &workspace;
    sampler.sample(
        ctx, {},
        {View<const double>(origin, 1, 3), View<const double>(direction, 1, 3), View<const double>(near_far, 1, 2)},
        &proposal, out);
  }
  double origin[3] = {0, 0, 0}, direction[3] = {1, 0, 0}, near_far[2];
  std::vector<Real> weight, old_t, t, delta;
  std::vector<std::int32_t> old_first, ray;
  std::int32_t first[2] = {-1, -1};
  Samples<Real> old, out;
  Proposal<Real> proposal;
  Workspace workspace;
};

ImportanceParams fresh_only(std::int64_t samples) {
  ImportanceParams params;
  params.samples = samples;
  params.keep_previous = false;
  return params;
}

TEST(Importance, ZeroWeightsGiveUniformSamples) {  // B01
  OneRay<float> ray(1, 5, std::vector<float>(13, 0.f), 64);
  ray.run(make<float>(fresh_only(64)));
  ASSERT_EQ(ray.out.count, 64);
  for (int k = 0; k < 64; ++k) EXPECT_NEAR(ray.t[static_cast<std::size_t>(k)], 1 + 4 * (k + 0.5) / 64, 1e-6);
  OneRay<float> none(1, 5, {}, 64);  // an earlier pass that left nothing on this ray
  none.run(make<float>(fresh_only(64)));
  EXPECT_EQ(none.t, ray.t);
}

TEST(Importance, SpikeTakesAllButTheFloor) {  // B02
  std::vector<float> weights(62, 0.f);
  weights[30] = 1;
  const int n = 20000;
  OneRay<float> ray(0, 62, weights, n);
  ImportanceParams params = fresh_only(n);
  params.floor = 0.01;
  ray.run(make<float>(params));
  int outside = 0, at_edge = 0;
  for (const float t : ray.t) {
    outside += t < 30 || t > 31 ? 1 : 0;
    at_edge += std::abs(t - 30) < 1e-3 || std::abs(t - 31) < 1e-3 ? 1 : 0;
  }
  EXPECT_LE(outside, 0.01 * n);
  EXPECT_GE(outside, 0.009 * n);
  EXPECT_LE(at_edge, 0.003 * n);  // 0.2 % of the cell
}

TEST(Importance, SpikesAtBothEndsStayInside) {  // B03
  std::vector<float> weights(16, 0.f);
  weights.front() = weights.back() = 0.5f;
  for (std::int64_t step = 0; step < 100; ++step) {
    OneRay<float> ray(0.1, 0.3, weights, 128);
    ray.run(make<float>(fresh_only(128)), true, step);
    int front = 0;
    for (const float t : ray.t) {
      ASSERT_TRUE(static_cast<double>(t) >= 0.1 && static_cast<double>(t) <= 0.3);
      front += t < 0.2f ? 1 : 0;
    }
    EXPECT_NEAR(front, 64, 1);
  }
}

TEST(Importance, BadWeightIsNamed) {  // B04
  for (const float bad : {std::nanf(""), -1.f, INFINITY}) {
    OneRay<float> ray(0, 1, {0.1f, 0.2f, bad, 0.f}, 8);
    try {
      ray.run(make<float>(fresh_only(8)));
      FAIL() << bad << " was accepted";
    } catch (const Error& e) {
      EXPECT_NE(e.message().find("ray 0, sample 2"), std::string::npos) << e.what();
    }
  }
}

TEST(Importance, EveryUFallsInsideItsCell) {  // B05, B06
  for (const double u : {0.0, 0.5, 1 - 0x1p-24, 1.0}) {
    CdfWalk cell;
    cell.begin = 2;
    cell.end = 3;
    cell.mass = 1 - 1e-7;  // a sum that came out short
    cell.is_last = true;
    EXPECT_TRUE(cell.holds(u));
    EXPECT_GE(cell.point(u), 2);
    EXPECT_LE(cell.point(u), 3);
  }
  CdfWalk inner;
  inner.mass = 0.25;
  EXPECT_TRUE(inner.holds(0.0));
  EXPECT_FALSE(inner.holds(0.25));                                      // the border belongs to the next cell
  OneRay<float> ray(0, 1, std::vector<float>(4096, 1.f / 4096), 8192);  // B06
  ray.run(make<float>(fresh_only(8192)));
  EXPECT_GT(ray.t.back(), 1 - 1.f / 8192);
  EXPECT_LE(ray.t.back(), 1.f);
}

TEST(Importance, FollowsTheInverseOverTheWholeRange) {  // B08
  std::vector<float> weights;
  long double total = 0;
  for (int k = 0; k < 40; ++k) {
    weights.push_back(static_cast<float>(std::pow(10.0, -8 + 8.0 * ((k * 17) % 40) / 39)));
    total += static_cast<long double>(weights.back());
  }
  const ImportanceParams params = fresh_only(500);
  OneRay<float> ray(2, 10, weights, 500);
  ray.run(make<float>(params));
  const auto floor = static_cast<long double>(params.floor);
  std::vector<long double> border{2}, cdf{0};
  for (std::size_t k = 0; k < 40; ++k) {
    border.push_back(
        k == 39 ? 10.0L : 0.5L * (static_cast<long double>(ray.old_t[k]) + static_cast<long double>(ray.old_t[k + 1])));
    cdf.push_back(cdf.back() +
                  (static_cast<long double>(weights[k]) + floor * (border[k + 1] - border[k]) / 8) / (total + floor));
  }
  for (std::size_t j = 0; j < 500; ++j) {
    const long double u = (static_cast<long double>(j) + 0.5L) / 500;
    const auto k = static_cast<std::size_t>(std::upper_bound(cdf.begin() + 1, cdf.end() - 1, u) - cdf.begin() - 1);
    const long double want = border[k] + (u - cdf[k]) / (cdf[k + 1] - cdf[k]) * (border[k + 1] - border[k]);
    EXPECT_NEAR(ray.t[j], static_cast<double>(want), 1e-6 * 8) << j;
  }
}

TEST(Importance, UnionIsSortedAndHoldsThePreviousSamples) {  // B07
  std::vector<double> weights(9, 0.01);
  weights[4] = 0.9;
  for (const auto rule : {Quadrature::paper, Quadrature::midpoint, Quadrature::stratified_bin}) {
    ImportanceParams params;
    params.samples = 32;
    params.quadrature = rule;
    OneRay<double> ray(1, 10, weights, 41);
    ray.run(make<double>(params), true);
    ASSERT_EQ(ray.out.count, 41);
    EXPECT_TRUE(std::is_sorted(ray.t.begin(), ray.t.end()));
    for (const double t : ray.old_t) EXPECT_EQ(std::count(ray.t.begin(), ray.t.end(), t), 1);
    double covered = 0;
    for (const double d : ray.delta) covered += d;
    EXPECT_NEAR(covered, rule == Quadrature::paper ? 10 - ray.t[0] : 9, 1e-12);
  }
  OneRay<float> twins(0, 1, {0.5f, 0.5f}, 6);  // equal distances: a zero interval, still in order
  twins.old_t = {0.25f, 0.25f};
  twins.old.t.data = twins.old_t.data();
  ImportanceParams params;
  params.samples = 4;
  twins.run(make<float>(params));
  EXPECT_TRUE(std::is_sorted(twins.t.begin(), twins.t.end()));
  for (const float d : twins.delta) EXPECT_TRUE(std::isfinite(d) && d >= 0);
}

TEST(Importance, Laws) {
  for (const bool keep : {false, true}) {
    for (const auto rule : {Quadrature::paper, Quadrature::midpoint}) {
      ImportanceParams params;
      params.samples = 20;
      params.keep_previous = keep;
      params.quadrature = rule;
      const auto failures = testkit::sampler_laws(make<float>(params), make<double>(params), room());
      EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
    }
  }
}

}  // namespace
}  // namespace semfield
