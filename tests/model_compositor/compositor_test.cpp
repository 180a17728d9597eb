// Compositing of part of the rays, its gradients against finite differences, and the addresses of density noise. Group
// A and cases D11, D16 and D17 of tests/numerics compare both with closed forms and long double.
#include "model/compositor.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "model/density_activation.h"
#include "rays_of_slabs.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using testing::RayBuffers;
using testing::TestNumbers;

template <class Real>
class Compositor : public ::testing::Test {};
using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(Compositor, Reals);

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

TEST(CompositorGradient, AllOutputsAgainstFiniteDifferences) {  // A22
  for (const FarMode mode : {FarMode::open, FarMode::closed, FarMode::background}) {
    RayBuffers<double> rays({5, 0, 1, 9}, 19);
    rays.space_evenly(3);
    rays.fill_random(22, 1.0);
    for (std::size_t k = 0; k < rays.g_weight.size(); ++k) rays.g_weight[k] = std::sin(static_cast<double>(k));
    rays.far = mode;
    rays.background = {0.3, -0.2, 0.9};
    rays.forward();
    rays.backward();
    const auto loss = [&rays] { return rays.loss(); };
    const testkit::GradientCheck options{1e-8, 1e-6, 400, 1};
    const auto d_sigma = rays.d_sigma, d_rgb = rays.d_rgb, d_hidden = rays.d_hidden;
    EXPECT_EQ(testkit::check_gradient(loss, rays.col(rays.sigma), View<const double>(d_sigma.data(), rays.rows(), 1),
                                      options),
              "");
    EXPECT_EQ(
        testkit::check_gradient(loss, rays.mat(rays.rgb, 3), View<const double>(d_rgb.data(), rays.rows(), 3), options),
        "");
    EXPECT_EQ(testkit::check_gradient(loss, rays.mat(rays.hidden, 19),
                                      View<const double>(d_hidden.data(), rays.rows(), 19), options),
              "");
    if (mode == FarMode::background) {
      EXPECT_EQ(rays.d_sigma[4], 0);  // last samples
      EXPECT_EQ(rays.d_sigma[5], 0);
      EXPECT_EQ(rays.d_sigma[14], 0);
    }
  }
}

TEST(CompositorGradient, DotsStandForHiddenActivationsOfTheFirstRays) {
  RayBuffers<float> rays({8, 5, 6}, 5);
  rays.space_evenly(1);
  rays.fill_random(12, 1.0);
  std::fill(rays.g_hidden.begin() + 10, rays.g_hidden.end(), 0.f);  // of the last ray
  rays.forward();
  rays.backward();
  const std::vector<float> whole = rays.d_sigma;
  std::vector<float> dots(13);
  for (std::size_t k = 0; k < dots.size(); ++k) {
    for (std::size_t c = 0; c < 5; ++c) dots[k] += rays.g_hidden[5 * (k < 8 ? 0 : 1) + c] * rays.hidden[5 * k + c];
  }
  CompositeIn<float> in = rays.in();
  CompositeGrad<float> grad = rays.grad();
  in.hidden = {};
  grad.hidden = {};
  grad.dotted_rays = 2;
  grad.dots = View<const float>(dots.data(), 13, 1);
  composite_backward(in, rays.out(), grad, rays.col(rays.d_sigma), {}, {});
  for (std::size_t k = 0; k < whole.size(); ++k)
    EXPECT_NEAR(rays.d_sigma[k], whole[k], 1e-5 * (1 + std::abs(whole[k]))) << k;
}

TEST(CompositorGradient, RaysDoNotTouchEachOther) {
  RayBuffers<float> both({40, 7}, 33), alone({7}, 33);
  both.fill_random(3, 1.0);
  both.space_evenly(2);
  alone.take_inputs(both);
  both.forward();
  both.backward();
  alone.forward();
  alone.backward();
  EXPECT_TRUE(std::equal(alone.d_sigma.begin(), alone.d_sigma.end(), both.d_sigma.end() - 7));
  EXPECT_TRUE(std::equal(alone.d_hidden.begin(), alone.d_hidden.end(), both.d_hidden.end() - 7 * 33));
}

TEST(DensityNoise, IsNormalAndIndependentOfTiles) {
  const int rays = 64, n = 100;
  std::vector<std::int32_t> first;
  for (int r = 0; r <= rays; ++r) first.push_back(r * n);
  std::vector<double> whole(rays * n, 1.0), part(10 * n, 1.0);
  const RandomAddress address{3, 4, stream_id("noise")};
  add_density_noise<double>(address, 5, View<const std::int32_t>(first.data(), rays + 1, 1), 2.0,
                            View<double>(whole.data(), rays * n, 1));
  add_density_noise<double>(address, 5 + 20, View<const std::int32_t>(first.data(), 11, 1), 2.0,
                            View<double>(part.data(), 10 * n, 1));
  for (int i = 0; i < 10 * n; ++i) ASSERT_EQ(part[i], whole[20 * n + i]);
  double mean = 0, square = 0;
  for (const double x : whole) {
    mean += (x - 1) / (rays * n);
    square += (x - 1) * (x - 1) / (rays * n);
  }
  EXPECT_NEAR(mean, 0, 4 * 2.0 / std::sqrt(rays * n));
  EXPECT_NEAR(square, 4, 4 * 4 * std::sqrt(2.0 / (rays * n)));
}

}  // namespace
}  // namespace semfield
