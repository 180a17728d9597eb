// Losses on the device against the CPU's in float64.

#include <algorithm>
#include <iostream>

#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "model/losses/semantic_cross_entropy.h"
#include "surface/objects/object_network.h"
#include "testkit/compare.h"
#include "testkit/loss_rays.h"
#include "tests/conformance/rows.h"

namespace semfield {
namespace {

using cuda::LossSums;
using cuda::Stage;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::NotedFault;

constexpr float kInf = std::numeric_limits<float>::infinity();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

TEST(CudaPhotometric, LossAndGradient) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t rays : {0, 1, 31, 33, 1365, 1366, 4097, 400000}) {
    const std::vector<float> color = testing::random_floats(3 * rays, 1, 0, 1);
    const std::vector<float> target = testing::random_floats(3 * rays, 2, 0, 1);
    const DeviceMatrix<float> color_there(color, 3, 4), target_there(target, 3, 5), d_color(rays, 3, 6);
    const DeviceMatrix<LossSums> sums(1, 1);
    const double normaliser = 3.0 * static_cast<double>(rays) + 1;
    cuda::photometric_loss(launch.arena(), color_there.read_only(), target_there.read_only(), normaliser,
                           d_color.view(), sums.data());
    const std::vector<double> wide = testing::widen(color);
    std::vector<double> d_want(color.size());
    const double want = photometric_loss<double>(testing::host_view(wide, 3), testing::host_view(target, 3), normaliser,
                                                 1, testing::host_view(d_want, 3));
    const double got = sums.read()[0].squares;
    EXPECT_NEAR(got, want, 1e-12 * want) << rays;
    const std::vector<float> d_got = d_color.read();
    for (std::size_t i = 0; i < d_got.size(); ++i) ASSERT_EQ(d_got[i], static_cast<float>(d_want[i])) << i;
    EXPECT_EQ(d_color.surroundings(), "");
    cuda::photometric_loss(launch.arena(), color_there.read_only(), target_there.read_only(), normaliser, {},
                           sums.data());
    EXPECT_EQ(sums.read()[0].squares, got) << "a second run gave other bits";
  }
}

struct Semantic {
  Semantic(std::int64_t rays_in, std::int32_t classes_in, double spread) : rays(rays_in), classes(classes_in) {
    logits = testing::random_floats(rays * classes, 3, -spread, spread);
    const std::vector<float> draws = testing::random_floats(rays, 4, -1, static_cast<double>(classes));
    for (const float x : draws) hard.push_back(static_cast<std::int16_t>(std::floor(x)));
    soft = testing::random_floats(rays * classes, 5, 0, 2);
    for (std::int64_t r = 2; r < rays; r += 3) std::fill_n(soft.begin() + r * classes, classes, 0.F);  // unlabelled
    weight = testing::random_floats(classes, 6, 0.1, 4);
  }
  std::int64_t rays;
  std::int32_t classes;
  std::vector<float> logits, soft, weight;
  std::vector<std::int16_t> hard;
};

