// Compositing on the device against the CPU's in float64.

#include <algorithm>

#include "core/non_copyable.h"
#include "core/rng.h"
#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "execution/lane_executor.h"
#include "model/camera_corrections.h"
#include "model/compositor.h"
#include "model/stages.h"
#include "testkit/compare.h"
#include "tests/model/rays_of_slabs.h"
#include "tests/session/step_configs.h"
#include "train/trainer.h"

namespace semfield {
namespace {

using testing::DeviceMatrix;
using testing::host_view;
using testing::random_floats;
using testing::RayBuffers;
using testing::TestNumbers;
using testing::there;

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
struct DeviceRays : NonCopyable {
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
  return testkit::compare(host_view(used, cols), host_view(want, cols), tolerance, 1e-6);
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

TEST(CudaCompositor, AwkwardBatchesAsTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t labelled : {0, 1, 6, 14})
    expect_same({awkward_counts(), 64, 0, 50, 1.0}, FarMode::open, labelled);
  for (const std::int64_t unused : {0, 40}) {
    for (const auto& counts : std::vector<std::vector<int>>{{}, {0}, {1}, {0, 0, 3}})
      expect_same({counts, 8, 0, unused, 1.0}, FarMode::background, -1);
  }
  // More than 32 tiles of 32 samples, whose optical depths a warp holds at once.
  expect_same({{1023, 1024, 1025, 1056, 2049, 5000}, 16, 0, 9, 0.5}, FarMode::open, -1);
  std::vector<int> many;
  for (int r = 0; r < 4097; ++r) many.push_back(r * 7 % 40);
  expect_same({many, 64, 0, 1000, 1.0}, FarMode::open, 3001);
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
    EXPECT_EQ(testkit::compare_norms(host_view(got, 1), host_view(std::as_const(want.d_sigma), 1), 1e-5), "");
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

template <class T>
std::vector<T> values_of(View<T> here, std::int64_t rows) {
  return std::vector<T>(here.data, here.data + rows);
}

TEST(CudaCompositor, LightReachesTheSamplesThatItReachesOnTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  const std::vector<int> counts{0, 1, 40, 33, 1000, 0, 64, 3};
  RayBuffers<float> host(counts, 0);
  host.space_evenly(2);
  TestNumbers random{11};
  for (float& s : host.sigma) s = static_cast<float>(random.in(0, 12));
  host.sigma[3] = 1e30F;
  const DeviceRays device(host, 50, 0);
  Workspace here;
  for (const ReachedBy part : {ReachedBy{0, 16, 1e-4}, {16, 32, 1e-4}, {32, 2000, 1e-4}, {0, 2000, 1e-4}}) {
    const ChosenSamples<float> want =
        cpu_stages<float>().reached(here, host.samples, host.col(host.sigma), part, host.rows());
    const std::int64_t count = want.samples.count;
    ASSERT_GT(count, 0);
    for (const std::int64_t room : {count, count + 100}) {
      const ChosenSamples<float> got =
          cuda::stages().reached(launch.arena(), device.samples, device.sigma.read_only(), part, room);
      EXPECT_EQ(there(got.samples.first), values_of(want.samples.first, host.rays() + 1));
      EXPECT_EQ(there(got.source.row_range(0, count)), values_of(want.source, count));
      EXPECT_EQ(there(got.samples.t.row_range(0, count)), values_of(want.samples.t, count));
      EXPECT_EQ(there(got.samples.delta.row_range(0, count)), values_of(want.samples.delta, count));
      EXPECT_EQ(there(got.samples.ray_of_sample.row_range(0, count)), values_of(want.samples.ray_of_sample, count));
      DeviceMatrix<float> sigma(std::vector<float>(static_cast<std::size_t>(host.rows()), -1.0F), 1);
      cuda::stages().spread(got, got.samples.t, sigma.view());
      std::vector<float> spread(static_cast<std::size_t>(host.rows()), -1.0F);
      for (std::int64_t k = 0; k < count; ++k)
        spread[static_cast<std::size_t>(want.source(k, 0))] = want.samples.t(k, 0);
      EXPECT_EQ(sigma.read(), spread);
    }
    EXPECT_EQ(launch.take_fault(), std::nullopt);
    (void)cuda::stages().reached(launch.arena(), device.samples, device.sigma.read_only(), part, count - 1);
    const auto fault = launch.take_fault();
    ASSERT_TRUE(fault.has_value());
    EXPECT_EQ(fault->stage, cuda::Stage::room);
  }
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

// Places of samples, densities, opacity resolution and the finite check on the device against the CPU's.

using cuda::Stage;
using testing::NotedFault;

constexpr float kInf = std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

// `rays` rays with 0 to 6 samples each and `unused` rows behind them.
struct Batch {
  Batch(std::int64_t rays, std::int64_t unused) {
    first.push_back(0);
    for (std::int64_t r = 0; r < rays; ++r) {
      for (std::int64_t k = 0; k < r * 5 % 7; ++k) ray.push_back(static_cast<std::int32_t>(r));
      first.push_back(static_cast<std::int32_t>(ray.size()));
    }
    used = ray.size();
    t = random_floats(static_cast<std::int64_t>(used), 1, 0.1, 9);
    delta = random_floats(static_cast<std::int64_t>(used), 2, 0, 1);
    const auto all = used + static_cast<std::size_t>(unused);
    ray.resize(all, static_cast<std::int32_t>(std::max<std::int64_t>(0, rays - 1)));
    t.resize(all, 0);
    delta.resize(all, 0);
    for (const float x : random_floats(3 * rays, 3, -5, 5)) origin.push_back(static_cast<double>(x));
    for (const float x : random_floats(3 * rays, 4, -1, 1)) direction.push_back(static_cast<double>(x));
  }
  std::vector<std::int32_t> first, ray;
  std::vector<float> t, delta;
  std::vector<double> origin, direction;
  std::size_t used = 0;
};

struct DeviceBatch {
  explicit DeviceBatch(const Batch& host, int gap = 0)
      : t(host.t, 1, 1 + gap),
        delta(host.delta, 1, 1 + gap),
        ray(host.ray, 1, 1 + gap),
        first(host.first, 1),
        origin(host.origin, 3, 3 + gap),
        direction(host.direction, 3, 3 + gap),
        rows(static_cast<std::int64_t>(host.t.size())),
        samples{t.view(), delta.view(), ray.view(), first.view(), rows},
        rays{origin.read_only(), direction.read_only(), {}} {}
  DeviceMatrix<float> t, delta;
  DeviceMatrix<std::int32_t> ray, first;
  DeviceMatrix<double> origin, direction;
  std::int64_t rows;
  Samples<float> samples;
  Rays<float> rays;
};

TEST(CudaLocate, PlacesOfSamplesInFloat64) {
  SEMFIELD_ON_DEVICE(launch);
  for (const int gap : {0, 2}) {
    // With the gap also the map that draws all of space in.
    const DomainMap map{{0.5, -2, 3}, 0.37, 0.5, gap == 0 ? 0 : 0.8};
    for (const std::int64_t rays : {0, 1, 31, 33, 4097}) {
      const Batch host(rays, 19);
      const DeviceBatch device(host, gap);
      const DeviceMatrix<double> x(device.rows, 3, 3 + gap);
      cuda::locate(device.rays, device.samples, map, x.view());
      std::vector<double> want(3 * host.t.size(), map.offset);
      for (std::size_t m = 0; m < host.used; ++m) {
        Vec3d p;
        for (int i = 0; i < 3; ++i) {
          const std::size_t at = 3 * static_cast<std::size_t>(host.ray[m]) + static_cast<std::size_t>(i);
          p[i] = host.origin[at] + static_cast<double>(host.t[m]) * host.direction[at];
        }
        const Vec3d place = map(p);
        for (int i = 0; i < 3; ++i) want[3 * m + static_cast<std::size_t>(i)] = place[i];
      }
      // Some units of the last place: the device fuses multiplications and additions.
      const std::vector<double> got = x.read();
      EXPECT_EQ(testkit::compare(host_view(got, 3), host_view(std::as_const(want), 3), gap == 0 ? 1e-15 : 4e-15, 1), "")
          << rays;
      EXPECT_EQ(x.surroundings(), "");
    }
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

TEST(CudaLocate, FaultsOfSamplesInUse) {
  SEMFIELD_ON_DEVICE(launch);
  const auto fault_of = [&](auto&& spoil) {
    Batch host(40, 5);
    spoil(host);
    const DeviceBatch device(host);
    const DeviceMatrix<double> x(device.rows, 3);
    cuda::locate(device.rays, device.samples, DomainMap{}, x.view());
    return launch.take_fault();
  };
  EXPECT_EQ(fault_of([](Batch& b) { b.t[60] = b.t[31] = kNan; }), (NotedFault{Stage::samples, 31}));
  EXPECT_EQ(fault_of([](Batch& b) { b.delta[17] = -1; }), (NotedFault{Stage::samples, 17}));
  EXPECT_EQ(fault_of([](Batch& b) { b.delta[18] = kInf; }), (NotedFault{Stage::samples, 18}));
  EXPECT_EQ(fault_of([](Batch& b) { b.origin[3 * 9 + 2] = 1e308 * 10; }),
            (NotedFault{Stage::samples, Batch(40, 5).first[9]}));
  EXPECT_EQ(fault_of([](Batch& b) { b.delta[b.used] = kNan; }), std::nullopt);
}

TEST(CudaDensity, ActivationsAndTheirSlopes) {
  SEMFIELD_ON_DEVICE(launch);
  for (const auto activation : {DensityActivation::relu, DensityActivation::softplus, DensityActivation::trunc_exp}) {
    for (const std::int64_t count : {0, 1, 31, 33, 4097}) {
      std::vector<float> raw = random_floats(count, 5, -30, 20);
      for (std::size_t i = 0; i < raw.size() && i < 6; ++i)
        raw[i] = std::vector<float>{0, -0.F, 1e-30F, -100, 15, 80}[i];
      const std::vector<float> d_sigma = random_floats(count, 6, -1, 1);
      const DeviceMatrix<float> raw_there(raw, 1, 3), sigma(count, 1, 2), d_there(d_sigma, 1, 2);
      DensityRule rule{.activation = activation, .per_m = 0.375, .bias = -0.25};
      cuda::density_forward(rule, nullptr, raw_there.view(), sigma.view());
      for (float& x : raw) x -= 0.25F;
      EXPECT_EQ(raw_there.read(), raw);
      std::vector<double> wide = testing::widen(raw);
      std::vector<double> want(raw.size()), slope(raw.size());
      density_forward<double>({activation}, nullptr, host_view(wide, 1), host_view(want, 1));
      const std::vector<double> wide_d = testing::widen(d_sigma);
      density_backward<double>({activation}, host_view(wide, 1), host_view(wide_d, 1), host_view(slope, 1));
      for (double& x : want) x *= rule.per_m;
      for (double& x : slope) x *= rule.per_m;
      cuda::density_backward(rule, raw_there.read_only(), d_there.read_only(), d_there.view());  // in place
      const std::vector<float> got = sigma.read(), got_d = d_there.read();
      for (std::size_t i = 0; i < got.size(); ++i) {
        constexpr double kSubnormal = 1e-38;  // numbers below it have fewer digits
        ASSERT_NEAR(got[i], want[i], 4e-7 * want[i] + kSubnormal) << "raw " << raw[i];
        ASSERT_NEAR(got_d[i], slope[i], 4e-7 * std::abs(slope[i]) + kSubnormal) << "raw " << raw[i];
      }
      EXPECT_EQ(sigma.surroundings() + raw_there.surroundings() + d_there.surroundings(), "");
    }
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

TEST(CudaDensity, FaultsNameTheStage) {
  SEMFIELD_ON_DEVICE(launch);
  const Batch host(100, 40);
  const DeviceBatch device(host);
  const auto fault_of = [&](std::size_t at, float value, double bias, DensityActivation activation) {
    std::vector<float> raw(host.t.size(), 0.5F);
    raw[at] = value;
    const DeviceMatrix<float> there(raw, 1), sigma(device.rows, 1);
    DensityRule rule{.activation = activation, .bias = bias};
    cuda::density_forward(rule, &device.samples, there.view(), sigma.view());
    return launch.take_fault();
  };
  EXPECT_EQ(fault_of(33, kNan, 0, DensityActivation::trunc_exp), (NotedFault{Stage::raw_density, 33}));
  EXPECT_EQ(fault_of(0, -kInf, 0, DensityActivation::relu), (NotedFault{Stage::raw_density, 0}));
  EXPECT_EQ(fault_of(34, 3e38F, 3e38, DensityActivation::relu), (NotedFault{Stage::density, 34}));
  EXPECT_EQ(fault_of(host.used, kNan, 0, DensityActivation::relu), std::nullopt);  // of no ray
}

TEST(CudaOpacityResolution, AsTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  for (const FarMode far : {FarMode::open, FarMode::background}) {
    for (const std::int64_t rays : {0, 1, 33, 4097}) {
      Batch host(rays, 11);
      std::vector<float> weight = random_floats(static_cast<std::int64_t>(host.t.size()), 9, 0, 0.6);
      for (std::size_t i = 0; i < weight.size(); i += 3) weight[i] = 0.5F;  // equal ones
      const DeviceBatch device(host);
      const DeviceMatrix<float> there(weight, 1, 2);
      const DeviceMatrix<OpacityResolution> result(rays, 1, 3);
      cuda::opacity_resolutions(device.samples, there.read_only(), far, 0.1, result.view());
      const Samples<float> samples{host_view(host.t, 1), host_view(host.delta, 1), host_view(host.ray, 1),
                                   host_view(host.first, 1), device.rows};
      const std::vector<OpacityResolution> got = result.read();
      std::int64_t kinds[3] = {};
      for (std::int64_t r = 0; r < rays; ++r) {
        const auto want = opacity_resolution<float>(samples, host_view(std::as_const(weight), 1), far, r, 0.1);
        ASSERT_EQ(got[r], want) << r;
        kinds[static_cast<int>(want)] += 1;
      }
      for (const std::int64_t n : kinds) EXPECT_TRUE(rays < 4097 || n > 0);
      EXPECT_EQ(result.surroundings(), "");
    }
  }
}

TEST(CudaGuard, NamesTheFirstRowThatIsNotFinite) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int32_t cols : {1, 3, 64}) {
    for (const int gap : {0, 1}) {
      for (const std::int64_t rows : {0, 1, 33, 4097, 300001}) {
        std::vector<float> values(static_cast<std::size_t>(rows * cols), std::numeric_limits<float>::max());
        const DeviceMatrix<float> sound(values, cols, cols + gap);
        cuda::guard_finite(Stage::feature, sound.read_only());
        ASSERT_EQ(launch.take_fault(), std::nullopt) << "the gaps hold NaN";
        if (rows == 0) continue;
        for (const std::int64_t row : {std::int64_t{0}, rows / 2, rows - 1}) {
          for (const float bad : {kNan, kInf, -kInf}) {
            values.assign(values.size(), 1);
            values[row * cols + cols / 2] = bad;
            values[(rows - 1) * cols] = bad;
            const DeviceMatrix<float> matrix(values, cols, cols + gap);
            cuda::guard_finite(Stage::feature, matrix.read_only());
            ASSERT_EQ(launch.take_fault(), (NotedFault{Stage::feature, row})) << rows << " x " << cols;
          }
          if (rows > 100000) break;
        }
      }
    }
  }
}

// Corrections of training cameras on the device against the CPU's.

constexpr std::int64_t kRays = 1000, kCameras = 37;

std::vector<float> cameras() {
  std::vector<float> of_ray;
  for (std::int64_t r = 0; r < kRays; ++r)
    of_ray.push_back(static_cast<float>(r * r % (kCameras - 2)));  // two see none
  return of_ray;
}
std::vector<double> doubles(std::int64_t count, std::uint64_t seed) {
  std::vector<double> values;
  for (const float x : random_floats(count, seed, -1, 1)) values.push_back(static_cast<double>(x));
  return values;
}

template <class T>
void expect_close(const std::vector<T>& got, const std::vector<T>& want, double tolerance) {
  ASSERT_EQ(got.size(), want.size());
  for (std::size_t i = 0; i < want.size(); ++i)
    ASSERT_NEAR(got[i], want[i], tolerance * std::max<double>(1, std::abs(want[i]))) << "element " << i;
}

TEST(CudaCameras, MoveRaysAndGiveGradientsAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  std::vector<float> camera = cameras(), pose = random_floats(kCameras * kPoseNumbers, 5, -0.3, 0.3);
  std::vector<double> origin = doubles(3 * kRays, 6), direction = doubles(3 * kRays, 7);
  const DeviceMatrix<float> d_camera(camera, 1), d_pose(pose, kPoseNumbers);
  const DeviceMatrix<double> d_origin(origin, 3, 4), d_direction(direction, 3, 5);
  gpu.move(d_camera.read_only(), d_pose.read_only(), 2.5, d_origin.view(), d_direction.view());
  cpu.move(host_view(camera, 1), host_view(pose, kPoseNumbers), 2.5, host_view(origin, 3), host_view(direction, 3));
  expect_close(d_origin.read(), origin, 1e-12);
  expect_close(d_direction.read(), direction, 1e-12);

  std::vector<float> d_ray = random_floats(6 * kRays, 8, -1, 1), gradient = random_floats(pose.size(), 9, -1, 1);
  const DeviceMatrix<float> there(d_ray, 6), sums(gradient, kPoseNumbers);
  gpu.move_backward(d_camera.read_only(), d_pose.read_only(), 2.5, d_direction.read_only(), there.read_only(),
                    sums.view());
  cpu.move_backward(host_view(camera, 1), host_view(pose, kPoseNumbers), 2.5, host_view(direction, 3),
                    host_view(d_ray, 6), host_view(gradient, kPoseNumbers));
  expect_close(sums.read(), gradient, 1e-4);
  EXPECT_EQ(d_origin.surroundings() + d_direction.surroundings() + sums.surroundings(), "");
}

TEST(CudaCameras, ChangeColoursAndGiveGradientsAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  std::vector<float> camera = cameras(), map = random_floats(kCameras * kColorNumbers, 5, -0.3, 0.3);
  std::vector<float> color = random_floats(3 * kRays, 6, 0, 1), shown(color.size()), d_color(color.size());
  std::vector<float> d_shown = random_floats(3 * kRays, 7, -1, 1), d_map = random_floats(map.size(), 8, -1, 1);
  const DeviceMatrix<float> t_camera(camera, 1), t_map(map, kColorNumbers), t_color(color, 3), t_shown(kRays, 3),
      t_d_shown(d_shown, 3), t_d_color(kRays, 3, 4), t_d_map(d_map, kColorNumbers);
  gpu.show(t_camera.read_only(), t_map.read_only(), t_color.read_only(), t_shown.view());
  gpu.show_backward(t_camera.read_only(), t_map.read_only(), t_color.read_only(), t_d_shown.read_only(),
                    t_d_color.view(), t_d_map.view());
  cpu.show(host_view(camera, 1), host_view(map, kColorNumbers), host_view(color, 3), host_view(shown, 3));
  cpu.show_backward(host_view(camera, 1), host_view(map, kColorNumbers), host_view(color, 3), host_view(d_shown, 3),
                    host_view(d_color, 3), host_view(d_map, kColorNumbers));
  expect_close(t_shown.read(), shown, 1e-6);
  expect_close(t_d_color.read(), d_color, 1e-6);
  expect_close(t_d_map.read(), d_map, 1e-4);
  EXPECT_EQ(t_d_color.surroundings() + t_d_map.surroundings(), "");
}

TEST(CudaCameras, KeepTheMeanAsTheCpuDoes) {
  SEMFIELD_ON_DEVICE(launch);
  const CameraKernels<float>&cpu = cpu_camera_kernels<float>(), &gpu = cuda::camera_kernels();
  for (const std::int64_t rows : {1, 37, 300}) {
    const double share = rows == 37 ? 0 : 1;
    std::vector<float> from = random_floats(rows * kPoseNumbers, 3, -1, 2), to(from.size()), sum(from.size(), 0.5F);
    const DeviceMatrix<float> t_from(from, kPoseNumbers), t_to(rows, kPoseNumbers), t_sum(sum, kPoseNumbers);
    gpu.centre(t_from.read_only(), share, t_to.view(), false);
    gpu.centre(t_from.read_only(), share, t_sum.view(), true);
    cpu.centre(host_view(from, kPoseNumbers), share, host_view(to, kPoseNumbers), false);
    cpu.centre(host_view(from, kPoseNumbers), share, host_view(sum, kPoseNumbers), true);
    expect_close(t_to.read(), to, 1e-6);
    expect_close(t_sum.read(), sum, 1e-6);
  }
}

// The semantic part at points of space on the device, against that of the CPU.

using namespace testing_train;

// With a branch of the position alone and dropout, with one that reads the field, and without a branch.
std::vector<std::string> branched_configs() {
  return {branch_config(", dropout: 0.2, reads_feature: false"), branch_config("")};
}
std::vector<std::string> configs() {
  std::vector<std::string> all = branched_configs();
  all.push_back(hash_config());
  return all;
}

// Points of three regions along x, the rows that a session's network reads there, and steps that learn them.
struct Lessons {
  PointNetwork<float>& network;
  std::int32_t dims;
  std::vector<Vec3d> places;
  std::vector<std::int16_t> logit;
  std::vector<float> rows;
  std::vector<std::int32_t> choice;
  std::vector<AdamStep> updates;
  static constexpr std::int64_t kBatch = 192;

  Lessons(const Session& session, int steps)
      : network(session.pipeline->executor().points()), dims(session.pipeline->passes().back().point_dims()) {
    constexpr int kCount = 300;
    const RandomAddress random{1, 0, stream_id("cuda_points_test")};
    std::uint64_t n = 0;
    const auto any = [&](double most) { return most * (2 * static_cast<double>(uniform01(random, n++)) - 1); };
    for (int i = 0; i < kCount; ++i) {
      places.push_back({1.3 * (i % 3 - 1) + any(0.4), any(1), any(0.8)});
      logit.push_back(static_cast<std::int16_t>(i % 3 == 2 ? 4 : i % 3));
    }
    for (int step = 0; step < steps; ++step) {
      updates.push_back(adam_step({}, 5e-3, step));
      for (std::int64_t b = 0; b < kBatch; ++b)
        choice.push_back(static_cast<std::int32_t>(uniform_below(random, 1000000 + choice.size(), kCount)));
    }
    rows.assign(places.size() * static_cast<std::size_t>(dims), -1);
    network.rows({&places.data()->x, std::ssize(places), 3}, {rows.data(), std::ssize(places), dims});
  }
  void learn() {
    PointLessons<float> lessons;
    lessons.rows = {rows.data(), std::ssize(places), dims};
    lessons.logit = logit;
    lessons.choice = choice;
    lessons.batch = kBatch;
    lessons.updates = updates;
    lessons.weight_decay = 1e-2;
    network.learn(lessons);
  }
  std::vector<float> logits() const {
    std::vector<float> out(5 * places.size());
    network.logits({rows.data(), std::ssize(places), dims}, {out.data(), std::ssize(places), 5});
    return out;
  }
};

double largest_difference(const std::vector<float>& a, const std::vector<float>& b) {
  return testkit::difference(host_view(a, 1), host_view(b, 1)).max_abs;
}

void restart_semantics(ParamStore<float>& store) {
  for (Tensor<float>* tensor : semantic_tensors(store))
    if (tensor->learned()) store.restart(*tensor);
}

struct CudaPoints : testing::DeviceTest {
  Registry& registry = all_plugins();
};

TEST_F(CudaPoints, ReadAndLearnWhatTheCpuDoes) {
  for (const std::string& config : configs()) {
    SCOPED_TRACE(config);
    const Session cuda = open_text(config + "runtime: {device: cuda}\n", registry);
    const Session cpu = open_text(config + "runtime: {device: cpu}\n", registry);
    Lessons a(cuda, 8), b(cpu, 8);
    EXPECT_LT(largest_difference(a.rows, b.rows), 1e-4);
    EXPECT_LT(largest_difference(a.logits(), b.logits()), 1e-3);
    a.learn(), b.learn();
    const std::vector<float> learned = a.logits(), wanted = b.logits();
    EXPECT_GT(largest_difference(wanted, std::vector<float>(wanted.size(), 0)), 0.1);
    EXPECT_LT(largest_difference(learned, wanted), 0.02);
    // The store has them too, and training goes on.
    const std::vector<Tensor<float>*> got = semantic_tensors(cuda.pipeline->store());
    const std::vector<Tensor<float>*> want = semantic_tensors(cpu.pipeline->store());
    ASSERT_EQ(got.size(), want.size());
    for (std::size_t i = 0; i < got.size(); ++i) {
      if (!got[i]->learned()) continue;
      for (std::int64_t e = 0; e < got[i]->size(); ++e) {
        ASSERT_NEAR(got[i]->value.data()[e], want[i]->value.data()[e], 0.01) << got[i]->name;
        ASSERT_EQ(got[i]->moment1.data()[e], 0) << got[i]->name;
      }
    }
  }
}

TEST_F(CudaPoints, TellRegionsApartAndLeaveTheRestAlone) {
  for (const char* precision : {"fp32", "bf16"}) {
    for (const std::string& config : branched_configs()) {  // without one the field, which has not learned, is read
      SCOPED_TRACE(precision + ("\n" + config));
      Session session = open_text(config + "runtime: {device: cuda, precision: " + precision + "}\n", registry);
      Trainer trainer(session);
      trainer.advance(5);
      trainer.collect();
      ParamStore<float>& store = session.pipeline->store();
      const auto others = [&] {
        std::vector<float> out;
        for (const Tensor<float>& t : store.all())
          if (!t.rule.semantic && t.learned()) out.insert(out.end(), t.value.data(), t.value.data() + t.value.size());
        return out;
      };
      const std::vector<float> before = others();
      Lessons lessons(session, 200);
      restart_semantics(store);
      lessons.learn();
      std::size_t right = 0;
      const std::vector<float> logits = lessons.logits();
      for (std::size_t i = 0; i < lessons.logit.size(); ++i) {
        const auto row = logits.begin() + static_cast<std::ptrdiff_t>(5 * i);
        right += std::max_element(row, row + 5) - row == lessons.logit[i] ? 1 : 0;
      }
      EXPECT_GT(right, lessons.logit.size() * 9 / 10);
      session.pipeline->executor().download(5);
      EXPECT_EQ(others(), before);
      const StepLosses next = trainer.advance(1).back();
      EXPECT_TRUE(std::isfinite(next.total));
    }
  }
}

TEST_F(CudaPoints, DeterministicLessonsHaveTheSameBits) {
  for (const std::string& config : configs()) {
    std::vector<std::uint32_t> bits;
    for (int i = 0; i < 2; ++i) {
      const Session session = open_text(config + "runtime: {device: cuda, deterministic: true}\n", registry);
      Lessons(session, 40).learn();
      bits.push_back(fingerprint(session.pipeline->store()));
    }
    EXPECT_EQ(bits[0], bits[1]);
  }
}

// What was kept is put back, for what comes next on the device as well.
TEST_F(CudaPoints, AreReadAndWritten) {
  const Session session = open_text(branch_config("") + "runtime: {device: cuda}\n", registry);
  Lessons lessons(session, 20);
  const std::vector<float> first = lessons.logits();
  lessons.network.read();
  std::vector<std::vector<float>> kept;
  for (const Tensor<float>* t : semantic_tensors(session.pipeline->store()))
    kept.emplace_back(t->value.data(), t->value.data() + t->value.size());
  lessons.learn();
  EXPECT_NE(lessons.logits(), first);
  std::size_t next = 0;
  for (const Tensor<float>* t : semantic_tensors(session.pipeline->store()))
    std::copy(kept[next].begin(), kept[next].end(), t->value.data()), ++next;
  lessons.network.write();
  EXPECT_EQ(lessons.logits(), first);
}

TEST_F(CudaPoints, AFaultIsExplainedByTheCpu) {
  const Session session = open_text(branch_config("") + "runtime: {device: cuda}\n", registry);
  Lessons lessons(session, 3);
  std::fill(lessons.rows.begin(), lessons.rows.end(), std::numeric_limits<float>::quiet_NaN());
  EXPECT_HAS(error_of([&] { lessons.learn(); }), "logit of ray");
}

}  // namespace
}  // namespace semfield
