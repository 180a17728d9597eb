// Hidden channels along rays on the device, kept as fp32 or bf16, against plain sums in float64; room for samples.
#include "cuda/kernels/kernels.h"
#include "cuda/steps/sample_room.h"
#include "cuda/stream_executor.h"
#include "device_fixture.h"
#include "session/trainer.h"
#include "testkit/compare.h"
#include "tests/cuda/device_fixture.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using testing::DeviceMatrix;
using testing::random_floats;
using Bf16 = __nv_bfloat16;

template <class Act>
class CudaHiddenChannels : public ::testing::Test {};
using Acts = ::testing::Types<float, Bf16>;
TYPED_TEST_SUITE(CudaHiddenChannels, Acts);

template <class Act>
std::vector<double> widened(const DeviceMatrix<Act>& matrix) {
  std::vector<double> wide;
  for (const Act x : matrix.read()) wide.push_back(static_cast<double>(static_cast<float>(x)));
  return wide;
}

struct Rays {
  explicit Rays(const std::vector<int>& counts) : first{0} {
    for (const int count : counts) {
      ray.insert(ray.end(), static_cast<std::size_t>(count), static_cast<std::int32_t>(first.size()) - 1);
      first.push_back(static_cast<std::int32_t>(ray.size()));
    }
    used = static_cast<std::int64_t>(ray.size());
    ray.resize(ray.size() + kUnused, static_cast<std::int32_t>(counts.size()) - 1);
    rows = static_cast<std::int64_t>(ray.size());
    weight = random_floats(rows, 1, -0.5, 1);
    for (float& w : weight) w = w < 0 ? 0.F : w;  // a third has none
  }
  static constexpr std::size_t kUnused = 21;
  std::vector<std::int32_t> first, ray;
  std::vector<float> weight;
  std::int64_t used = 0, rows = 0;
};

// Sums of the first `labelled` rays, and gradients behind a ReLU or not.
template <class Act>
void expect_same(const Rays& rays, std::int32_t channels, int gap, std::int64_t labelled, bool relu_output) {
  SCOPED_TRACE(std::to_string(channels) + " channels, gap " + std::to_string(gap) + ", labelled " +
               std::to_string(labelled) + ", relu " + std::to_string(relu_output));
  const DeviceMatrix<std::int32_t> first(rays.first, 1), ray(rays.ray, 1);
  const DeviceMatrix<float> weight(rays.weight, 1, 2),
      d_out(random_floats(labelled * channels, 3, -1, 1), channels, channels + gap);
  const DeviceMatrix<Act> hidden(random_floats(rays.rows * channels, 2, -1, 1), channels, channels + gap);
  const DeviceMatrix<float> out(labelled, channels, channels + gap), dots(rays.rows, 1, 3);
  const DeviceMatrix<Act> d_hidden(rays.rows, channels, channels + gap);
  Samples<float> samples;
  samples.first = first.view();
  samples.ray_of_sample = ray.view();
  samples.count = rays.rows;
  cuda::HiddenBackward<Act> call{weight.read_only(), hidden.read_only(), d_out.read_only(),
                                 dots.view(),        d_hidden.view(),    relu_output};
  cuda::hidden_forward<Act>(samples, weight.read_only(), hidden.read_only(), out.view());
  cuda::hidden_backward<Act>(samples, call);

  const std::vector<double> h = widened(hidden), g = widened(d_out);
  std::vector<double> want_out(static_cast<std::size_t>(labelled * channels)), want_d(h.size());
  const std::vector<float> got_dots = dots.read();
  const std::int64_t live = rays.first[labelled];
  for (std::int64_t m = 0; m < live; ++m) {
    const auto r = static_cast<std::size_t>(rays.ray[m]);
    const auto w = static_cast<double>(rays.weight[m]);
    double dot = 0, terms = 0;
    for (std::int32_t c = 0; c < channels; ++c) {
      const auto at = static_cast<std::size_t>(m * channels + c);
      const auto of_ray = r * static_cast<std::size_t>(channels) + static_cast<std::size_t>(c);
      want_out[of_ray] += w * h[at];
      dot += g[of_ray] * h[at];
      terms += std::abs(g[of_ray] * h[at]);
      want_d[at] = relu_output && h[at] <= 0 ? 0 : w * g[of_ray];
    }
    ASSERT_NEAR(got_dots[m], dot, 3e-7 * terms) << m;
  }
  for (std::int64_t m = live; m < rays.rows; ++m)
    ASSERT_TRUE(std::isnan(got_dots[m])) << "row " << m << " is left alone";
  const std::vector<double> got_out = widened(out), got_d = widened(d_hidden);
  EXPECT_EQ(testkit::compare(testing::host_view(got_out, channels),
                             testing::host_view(std::as_const(want_out), channels), 5e-6),
            "");
  const double rounding =
      std::is_same_v<Act, Bf16> ? 1.0 / 256 : 1e-7;  // half of a last bit: 2^-8 of a number just above a power of two
  for (std::size_t i = 0; i < got_d.size(); ++i)
    ASSERT_NEAR(got_d[i], want_d[i], rounding * std::abs(want_d[i])) << "element " << i;
  EXPECT_EQ(out.surroundings() + dots.surroundings() + d_hidden.surroundings(), "");
}