void expect_same(DeviceLaunch& launch, const Semantic& s, bool is_hard, bool weighted, double normaliser) {
  SCOPED_TRACE(std::to_string(s.rays) + " rays, " + std::to_string(s.classes) + " classes, hard " +
               std::to_string(is_hard) + ", weighted " + std::to_string(weighted));
  cuda::StepCell cell{.semantic_normaliser = normaliser};
  launch.set_cell(cell);
  const DeviceMatrix<float> logits(s.logits, s.classes, s.classes + 3), soft(s.soft, s.classes, s.classes + 1),
      weight(s.weight, s.classes), d_logits(s.rays, s.classes, s.classes + 2);
  const DeviceMatrix<std::int16_t> hard(s.hard, 1, 2);
  const DeviceMatrix<LossSums> sums(1, 1);
  SemanticTargets there, here;
  if (is_hard) {
    there.hard = hard.read_only();
    here.hard = testing::host_view(s.hard, 1);
  } else {
    there.soft = soft.read_only();
    here.soft = testing::host_view(s.soft, s.classes);
  }
  constexpr double kScale = 0.04;
  const auto run = [&] {
    cuda::semantic_cross_entropy(launch.arena(), logits.read_only(), there,
                                 weighted ? weight.read_only() : View<const float>(), kScale, d_logits.view(),
                                 sums.data());
    return sums.read()[0];
  };
  const LossSums got = run();
  const std::vector<double> wide = testing::widen(s.logits);
  std::vector<double> d_want(wide.size());
  const SemanticLoss want =
      semantic_cross_entropy<double>(testing::host_view(wide, s.classes), here,
                                     weighted ? testing::host_view(s.weight, s.classes) : View<const float>(),
                                     normaliser, kScale, testing::host_view(d_want, s.classes));
  EXPECT_NEAR(got.semantic, want.sum, 1e-6 * want.sum);
  EXPECT_EQ(got.labelled, want.labelled);
  const std::vector<float> d_got = d_logits.read();
  EXPECT_EQ(near(d_logits, d_want, 1e-6), "");
  for (std::size_t i = 0; i < d_got.size(); ++i) ASSERT_TRUE(d_want[i] != 0 || d_got[i] == 0) << i;
  EXPECT_EQ(d_logits.surroundings(), "");
  EXPECT_EQ(run().semantic, got.semantic) << "a second run gave other bits";
  EXPECT_EQ(d_logits.read(), d_got) << "a second run gave other bits";
}

TEST(CudaCrossEntropy, LossAndGradientAsTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t rays : {0, 1, 31, 33, 4097}) {
    for (const std::int32_t classes : {1, 2, 29, 33, 101}) {
      const Semantic s(rays, classes, 8);
      for (const bool is_hard : {true, false}) {
        for (const bool weighted : {true, false}) expect_same(launch, s, is_hard, weighted, 17.5);
      }
    }
  }
  const Semantic many(300, 1024, 30);
  for (const bool is_hard : {true, false}) {
    expect_same(launch, many, is_hard, true, 300);
    expect_same(launch, many, is_hard, false, 0);  // nobody divides by 0: gradients are 0
  }
  EXPECT_EQ(launch.take_fault(), std::nullopt);
}

TEST(CudaCrossEntropy, AlmostCertainRowsKeepTheirDigits) {
  SEMFIELD_ON_DEVICE(launch);
  Semantic s(6, 3, 1);
  s.hard = {0, 0, 0, 1, 2, 0};
  s.logits = {0, -60, -70, 0, -100, -300, 5, 5, 5, 1e18F, -1e18F, 0, -200, 0, 200, 120, 0, -1e30F};
  expect_same(launch, s, true, false, 6);
}

TEST(CudaCrossEntropy, FaultsOfLogitsAndLabels) {
  SEMFIELD_ON_DEVICE(launch);
  cuda::StepCell cell{.semantic_normaliser = 1};
  launch.set_cell(cell);
  const auto fault_of = [&](bool is_hard, auto&& spoil) {
    Semantic s(40, 37, 5);
    for (std::int16_t& label : s.hard) label = 7;
    s.soft.assign(s.soft.size(), 0.25F);
    spoil(s);
    const DeviceMatrix<float> logits(s.logits, 37), soft(s.soft, 37), d_logits(40, 37);
    const DeviceMatrix<std::int16_t> hard(s.hard, 1);
    const DeviceMatrix<LossSums> sums(1, 1);
    SemanticTargets targets;
    if (is_hard) targets.hard = hard.read_only();
    if (!is_hard) targets.soft = soft.read_only();
    cuda::semantic_cross_entropy(launch.arena(), logits.read_only(), targets, {}, 1, d_logits.view(), sums.data());
    const LossSums got = sums.read()[0];
    EXPECT_TRUE(std::isfinite(got.semantic));
    for (const float d : d_logits.read()) EXPECT_TRUE(std::isfinite(d));
    return launch.take_fault();
  };
  for (const bool is_hard : {true, false}) {
    EXPECT_EQ(fault_of(is_hard, [](Semantic& s) { s.logits[37 * 12 + 36] = kNan; }), (NotedFault{Stage::logits, 12}));
    EXPECT_EQ(fault_of(is_hard, [](Semantic& s) { s.logits[37 * 13] = kInf; }), (NotedFault{Stage::logits, 13}));
    EXPECT_EQ(fault_of(is_hard, [](Semantic& s) { s.logits[37 * 14] = -kInf; }), (NotedFault{Stage::logits, 14}));
  }
  EXPECT_EQ(fault_of(true, [](Semantic& s) { s.hard[3] = 37; }), (NotedFault{Stage::label, 3}));
  EXPECT_EQ(fault_of(true, [](Semantic& s) { s.hard[4] = -2; }), (NotedFault{Stage::label, 4}));
  EXPECT_EQ(fault_of(false, [](Semantic& s) { s.soft[37 * 5 + 9] = -1e-3F; }), (NotedFault{Stage::label, 5}));
  EXPECT_EQ(fault_of(false, [](Semantic& s) { s.soft[37 * 6 + 35] = kNan; }), (NotedFault{Stage::label, 6}));
}

