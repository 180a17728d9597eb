// Compositing on the device against the CPU's in float64.
#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "testkit/compare.h"
#include "tests/model_compositor/rays_of_slabs.h"

namespace semfield {
namespace {

using testing::DeviceMatrix;
using testing::RayBuffers;
using testing::TestNumbers;

// Random rays; some samples are vacuum, some ray is opaque half way.
void fill(RayBuffers<float>& rays, std::uint64_t seed, double density) {
  TestNumbers random{seed};
  rays.space_evenly(2);
  for (float& s : rays.sigma) {
    const double u = random.uniform();
    s = u < 0.3 ? 0.0F : u > 0.995 ? 1e6F : static_cast<float>(random.in(0, 2 * density));
  }
  for (auto* v :
       {&rays.rgb, &rays.hidden, &rays.g_color, &rays.g_depth, &rays.g_opacity, &rays.g_hidden, &rays.g_weight}) {
    for (float& x : *v) x = static_cast<float>(random.in(-1, 1));
  }
}

// The same numbers in float64.
RayBuffers<double> widened(const RayBuffers<float>& rays, const std::vector<int>& counts) {
  RayBuffers<double> wide(counts, rays.channels);
  wide.take_inputs(rays);
  wide.samples = {wide.col(wide.t), wide.col(wide.delta), View<std::int32_t>(wide.ray.data(), wide.rows(), 1),
                  View<std::int32_t>(wide.first.data(), static_cast<std::int64_t>(wide.first.size()), 1), wide.rows()};
  wide.far = rays.far;
  wide.background = rays.background;
  return wide;
}

template <class T>
std::vector<T> with_tail(std::vector<T> values, std::int64_t more, T value) {
  values.insert(values.end(), static_cast<std::size_t>(more), value);
  return values;
}

// Rays on the device, `unused` rows behind their samples, `gap` columns between rows of matrices; the first `labelled`
// rays have hidden channels (-1: all of them).
struct DeviceRays {
  DeviceRays(const RayBuffers<float>& host, std::int64_t unused, int gap, std::int64_t labelled_rays = -1)
      : rows(host.rows() + unused),
        labelled(labelled_rays < 0 ? host.rays() : labelled_rays),
        t(with_tail(host.t, unused, 0.F), 1),
        delta(with_tail(host.delta, unused, 0.F), 1),
        ray(with_tail(host.ray, unused, static_cast<std::int32_t>(std::max<std::int64_t>(0, host.rays() - 1))), 1),
        first(host.first, 1),
        sigma(with_tail(host.sigma, unused, 3.F), 1, 1 + gap),
        rgb(with_tail(host.rgb, 3 * unused, 7.F), 3, 3 + gap),
        hidden(with_tail(host.hidden, host.channels * unused, 7.F), host.channels, host.channels + gap),
        g_color(host.g_color, 3, 3 + gap),
        g_depth(host.g_depth, 1, 1 + gap),
        g_opacity(host.g_opacity, 1, 1 + gap),
        g_hidden(std::vector<float>(host.g_hidden.begin(), host.g_hidden.begin() + labelled * host.channels),
                 host.channels, host.channels + gap),
        g_weight(with_tail(host.g_weight, unused, 7.F), 1, 1 + gap),
        color(host.rays(), 3, 3 + gap),
        depth(host.rays(), 1, 1 + gap),
        opacity(host.rays(), 1, 1 + gap),
        out_hidden(labelled, host.channels, host.channels + gap),
        weight(rows, 1, 1 + gap),
        d_sigma(rows, 1, 1 + gap),
        d_rgb(rows, 3, 3 + gap),
        d_hidden(rows, host.channels, host.channels + gap) {
    samples = {t.view(), delta.view(), ray.view(), first.view(), rows};
    in.samples = &samples;
    in.sigma = sigma.read_only();
    in.rgb = rgb.read_only();
    in.far = host.far;
    in.background = host.background;
    out.color = color.view();
    out.depth = depth.view();
    out.opacity = opacity.view();
    out.weight = weight.view();
    grad.color = g_color.read_only();
    grad.depth = g_depth.read_only();
    grad.opacity = g_opacity.read_only();
    grad.weight = g_weight.read_only();
    if (host.channels == 0) return;
    in.hidden = hidden.read_only();
    out.hidden = out_hidden.view();
    grad.hidden = g_hidden.read_only();
  }
  DeviceRays(const DeviceRays&) = delete;
  DeviceRays& operator=(const DeviceRays&) = delete;

