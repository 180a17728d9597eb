// Stratified and importance samplers on the device: the samples of the CPU, bit for bit. No tolerance: both compute
// with float64 in the same order, without fused operations.
#include <algorithm>
#include <limits>

#include "core/error.h"
#include "sampler_bench.h"
#include "samplers/importance/importance.h"
#include "samplers/stratified/stratified.h"

namespace semfield {
namespace {

using namespace testing;

constexpr Quadrature kRules[] = {Quadrature::paper, Quadrature::midpoint, Quadrature::stratified_bin};

std::string compare(const Sampler<float>& cpu, const Sampler<float>& device, const StepContext& ctx,
                    const HostRays& rays, HostProposal* previous, std::int64_t gap) {
  DeviceLaunch launch;
  const HostSamples want = sample_on_cpu(cpu, ctx, {}, rays, previous);
  DeviceBatch batch(device, rays, previous, gap);
  batch.sample(device_context(ctx, launch), {});
  const HostSamples got = batch.read();
  EXPECT_EQ(launch.take_fault(), std::nullopt);
  return difference(want, got);
}

constexpr std::pair<Quadrature, SampleSpacing> kRulesAndSpacings[] = {
    {Quadrature::paper, SampleSpacing::linear},
    {Quadrature::midpoint, SampleSpacing::linear},
    {Quadrature::stratified_bin, SampleSpacing::linear},
    {Quadrature::paper, SampleSpacing::disparity},
    {Quadrature::stratified_bin, SampleSpacing::disparity}};

TEST(CudaStratified, SamplesAreThoseOfTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t rays : {1, 31, 33, 1025}) {
    for (const std::int64_t samples : {1, 31, 32, 64, 100}) {
      for (const auto& [rule, spacing] : kRulesAndSpacings) {
        const Twins<Stratified> twins(StratifiedParams{samples, rule, spacing});
        for (const bool training : {false, true}) {
          const std::int64_t empty_every = (rays + samples) % 3;  // none, all, every other
          EXPECT_EQ(compare(twins.cpu, twins.device, context_at(samples, training), random_rays(rays, 1, empty_every),
                            nullptr, rays % 2),
                    "")
              << rays << " rays, " << samples << " samples, rule " << static_cast<int>(rule) << ", " << training;
        }
      }
    }
  }
}

TEST(CudaStratified, ManyRaysAreCountedOverManyBlocks) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t rays : {1023, 1024, 4097, 65537}) {
    const Twins<Stratified> twins(StratifiedParams{3, Quadrature::paper});
    EXPECT_EQ(compare(twins.cpu, twins.device, context_at(9, true), random_rays(rays, 2, 7), nullptr, 0), "") << rays;
  }
}

TEST(CudaStratified, NoRaysNoLaunch) {
  SEMFIELD_NEEDS_DEVICE();
  const Twins<Stratified> twins(StratifiedParams{});
  const HostRays none;
  DeviceLaunch launch(true);
  DeviceBatch batch(twins.device, none, nullptr, 0);
  batch.sample(device_context(context_at(0, true), launch), {});
  EXPECT_EQ(batch.read().t.size(), 0u);
}

// Previous samples of `rays`: up to `per_ray` a ray, fewer on every third ray if ragged, with weights of many sizes,
// spikes, and rays without any weight.
HostProposal previous_of(const HostRays& rays, std::int64_t per_ray, bool ragged) {
  const Twins<Stratified> twins(StratifiedParams{std::max<std::int64_t>(1, per_ray), Quadrature::paper});
  const HostSamples all = sample_on_cpu(twins.cpu, context_at(3, true), {}, rays);
  HostProposal previous;
  previous.per_ray = per_ray;
  previous.samples.first.push_back(0);
  for (std::int64_t r = 0; r < rays.count(); ++r) {
    const std::int32_t begin = all.first[static_cast<std::size_t>(r)];
    const std::int64_t given = all.first[static_cast<std::size_t>(r + 1)] - begin;
    const std::int64_t kept = std::min(per_ray, ragged && r % 3 == 1 ? r % (given + 1) : given);
    for (std::int64_t k = 0; k < kept; ++k) {
      const auto at = static_cast<std::size_t>(begin + k);
      const float u = uniform01({4, 0, 5}, static_cast<std::uint64_t>(begin + k));
      previous.samples.t.push_back(all.t[at]);
      previous.samples.delta.push_back(all.delta[at]);
      previous.samples.ray.push_back(static_cast<std::int32_t>(r));
      previous.weight.push_back(r % 5 == 0 ? 0.F : r % 5 == 1 ? (k == kept / 2 ? 1.F : 0.F) : std::exp(-20 * u));
    }
    previous.samples.first.push_back(static_cast<std::int32_t>(previous.samples.t.size()));
  }
  return previous;
}