TEST(CudaCrossEntropy, TheFirstOfEqualLogitsIsTheClass) {
  SEMFIELD_ON_DEVICE(launch);
  Semantic s(3, 70, 1);
  s.logits.assign(s.logits.size(), 2);  // all equal: class 0
  s.logits[70 + 40] = s.logits[70 + 33] = 3;
  s.logits[140 + 64] = s.logits[140 + 1] = 3;
  s.hard = {0, 33, 1};
  expect_same(launch, s, true, false, 3);
  const DeviceMatrix<float> logits(s.logits, 70);
  const DeviceMatrix<std::int16_t> label(3, 1);
  ClassResults<float> results{.label = label.view()};
  cuda::class_results(logits.view(), results);
  EXPECT_EQ(label.read(), s.hard);
}

TEST(CudaClassResults, AsRenderingOnTheProcessor) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t rays : {0, 1, 31, 33, 4097}) {
    for (const std::int32_t classes : {1, 29, 101, 1024}) {
      const Semantic s(rays, classes, classes == 29 ? 40 : 6);
      const DeviceMatrix<float> logits(s.logits, classes, classes + 1);
      const DeviceMatrix<std::int16_t> truth(s.hard, 1, 2), label(rays, 1, 2);
      const DeviceMatrix<float> entropy(rays, 1, 3), confidence(rays, 1), of_truth(rays, 1, 2),
          probability(rays, classes, classes + 3);
      cuda::class_results(logits.view(), {truth.read_only(), label.view(), entropy.view(), confidence.view(),
                                          of_truth.view(), probability.view()});
      std::vector<float> p(s.logits.size()), want_entropy(static_cast<std::size_t>(rays));
      softmax<float>(testing::host_view(s.logits, classes), testing::host_view(p, classes));
      softmax_entropy<float>(testing::host_view(s.logits, classes), testing::host_view(want_entropy, 1));
      const std::vector<std::int16_t> got_label = label.read();
      const std::vector<float> got_entropy = entropy.read(), got_confidence = confidence.read(),
                               got_truth = of_truth.read(), got_probability = probability.read();
      for (std::size_t r = 0; r < static_cast<std::size_t>(rays); ++r) {
        const auto* const row = p.data() + r * static_cast<std::size_t>(classes);
        const auto* const best = std::max_element(row, row + classes);
        ASSERT_EQ(got_label[r], best - row) << r;
        ASSERT_NEAR(got_confidence[r], *best, 2e-7 * *best) << r;
        ASSERT_NEAR(got_entropy[r], want_entropy[r], 2e-7 * std::abs(want_entropy[r])) << r;
        const float want = s.hard[r] < 0 ? 0.F : row[s.hard[r]];
        ASSERT_NEAR(got_truth[r], want, 2e-7 * want) << r;
        const auto* const got = got_probability.data() + r * static_cast<std::size_t>(classes);
        for (std::int32_t c = 0; c < classes; ++c) ASSERT_NEAR(got[c], row[c], 2e-7 * row[c]) << r << ", class " << c;
        ASSERT_EQ(std::max_element(got, got + classes) - got, got_label[r]) << r;
        ASSERT_EQ(got[got_label[r]], got_confidence[r]) << r;
      }
      EXPECT_EQ(label.surroundings() + entropy.surroundings() + of_truth.surroundings() + probability.surroundings(),
                "");
    }
  }
}

