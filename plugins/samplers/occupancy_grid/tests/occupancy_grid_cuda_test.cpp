// The occupancy grid on the device: samples, densities and bits of the CPU, bit for bit. Only the mean density is
// summed in another order: within 1e-6, and so are the threshold made from it and the share of occupied cells.

#include "core/error.h"
#include "samplers/occupancy_grid/occupancy_grid.h"
#include "testkit/compare.h"
#include "tests/cuda/sampler_bench.h"

namespace semfield {
namespace {

using namespace testing;

struct Grids {
  explicit Grids(const OccupancyGridParams& params)
      : cpu(params, room_on(Device::cpu), all_kernels()), device(params, room_on(Device::cuda), all_kernels()) {}
  OccupancyGrid<float> cpu, device;
};

constexpr double kMeanTolerance = 1e-6;

// Densities of a field: a ball over a haze that grows along x, and a wavy one.
using Field = double (*)(Vec3d p);
double ball(Vec3d p) {
  const Vec3d d = p - Vec3d{0.5, 0, 0.5};
  return dot(d, d) < 0.64 ? 50 : 0;
}
double hazy_ball(Vec3d p) { return ball(p) > 0 ? 50 : 1e-5 * std::exp(2 * std::min(p.x + p.y, 4.0)); }
double waves(Vec3d p) { return std::exp(8 * std::sin(5 * p.x + p.y * p.z)); }
double nothing(Vec3d) { return 0; }

DensityQuery<float> host_query(Field field) {
  return [field](View<const double> x, View<float> sigma) {
    for (std::int64_t i = 0; i < x.rows; ++i) *sigma.row(i) = static_cast<float>(field({x(i, 0), x(i, 1), x(i, 2)}));
  };
}
// The same for views of device memory, by way of the host.
DensityQuery<float> device_query(Field field) {
  return [field](View<const double> x, View<float> sigma) {
    ASSERT_EQ(x.device, Device::cuda);
    ASSERT_TRUE(x.contiguous() && sigma.contiguous());
    std::vector<double> positions(static_cast<std::size_t>(x.size()));
    std::vector<float> densities(static_cast<std::size_t>(x.rows));
    cuda::download<double>(x.data, positions);
    cuda::synchronize();
    host_query(field)(host_view(positions, 3), host_view(densities, 1));
    cuda::upload<float>(densities, sigma.data);
    cuda::synchronize();
  };
}

OccupancyGridParams small_grid() {
  return OccupancyGridParams{.resolution = 32, .max_samples = 1024, .warmup_steps = 64};
}

// A grid with the state that the CPU's updates give it.
struct Subject {
  explicit Subject(const OccupancyGridParams& params) : grids(params), box(grids.cpu, 1, 0.0) {}
  void learn(Field field, std::int64_t until) {
    Workspace workspace;
    for (std::int64_t step = 0; step < until; ++step) {
      StepContext ctx = context_at(step, true);
      ctx.workspace = &workspace;
      grids.cpu.observe(ctx, box.values_only(), host_query(field));
    }
  }
  std::string compare(const StepContext& ctx, const HostRays& rays, std::int64_t gap, std::int64_t* live = nullptr) {
    const HostSamples want = sample_on_cpu(grids.cpu, ctx, box.values_only(), rays);
    if (live != nullptr) *live = want.live();
    DeviceLaunch launch;
    const DeviceTensors state(box);
    DeviceBatch batch(grids.device, rays, nullptr, gap, ctx.training);
    batch.sample(device_context(ctx, launch), state.values_only());
    const HostSamples got = batch.read();
    EXPECT_EQ(launch.take_fault(), std::nullopt);
    return difference(want, got);
  }
  Grids grids;
  testkit::TensorBox<float> box;
};

using CudaOccupancyGrid = testing::DeviceTest;

TEST_F(CudaOccupancyGrid, SamplesAreThoseOfTheCpu) {
  for (const std::int64_t cascades : {1, 3, 5}) {
    for (const SkipRule rule : {SkipRule::certified, SkipRule::threshold, SkipRule::never}) {
      for (const Field field : {ball, hazy_ball}) {
        OccupancyGridParams params = small_grid();
        params.cascades = cascades;
        params.growth = cascades == 5 ? 0.02 : 0;
        params.skip = rule;
        params.keep_last = cascades == 3;
        Subject subject(params);
        subject.learn(field, 96);
        for (const bool training : {false, true}) {
          std::int64_t live = 0;
          EXPECT_EQ(subject.compare(context_at(70, training), random_rays(517, 3, 5), training ? 1 : 0, &live), "")
              << cascades << " cascades, rule " << static_cast<int>(rule) << ", " << training;
          EXPECT_GT(live, 1000);
        }
      }
    }
  }
}

// Hazes for which the budget pays none, some and all of the jumps.
TEST_F(CudaOccupancyGrid, BudgetsAreSpentAsOnTheCpu) {
  for (const double budget : {0.0, 1e-5, 1e-3, 0.05, 1.0}) {
    for (const Field field : {hazy_ball, waves}) {
      OccupancyGridParams params = small_grid();
      params.resolution = 64;
      params.skip_budget = budget;
      params.keep_last = budget == 0.05;
      Subject subject(params);
      subject.learn(field, 80);
      EXPECT_EQ(subject.compare(context_at(70, false), random_rays(300, 4, 0), 0), "") << budget;
    }
  }
}

TEST_F(CudaOccupancyGrid, RaysThatNeedMoreSamplesTakeLongerSteps) {
  for (const std::int64_t most : {1, 31, 48, 256}) {
    for (const std::int64_t until : {0, 80}) {  // never updated: the whole ray is occupied
      OccupancyGridParams params = small_grid();
      params.max_samples = most;
      params.step_m = most == 31 ? 1e-9 : 0;  // a lattice that is cut
      Subject subject(params);
      subject.learn(hazy_ball, until);
      for (const std::int64_t rays : {1, 31, 33, 1030})
        EXPECT_EQ(subject.compare(context_at(1, true), random_rays(rays, 5, 0), 0), "") << most << ", " << rays;
    }
  }
}

TEST_F(CudaOccupancyGrid, RaysThatMissTheGridAndRaysAlongItsAxes) {
  Subject subject(small_grid());
  subject.learn(ball, 80);
  HostRays rays{.origin = {1e5, 1e5, 1e5, 0, 0, 0.5, 0.5, 0.25, 0.5, 0.5, 0, -0.9, -5, 0, 0.5},
                .direction = {1, 0, 0, 1, 0, 0, 0, -1, 0, 0, 0, 1, 1, 0, 0},
                .near_far = {0, 1e7, 0, 10, 0.1, 10, 0, 1, 0, 1e9}};
  std::int64_t live = 0;
  EXPECT_EQ(subject.compare(context_at(1, false), rays, 0, &live), "");
  EXPECT_GT(live, 100);
}

// The state after the same updates on both sides.
void expect_same_state(const OccupancyGridParams& params, Field field, const std::vector<std::int64_t>& steps) {
  Subject subject(params);
  DeviceLaunch launch;
  const DeviceTensors state(subject.box);
  Workspace workspace;
  for (const std::int64_t step : steps) {
    StepContext ctx = context_at(step, true);
    ctx.workspace = &workspace;
    subject.grids.cpu.observe(ctx, subject.box.values_only(), host_query(field));
    ctx.workspace = &launch.arena();
    subject.grids.device.observe(ctx, state.values_only(), device_query(field));
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
  const auto cpu = [&](std::size_t tensor) {
    const View<float> v = subject.box.value(tensor);
    return std::vector<float>(v.data, v.data + v.rows);
  };
  const auto device = [&](std::size_t tensor) { return state.values[tensor]->read(); };
  const std::vector<float> density = cpu(0), summary = cpu(3), device_summary = device(3);
  EXPECT_EQ(state.surroundings(), "");
  ASSERT_EQ(density, device(0));
  for (std::size_t i = 0; i < 3; ++i)
    EXPECT_NEAR(device_summary[i], summary[i], kMeanTolerance * static_cast<double>(summary[i])) << i;
  // A density between the two thresholds may count either way; one must be very unlucky to meet it.
  const auto [low, high] = std::minmax(summary[1], device_summary[1]);
  for (const float value : density) ASSERT_FALSE(value > low && value <= high) << value;
  const std::vector<float> bits = cpu(1), device_bits = device(1);
  ASSERT_EQ(std::memcmp(bits.data(), device_bits.data(), bits.size() * sizeof(float)), 0);
  ASSERT_EQ(cpu(2), device(2));
}

TEST_F(CudaOccupancyGrid, UpdatesAreThoseOfTheCpu) {
  const std::vector<std::int64_t> warm_up{0, 16, 32, 48};
  std::vector<std::int64_t> steps = warm_up;
  for (std::int64_t step = 64; step < 64 + 12 * 16; step += 16) steps.push_back(step);
  for (const Field field : {ball, hazy_ball, waves, nothing}) {
    for (const std::int64_t cascades : {1, 3}) {
      OccupancyGridParams params = small_grid();
      params.cascades = cascades;
      expect_same_state(params, field, warm_up);
      expect_same_state(params, field, steps);
    }
  }
}

TEST_F(CudaOccupancyGrid, AnUpdateOfSeveralQueries) {
  OccupancyGridParams params = small_grid();
  params.resolution = 96;  // 884,736 cells
  params.update_share = 0.7;
  expect_same_state(params, waves, {48, 64, 80});
}

double spoilt(Vec3d p) { return p.x > 2.5 ? std::nan("") : ball(p); }
double negative(Vec3d p) { return p.z > 1.5 ? -1 : ball(p); }

TEST_F(CudaOccupancyGrid, ABadDensityIsAFaultAndChangesNothing) {
  for (const Field field : {spoilt, negative}) {
    Subject subject(small_grid());
    subject.learn(ball, 80);
    DeviceLaunch launch;
    const DeviceTensors state(subject.box);
    std::array<std::vector<float>, 4> before;
    for (std::size_t i = 0; i < 4; ++i) before[i] = state.values[i]->read();
    StepContext ctx = context_at(80, true);
    ctx.workspace = &launch.arena();
    subject.grids.device.observe(ctx, state.values_only(), device_query(field));
    for (std::size_t i = 0; i < 4; ++i)
      EXPECT_EQ(std::memcmp(before[i].data(), state.values[i]->read().data(), before[i].size() * sizeof(float)), 0)
          << i;
    EXPECT_EQ(state.surroundings(), "");
    const std::optional<NotedFault> fault = launch.take_fault();
    ASSERT_TRUE(fault.has_value());
    EXPECT_EQ(fault->stage, cuda::Stage::occupancy_density);
    DeviceLaunch at_once(true);
    ctx.workspace = &at_once.arena();
    const auto on_device = [&] { subject.grids.device.observe(ctx, state.values_only(), device_query(field)); };
    Workspace workspace;
    StepContext host = ctx;
    host.workspace = &workspace;
    EXPECT_EQ(error_of(on_device),
              error_of([&] { subject.grids.cpu.observe(host, subject.box.values_only(), host_query(field)); }));
  }
}

TEST_F(CudaOccupancyGrid, LimitsThatAreNotFiniteAreAFault) {
  Subject subject(small_grid());
  HostRays rays = random_rays(9, 1, 0);
  rays.near_far[11] = INFINITY;
  DeviceLaunch launch;
  const DeviceTensors state(subject.box);
  DeviceBatch batch(subject.grids.device, rays, nullptr, 0);
  batch.sample(device_context(context_at(1, true), launch), state.values_only());
  EXPECT_EQ(launch.take_fault(), (NotedFault{cuda::Stage::rays, 5}));
  for (const float t : batch.read().t) ASSERT_TRUE(std::isfinite(t));
  DeviceLaunch at_once(true);
  const StepContext ctx = context_at(1, true);
  EXPECT_EQ(error_of([&] { batch.sample(device_context(ctx, at_once), state.values_only()); }),
            error_of([&] { sample_on_cpu(subject.grids.cpu, ctx, subject.box.values_only(), rays); }));
}

}  // namespace
}  // namespace semfield