  void forward() { cuda::composite_forward(in, out); }
  void backward() {
    cuda::composite_backward(in, out, grad, d_sigma.view(), d_rgb.view(),
                             in.hidden.empty() ? View<float>() : d_hidden.view());
  }
  std::string surroundings() const {
    std::string all;
    for (const auto* m : {&color, &depth, &opacity, &out_hidden, &weight, &d_sigma, &d_rgb, &d_hidden})
      all += m->surroundings();
    return all;
  }

  std::int64_t rows, labelled;
  DeviceMatrix<float> t, delta;
  DeviceMatrix<std::int32_t> ray, first;
  DeviceMatrix<float> sigma, rgb, hidden, g_color, g_depth, g_opacity, g_hidden, g_weight;
  DeviceMatrix<float> color, depth, opacity, out_hidden, weight, d_sigma, d_rgb, d_hidden;
  Samples<float> samples;
  CompositeIn<float> in;
  CompositeOut<float> out;
  CompositeGrad<float> grad;
};

// "" or what differs by more than `tolerance` of the largest number that is wanted; rows behind it must be zeros.
std::string against(const DeviceMatrix<float>& got, const std::vector<double>& want, std::int32_t cols,
                    double tolerance) {
  const std::vector<float> values = got.read();
  for (std::size_t i = want.size(); i < values.size(); ++i) {
    if (values[i] != 0) return "element " + std::to_string(i) + " of unused rows is " + std::to_string(values[i]);
  }
  if (want.empty()) return "";
  const std::vector<float> used(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(want.size()));
  return testkit::compare(testing::host_view(used, cols), testing::host_view(want, cols), tolerance, 1e-6);
}

struct Case {
  std::vector<int> counts;
  std::int32_t channels;
  int gap;
  std::int64_t unused;
  double density;
};

void expect_same(const Case& c, FarMode mode, std::int64_t labelled) {
  SCOPED_TRACE("rays " + std::to_string(c.counts.size()) + ", channels " + std::to_string(c.channels) + ", gap " +
               std::to_string(c.gap) + ", mode " + std::to_string(static_cast<int>(mode)) + ", labelled " +
               std::to_string(labelled));
  RayBuffers<float> host(c.counts, c.channels);
  fill(host, 7 + static_cast<std::uint64_t>(c.channels), c.density);
  host.far = mode;
  host.background = {0.3, -0.2, 0.9};
  DeviceRays device(host, c.unused, c.gap, labelled);
  // Rays without channels have no gradient there.
  const std::size_t live_grads = static_cast<std::size_t>(device.labelled * c.channels);
  for (std::size_t i = live_grads; i < host.g_hidden.size(); ++i) host.g_hidden[i] = 0;
  RayBuffers<double> want = widened(host, c.counts);
  want.forward();
  want.backward();
  want.out_hidden.resize(live_grads);
  device.forward();
  // Rounding of a float is 6e-8; a weight holds the exponential of a rounded optical depth, a channel is a sum of up to
  // a thousand products.
  EXPECT_EQ(against(device.weight, want.weight, 1, 1e-6), "") << "weight";
  EXPECT_EQ(against(device.color, want.color, 3, 2e-6), "") << "colour";
  EXPECT_EQ(against(device.depth, want.depth, 1, 2e-6), "") << "depth";
  EXPECT_EQ(against(device.opacity, want.opacity, 1, 2e-6), "") << "opacity";
  EXPECT_EQ(against(device.out_hidden, want.out_hidden, c.channels, 5e-6), "") << "hidden";
  device.backward();
  EXPECT_EQ(against(device.d_sigma, want.d_sigma, 1, 5e-6), "") << "d_sigma";
  EXPECT_EQ(against(device.d_rgb, want.d_rgb, 3, 2e-6), "") << "d_rgb";
  EXPECT_EQ(against(device.d_hidden, want.d_hidden, c.channels, 2e-6), "") << "d_hidden";
  EXPECT_EQ(device.surroundings(), "");
  const std::vector<float> d_sigma = device.d_sigma.read(), out_hidden = device.out_hidden.read();
  device.forward();
  device.backward();
  EXPECT_EQ(device.d_sigma.read(), d_sigma) << "a second run gave other bits";
  EXPECT_EQ(device.out_hidden.read(), out_hidden) << "a second run gave other bits";
}

const std::vector<int>& awkward_counts() {
  static const std::vector<int> counts{31, 0, 1, 32, 33, 0, 0, 64, 127, 128, 129, 5, 200, 0};
  return counts;
}

TEST(CudaCompositor, EveryModeAndWidthAsTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  for (const FarMode mode : {FarMode::open, FarMode::closed, FarMode::background}) {
    for (const std::int32_t channels : {0, 1, 4, 29, 32, 36, 64, 100, 128, 132, 300}) {
      for (const int gap : {0, 1, 4}) expect_same({awkward_counts(), channels, gap, 77, 1.0}, mode, -1);
    }
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

TEST(CudaCompositor, LabelledRaysAreTheFirst) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t labelled : {0, 1, 6, 14})
    expect_same({awkward_counts(), 64, 0, 50, 1.0}, FarMode::open, labelled);
}

TEST(CudaCompositor, EmptyBatchesAndSingleRays) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t unused : {0, 40}) {
    for (const auto& counts : std::vector<std::vector<int>>{{}, {0}, {1}, {0, 0, 3}})
      expect_same({counts, 8, 0, unused, 1.0}, FarMode::background, -1);
  }
}