// Losses on the device against the CPU's in float64.

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

// A loss of a conformance row, with its kernels; none for a loss of CPUs alone.
std::vector<cuda::DeviceLoss> device_losses(const testkit::Row& row) {
  const PluginEntry& entry = testkit::linked_registry().get(PluginKind::loss, row.name);
  std::shared_ptr<const Loss> loss = entry.loss(*testkit::make_params(entry, row.settings));
  if (!testing::all_kernels().has(Device::cuda, "loss '" + row.name + "'")) {
    std::cout << "loss '" << row.name << "' has no cuda kernels: runs with it stay on the CPU\n";
    return {};
  }
  const LossList list({{row.name, loss, nullptr, ""}, {row.name, loss, nullptr, ""}});
  return cuda::loss_kernels(list, &testing::all_kernels());
}

void loss_terms_expect_same(const testkit::Row& row, const std::vector<int>& counts, int gap,
                            bool soft_labels = false) {
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
    for (const int gap : {0, 3}) loss_terms_expect_same(row, testkit::awkward_ray_lengths(), gap);
    loss_terms_expect_same(row, testkit::awkward_ray_lengths(), 0, true);
    loss_terms_expect_same(row, {1023, 1024, 1025, 2049, 5000}, 0);
    for (const auto& counts : std::vector<std::vector<int>>{{0}, {1}, {0, 0, 3}})
      loss_terms_expect_same(row, counts, 0);
    std::vector<int> many;
    for (int r = 0; r < 4097; ++r) many.push_back(r * 7 % 40);
    loss_terms_expect_same(row, many, 0);
  }
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

// Groupings on the device against those of the CPU: sums, gradients, and networks that learn.

std::unique_ptr<Grouping> grouping_of(const std::string& name) {
  const PluginEntry& entry = testing::registry_with_cuda().get(PluginKind::grouping, name);
  return entry.grouping(*entry.new_params());
}

// Points of images whose segments differ in number and size; the last image has one segment alone.
struct Images {
  std::int64_t per_image;
  std::vector<std::int32_t> segment, segments;
  std::vector<float> rows, slow;

  Images(std::int64_t count, std::int64_t points, std::int32_t width) : per_image(points) {
    const RandomAddress random{3, 0, stream_id("groupings_test")};
    for (std::int64_t i = 0; i < count; ++i) {
      segments.push_back(i + 1 == count ? 1 : static_cast<std::int32_t>(3 + 40 * i));
      for (std::int64_t p = 0; p < points; ++p) {
        const double drawn = static_cast<double>(uniform01(random, static_cast<std::uint64_t>(i * points + p)));
        segment.push_back(static_cast<std::int32_t>(drawn * drawn * segments.back()));  // some segments have no point
      }
    }
    rows = testing::random_floats(std::ssize(segment) * width, 1, -1.5, 1.5);
    slow = testing::random_floats(std::ssize(segment) * width, 2, -1.5, 1.5);
  }
};

