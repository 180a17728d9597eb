// Losses on the device against the CPU's in float64.
#include <iostream>

#include "cuda/kernel_tables.h"
#include "cuda/stages.h"
#include "device_fixture.h"
#include "testkit/compare.h"
#include "testkit/loss_rays.h"
#include "tests/conformance/rows.h"
#include "tests/says.h"

namespace semfield {
namespace {

using cuda::LossSums;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testkit::LossRays;

constexpr double kScale = 0.37;
constexpr std::int64_t kUnused = 41;  // rows behind the samples that no ray owns
constexpr std::int32_t kClasses = LossRays<float>::kClasses, kColumns = LossRays<float>::kColumns;

std::vector<float> with_tail(const std::vector<float>& values, float tail) {
  std::vector<float> all = values;
  all.insert(all.end(), static_cast<std::size_t>(kUnused), tail);
  return all;
}
std::vector<float> ones(std::size_t count) { return std::vector<float>(count, 1.F); }

// The rays there, columns a `gap` apart; gradients begin with 1.
struct DeviceRays {
  DeviceRays(const LossRays<float>& host, int gap)
      : unit_m(host.unit_m),
        first(host.first, 1),
        near_far(host.near_far, 2),
        label(host.label, 1),
        truth(host.depth_target, 1),
        alpha(host.alpha_target, 1),
        soft(host.soft, kClasses),
        t(with_tail(host.t, 0.F), 1, 1 + gap),
        delta(with_tail(host.delta, 0.F), 1, 1 + gap),
        sigma(with_tail(host.sigma, 3.F), 1, 1 + gap),
        weight(with_tail(host.weight, 0.F), 1, 1 + gap),
        depth(host.depth, 1, 1 + gap),
        opacity(host.opacity, 1, 1 + gap),
        color(host.color, 3, 3 + gap),
        logits(host.logits, kClasses, kClasses + gap),
        further(host.further),
        target(host.further_target, kColumns),
        made(host.made, kColumns, kColumns + gap),
        d_color(ones(host.color.size()), 3, 3 + gap),
        d_depth(ones(host.depth.size()), 1, 1 + gap),
        d_weight(with_tail(ones(host.t.size()), 1.F), 1, 1 + gap),
        d_sigma(with_tail(ones(host.t.size()), 1.F), 1, 1 + gap),
        d_logits(ones(host.logits.size()), kClasses, kClasses + gap),
        d_made(ones(host.made.size()), kColumns, kColumns + gap) {}
  RayTargets targets() const {
    RayTargets out{.label = label.read_only()};
    out.more.set(channel::depth, truth.read_only());
    out.more.set(channel::alpha, alpha.read_only());
    if (soft.view().rows > 0) out.more.set(channel::soft_label, soft.read_only());
    if (!further.target.empty()) out.more.set(further.target, target.read_only());
    return out;
  }
  RayValues<float> values() const {
    RayValues<float> out{
        near_far.read_only(), first.read_only(), t.read_only(),     delta.read_only(),   sigma.read_only(),
        weight.read_only(),   color.read_only(), depth.read_only(), opacity.read_only(), {}};
    out.heads.set(channel::logits, logits.read_only());
    if (!further.head.empty()) out.heads.set(further.head, made.read_only());
    out.unit_m = unit_m;
    return out;
  }
  RayGradients<float> gradients() const {
    RayGradients<float> out{d_color.view(), d_depth.view(), d_weight.view(), d_sigma.view(), {}};
    out.heads.set(channel::logits, d_logits.view());
    if (!further.head.empty()) out.heads.set(further.head, d_made.view());
    return out;
  }
  std::string surroundings() const {
    return d_color.surroundings() + d_depth.surroundings() + d_weight.surroundings() + d_sigma.surroundings() +
           d_logits.surroundings() + d_made.surroundings();
  }
  double unit_m;
  DeviceMatrix<std::int32_t> first;
  DeviceMatrix<double> near_far;
  DeviceMatrix<std::int16_t> label;
  DeviceMatrix<float> truth, alpha, soft, t, delta, sigma, weight, depth, opacity, color, logits;
  testkit::FurtherChannels further;
  DeviceMatrix<float> target, made;
  DeviceMatrix<float> d_color, d_depth, d_weight, d_sigma, d_logits, d_made;
};

// The gradient that was added; rows that no ray owns must still hold 1.
std::vector<float> added(const DeviceMatrix<float>& gradient, std::size_t rows) {
  std::vector<float> values = gradient.read();
  for (std::size_t i = rows; i < values.size(); ++i) EXPECT_EQ(values[i], 1.F) << "unused row " << i;
  values.resize(rows);
  for (float& value : values) value -= 1;
  return values;
}

const KernelTables& kernels() {
  static const KernelTables tables = testing::tables_of({cuda::add_plugin_kernels});
  return tables;
}

// A loss of a conformance row, with its kernels; none for a loss of CPUs alone.
std::vector<cuda::DeviceLoss> device_losses(const testkit::Row& row) {
  const PluginEntry& entry = testkit::linked_registry().get(PluginKind::loss, row.name);
  std::shared_ptr<const Loss> loss = entry.loss(*testkit::make_params(entry, row.settings));
  if (!kernels().has(Device::cuda, "loss '" + row.name + "'")) {
    std::cout << "loss '" << row.name << "' has no cuda kernels: runs with it stay on the CPU\n";
    return {};
  }
  const LossList list({{row.name, loss, nullptr, ""}, {row.name, loss, nullptr, ""}});
  return cuda::loss_kernels(list, &kernels());
}

void expect_same(const testkit::Row& row, const std::vector<int>& counts, int gap, bool soft_labels = false) {
  SCOPED_TRACE(row.text() + ", " + std::to_string(counts.size()) + " rays, gap " + std::to_string(gap));
  const std::vector<cuda::DeviceLoss> losses = device_losses(row);
  if (losses.empty()) return;
  DeviceLaunch launch;
  const testkit::FurtherChannels further(losses[0].loss->traits());
  LossRays<float> host(counts, 1, soft_labels, further);
  LossRays<double> want(counts, 1, soft_labels, further);
  host.unit_m = want.unit_m = 1.75;
  const double sum = want.add(*losses[0].loss, kScale);
  // Second in a list of two, of which the first does not work.
  cuda::StepCell cell;
  cell.loss_scale[1] = kScale;
  launch.set_cell(cell);
  DeviceRays there(host, gap);
  const DeviceMatrix<LossSums> sums(std::vector<LossSums>(1), 1);
  const auto run = [&] {
    cuda::add_losses(launch.arena(), losses, 2, {there.targets(), there.values(), there.gradients()}, sums.data());
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
  compare("logits", there.d_logits, want.d_logits);
  compare("a head's channel", there.d_made, want.d_made);
  EXPECT_EQ(there.surroundings(), "");
  EXPECT_EQ(run().terms[1], got.terms[1]) << "a second run gave other bits";
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

TEST(CudaLosses, EachAsTheProcessor) {
  SEMFIELD_NEEDS_DEVICE();
  for (const testkit::Row& row : testkit::rows_of(PluginKind::loss)) {
    for (const int gap : {0, 3}) expect_same(row, testkit::awkward_ray_lengths(), gap);
    expect_same(row, testkit::awkward_ray_lengths(), 0, true);
    expect_same(row, {1023, 1024, 1025, 2049, 5000}, 0);
    for (const auto& counts : std::vector<std::vector<int>>{{0}, {1}, {0, 0, 3}}) expect_same(row, counts, 0);
  }
}

TEST(CudaLosses, ManyRays) {
  SEMFIELD_NEEDS_DEVICE();
  std::vector<int> counts;
  for (int r = 0; r < 4097; ++r) counts.push_back(r * 7 % 40);
  for (const testkit::Row& row : testkit::rows_of(PluginKind::loss)) expect_same(row, counts, 0);
}

// A batch without what a loss compares with, as `bench step` makes it.
TEST(CudaLosses, NoTargetsAreNoLoss) {
  SEMFIELD_ON_DEVICE(launch);
  const DeviceMatrix<LossSums> sums(std::vector<LossSums>(1), 1);
  for (const testkit::Row& row : testkit::rows_of(PluginKind::loss)) {
    const std::vector<cuda::DeviceLoss> losses = device_losses(row);
    if (losses.empty() || losses[0].loss->traits().targets.empty()) continue;
    const testkit::FurtherChannels further(losses[0].loss->traits());
    const DeviceRays there(LossRays<float>(testkit::awkward_ray_lengths(), 1, false, further), 0);
    cuda::add_losses(launch.arena(), losses, 1, {{}, there.values(), there.gradients()}, sums.data());
    EXPECT_EQ(sums.read()[0].terms[0], 0) << row.text();
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

struct ElsewhereParams : LossRule {};
class Elsewhere final : public LossOf<Elsewhere, ElsewhereParams> {
 public:
  LossTraits traits() const override { return {}; }
  template <class Real>
  double sum(const RayTargets&, const RayValues<Real>&, double, const RayGradients<Real>&) const {
    return 0;
  }
};

TEST(CudaLosses, OneWithoutKernelsIsRefusedByName) {
  EXPECT_HAS(
      error_of([&] {
        (void)cuda::loss_kernels(LossList({{"elsewhere", std::make_shared<Elsewhere>(), nullptr, ""}}), &kernels());
      }),
      "loss 'elsewhere' has no cuda kernels");
}

}  // namespace
}  // namespace semfield
