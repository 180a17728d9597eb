// The hash grid on the device against its float64 twin on the CPU: values, gradients of tables in any order and in
// fixed point, gradients of positions, rows out of use, faults.
#include <algorithm>

#include "core/error.h"
#include "cuda/kernels/kernels.h"
#include "encoders/hash_grid/hash_grid.h"
#include "tests/cuda/encoder_bench.h"

namespace semfield {
namespace {

using cuda::Stage;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::DeviceTensors;
using testing::NotedFault;

template <class Real>
HashGrid<Real> make(const HashGridParams& params, Device device) {
  return HashGrid<Real>(params, EncoderBuild{.device = device}, testing::all_kernels());
}

// Grids are {levels, features, log2_entries, base and finest resolution, interpolation}.

/// Dense and hashed levels, every entry width, groups of 8 columns that are full and that are not.
std::vector<HashGridParams> grids() {
  std::vector<HashGridParams> all;
  for (const Interpolation interpolation : {Interpolation::linear, Interpolation::smoothstep}) {
    for (const int features : {1, 2, 4, 8}) {
      all.push_back({5, features, 10, 4, 64, interpolation});
      all.push_back({16, features, 12, 8, 512, interpolation});
    }
    all.push_back({1, 1, 1, 3, 3, interpolation});            // two entries
    all.push_back({2, 2, 20, 1, 60, interpolation});          // one cell; dense alone
    all.push_back({3, 2, 14, 1000, 1048576, interpolation});  // hashed alone
  }
  return all;
}

std::string name_of(const HashGridParams& p) {
  return std::to_string(p.levels) + " levels of " + std::to_string(p.features) + " features, 2^" +
         std::to_string(p.log2_entries) + " entries, " + std::to_string(p.base_resolution) + " to " +
         std::to_string(p.finest_resolution) + " cells" +
         (p.interpolation == Interpolation::linear ? "" : ", smoothstep");
}

/// Rows along rays of 24 samples, so that neighbours share coarse cells; every 7th row lies on the border of the cube
/// or outside, every 11th on vertices.
std::vector<double> points(std::int64_t rows, std::uint64_t seed) {
  std::vector<double> x(static_cast<std::size_t>(3 * rows));
  for (std::int64_t r = 0; r < rows; ++r) {
    const std::int64_t ray = r / 24;
    for (int d = 0; d < 3; ++d) {
      const auto number = static_cast<std::uint64_t>(6 * ray + 2 * d);
      const double from = static_cast<double>(uniform01({seed, 0, 1}, number));
      const double to = static_cast<double>(uniform01({seed, 0, 1}, number + 1));
      double at = from + (to - from) * (static_cast<double>(r % 24) + 0.3) / 24 + 1e-10 * static_cast<double>(d);
      if (r % 7 == 6 && d == r % 3) at = std::vector<double>{0, 1, -0.5, 1.25}[static_cast<std::size_t>(r % 4)];
      if (r % 11 == 10) at = std::round(8 * at) / 8;
      x[3 * r + d] = at;
    }
  }
  return x;
}

/// Gradients over ten orders of magnitude; every 5th row is zero.
std::vector<float> gradients(std::int64_t rows, std::int32_t cols, std::uint64_t seed) {
  std::vector<float> dy = testing::random_floats(rows * cols, seed, -1, 1);
  for (std::int64_t r = 0; r < rows; ++r) {
    const float scale = r % 5 == 4 ? 0.F : std::pow(10.F, static_cast<float>(-(r % 11)));
    for (std::int32_t c = 0; c < cols; ++c) dy[r * cols + c] *= scale;
  }
  return dy;
}

StepContext context(DeviceLaunch& launch) { return StepContext{.workspace = &launch.arena()}; }

/// Both twins over the same rows. `stride`: beyond the columns, 0: 16-byte accesses are possible. Entries lie below
/// 1.0001 in magnitude; weights and sums err by a few units in the last place, gradients are sums of up to 8 rows'
/// worth of addends an entry in fp32.
void expect_twins(const HashGridParams& params, std::int64_t rows, std::int32_t stride) {
  const HashGrid<double> host = make<double>(params, Device::cpu);
  testing::expect_twins(make<float>(params, Device::cuda), host, points(rows, 5),
                        gradients(rows, host.traits().out_dims, 6), {stride, stride}, 1e-6, 1e-5);
}

using CudaHashGrid = testing::DeviceTest;

TEST_F(CudaHashGrid, FollowsItsTwinOnTheCpu) {
  for (const HashGridParams& params : grids()) {
    for (const std::int64_t rows : {1, 31, 33, 700}) {
      SCOPED_TRACE(name_of(params) + ", " + std::to_string(rows) + " rows");
      expect_twins(params, rows, rows == 33 ? 3 : 0);
    }
  }
  expect_twins({16, 2, 14, 16, 2048}, 4097, 0);
  expect_twins({16, 2, 14, 16, 2048}, 4097, 1);
}

TEST_F(CudaHashGrid, FixedPointGivesTheSameBitsEveryTimeAndAddsToWhatIsThere) {
  constexpr std::int64_t kRows = 100'000;  // many blocks meet in the coarse levels' few entries
  const HashGridParams params{8, 2, 12, 8, 256};
  const HashGrid<float> encoder = make<float>(params, Device::cuda);
  DeviceLaunch launch(false, true);
  DeviceTensors tables(testkit::TensorBox<float>(encoder, 1, 1));
  const DeviceMatrix<double> x(points(kRows, 9), 3);
  const DeviceMatrix<float> dy(gradients(kRows, 16, 8), 16);
  std::vector<std::vector<float>> first;
  for (int turn = 0; turn < 4; ++turn) {
    tables.clear_gradients();
    encoder.backward(context(launch), tables.tensors(), x.read_only(), dy.read_only(), {});
    if (turn == 0) first = tables.gradients();
    EXPECT_EQ(tables.gradients(), first) << "turn " << turn;
  }
  encoder.backward(context(launch), tables.tensors(), x.read_only(), dy.read_only(), {});
  const std::vector<std::vector<float>> twice = tables.gradients();
  for (std::size_t l = 0; l < first.size(); ++l) {
    for (std::size_t i = 0; i < first[l].size(); ++i) ASSERT_EQ(twice[l][i], 2 * first[l][i]);
  }
}

// Gradients differ by ten orders of magnitude: where only small ones meet, fixed point must not round them away.
TEST_F(CudaHashGrid, FixedPointKeepsTheAccuracyOfSmallGradients) {
  constexpr std::int64_t kRows = 4097;
  const HashGrid<float> encoder = make<float>({16, 2, 14, 16, 2048}, Device::cuda);
  DeviceTensors tables(testkit::TensorBox<float>(encoder, 1, 1));
  const DeviceMatrix<double> x(points(kRows, 9), 3);
  std::vector<float> dy = gradients(kRows, 32, 8);
  const auto run = [&](bool deterministic) {
    DeviceLaunch launch(false, deterministic);
    const DeviceMatrix<float> dy_device(dy, 32);
    tables.clear_gradients();
    encoder.backward(context(launch), tables.tensors(), x.read_only(), dy_device.read_only(), {});
    return tables.gradients();
  };
  const std::vector<std::vector<float>> any_order = run(false), fixed = run(true);
  for (float& v : dy) v = std::abs(v);
  const std::vector<std::vector<float>> magnitude = run(false);  // sums of addends' magnitudes
  double smallest = 1;
  for (std::size_t l = 0; l < fixed.size(); ++l) {
    for (std::size_t i = 0; i < fixed[l].size(); ++i) {
      const double error = std::abs(static_cast<double>(fixed[l][i]) - static_cast<double>(any_order[l][i]));
      const double sum = static_cast<double>(magnitude[l][i]);
      // fp32 sums of hundreds of addends, and roundings of 64 addends to units of at most 2^-48.
      ASSERT_LE(error, 1e-5 * sum + 64 * 0x1p-49) << "level " << l << " value " << i;
      if (sum > 0) smallest = std::min(smallest, sum);
    }
  }
  EXPECT_LT(smallest, 1e-9);
}

TEST_F(CudaHashGrid, RowsOutOfUseAreLeftOut) {
  constexpr std::int64_t kRows = 1000, kLive = 333;
  const HashGrid<float> encoder = make<float>({5, 2, 10, 4, 64}, Device::cuda);
  const testkit::TensorBox<float> box(encoder, 1, 1);
  DeviceTensors tables(box), live_tables(box);
  const std::vector<double> x = points(kRows, 2);
  const std::vector<float> dy = gradients(kRows, 10, 3);
  const DeviceMatrix<double> x_all(x, 3);
  const DeviceMatrix<float> dy_all(dy, 10), y_all(kRows, 10), y_live(kLive, 10);
  const DeviceMatrix<std::int32_t> live(std::vector<std::int32_t>{static_cast<std::int32_t>(kLive)}, 1);
  for (const bool deterministic : {false, true}) {
    DeviceLaunch launch(false, deterministic);
    encoder.forward(context(launch), live_tables.tensors(), x_all.read_only().row_range(0, kLive), y_live.view());
    launch.set_live_rows(live.data());
    encoder.forward(context(launch), tables.tensors(), x_all.read_only(), y_all.view());
    std::vector<float> want = y_live.read();
    want.resize(kRows * 10, 0);
    EXPECT_EQ(y_all.read(), want);
    tables.clear_gradients();
    live_tables.clear_gradients();
    encoder.backward(context(launch), tables.tensors(), x_all.read_only(), dy_all.read_only(), {});
    launch.set_live_rows(nullptr);
    encoder.backward(context(launch), live_tables.tensors(), x_all.read_only().row_range(0, kLive),
                     dy_all.read_only().row_range(0, kLive), {});
    for (std::size_t l = 0; l < tables.grads.size(); ++l)
      EXPECT_EQ(near(*tables.grads[l], testing::widen(*live_tables.grads[l]), 1e-5), "");
  }
}

TEST_F(CudaHashGrid, PositionsThatAreNotFiniteAreFaultsAndStayInsideTheTables) {
  const HashGrid<float> encoder = make<float>({16, 2, 12, 8, 1048576}, Device::cuda);
  DeviceTensors tables(testkit::TensorBox<float>(encoder, 1, 1));
  for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) {
    std::vector<double> x = points(500, 2), clamped = x;
    for (const std::size_t i : {3 * 411, 3 * 122 + 2}) x[i] = bad, clamped[i] = bad > 0 ? 1 : 0;
    const DeviceMatrix<double> x_device(x, 3), clamped_device(clamped, 3);
    const DeviceMatrix<float> y(500, 32), want(500, 32), dy(gradients(500, 32, 1), 32), dx(500, 3);
    {
      DeviceLaunch launch;
      encoder.forward(context(launch), tables.tensors(), clamped_device.read_only(), want.view());
      EXPECT_EQ(launch.take_fault(), std::nullopt);
      encoder.forward(context(launch), tables.tensors(), x_device.read_only(), y.view());
      EXPECT_EQ(launch.take_fault(), (NotedFault{Stage::encoded_position, 122}));
      EXPECT_EQ(y.read(), want.read());
      encoder.backward(context(launch), tables.tensors(), x_device.read_only(), dy.read_only(), dx.view());
      for (const float v : dx.read()) ASSERT_TRUE(std::isfinite(v));
      EXPECT_EQ(tables.surroundings(), "");
    }
    DeviceLaunch at_once(true);
    EXPECT_THROW(encoder.forward(context(at_once), tables.tensors(), x_device.read_only(), y.view()), Error);
  }
}

TEST_F(CudaHashGrid, GradientsThatAreNotFiniteReachEveryLevel) {
  const HashGrid<float> encoder = make<float>({5, 2, 10, 4, 64}, Device::cuda);
  DeviceTensors tables(testkit::TensorBox<float>(encoder, 1, 1));
  const DeviceMatrix<double> x(points(100, 2), 3);
  std::vector<float> rows = gradients(100, 10, 3);
  for (int c = 0; c < 10; ++c) rows[10 * 60 + c] = c % 2 == 0 ? NAN : -HUGE_VALF;
  const DeviceMatrix<float> dy(rows, 10);
  for (const bool deterministic : {false, true}) {
    DeviceLaunch launch(false, deterministic);
    tables.clear_gradients();
    encoder.backward(context(launch), tables.tensors(), x.read_only(), dy.read_only(), {});
    for (const std::vector<float>& grad : tables.gradients())
      EXPECT_TRUE(std::any_of(grad.begin(), grad.end(), [](float v) { return !std::isfinite(v); }));
  }
}

}  // namespace
}  // namespace semfield
