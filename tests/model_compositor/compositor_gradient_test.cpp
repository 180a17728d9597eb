// Gradients of compositing: against finite differences, and in fog and behind walls against a long double recurrence.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "model/compositor.h"
#include "rays_of_slabs.h"
#include "testkit/gradient_check.h"

namespace semfield {
namespace {

using testing::RayBuffers;
using testing::TestNumbers;

template <class Real>
void fill_random(RayBuffers<Real>& rays, std::uint64_t seed, double density) {
  TestNumbers random{seed};
  for (auto& s : rays.sigma) s = static_cast<Real>(random.in(0, 2 * density));
  for (auto* v : {&rays.rgb, &rays.hidden}) {
    for (auto& x : *v) x = static_cast<Real>(random.in(-1, 1));
  }
  for (auto* v : {&rays.g_color, &rays.g_depth, &rays.g_opacity, &rays.g_hidden}) {
    for (auto& x : *v) x = static_cast<Real>(random.in(-1, 1));
  }
}

// Sum of gradient times output: what backward differentiates.
double loss_of(RayBuffers<double>& rays) {
  rays.forward();
  double loss = 0;
  const auto add = [&loss](const std::vector<double>& out, const std::vector<double>& grad) {
    for (std::size_t i = 0; i < out.size(); ++i) loss += out[i] * grad[i];
  };
  add(rays.color, rays.g_color);
  add(rays.depth, rays.g_depth);
  add(rays.opacity, rays.g_opacity);
  add(rays.out_hidden, rays.g_hidden);
  add(rays.weight, rays.g_weight);
  return loss;
}

TEST(CompositorGradient, AllOutputsAgainstFiniteDifferences) {  // A22
  for (const FarMode mode : {FarMode::open, FarMode::closed, FarMode::background}) {
    RayBuffers<double> rays({5, 0, 1, 9}, 19);
    rays.space_evenly(3);
    fill_random(rays, 22, 1.0);
    for (std::size_t k = 0; k < rays.g_weight.size(); ++k) rays.g_weight[k] = std::sin(static_cast<double>(k));
    rays.far = mode;
    rays.background = {0.3, -0.2, 0.9};
    rays.forward();
    rays.backward();
    const auto loss = [&rays] { return loss_of(rays); };
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

// d_sigma of a single ray with colour gradient alone, in long double from the float inputs.
std::vector<long double> reference_gradient(const RayBuffers<float>& rays) {
  const std::size_t n = rays.sigma.size();
  std::vector<long double> result(n), after(n);
  long double tau = 0;
  for (std::size_t k = 0; k < n; ++k) {
    tau += static_cast<long double>(rays.sigma[k]) * static_cast<long double>(rays.delta[k]);
    after[k] = std::exp(-tau);
  }
  long double behind = 0;
  for (std::size_t k = n; k-- > 0;) {
    long double value = 0;
    for (std::size_t c = 0; c < 3; ++c)
      value += static_cast<long double>(rays.g_color[c]) * static_cast<long double>(rays.rgb[3 * k + c]);
    result[k] = static_cast<long double>(rays.delta[k]) * after[k] * (value - behind);
    behind += -std::expm1(-static_cast<long double>(rays.sigma[k]) * static_cast<long double>(rays.delta[k])) *
              (value - behind);
  }
  return result;
}

TEST(CompositorGradient,
     KeepsItsSignInFogOfAnyDepth) {  // A20: total minus prefix gets 18 of 192 signs wrong at tau = 20
  for (const double tau : {0.1, 1.0, 5.0, 20.0, 80.0}) {
    for (std::uint64_t seed = 0; seed < 5; ++seed) {
      RayBuffers<float> rays({192}, 0);
      rays.space_evenly(1);
      fill_random(rays, seed, tau);
      rays.g_depth = {0};
      rays.g_opacity = {0};
      rays.forward();
      rays.backward();
      const auto want = reference_gradient(rays);
      double error2 = 0, norm2 = 0;
      for (std::size_t k = 0; k < want.size(); ++k) {
        const auto w = static_cast<double>(want[k]), got = static_cast<double>(rays.d_sigma[k]);
        error2 += (got - w) * (got - w);
        norm2 += w * w;
        if (std::abs(w) < 1e-37) continue;
        EXPECT_EQ(got > 0, w > 0) << "tau " << tau << ", sample " << k;
        EXPECT_NEAR(got, w, 1e-3 * std::abs(w)) << "tau " << tau << ", sample " << k;
      }
      EXPECT_LE(std::sqrt(error2), 1e-5 * std::sqrt(norm2)) << "tau " << tau;
    }
  }
}

TEST(CompositorGradient, BehindAnOpaqueSampleIsExactlyZero) {  // A21
  RayBuffers<float> rays({64}, 0);
  rays.space_evenly(1);
  fill_random(rays, 21, 2.0);
  rays.g_depth = {0};
  rays.g_opacity = {0};
  rays.sigma[10] = 200.0f * 64;
  rays.forward();
  rays.backward();
  const auto want = reference_gradient(rays);
  for (std::size_t k = 0; k < 64; ++k) {
    ASSERT_TRUE(std::isfinite(rays.d_sigma[k]));
    const auto w = static_cast<double>(want[k]);
    if (k < 10) {
      EXPECT_NEAR(rays.d_sigma[k], w, 1e-5 * std::abs(w) + 1e-9);
    } else {
      EXPECT_EQ(rays.d_sigma[k], 0);
    }
    if (k > 10) {
      EXPECT_EQ(rays.d_rgb[3 * k], 0);
    }
  }
}

TEST(CompositorGradient, DetachedHiddenLeavesDensityAlone) {  // D11
  RayBuffers<float> rays({8}, 5);
  rays.space_evenly(1);
  fill_random(rays, 11, 1.0);
  for (auto* v : {&rays.g_color, &rays.g_depth, &rays.g_opacity}) std::fill(v->begin(), v->end(), 0.f);
  rays.forward();
  CompositeGrad<float> grad = rays.grad();
  grad.hidden_moves_density = false;
  composite_backward(rays.in(), rays.out(), grad, rays.col(rays.d_sigma), {}, rays.mat(rays.d_hidden, 5));
  for (const float d : rays.d_sigma) EXPECT_EQ(d, 0);
  for (std::size_t k = 0; k < 8; ++k) EXPECT_EQ(rays.d_hidden[5 * k + 2], rays.weight[k] * rays.g_hidden[2]);
}

TEST(CompositorGradient, DotsStandForHiddenActivationsOfTheFirstRays) {
  RayBuffers<float> rays({8, 5, 6}, 5);
  rays.space_evenly(1);
  fill_random(rays, 12, 1.0);
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
  fill_random(both, 3, 1.0);
  both.space_evenly(2);
  alone.space_evenly(2);
  const auto tail = [](const std::vector<float>& from, std::vector<float>& to) {
    to.assign(from.end() - static_cast<std::ptrdiff_t>(to.size()), from.end());
  };
  tail(both.sigma, alone.sigma);
  tail(both.rgb, alone.rgb);
  tail(both.hidden, alone.hidden);
  tail(both.g_color, alone.g_color);
  tail(both.g_depth, alone.g_depth);
  tail(both.g_opacity, alone.g_opacity);
  tail(both.g_hidden, alone.g_hidden);
  both.forward();
  both.backward();
  alone.forward();
  alone.backward();
  std::vector<float> last(alone.d_sigma.size());
  tail(both.d_sigma, last);
  EXPECT_EQ(last, alone.d_sigma);
  last.resize(alone.d_hidden.size());
  tail(both.d_hidden, last);
  EXPECT_EQ(last, alone.d_hidden);
}

}  // namespace
}  // namespace semfield
