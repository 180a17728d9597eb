// Terms of the loss on the device against the processor's in float64.
#include "cuda/loss_terms.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <iostream>

#include "device_fixture.h"
#include "testkit/compare.h"
#include "tests/losses/loss_rays.h"

namespace semfield {
namespace {

using cuda::LossSums;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::LossRays;

constexpr double kScale = 0.37;
constexpr std::int64_t kUnused = 41;  // rows behind the samples that no ray owns

std::vector<float> with_tail(const std::vector<float>& values, float tail) {
  std::vector<float> all = values;
  all.insert(all.end(), static_cast<std::size_t>(kUnused), tail);
  return all;
}

// The rays there, columns a `gap` apart; gradients begin with 1.
struct DeviceRays {
  DeviceRays(const LossRays<float>& host, int gap)
      : first(host.first, 1),
        near_far(host.near_far, 2),
        truth(host.depth_target, 1),
        t(with_tail(host.t, 0.F), 1, 1 + gap),
        delta(with_tail(host.delta, 0.F), 1, 1 + gap),
        sigma(with_tail(host.sigma, 3.F), 1, 1 + gap),
        weight(with_tail(host.weight, 0.F), 1, 1 + gap),
        depth(host.depth, 1, 1 + gap),
        opacity(host.opacity, 1, 1 + gap),
        color(host.color, 3, 3 + gap),
        d_color(std::vector<float>(host.color.size(), 1.F), 3, 3 + gap),
        d_depth(std::vector<float>(host.depth.size(), 1.F), 1, 1 + gap),
        d_weight(with_tail(std::vector<float>(host.t.size(), 1.F), 1.F), 1, 1 + gap),
        d_sigma(with_tail(std::vector<float>(host.t.size(), 1.F), 1.F), 1, 1 + gap) {}
  RayTargets targets() const {
    RayTargets out;
    out.depth = truth.read_only();
    return out;
  }
  RayValues<float> values() const {
    return {near_far.read_only(), first.read_only(), t.read_only(),     delta.read_only(),  sigma.read_only(),
            weight.read_only(),   color.read_only(), depth.read_only(), opacity.read_only()};
  }
  RayGradients<float> gradients() const { return {d_color.view(), d_depth.view(), d_weight.view(), d_sigma.view()}; }
  std::string surroundings() const {
    return d_color.surroundings() + d_depth.surroundings() + d_weight.surroundings() + d_sigma.surroundings();
  }
  DeviceMatrix<std::int32_t> first;
  DeviceMatrix<double> near_far;
  DeviceMatrix<float> truth, t, delta, sigma, weight, depth, opacity, color;
  DeviceMatrix<float> d_color, d_depth, d_weight, d_sigma;
};

// The gradient that was added; rows that no ray owns must still hold 1.
std::vector<float> added(const DeviceMatrix<float>& gradient, std::size_t rows) {
  std::vector<float> values = gradient.read();
  for (std::size_t i = rows; i < values.size(); ++i) EXPECT_EQ(values[i], 1.F) << "unused row " << i;
  values.resize(rows);
  for (float& value : values) value -= 1;
  return values;
}

void expect_same(const testing::LossSetting& setting, const std::vector<int>& counts, int gap) {
  SCOPED_TRACE(setting.name + ", " + std::to_string(counts.size()) + " rays, gap " + std::to_string(gap));
  DeviceLaunch launch;
  const LossRays<float> host(counts);
  LossRays<double> want(counts);
  const double sum = want.add(*setting.term, kScale);
  std::vector<LossEntry> entries;
  for (const LossKind& kind : loss_kinds()) {
    if (setting.name.starts_with(kind.type)) entries = {{std::string(kind.type), setting.term, ""}};
  }
  ASSERT_EQ(entries.size(), 1u);
  // Second in a list of two, of which the first does not work.
  const LossList losses({entries[0], entries[0]});
  cuda::StepCell cell;
  cell.loss_scale[1] = kScale;
  launch.set_cell(cell);
  DeviceRays there(host, gap);
  const DeviceMatrix<LossSums> sums(std::vector<LossSums>(1), 1);
  const auto run = [&] {
    cuda::add_losses(launch.arena(), losses, 2, there.targets(), there.values(), there.gradients(), sums.data());
    return sums.read()[0];
  };
  const LossSums got = run();
  EXPECT_NEAR(got.terms[1], sum, 1e-6 * sum);
  EXPECT_EQ(got.terms[0], 0);
  EXPECT_EQ(got.squares, 0);
  // 1 was added to and taken from each of them.
  constexpr double kTolerance = 1e-5, kRounding = 1e-2;
  const auto compare = [&](const char* what, const DeviceMatrix<float>& gradient, const std::vector<double>& wanted) {
    const std::vector<float> values = added(gradient, wanted.size());
    EXPECT_EQ(testkit::compare(testing::host_view(values, 1), testing::host_view(wanted, 1), kTolerance, kRounding), "")
        << what;
  };
  compare("colour", there.d_color, want.d_color);
  compare("depth", there.d_depth, want.d_depth);
  compare("weight", there.d_weight, want.d_weight);
  compare("density", there.d_sigma, want.d_sigma);
  EXPECT_EQ(there.surroundings(), "");
  EXPECT_EQ(run().terms[1], got.terms[1]) << "a second run gave other bits";
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

// Of the terms that have kernels; EveryKindHasKernels names the others.
std::vector<testing::LossSetting> settings_with_kernels() {
  std::vector<testing::LossSetting> settings = testing::loss_settings();
  std::erase_if(settings, [](const testing::LossSetting& setting) {
    return std::none_of(loss_kinds().begin(), loss_kinds().end(),
                        [&](const LossKind& kind) { return kind.cuda && setting.name.starts_with(kind.type); });
  });
  EXPECT_FALSE(settings.empty());
  return settings;
}

TEST(CudaLossTerms, EveryTermAsTheProcessor) {
  SEMFIELD_NEEDS_DEVICE();
  for (const testing::LossSetting& setting : settings_with_kernels()) {
    for (const int gap : {0, 3}) expect_same(setting, testing::awkward_ray_lengths(), gap);
    expect_same(setting, {1023, 1024, 1025, 2049, 5000}, 0);
    for (const auto& counts : std::vector<std::vector<int>>{{0}, {1}, {0, 0, 3}}) expect_same(setting, counts, 0);
  }
}

TEST(CudaLossTerms, ManyRays) {
  SEMFIELD_NEEDS_DEVICE();
  std::vector<int> counts;
  for (int r = 0; r < 4097; ++r) counts.push_back(r * 7 % 40);
  for (const testing::LossSetting& setting : settings_with_kernels()) expect_same(setting, counts, 0);
}

// A batch without depth, as `bench step` makes it.
TEST(CudaLossTerms, NoTargetsAreNoLoss) {
  SEMFIELD_NEEDS_DEVICE();
  DeviceLaunch launch;
  const LossRays<float> host(testing::awkward_ray_lengths());
  DeviceRays there(host, 0);
  const DeviceMatrix<LossSums> sums(std::vector<LossSums>(1), 1);
  for (const LossKind& kind : loss_kinds()) {
    if (!kind.cuda || !kind.make()->traits().reads_depth) continue;
    cuda::add_losses(launch.arena(), LossList({{std::string(kind.type), kind.make(), ""}}), 1, {}, there.values(),
                     there.gradients(), sums.data());
    EXPECT_EQ(sums.read()[0].terms[0], 0) << kind.type;
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

// Those that the build says have them; a term of processors alone is named, and refused where it is asked for.
TEST(CudaLossTerms, EveryKindHasKernels) {
  for (const LossKind& kind : loss_kinds()) {
    const LossList list({{std::string(kind.type), kind.make(), ""}});
    if (kind.cuda) {
      EXPECT_NO_THROW(cuda::require_loss_kernels(list)) << kind.type;
      continue;
    }
    std::cout << "loss term '" << kind.type << "' has no cuda kernels: runs with it stay on the processor\n";
    EXPECT_THROW(cuda::require_loss_kernels(list), Error) << kind.type;
  }
  try {
    cuda::require_loss_kernels(LossList({{"elsewhere", nullptr, ""}}));
    FAIL() << "a term without kernels was taken";
  } catch (const Error& error) {
    EXPECT_NE(error.message().find("'elsewhere' has no CUDA kernels"), std::string::npos) << error.message();
  }
}

}  // namespace
}  // namespace semfield