TEST(CudaImportance, SamplesAreThoseOfTheCpu) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t rays : {1, 33, 259}) {
    for (const std::int64_t per_ray : {0, 1, 31, 33, 64}) {
      for (const std::int64_t samples : {1, 32, 128, 129}) {
        const HostRays given = random_rays(rays, 6, per_ray == 33 ? 4 : 0);
        HostProposal previous = previous_of(given, per_ray, per_ray != 64);
        for (const Quadrature rule : kRules) {
          ImportanceParams params;
          params.samples = samples;
          params.quadrature = rule;
          params.keep_previous = (samples + static_cast<int>(rule)) % 2 == 0;
          const Twins<Importance> twins(params);
          EXPECT_EQ(compare(twins.cpu, twins.device, context_at(7, rule != Quadrature::midpoint), given, &previous,
                            rays % 2 * 2),
                    "")
              << rays << " rays, " << per_ray << " before, " << samples << " samples, rule " << static_cast<int>(rule);
        }
      }
    }
  }
}

TEST(CudaImportance, RaysThatDoNotFitSharedMemory) {
  SEMFIELD_NEEDS_DEVICE();
  for (const bool keep : {false, true}) {
    for (const std::int64_t samples : {40, 3000}) {
      const HostRays rays = random_rays(37, 8, 6);
      HostProposal previous = previous_of(rays, 1500, true);
      ImportanceParams params;
      params.samples = samples;
      params.keep_previous = keep;
      const Twins<Importance> twins(params);
      EXPECT_EQ(compare(twins.cpu, twins.device, context_at(2, true), rays, &previous, 0), "") << keep << samples;
    }
  }
}

TEST(CudaImportance, EqualDistancesAndLimitsInsideThePreviousSamples) {
  SEMFIELD_NEEDS_DEVICE();
  HostRays rays = random_rays(40, 9, 0);
  HostProposal previous = previous_of(rays, 20, false);
  for (std::size_t i = 0; i < previous.samples.t.size(); ++i) {
    if (i % 20 > 0 && i % 20 < 6) previous.samples.t[i] = previous.samples.t[i - 1];
  }
  for (std::size_t r = 0; r < 20; ++r) rays.near_far[2 * r] += 0.3 * (rays.near_far[2 * r + 1] - rays.near_far[2 * r]);
  ImportanceParams params;
  params.samples = 50;
  const Twins<Importance> twins(params);
  EXPECT_EQ(compare(twins.cpu, twins.device, context_at(2, true), rays, &previous, 0), "");
}

TEST(CudaSamplers, ACapturedGraphFollowsTheStepInTheCell) {
  SEMFIELD_NEEDS_DEVICE();
  const HostRays rays = random_rays(100, 12, 9);
  HostProposal previous = previous_of(rays, 64, false);
  const Twins<Importance> twins(ImportanceParams{});
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

TEST(CudaSamplers, LimitsThatAreNotFiniteAreAFault) {
  SEMFIELD_NEEDS_DEVICE();
  const Twins<Stratified> twins(StratifiedParams{});
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

TEST(CudaImportance, ABadWeightIsAFault) {
  SEMFIELD_NEEDS_DEVICE();
  const Twins<Importance> twins(ImportanceParams{});
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

TEST(CudaImportance, MoreSamplesThanTheBatchMayHaveAreAFault) {
  SEMFIELD_NEEDS_DEVICE();
  const Twins<Importance> twins(ImportanceParams{});
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
