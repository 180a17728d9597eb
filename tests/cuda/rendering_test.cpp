// Places of samples, densities, opacity resolution and the finite check on the device against the CPU's.
#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "model/density_activation.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using cuda::Stage;
using testing::DeviceMatrix;
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
    t = testing::random_floats(static_cast<std::int64_t>(used), 1, 0.1, 9);
    delta = testing::random_floats(static_cast<std::int64_t>(used), 2, 0, 1);
    const auto all = used + static_cast<std::size_t>(unused);
    ray.resize(all, static_cast<std::int32_t>(std::max<std::int64_t>(0, rays - 1)));
    t.resize(all, 0);
    delta.resize(all, 0);
    for (const float x : testing::random_floats(3 * rays, 3, -5, 5)) origin.push_back(static_cast<double>(x));
    for (const float x : testing::random_floats(3 * rays, 4, -1, 1)) direction.push_back(static_cast<double>(x));
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
      EXPECT_EQ(testkit::compare(testing::host_view(std::as_const(want), 3), testing::host_view(x.read(), 3),
                                 gap == 0 ? 1e-15 : 4e-15, 1),
                "")
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

TEST(CudaLocate, MapsPositions) {
  SEMFIELD_ON_DEVICE(launch);
  for (const double radius : {0.0, 1.5}) {
    const DomainMap map{{0.5, -2, 3}, 0.37, 0.5, radius};
    for (const std::int64_t count : {0, 1, 33, 4097}) {
      const std::vector<double> positions = testing::widen(testing::random_floats(3 * count, 8, -4, 4));
      const DeviceMatrix<double> from(positions, 3, 5), x(count, 3, 4);
      cuda::map_positions(from.read_only(), map, x.view());
      const std::vector<double> got = x.read();
      for (std::size_t i = 0; i < got.size(); ++i) {
        const std::size_t row = i - i % 3;
        const Vec3d want = map({positions[row], positions[row + 1], positions[row + 2]});
        ASSERT_NEAR(got[i], want[static_cast<int>(i % 3)], radius > 0 ? 4e-15 : 1e-15) << i;
      }
      EXPECT_EQ(x.surroundings(), "");
    }
  }
}

TEST(CudaDensity, ActivationsAndTheirSlopes) {
  SEMFIELD_ON_DEVICE(launch);
  for (const auto activation : {DensityActivation::relu, DensityActivation::softplus, DensityActivation::trunc_exp}) {
    for (const std::int64_t count : {0, 1, 31, 33, 4097}) {
      std::vector<float> raw = testing::random_floats(count, 5, -30, 20);
      for (std::size_t i = 0; i < raw.size() && i < 6; ++i)
        raw[i] = std::vector<float>{0, -0.F, 1e-30F, -100, 15, 80}[i];
      const std::vector<float> d_sigma = testing::random_floats(count, 6, -1, 1);
      const DeviceMatrix<float> raw_there(raw, 1, 3), sigma(count, 1, 2), d_there(d_sigma, 1, 2);
      DensityRule rule{.activation = activation, .per_m = 0.375, .bias = -0.25};
      cuda::density_forward(rule, nullptr, raw_there.view(), sigma.view());
      for (float& x : raw) x -= 0.25F;
      EXPECT_EQ(raw_there.read(), raw);
      const std::vector<double> wide = testing::widen(raw);
      std::vector<double> want(raw.size()), slope(raw.size());
      density_forward<double>(activation, testing::host_view(wide, 1), testing::host_view(want, 1));
      const std::vector<double> wide_d = testing::widen(d_sigma);
      density_backward<double>(activation, testing::host_view(wide, 1), testing::host_view(wide_d, 1),
                               testing::host_view(slope, 1));
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

TEST(CudaDensity, NoiseIsThatOfTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  cuda::StepCell cell{.step = (std::uint64_t{1} << 33) + 5};
  launch.set_cell(cell);
  const Batch host(100, 40);
  const DeviceBatch device(host);
  DensityRule rule{.bias = 0.5, .deviation = 1.5, .random = {3, 0, 99}, .first_ray = 7000};
  const std::vector<float> raw = testing::random_floats(device.rows, 5, -2, 2);
  const DeviceMatrix<float> there(raw, 1), sigma(device.rows, 1);
  cuda::density_forward(rule, &device.samples, there.view(), sigma.view());
  std::vector<float> want = raw;
  for (float& x : want) x += 0.5F;
  RandomAddress address = rule.random;
  address.step = cell.step;
  add_density_noise<float>(address, rule.first_ray, testing::host_view(host.first, 1), rule.deviation,
                           testing::host_view(want, 1));
  const std::vector<float> got = there.read(), density = sigma.read();
  for (std::size_t i = 0; i < got.size(); ++i) {
    ASSERT_NEAR(got[i], want[i], 1e-6) << i;  // the same draw; its logarithm and cosine may round apart
    ASSERT_EQ(density[i], std::max(0.F, got[i])) << i;
  }
  EXPECT_EQ(std::vector<float>(got.begin() + static_cast<std::ptrdiff_t>(host.used), got.end()),
            std::vector<float>(want.begin() + static_cast<std::ptrdiff_t>(host.used), want.end()));
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
      std::vector<float> weight = testing::random_floats(static_cast<std::int64_t>(host.t.size()), 9, 0, 0.6);
      for (std::size_t i = 0; i < weight.size(); i += 3) weight[i] = 0.5F;  // equal ones
      const DeviceBatch device(host);
      const DeviceMatrix<float> there(weight, 1, 2);
      const DeviceMatrix<OpacityResolution> result(rays, 1, 3);
      cuda::opacity_resolutions(device.samples, there.read_only(), far, 0.1, result.view());
      const Samples<float> samples{testing::host_view(host.t, 1), testing::host_view(host.delta, 1),
                                   testing::host_view(host.ray, 1), testing::host_view(host.first, 1), device.rows};
      const std::vector<OpacityResolution> got = result.read();
      std::int64_t kinds[3] = {};
      for (std::int64_t r = 0; r < rays; ++r) {
        const auto want = opacity_resolution<float>(samples, testing::host_view(std::as_const(weight), 1), far, r, 0.1);
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

}  // namespace
}  // namespace semfield
