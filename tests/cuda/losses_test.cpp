// Losses on the device against the CPU's in float64.
#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "device_fixture.h"
#include "losses/semantic_cross_entropy.h"
#include "testkit/compare.h"

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

TEST(CudaCounts, SamplesAndDensity) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int32_t count : {0, 1, 1023, 1025, 300001}) {
    const DeviceMatrix<std::int32_t> first(std::vector<std::int32_t>{0, count / 2, count}, 1);
    for (const int kind : {0, 1, 2}) {  // none; the last sample; one behind those in use
      std::vector<float> sigma(static_cast<std::size_t>(count) + 9, 0.F);
      if (kind == 1 && count > 0) sigma[static_cast<std::size_t>(count) - 1] = 1e-30F;
      if (kind == 2) sigma[count] = 1;
      const DeviceMatrix<float> there(sigma, 1);
      const DeviceMatrix<LossSums> sums(1, 1);
      cuda::count_samples(first.read_only(), there.read_only(), sums.data());
      EXPECT_EQ(sums.read()[0].samples, count);
      EXPECT_EQ(sums.read()[0].dense, kind == 1 && count > 0 ? 1 : 0) << count << ", kind " << kind;
    }
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
  EXPECT_EQ(got.correct, want.correct);
  const std::vector<float> d_got = d_logits.read();
  EXPECT_EQ(testkit::compare(testing::host_view(d_got, s.classes), testing::host_view(std::as_const(d_want), s.classes),
                             1e-6),
            "");
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

}  // namespace
}  // namespace semfield
