// Tests of the stratified sampler: quadrature rules and spacings; cases A07, B09, B10 and B12 of tests/numerics have
// the rules' orders, its strata and limits.

#include "tests/conformance/rows.h"
#include "tests/numerics/ray_bench.h"

namespace semfield {
namespace {

using numerics::RayBench;

testkit::Settings settings(int samples, const std::string& rule, const std::string& spacing = "linear") {
  return {{"samples", std::to_string(samples)}, {"quadrature", rule}, {"spacing", spacing}};
}

TEST(Stratified, QuadratureRules) {
  for (const bool training : {false, true}) {
    for (const std::string rule : {"paper", "midpoint", "stratified_bin"}) {
      RayBench<double> bench(testkit::linked_registry(), "stratified", settings(8, rule));
      bench.ctx.step = 3;
      bench.ctx.training = training;
      bench.set_rays({1, 5});
      bench.draw();
      for (std::size_t k = 0; k < 8; ++k) {
        if (rule == "paper") {
          EXPECT_NEAR(bench.delta[k], (k == 7 ? 5 : bench.t[k + 1]) - bench.t[k], 1e-14);
        } else {
          EXPECT_DOUBLE_EQ(bench.delta[k], 0.5);
        }
        const double centre = 1.25 + 0.5 * static_cast<double>(k);
        if (!training || rule == "midpoint") {
          EXPECT_DOUBLE_EQ(bench.t[k], centre);
        } else {
          EXPECT_NE(bench.t[k], centre);
        }
      }
    }
  }
}

TEST(Stratified, DisparityPutsEachSampleIntoItsBinOfDisparity) {
  RayBench<double> bench(testkit::linked_registry(), "stratified", settings(16, "stratified_bin", "disparity"));
  bench.ctx.training = true;
  for (std::int64_t step = 0; step < 20; ++step) {
    bench.ctx.step = step;
    bench.set_rays({0.2, 5, 2, 3});
    bench.draw();
    for (std::size_t r = 0; r < 2; ++r) {
      const double near_m = r == 0 ? 0.2 : 2, far_m = r == 0 ? 5 : 3;
      double sum = 0;
      for (std::size_t k = 0; k < 16; ++k) {
        const double s = (1 / bench.t[16 * r + k] - 1 / near_m) / (1 / far_m - 1 / near_m) * 16;
        EXPECT_GE(s, static_cast<double>(k) - 1e-9);
        EXPECT_LE(s, static_cast<double>(k + 1) + 1e-9);
        const double at = static_cast<double>(k) / 16, next = static_cast<double>(k + 1) / 16;
        const auto border = [&](double x) { return 1 / (1 / near_m + x * (1 / far_m - 1 / near_m)); };
        EXPECT_NEAR(bench.delta[16 * r + k], border(next) - border(at), 1e-12);
        sum += bench.delta[16 * r + k];
      }
      EXPECT_NEAR(sum, far_m - near_m, 1e-12) << "the bins fill the ray";
    }
  }
}

TEST(Stratified, DisparityFromTheEyeItselfStaysOnTheRay) {
  for (const std::string rule : {"paper", "midpoint", "stratified_bin"}) {
    RayBench<float> bench(testkit::linked_registry(), "stratified", settings(64, rule, "disparity"));
    bench.ctx.training = true;
    bench.set_rays({0, 5});
    bench.draw();
    double before = 0, sum = 0;
    for (std::size_t k = 0; k < 64; ++k) {
      EXPECT_GE(static_cast<double>(bench.t[k]), before);
      EXPECT_GT(bench.delta[k], 0.F);
      before = static_cast<double>(bench.t[k]);
      sum += static_cast<double>(bench.delta[k]);
    }
    EXPECT_LE(before, 5);
    EXPECT_NEAR(sum, rule == "paper" ? 5 - static_cast<double>(bench.t[0]) : 5, 1e-5);
  }
}

}  // namespace
}  // namespace semfield