TYPED_TEST(CudaHiddenChannels, SumsAndGradients) {
  SEMFIELD_ON_DEVICE(launch);
  const Rays rays({31, 0, 1, 32, 33, 0, 0, 64, 127, 128, 129, 5, 300, 0});
  for (const std::int32_t channels : {1, 4, 29, 32, 36, 64, 100, 128, 132, 300}) {
    for (const int gap : {0, 1, 4, 8}) {
      for (const std::int64_t labelled : {0, 7, 14}) {
        for (const bool relu_output : {false, true}) expect_same<TypeParam>(rays, channels, gap, labelled, relu_output);
      }
    }
  }
}

TYPED_TEST(CudaHiddenChannels, GradientsInBlocksAreTheSame) {
  SEMFIELD_ON_DEVICE(launch);
  const Rays rays({31, 0, 64, 129, 5, 300});
  constexpr std::int32_t kChannels = 128;
  constexpr std::int64_t kLabelled = 4, kMore = 768;  // rows of gradients, more than of samples
  const DeviceMatrix<std::int32_t> first(rays.first, 1), ray(rays.ray, 1);
  const DeviceMatrix<float> weight(rays.weight, 1), d_out(random_floats(kLabelled * kChannels, 3, -1, 1), kChannels);
  const DeviceMatrix<TypeParam> hidden(random_floats(rays.rows * kChannels, 2, -1, 1), kChannels);
  const DeviceMatrix<TypeParam> in_rows(kMore, kChannels), in_blocks(kMore, kChannels);
  Samples<float> samples;
  samples.first = first.view();
  samples.ray_of_sample = ray.view();
  samples.count = rays.rows;
  cuda::HiddenBackward<TypeParam> call{
      weight.read_only(), hidden.read_only(), d_out.read_only(), {}, in_rows.view(), true};
  cuda::hidden_backward<TypeParam>(samples, call);
  call.d_hidden = in_blocks.view();
  call.blocked = true;
  cuda::hidden_backward<TypeParam>(samples, call);
  const std::vector<double> want = widened(in_rows), got = widened(in_blocks);
  for (std::int64_t m = 0; m < kMore; ++m) {
    for (std::int32_t c = 0; c < kChannels; ++c)
      ASSERT_EQ(got[(m / 8 * (kChannels / 8) + c / 8) * 64 + m % 8 * 8 + c % 8], want[m * kChannels + c])
          << m << ", " << c;
  }
  EXPECT_EQ(in_blocks.surroundings(), "");
}

TYPED_TEST(CudaHiddenChannels, ASampleWithoutWeightIsNotRead) {
  SEMFIELD_ON_DEVICE(launch);
  const std::vector<std::int32_t> offsets{0, 3};
  std::vector<float> values(3 * 64, 2.F);
  for (std::size_t i = 64; i < 128; ++i) values[i] = std::numeric_limits<float>::infinity();
  const DeviceMatrix<std::int32_t> first(offsets, 1);
  const DeviceMatrix<float> weight(std::vector<float>{0.25F, 0, 0.5F}, 1), out(1, 64);
  const DeviceMatrix<TypeParam> hidden(values, 64);
  Samples<float> samples{.first = first.view()};
  cuda::hidden_forward<TypeParam>(samples, weight.read_only(), hidden.read_only(), out.view());
  EXPECT_EQ(out.read(), std::vector<float>(64, 1.5F));
}

