// The stratified sampler on the device: the samples of the CPU, bit for bit. No tolerance: both compute
// with float64 in the same order, without fused operations.

#include "core/error.h"
#include "tests/cuda/sampler_bench.h"

namespace semfield {
namespace {

using namespace testing;

constexpr std::pair<const char*, const char*> kRulesAndSpacings[] = {{"paper", "linear"},
                                                                     {"midpoint", "linear"},
                                                                     {"stratified_bin", "linear"},
                                                                     {"paper", "disparity"},
                                                                     {"stratified_bin", "disparity"}};

using CudaStratified = testing::DeviceTest;

TEST_F(CudaStratified, SamplesAreThoseOfTheCpu) {
  for (const std::int64_t rays : {1, 31, 33, 1025}) {
    for (const std::int64_t samples : {1, 31, 32, 64, 100}) {
      for (const auto& [rule, spacing] : kRulesAndSpacings) {
        const Twins twins("stratified",
                          {{"samples", std::to_string(samples)}, {"quadrature", rule}, {"spacing", spacing}});
        for (const bool training : {false, true}) {
          const std::int64_t empty_every = (rays + samples) % 3;  // none, all, every other
          EXPECT_EQ(compare(twins.cpu, twins.device, context_at(samples, training), random_rays(rays, 1, empty_every),
                            nullptr, rays % 2),
                    "")
              << rays << " rays, " << samples << " samples, rule " << rule << ", " << training;
        }
      }
    }
  }
}

TEST_F(CudaStratified, ManyRaysAreCountedOverManyBlocks) {
  for (const std::int64_t rays : {1023, 1024, 4097, 65537}) {
    const Twins twins("stratified", {{"samples", "3"}});
    EXPECT_EQ(compare(twins.cpu, twins.device, context_at(9, true), random_rays(rays, 2, 7), nullptr, 0), "") << rays;
  }
}

TEST_F(CudaStratified, NoRaysNoLaunch) {
  const Twins twins("stratified", {});
  const HostRays none;
  DeviceLaunch launch(true);
  DeviceBatch batch(twins.device, none, nullptr, 0);
  batch.sample(device_context(context_at(0, true), launch), {});
  EXPECT_EQ(batch.read().t.size(), 0u);
}

TEST(CudaSamplers, LimitsThatAreNotFiniteAreAFault) {
  SEMFIELD_NEEDS_DEVICE();
  const Twins twins("stratified", {});
  for (const double bad : {std::numeric_limits<double>::infinity(), std::nan("")}) {
    HostRays rays = random_rays(1500, 1, 0);
    rays.near_far[2 * 1100 + 1] = bad;
    rays.near_far[2 * 1400] = bad;
    const StepContext ctx = context_at(1, true);
    DeviceLaunch later;
    DeviceBatch batch(twins.device, rays, nullptr, 0);
    batch.sample(device_context(ctx, later), {});
    EXPECT_EQ(later.take_fault(), (NotedFault{cuda::Stage::rays, 1100}));
    const HostSamples got = batch.read();
    EXPECT_EQ(got.live(), 1498 * 64);
    for (const float t : got.t) ASSERT_TRUE(std::isfinite(t));
    DeviceLaunch at_once(true);
    EXPECT_EQ(error_of([&] { batch.sample(device_context(ctx, at_once), {}); }),
              error_of([&] { sample_on_cpu(twins.cpu, ctx, {}, rays); }));
    EXPECT_EQ(at_once.take_fault(), std::nullopt);
  }
}

}  // namespace
}  // namespace semfield
