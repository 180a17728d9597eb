// The importance sampler on the device: the samples of the CPU, bit for bit. No tolerance: both compute
// with float64 in the same order, without fused operations.

#include "core/error.h"
#include "tests/cuda/sampler_bench.h"

namespace semfield {
namespace {

using namespace testing;

const std::string kRules[] = {"paper", "midpoint", "stratified_bin"};

using CudaImportance = testing::DeviceTest;

TEST_F(CudaImportance, SamplesAreThoseOfTheCpu) {
  for (const std::int64_t rays : {1, 33, 259}) {
    for (const std::int64_t per_ray : {0, 1, 31, 33, 64}) {
      for (const std::int64_t samples : {1, 32, 128, 129}) {
        const HostRays given = random_rays(rays, 6, per_ray == 33 ? 4 : 0);
        HostProposal previous = previous_of(given, per_ray, per_ray != 64);
        for (const std::string& rule : kRules) {
          const bool keep = (samples + (&rule - kRules)) % 2 == 0;
          const Twins twins(
              "importance",
              {{"samples", std::to_string(samples)}, {"quadrature", rule}, {"keep_previous", keep ? "true" : "false"}});
          EXPECT_EQ(compare(twins.cpu, twins.device, context_at(7, rule != "midpoint"), given, &previous, rays % 2 * 2),
                    "")
              << rays << " rays, " << per_ray << " before, " << samples << " samples, rule " << rule;
        }
      }
    }
  }
}

TEST_F(CudaImportance, RaysThatDoNotFitSharedMemory) {
  for (const std::string keep : {"false", "true"}) {
    for (const std::string samples : {"40", "3000"}) {
      const HostRays rays = random_rays(37, 8, 6);
      HostProposal previous = previous_of(rays, 1500, true);
      const Twins twins("importance", {{"samples", samples}, {"keep_previous", keep}});
      EXPECT_EQ(compare(twins.cpu, twins.device, context_at(2, true), rays, &previous, 0), "") << keep << samples;
    }
  }
}

TEST_F(CudaImportance, EqualDistancesAndLimitsInsideThePreviousSamples) {
  HostRays rays = random_rays(40, 9, 0);
  HostProposal previous = previous_of(rays, 20, false);
  for (std::size_t i = 0; i < previous.samples.t.size(); ++i) {
    if (i % 20 > 0 && i % 20 < 6) previous.samples.t[i] = previous.samples.t[i - 1];
  }
  for (std::size_t r = 0; r < 20; ++r) rays.near_far[2 * r] += 0.3 * (rays.near_far[2 * r + 1] - rays.near_far[2 * r]);
  const Twins twins("importance", {{"samples", "50"}});
  EXPECT_EQ(compare(twins.cpu, twins.device, context_at(2, true), rays, &previous, 0), "");
}

TEST(CudaSamplers, ACapturedGraphFollowsTheStepInTheCell) {
  SEMFIELD_NEEDS_DEVICE();
  const HostRays rays = random_rays(100, 12, 9);
  HostProposal previous = previous_of(rays, 64, false);
  const Twins twins("importance", {});
  DeviceLaunch launch;
  DeviceBatch batch(twins.device, rays, &previous, 0);
  const StepContext ctx = device_context(context_at(0, true), launch);
  batch.sample(ctx, {});
  cuda::check(cudaStreamSynchronize(launch.stream()), "a first pass");  // the arena has grown
  cudaGraph_t graph = nullptr;
  cudaGraphExec_t step = nullptr;
  cuda::check(cudaStreamBeginCapture(launch.stream(), cudaStreamCaptureModeThreadLocal), "capturing");
  batch.sample(ctx, {});
  cuda::check(cudaStreamEndCapture(launch.stream(), &graph), "capturing");
  cuda::check(cudaGraphInstantiate(&step, graph, 0), "a graph");
  for (const std::int64_t number : {3, 4, 1000000}) {
    (void)device_context(context_at(number, true), launch);
    cuda::check(cudaGraphLaunch(step, launch.stream()), "a step");
    EXPECT_EQ(difference(sample_on_cpu(twins.cpu, context_at(number, true), {}, rays, &previous), batch.read()), "")
        << number;
  }
  (void)cudaGraphExecDestroy(step);
  (void)cudaGraphDestroy(graph);
}

TEST_F(CudaImportance, ABadWeightIsAFault) {
  const Twins twins("importance", {});
  for (const float bad : {std::nanf(""), -1.F, std::numeric_limits<float>::infinity()}) {
    const HostRays rays = random_rays(30, 1, 0);
    HostProposal previous = previous_of(rays, 64, false);
    previous.weight[64 * 17 + 40] = bad;
    previous.weight[64 * 21 + 3] = bad;
    const StepContext ctx = context_at(1, true);
    DeviceLaunch later;
    DeviceBatch batch(twins.device, rays, &previous, 0);
    batch.sample(device_context(ctx, later), {});
    EXPECT_EQ(later.take_fault(), (NotedFault{cuda::Stage::proposal_weight, 17}));
    for (const float t : batch.read().t) ASSERT_TRUE(std::isfinite(t));
    DeviceLaunch at_once(true);
    EXPECT_EQ(error_of([&] { batch.sample(device_context(ctx, at_once), {}); }),
              error_of([&] { sample_on_cpu(twins.cpu, ctx, {}, rays, &previous); }));
  }
}

TEST_F(CudaImportance, MoreSamplesThanTheBatchMayHaveAreAFault) {
  const Twins twins("importance", {});
  const HostRays rays = random_rays(4, 1, 0);
  HostProposal previous = previous_of(rays, 8, false);
  previous.samples.first = {0, 9, 16, 24, 32};
  DeviceLaunch launch;
  DeviceBatch batch(twins.device, rays, &previous, 0);
  batch.sample(device_context(context_at(1, true), launch), {});
  EXPECT_EQ(launch.take_fault(), (NotedFault{cuda::Stage::samples, 0}));
  EXPECT_EQ(batch.read().first[1], 0);
}

}  // namespace
}  // namespace semfield