// Room for samples on a device: how it follows what steps use, and that a step with too little of it is made again.

using namespace testing_train;
using cuda::SampleRoom;

TEST(SampleRoom, FollowsWhatStepsUseWithAQuarterToSpare) {
  constexpr std::int64_t kMost = 8192 * 1024;
  SampleRoom room;
  room.begin(kMost);
  EXPECT_EQ(room.rows(), 0);
  EXPECT_FALSE(room.saw(kMost));
  EXPECT_EQ(room.rows(), 0);
  EXPECT_TRUE(room.saw(200'000));
  const std::int64_t first = room.rows();
  EXPECT_GE(first, 250'000);
  EXPECT_LE(first, 285'000);
  EXPECT_FALSE(room.saw(180'000));  // hardly less
  EXPECT_FALSE(room.saw(230'000));
  EXPECT_EQ(room.rows(), first);
  EXPECT_TRUE(room.saw(first - 1000));  // the next step might need more
  EXPECT_GT(room.rows(), first);
  EXPECT_TRUE(room.saw(100));
  EXPECT_EQ(room.rows(), 8192);
  EXPECT_TRUE(room.saw(kMost - 1));
  EXPECT_EQ(room.rows(), 0);
}

TEST(SampleRoom, OfASamplerThatUsesItAllIsNeverLess) {
  SampleRoom room;
  room.begin(0);
  EXPECT_FALSE(room.saw(10));
  EXPECT_EQ(room.rows(), 0);
}

std::string roomy_config() {
  std::string yaml = hash_config();
  return yaml.replace(yaml.find("max_samples: 96"), 15, "max_samples: 512, step_m: 0.1");
}

struct Subject {
  Subject(const std::string& more, Registry& registry)
      : session(open_text(roomy_config() + "runtime: {device: cuda" + more + "}\n", registry)) {}
  SampleRoom& room() { return dynamic_cast<cuda::StreamExecutor&>(session.pipeline->executor()).sample_room(); }
  std::uint32_t bits() {
    trainer.collect();
    return fingerprint(session.pipeline->store());
  }

  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
};

// Several steps are queued; room is short from the first, and later ones change nothing until it is made again.
TEST(CudaSampleRoom, AStepWithTooLittleIsMadeAgainToTheSameBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject plain(", deterministic: true", registry), limited(", deterministic: true", registry);
  for (const std::int64_t given : {64, 300}) {
    limited.room().give(given);
    const std::span<const StepLosses> a = plain.trainer.advance_many(2);
    const std::vector<StepLosses> want(a.begin(), a.end());
    const std::span<const StepLosses> got = limited.trainer.advance_many(2);
    ASSERT_EQ(got.size(), want.size());
    for (std::size_t i = 0; i < got.size(); ++i) {
      EXPECT_GT(want[i].samples, 8 * given);
      EXPECT_EQ(got[i].samples, want[i].samples);
      EXPECT_EQ(got[i].total, want[i].total);
    }
    EXPECT_EQ(limited.trainer.step(), plain.trainer.step());
    EXPECT_EQ(limited.bits(), plain.bits());
    EXPECT_EQ(limited.room().rows(), 0);
  }
}

TEST(CudaSampleRoom, ShrinksWhereMostIsUnusedAndTrainingGoesOn) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject run(", precision: bf16", registry), exact(", precision: bf16, deterministic: true", registry);
  double color = 0, same = 0;
  while (run.trainer.step() < 160) {
    for (const StepLosses& losses : run.trainer.advance_many(160 - run.trainer.step())) color = losses.color;
    for (const StepLosses& losses : exact.trainer.advance_many(run.trainer.step() - exact.trainer.step()))
      same = losses.color;
  }
  EXPECT_GT(run.room().rows(), 0);
  EXPECT_LT(run.room().rows(), 192 * 512);
  EXPECT_EQ(exact.room().rows(), 0);
  EXPECT_LT(std::abs(color - same), 0.3 * same);
}

}  // namespace
}  // namespace semfield