TEST(CudaGroupings, SumAndGradientsAreTheCpus) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::string& name : testing::registry_with_cuda().names(PluginKind::grouping)) {
    SCOPED_TRACE(name);
    const std::unique_ptr<Grouping> grouping = grouping_of(name);
    const GroupingKernel kernel = grouping->kernel(Device::cuda, testing::registry_with_cuda().kernels());
    ASSERT_NE(kernel, nullptr);
    const std::int32_t width = grouping->width();
    for (const std::int64_t points : {1, 2, 33, 256, 301}) {
      SCOPED_TRACE(points);
      const std::int64_t count = 4;
      const Images images(count, points, width);
      const DeviceMatrix<float> rows(images.rows, width), slow(images.slow, width),
          gradients(std::vector<float>(images.rows.size(), 0.5F), width);
      const DeviceMatrix<std::int32_t> segment(images.segment, 1), segments(images.segments, 1);
      const DeviceMatrix<double> loss(std::vector<double>(images.segment.size(), 0), 1);
      GroupingCall call;
      call.rows = rows.read_only();
      call.slow = grouping->slow_share() > 0 ? slow.read_only() : rows.read_only();
      call.segment = segment.read_only();
      call.segments = segments.read_only();
      call.per_image = points;
      call.most_segments = 3 + 40 * 2;
      call.scale = 0.3;
      call.gradients = gradients.view();
      call.loss = loss.view();
      kernel(*grouping, call, launch.arena());
      std::vector<double> want(images.rows.size(), 0.5);
      double want_loss = 0;
      const std::vector<double> wide = testing::widen(images.rows), wide_slow = testing::widen(images.slow);
      for (std::int64_t i = 0; i < count; ++i) {
        const auto first = static_cast<std::size_t>(i * points * width);
        const View<const double> own(wide.data() + first, points, width);
        const View<const double> keys(wide_slow.data() + first, points, width);
        want_loss += grouping->add(SegmentedPoints<double>{own, grouping->slow_share() > 0 ? keys : own,
                                                           std::span(images.segment)
                                                               .subspan(static_cast<std::size_t>(i * points),
                                                                        static_cast<std::size_t>(points)),
                                                           images.segments[static_cast<std::size_t>(i)]},
                                   call.scale, View<double>(want.data() + first, points, width));
      }
      const std::vector<float> got = gradients.read();
      for (std::size_t i = 0; i < got.size(); ++i) ASSERT_NEAR(got[i], want[i], 2e-5) << i;
      double got_loss = 0;
      for (const double of_point : loss.read()) got_loss += of_point;
      EXPECT_NEAR(got_loss, want_loss, 1e-5 * (1 + std::abs(want_loss)));
      EXPECT_EQ(gradients.surroundings() + loss.surroundings(), "");
    }
  }
}

// Two bars side by side, each one segment of every view, numbered anew in each.
TEST(CudaGroupings, ANetworkLearnsWhatTheCpuDoesAndRepeatsItsBits) {
  SEMFIELD_NEEDS_DEVICE();
  std::vector<Vec3d> positions;
  for (int i = 0; i < 40; ++i) positions.push_back({i < 20 ? -0.5 : 0.5, 0.05 * (i % 20) - 0.5, 0.1});
  std::vector<SegmentSights> sights(3);
  for (std::size_t v = 0; v < sights.size(); ++v) {
    SegmentSights& view = sights[v];
    for (int s = 0; s < 2; ++s) {
      for (int i = 0; i < 20; ++i) {
        view.point.push_back(20 * (v % 2 == 0 ? s : 1 - s) + i);
        view.segment.push_back(s);
      }
      view.class_of.push_back(kVoid);
    }
    view.first = {0, 20, 40};
  }
  const Box box{{-1, -1, -1}, {1, 1, 1}};
  const ObjectLearning learning{.steps = 25, .views = 4, .view_points = 64};
  for (const std::string& name : testing::registry_with_cuda().names(PluginKind::grouping)) {
    SCOPED_TRACE(name);
    const std::unique_ptr<Grouping> grouping = grouping_of(name);
    std::vector<std::vector<float>> found;
    double said = 0;
    for (const bool on_gpu : {false, true, true}) {
      ObjectNetwork<float> net(testing::registry_with_cuda().kernels(), *grouping, {}, box, 3, learning.views);
      const auto say = [&](double done, double of) { said = done / of; };
      if (on_gpu)
        EXPECT_TRUE(net.learn_on_gpu(0, positions, sights, learning, say));
      else
        net.learn(positions, sights, learning, {});
      found.push_back(net.outputs(positions));
    }
    EXPECT_EQ(said, 1);
    EXPECT_EQ(found[1], found[2]);
    double largest = 0;
    for (std::size_t i = 0; i < found[0].size(); ++i) {
      EXPECT_NEAR(found[1][i], found[0][i], 0.02) << i;
      largest = std::max(largest, std::abs(double{found[0][i]}));
    }
    EXPECT_GT(largest, 0.2) << "nothing was learned";
  }
}

}  // namespace
}  // namespace semfield
