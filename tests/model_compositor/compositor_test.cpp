// Compositing against closed forms: vacuum, fog, slabs, far modes, bad densities.
#include "model/compositor.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <string>

#include "core/error.h"
#include "rays_of_slabs.h"

namespace semfield {
namespace {

using testing::RayBuffers;
using testing::TestNumbers;

template <class Real>
class Compositor : public ::testing::Test {};
using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(Compositor, Reals);

template <class Real>
double tolerance(double single) {
  return std::is_same_v<Real, float> ? single : 1e-12;
}

TYPED_TEST(Compositor, VacuumIsExactlyNothing) {  // A01
  for (const int n : {0, 1, 7, 1024}) {
    RayBuffers<TypeParam> rays({n}, 2);
    rays.space_evenly(4);
    rays.color = {9, 9, 9};
    std::fill(rays.rgb.begin(), rays.rgb.end(), TypeParam(1));
    std::fill(rays.hidden.begin(), rays.hidden.end(), TypeParam(1));
    rays.background = {0.25, 0.5, 1};
    rays.forward();
    EXPECT_EQ(rays.opacity[0], 0);
    EXPECT_EQ(rays.depth[0], 0);
    EXPECT_EQ(rays.out_hidden, (std::vector<TypeParam>{0, 0}));
    EXPECT_EQ(rays.color, (std::vector<TypeParam>{TypeParam(0.25), TypeParam(0.5), TypeParam(1)}));  // T = 1
    for (const TypeParam w : rays.weight) EXPECT_EQ(w, 0);
  }
}

TYPED_TEST(Compositor, ConstantDensitySweep) {  // A02
  for (int exponent = -12; exponent <= 8; ++exponent) {
    for (const int n : {1, 7, 64, 1024}) {
      RayBuffers<TypeParam> rays({n}, 0);
      rays.space_evenly(1);
      const auto sigma = static_cast<TypeParam>(std::pow(10.0, exponent));
      std::fill(rays.sigma.begin(), rays.sigma.end(), sigma);
      rays.forward();
      long double tau = 0;
      for (const TypeParam d : rays.delta) tau += static_cast<long double>(sigma) * static_cast<long double>(d);
      const auto want = static_cast<double>(-std::expm1(-tau));
      EXPECT_NEAR(rays.opacity[0], want, tolerance<TypeParam>(4e-6) * want) << "1e" << exponent << ", n " << n;
    }
  }
}

TYPED_TEST(Compositor, TwoSemanticSlabs) {  // A12
  RayBuffers<TypeParam> rays({2, 2, 2}, 2);
  rays.space_evenly(2);
  const double front[3] = {0.7, std::log(2.0) - 1e-4, std::log(2.0) + 1e-4};
  for (std::size_t r = 0; r < 3; ++r) {
    rays.sigma[2 * r] = static_cast<TypeParam>(front[r]);
    rays.sigma[2 * r + 1] = 20;
    rays.hidden[4 * r] = 1;      // class A in front
    rays.hidden[4 * r + 3] = 1;  // class B behind
  }
  rays.forward();
  for (std::size_t r = 0; r < 3; ++r) {
    const double tau = static_cast<double>(rays.sigma[2 * r]);
    const double a = -std::expm1(-tau), b = std::exp(-tau) * -std::expm1(-20.0);
    EXPECT_NEAR(rays.out_hidden[2 * r], a, tolerance<TypeParam>(2e-6) * a);
    EXPECT_NEAR(rays.out_hidden[2 * r + 1], b, tolerance<TypeParam>(2e-6) * b);
  }
  EXPECT_LT(rays.out_hidden[2], rays.out_hidden[3]);  // just below ln 2 the back wins
  EXPECT_GT(rays.out_hidden[4], rays.out_hidden[5]);
}

TYPED_TEST(Compositor,
           DensityInsideTheSumIsThatOfTheSampleInFront) {  // A13: reading the misprint literally gives 0.075
  RayBuffers<TypeParam> rays({3}, 0);
  rays.delta = {TypeParam(0.5), TypeParam(0.5), TypeParam(1)};
  rays.sigma = {1, 5, 0};
  rays.rgb = {0, 0, 0, 1, 1, 1, 0, 0, 0};
  rays.forward();
  const double want = std::exp(-0.5) * (1 - std::exp(-2.5));
  EXPECT_NEAR(rays.color[0], want, 1e-6);
  RayBuffers<TypeParam> slabs({2}, 0);  // slabs 1 | 5 over [0, 1]: weight of the second half
  slabs.delta = {TypeParam(0.5), TypeParam(0.5)};
  slabs.sigma = {TypeParam(1), TypeParam(5)};
  slabs.forward();
  EXPECT_NEAR(slabs.weight[1], std::exp(-0.5) - std::exp(-3.0), 1e-6);
}

TYPED_TEST(Compositor, FarModes) {  // A14
  const double tau = 1e-6 * 0.5;
  for (const FarMode mode : {FarMode::open, FarMode::closed, FarMode::background}) {
    RayBuffers<TypeParam> rays({1, 0}, 0);
    rays.far = mode;
    rays.background = {0.5, 0.5, 0.5};
    rays.t = {2};
    rays.delta = {TypeParam(0.5)};
    rays.sigma = {TypeParam(1e-6)};
    rays.rgb = {1, 1, 1};
    rays.forward();
    if (mode == FarMode::background) {
      EXPECT_EQ(rays.opacity[0], 1);
      EXPECT_EQ(rays.depth[0], 2);
      EXPECT_EQ(rays.color[0], 1);  // nothing shines through
    } else {
      EXPECT_NEAR(rays.opacity[0], tau, 1e-6 * tau);
      const double behind = mode == FarMode::open ? 0.5 * (1 - tau) : 0;
      EXPECT_NEAR(rays.color[0], tau + behind, 1e-7);
    }
    EXPECT_EQ(rays.opacity[1], 0);  // the ray without samples
    EXPECT_EQ(rays.color[3], mode == FarMode::closed ? TypeParam(0) : TypeParam(0.5));
  }
}

TYPED_TEST(Compositor, WeightsAndTransmittanceAddUpToOne) {  // A15
  TestNumbers random{15};
  double worst = 0;
  for (int i = 0; i < 400; ++i) {
    const int n = i % 4 == 0 ? 1024 : 1 + i % 64;
    RayBuffers<TypeParam> rays({n}, 0);
    rays.space_evenly(1);
    const double tau = std::pow(10.0, random.in(-8, 8));
    for (auto& s : rays.sigma) s = static_cast<TypeParam>(2 * tau * random.uniform());
    rays.background = {1, 1, 1};
    rays.forward();  // black medium: colour = T
    double sum = static_cast<double>(rays.color[0]);
    for (const TypeParam w : rays.weight) {
      sum += static_cast<double>(w);
      ASSERT_GE(w, 0);
    }
    worst = std::max(worst, std::abs(sum - 1));
  }
  EXPECT_LE(worst, tolerance<TypeParam>(2e-6));
}

TYPED_TEST(Compositor, ManySamples) {  // A16
  RayBuffers<TypeParam> rays({65536}, 0);
  rays.space_evenly(1);
  std::fill(rays.sigma.begin(), rays.sigma.end(), TypeParam(1));
  rays.forward();
  EXPECT_NEAR(rays.opacity[0], -std::expm1(-1.0), tolerance<TypeParam>(1e-5) * 0.632);
}

TYPED_TEST(Compositor, SplittingIntervalsChangesNothing) {  // A23
  for (const int m : {2, 4, 8}) {
    RayBuffers<TypeParam> whole({16}, 1), parts({16 * m}, 1);
    whole.space_evenly(2);
    parts.space_evenly(2);
    TestNumbers random{23};
    for (std::size_t k = 0; k < 16; ++k) {
      whole.sigma[k] = static_cast<TypeParam>(random.in(0, 4));
      whole.hidden[k] = static_cast<TypeParam>(random.in(-1, 1));
      for (std::size_t j = 0; j < static_cast<std::size_t>(m); ++j) {
        parts.sigma[k * static_cast<std::size_t>(m) + j] = whole.sigma[k];
        parts.hidden[k * static_cast<std::size_t>(m) + j] = whole.hidden[k];
      }
    }
    whole.forward();
    parts.forward();
    EXPECT_NEAR(whole.opacity[0], parts.opacity[0], tolerance<TypeParam>(1e-6) * std::sqrt(m));
    EXPECT_NEAR(whole.out_hidden[0], parts.out_hidden[0], tolerance<TypeParam>(1e-6) * std::sqrt(m));
  }
}

TYPED_TEST(Compositor, DenseFogIsStable) {  // A24: alpha = sigma delta would diverge
  RayBuffers<TypeParam> rays({64}, 0);
  rays.space_evenly(64);
  std::fill(rays.sigma.begin(), rays.sigma.end(), TypeParam(2.016));
  rays.background = {1, 1, 1};
  rays.forward();
  EXPECT_GE(rays.color[0], 0);
  EXPECT_LE(rays.color[0], 1e-30);
  EXPECT_NEAR(rays.opacity[0], 1, 1e-6);
}

TYPED_TEST(Compositor, InfiniteIntervalsAndHugeDensities) {  // A25, and A19's smallest products
  RayBuffers<TypeParam> rays({2, 2, 1}, 0);
  rays.delta = {std::numeric_limits<TypeParam>::infinity(), 1, 10, 1, TypeParam(1e-20)};
  rays.sigma = {0, 1, TypeParam(3e38), 1, TypeParam(1e-20)};
  rays.t = {1, 2, 1, 2, 1};
  rays.forward();
  EXPECT_EQ(rays.weight[0], 0);
  EXPECT_NEAR(rays.weight[1], -std::expm1(-1.0), 1e-6);
  EXPECT_EQ(rays.weight[2], 1);
  EXPECT_EQ(rays.weight[3], 0);
  EXPECT_NEAR(rays.weight[4] / 1e-40, 1, 2e-5);  // subnormal in float, not lost
  rays.g_opacity = {1, 1, 1};
  rays.backward();
  for (const TypeParam d : rays.d_sigma) EXPECT_TRUE(std::isfinite(d));
  EXPECT_EQ(rays.d_sigma[3], 0);
}

TYPED_TEST(Compositor, BadDensitiesAreNamed) {  // A18
  const double bad[] = {-1, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(),
                        -std::numeric_limits<double>::infinity()};
  for (const double value : bad) {
    RayBuffers<TypeParam> rays({3, 4}, 0);
    rays.space_evenly(1);
    EXPECT_NO_THROW(check_density<TypeParam>(rays.samples, rays.col(rays.sigma), 100));
    rays.sigma[5] = static_cast<TypeParam>(value);
    try {
      check_density<TypeParam>(rays.samples, rays.col(rays.sigma), 100);
      FAIL() << value << " was accepted";
    } catch (const Error& e) {
      EXPECT_EQ(e.kind(), ErrorKind::failure);
      EXPECT_NE(e.message().find("ray 101, sample 2"), std::string::npos) << e.what();
    }
  }
}

TYPED_TEST(Compositor, HiddenMayCoverTheFirstRaysAlone) {
  RayBuffers<TypeParam> rays({2, 3, 2}, 37);
  rays.space_evenly(2);
  TestNumbers random{7};
  for (auto& s : rays.sigma) s = static_cast<TypeParam>(random.in(0, 2));
  for (auto& h : rays.hidden) h = static_cast<TypeParam>(random.in(-1, 1));
  for (auto& g : rays.g_hidden) g = static_cast<TypeParam>(random.in(-1, 1));
  rays.forward();
  rays.backward();
  const auto all_hidden = rays.out_hidden, all_d_hidden = rays.d_hidden, all_d_sigma = rays.d_sigma;
  std::fill(rays.out_hidden.begin(), rays.out_hidden.end(), TypeParam(-5));
  std::fill(rays.d_hidden.begin(), rays.d_hidden.end(), TypeParam(-5));
  CompositeIn<TypeParam> in = rays.in();
  CompositeOut<TypeParam> out = rays.out();
  CompositeGrad<TypeParam> grad = rays.grad();
  in.hidden = in.hidden.row_range(0, 5);
  out.hidden = out.hidden.row_range(0, 2);
  grad.hidden = grad.hidden.row_range(0, 2);
  composite_forward(in, out);
  composite_backward(in, out, grad, rays.col(rays.d_sigma), rays.mat(rays.d_rgb, 3),
                     rays.mat(rays.d_hidden, 37).row_range(0, 5));
  for (std::size_t i = 0; i < 2 * 37; ++i) EXPECT_EQ(rays.out_hidden[i], all_hidden[i]);
  for (std::size_t i = 2 * 37; i < 3 * 37; ++i) EXPECT_EQ(rays.out_hidden[i], TypeParam(-5));
  for (std::size_t i = 0; i < 5 * 37; ++i) EXPECT_EQ(rays.d_hidden[i], all_d_hidden[i]);
  for (std::size_t i = 5 * 37; i < 7 * 37; ++i) EXPECT_EQ(rays.d_hidden[i], TypeParam(-5));
  for (std::size_t k = 0; k < 5; ++k) EXPECT_EQ(rays.d_sigma[k], all_d_sigma[k]);
  for (std::size_t k = 5; k < 7; ++k) EXPECT_EQ(rays.d_sigma[k], 0);
}

}  // namespace
}  // namespace semfield