TEST(CudaCompositor, LongRays) {  // more than 32 tiles of 32 samples, whose optical depths a warp holds at once
  SEMFIELD_ON_DEVICE(launch);
  expect_same({{1023, 1024, 1025, 1056, 2049, 5000}, 16, 0, 9, 0.5}, FarMode::open, -1);
}

TEST(CudaCompositor, ManyRays) {
  SEMFIELD_ON_DEVICE(launch);
  std::vector<int> counts;
  for (int r = 0; r < 4097; ++r) counts.push_back(r * 7 % 40);
  expect_same({counts, 64, 0, 1000, 1.0}, FarMode::open, 3001);
}

TEST(CudaCompositor, GradientKeepsItsSignInFogOfAnyDepth) {
  SEMFIELD_ON_DEVICE(launch);
  for (const double tau : {0.1, 1.0, 5.0, 20.0, 80.0}) {
    RayBuffers<float> host({192, 192, 192}, 0);
    fill(host, 20, tau);
    for (float& s : host.sigma) s = s == 0 || s > 1e5F ? static_cast<float>(tau) : s;
    host.space_evenly(1);
    for (auto* v : {&host.g_depth, &host.g_opacity, &host.g_weight}) std::fill(v->begin(), v->end(), 0.F);
    RayBuffers<double> want = widened(host, {192, 192, 192});
    want.forward();
    want.backward();
    DeviceRays device(host, 0, 0);
    device.forward();
    device.backward();
    const std::vector<float> got = device.d_sigma.read();
    for (std::size_t k = 0; k < got.size(); ++k) {
      if (std::abs(want.d_sigma[k]) < 1e-37) continue;
      ASSERT_EQ(got[k] > 0, want.d_sigma[k] > 0) << "tau " << tau << ", sample " << k;
      ASSERT_NEAR(got[k], want.d_sigma[k], 1e-3 * std::abs(want.d_sigma[k])) << "tau " << tau << ", sample " << k;
    }
    EXPECT_EQ(
        testkit::compare_norms(testing::host_view(got, 1), testing::host_view(std::as_const(want.d_sigma), 1), 1e-5),
        "");
  }
}

TEST(CudaCompositor, InfiniteIntervalsAndHugeDensities) {
  SEMFIELD_ON_DEVICE(launch);
  RayBuffers<float> host({2, 2, 1}, 0);
  host.delta = {std::numeric_limits<float>::infinity(), 1, 10, 1, 1e-20F};
  host.sigma = {0, 1, 3e38F, 1, 1e-20F};
  host.t = {1, 2, 1, 2, 1};
  host.g_opacity = {1, 1, 1};
  DeviceRays device(host, 0, 0);
  device.forward();
  const std::vector<float> weight = device.weight.read();
  EXPECT_EQ(weight[0], 0);
  EXPECT_NEAR(weight[1], -std::expm1(-1.0), 1e-6);
  EXPECT_EQ(weight[2], 1);
  EXPECT_EQ(weight[3], 0);
  EXPECT_NEAR(weight[4] / 1e-40, 1, 2e-5);  // subnormal in float, not lost
  device.backward();
  const std::vector<float> d_sigma = device.d_sigma.read();
  for (const float d : d_sigma) EXPECT_TRUE(std::isfinite(d));
  EXPECT_EQ(d_sigma[3], 0);
}

TEST(CudaCompositor, ARayDoesNotDependOnItsNeighbours) {
  SEMFIELD_ON_DEVICE(launch);
  RayBuffers<float> both({40, 170}, 64), alone({170}, 64);
  fill(both, 3, 1.0);
  alone.take_inputs(both);
  DeviceRays a(both, 0, 0), b(alone, 33, 0);
  for (DeviceRays* rays : {&a, &b}) {
    rays->forward();
    rays->backward();
  }
  const auto same_end = [&](const DeviceMatrix<float>& whole, const DeviceMatrix<float>& part, std::size_t count) {
    const std::vector<float> x = whole.read(), y = part.read();
    return std::equal(x.end() - static_cast<std::ptrdiff_t>(count), x.end(), y.begin());
  };
  EXPECT_TRUE(same_end(a.color, b.color, 3));
  EXPECT_TRUE(same_end(a.out_hidden, b.out_hidden, 64));
  EXPECT_TRUE(same_end(a.d_sigma, b.d_sigma, 170));
  EXPECT_TRUE(same_end(a.d_hidden, b.d_hidden, 170 * 64));
}

TEST(CudaCompositor, DetachedHiddenLeavesDensityAlone) {
  SEMFIELD_ON_DEVICE(launch);
  RayBuffers<float> host({8, 40}, 12);
  fill(host, 11, 1.0);
  for (auto* v : {&host.g_color, &host.g_depth, &host.g_opacity, &host.g_weight}) std::fill(v->begin(), v->end(), 0.F);
  DeviceRays device(host, 5, 0);
  device.forward();
  device.grad.hidden_moves_density = false;
  device.backward();
  EXPECT_EQ(device.d_sigma.read(), std::vector<float>(53, 0.F));
  const std::vector<float> weight = device.weight.read(), d_hidden = device.d_hidden.read();
  for (std::size_t k = 0; k < 8; ++k) EXPECT_EQ(d_hidden[12 * k + 2], weight[k] * host.g_hidden[2]);
}

TEST(CudaCompositor, OutputsThatNobodyWantsAreLeftOut) {
  SEMFIELD_ON_DEVICE(launch);
  RayBuffers<float> host(awkward_counts(), 8);
  fill(host, 5, 1.0);
  DeviceRays device(host, 3, 0);
  device.out.color = device.out.depth = device.out.opacity = device.out.hidden = {};
  device.in.rgb = {};
  device.forward();
  const std::vector<float> weight = device.weight.read();
  DeviceRays all(host, 3, 0);
  all.forward();
  EXPECT_EQ(weight, all.weight.read());
  cuda::composite_backward(all.in, all.out, all.grad, {}, all.d_rgb.view(), {});
  const std::vector<float> d_rgb = all.d_rgb.read();
  all.backward();
  EXPECT_EQ(d_rgb, all.d_rgb.read());
  const std::vector<float> d_sigma = all.d_sigma.read();
  cuda::composite_backward(all.in, all.out, all.grad, device.d_sigma.view(), {}, {});
  EXPECT_EQ(device.d_sigma.read(), d_sigma);
}

TEST(CudaCompositor, AColourThatIsNotFiniteIsAFaultOfItsSample) {
  SEMFIELD_ON_DEVICE(launch);
  RayBuffers<float> host({40, 40}, 0);
  fill(host, 5, 1.0);
  host.rgb[3 * 70 + 1] = std::numeric_limits<float>::infinity();
  host.rgb[3 * 71] = std::numeric_limits<float>::quiet_NaN();
  DeviceRays device(host, 3, 0);
  device.forward();
  EXPECT_EQ(launch.take_fault(), (testing::NotedFault{cuda::Stage::color, 70}));
}

}  // namespace
}  // namespace semfield
