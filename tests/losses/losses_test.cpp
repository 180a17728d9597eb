// Losses: log-sum-exp at the extremes, void batches, normalisation, soft labels, class weights, gradients.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/rng.h"
#include "losses/photometric.h"
#include "losses/semantic_cross_entropy.h"
#include "testkit/gradient_check.h"

namespace semfield {
namespace {

using Logits = std::vector<double>;

double uniform(std::uint64_t i) { return static_cast<double>(uniform01({5, 0, stream_id("loss test")}, i)); }

template <class Real>
struct Run {
  SemanticLoss loss;
  std::vector<Real> d;
};

template <class Real>
Run<Real> run_hard(const std::vector<Real>& logits, int classes, const std::vector<std::int16_t>& labels,
                   double normaliser, double scale = 1, const std::vector<float>& weights = {}) {
  Run<Real> run;
  run.d.assign(logits.size(), Real(7));
  const auto rows = static_cast<std::int64_t>(labels.size());
  SemanticTargets targets;
  targets.hard = View<const std::int16_t>(labels.data(), rows, 1);
  const View<const float> w = weights.empty() ? View<const float>() : View<const float>(weights.data(), 1, classes);
  run.loss = semantic_cross_entropy<Real>(View<const Real>(logits.data(), rows, classes), targets, w, normaliser, scale,
                                          View<Real>(run.d.data(), rows, classes));
  return run;
}

template <class Real>
Run<Real> run_soft(const std::vector<Real>& logits, int classes, const std::vector<float>& soft, double normaliser) {
  Run<Real> run;
  run.d.assign(logits.size(), Real(7));
  const auto rows = static_cast<std::int64_t>(logits.size()) / classes;
  SemanticTargets targets;
  targets.soft = View<const float>(soft.data(), rows, classes);
  run.loss = semantic_cross_entropy<Real>(View<const Real>(logits.data(), rows, classes), targets, {}, normaliser, 1,
                                          View<Real>(run.d.data(), rows, classes));
  return run;
}

TEST(Photometric, SumOfSquaresAndGradient) {
  const std::vector<double> color{0.5, 0.25, 1, 0, 0, 0};
  const std::vector<float> target{0, 0.25f, 0.5f, 1, 0, 0};
  std::vector<double> d(6, 9);
  const double sum =
      photometric_loss<double>(View<const double>(color.data(), 2, 3), View<const float>(target.data(), 2, 3), 6, 0.5,
                               View<double>(d.data(), 2, 3));
  EXPECT_DOUBLE_EQ(sum, 0.25 + 0.25 + 1);
  EXPECT_EQ(d, (std::vector<double>{0.5 / 6, 0, 0.5 / 6, -1.0 / 6, 0, 0}));
  EXPECT_EQ(photometric_loss<float>({nullptr, 0, 3}, {nullptr, 0, 3}, 1, 1, {}), 0);  // B12
}

TEST(CrossEntropy, LogitSweepAgainstLongDouble) {  // D01
  for (const int classes : {2, 29, 1024}) {
    for (const double size : {0.0, 11.0, 88.0, 89.0, 1e4, 1e30}) {
      for (const int winner : {0, 1}) {
        std::vector<float> logits;
        for (int c = 0; c < classes; ++c)
          logits.push_back(static_cast<float>(size * (c == winner ? 1 : -uniform(static_cast<std::uint64_t>(c)))));
        const auto run = run_hard<float>(logits, classes, {0}, 1);
        long double largest = -1e4900L, z = 0;
        for (const float s : logits) largest = std::max(largest, static_cast<long double>(s));
        for (const float s : logits) z += std::exp(static_cast<long double>(s) - largest);
        // With the winner first, log z = log1p(rest): only that keeps the digits of an almost certain row.
        long double rest = 0;
        for (int c = 0; c < classes; ++c)
          rest +=
              c == winner ? 0.0L : std::exp(static_cast<long double>(logits[static_cast<std::size_t>(c)]) - largest);
        const auto want = static_cast<double>((largest - static_cast<long double>(logits[0])) + std::log1p(rest));
        EXPECT_NEAR(run.loss.sum, want, 1e-6 * want) << classes << " classes, " << size;
        EXPECT_EQ(run.loss.correct, logits[0] >= largest ? 1 : 0);
        std::vector<float> p(logits.size());
        float entropy = -1;
        softmax<float>(View<const float>(logits.data(), 1, classes), View<float>(p.data(), 1, classes));
        softmax_entropy<float>(View<const float>(logits.data(), 1, classes), View<float>(&entropy, 1, 1));
        long double h = 0;
        for (int c = 0; c < classes; ++c) {
          const auto gap = static_cast<long double>(logits[static_cast<std::size_t>(c)]) - largest;
          const long double pc = std::exp(gap) / z;
          if (pc > 1e-30L) {
            EXPECT_NEAR(p[static_cast<std::size_t>(c)], static_cast<double>(pc), 1e-6 * static_cast<double>(pc));
          }
          if (pc > 0) h += pc * (std::log1p(rest) - gap);
        }
        EXPECT_NEAR(entropy, static_cast<double>(h), 1e-6 * static_cast<double>(h) + 1e-38);
      }
    }
  }
}

TEST(CrossEntropy, InfiniteLogitsAreRefused) {  // D02
  const float inf = std::numeric_limits<float>::infinity();
  for (const float bad : {inf, -inf, std::nanf("")}) {
    try {
      run_hard<float>({0, 1, 2, 0, bad, 2}, 3, {0, 1}, 1);
      FAIL() << bad << " was accepted";
    } catch (const Error& e) {
      EXPECT_NE(e.message().find("ray 1, class 1"), std::string::npos) << e.what();
    }
  }
  EXPECT_NO_THROW(run_hard<float>({0, 1, 2, 0, inf, 2}, 3, {0, -1}, 1));  // an unlabelled row is not read
}

TEST(CrossEntropy, CertainRowHasNoEntropyAndNoGradient) {  // D03, D04
  std::vector<float> entropy(2, -1);
  const std::vector<float> logits{1e4f, 0, 0, 0, 1e30f, -1e30f};
  softmax_entropy<float>(View<const float>(logits.data(), 2, 3), View<float>(entropy.data(), 2, 1));
  EXPECT_EQ(entropy, (std::vector<float>{0, 0}));
  const auto certain = run_hard<float>(logits, 3, {0, 1}, 1);
  EXPECT_EQ(certain.loss.sum, 0);
  for (const float d : certain.d) EXPECT_EQ(d, 0);
  const auto one = run_hard<float>({3, -4}, 1, {0, 0}, 2);
  EXPECT_EQ(one.loss.sum, 0);
  EXPECT_EQ(one.d, (std::vector<float>{0, 0}));
}

TEST(CrossEntropy, AllVoidBatchIsExactlyNothing) {  // D05
  const std::vector<std::int16_t> labels(1024, -1);
  const std::vector<float> logits(1024 * 3, 0.5f);
  SemanticTargets targets;
  targets.hard = View<const std::int16_t>(labels.data(), 1024, 1);
  const double normaliser =
      semantic_normaliser(SemanticNormalisation::mean_labelled, labelled_weight(targets, {}), 1024);
  EXPECT_EQ(normaliser, 0);
  const auto run = run_hard<float>(logits, 3, labels, normaliser, 0.04);
  EXPECT_EQ(run.loss.sum, 0);
  EXPECT_EQ(run.loss.labelled, 0);
  for (const float d : run.d) EXPECT_TRUE(d == 0 && !std::signbit(d));
}

TEST(CrossEntropy, OneLabelledRayUnderEachNormalisation) {  // D06
  std::vector<std::int16_t> labels(1024, -1);
  labels[17] = 1;
  std::vector<double> logits(2048, 0.0);
  logits[34] = 1;
  SemanticTargets targets;
  targets.hard = View<const std::int16_t>(labels.data(), 1024, 1);
  const double count = labelled_weight(targets, {});
  EXPECT_EQ(count, 1);
  const double want = std::log1p(std::exp(1.0)), p = 1 / (1 + std::exp(1.0));
  const double ratio[] = {1, 1, 1.0 / 1024};
  for (int kind = 0; kind < 3; ++kind) {
    const double normaliser = semantic_normaliser(static_cast<SemanticNormalisation>(kind), count, 1024);
    const auto run = run_hard<double>(logits, 2, labels, normaliser, 0.04);
    EXPECT_NEAR(run.loss.sum / normaliser, want * ratio[kind], 1e-12);
    EXPECT_NEAR(run.d[34], 0.04 * (1 - p) * ratio[kind], 1e-14);
    EXPECT_NEAR(run.d[35], 0.04 * (p - 1) * ratio[kind], 1e-14);
  }
}

TEST(CrossEntropy, LabelOutsideTheClassesIsRefused) {  // D07
  for (const std::int16_t bad : {std::int16_t{3}, std::int16_t{-2}, std::int16_t{255}}) {
    try {
      run_hard<float>({0, 1, 2}, 3, {bad}, 1);
      FAIL() << bad << " was accepted";
    } catch (const Error& e) {
      EXPECT_EQ(e.kind(), ErrorKind::data);
      EXPECT_NE(e.message().find("is " + std::to_string(bad)), std::string::npos) << e.what();
    }
  }
}

TEST(CrossEntropy, SoftRowsAreNormalisedOrRefused) {  // D10
  const std::vector<double> logits{0.3, -0.2, 1.1};
  const auto exact = run_soft<double>(logits, 3, {0.25f, 0.5f, 0.25f}, 1);
  for (const float scale : {0.5f, 2.0f}) {
    const auto scaled = run_soft<double>(logits, 3, {0.25f * scale, 0.5f * scale, 0.25f * scale}, 1);
    EXPECT_NEAR(scaled.loss.sum, exact.loss.sum, 1e-14);
    for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(scaled.d[c], exact.d[c], 1e-14);
  }
  const auto none = run_soft<double>(logits, 3, {0, 0, 0}, 1);
  EXPECT_EQ(none.loss.labelled, 0);
  EXPECT_EQ(none.d, (std::vector<double>{0, 0, 0}));
  EXPECT_THROW(run_soft<double>(logits, 3, {0.5f, -0.1f, 0.6f}, 1), Error);
  EXPECT_THROW(run_soft<double>(logits, 3, {0.5f, std::nanf(""), 0.6f}, 1), Error);
  const auto one_hot = run_soft<double>(logits, 3, {0, 1, 0}, 1);
  const auto hard = run_hard<double>(logits, 3, {1}, 1);
  EXPECT_NEAR(one_hot.loss.sum, hard.loss.sum, 1e-15);
  for (std::size_t c = 0; c < 3; ++c) EXPECT_NEAR(one_hot.d[c], hard.d[c], 1e-15);
}

TEST(CrossEntropy, ClassWeights) {  // D12
  const auto weights = inverse_log_frequency_weights({0, 30, 70});
  for (const float w : weights) EXPECT_TRUE(std::isfinite(w) && w > 0 && w <= 50.5f);
  EXPECT_NEAR(weights[0], 1 / std::log(1.02), 1e-4);
  EXPECT_GT(weights[1], weights[2]);
  for (const float w : inverse_log_frequency_weights({0, 0})) EXPECT_TRUE(std::isfinite(w));
  const std::vector<double> logits{0, 1, 2, 0, 1, 2};
  const auto plain = run_hard<double>(logits, 3, {1, 2}, 1);
  const auto weighted = run_hard<double>(logits, 3, {1, 2}, 1, 1, {1, 2, 5});
  EXPECT_NEAR(weighted.d[0], 2 * plain.d[0], 1e-14);
  EXPECT_NEAR(weighted.d[3], 5 * plain.d[3], 1e-14);
  const std::vector<std::int16_t> labels{1, 2, -1};
  const std::vector<float> w{1, 2, 5};
  SemanticTargets targets;
  targets.hard = View<const std::int16_t>(labels.data(), 3, 1);
  EXPECT_EQ(labelled_weight(targets, View<const float>(w.data(), 1, 3)), 7);
}

TEST(CrossEntropy, GradientAgainstFiniteDifferences) {
  constexpr int kRays = 5, kClasses = 7;
  std::vector<double> logits;
  std::vector<float> soft, weights;
  for (std::uint64_t i = 0; i < kRays * kClasses; ++i) {
    logits.push_back(6 * uniform(i) - 3);
    soft.push_back(i / kClasses == 2 ? 0.f : static_cast<float>(uniform(1000 + i)));
  }
  for (std::uint64_t c = 0; c < kClasses; ++c) weights.push_back(static_cast<float>(0.5 + uniform(2000 + c)));
  const std::vector<std::int16_t> hard{0, 6, -1, 3, 3};
  for (const bool is_hard : {true, false}) {
    SemanticTargets targets;
    if (is_hard) targets.hard = View<const std::int16_t>(hard.data(), kRays, 1);
    if (!is_hard) targets.soft = View<const float>(soft.data(), kRays, kClasses);
    const View<const float> w(weights.data(), 1, kClasses);
    std::vector<double> d(logits.size());
    const View<double> x(logits.data(), kRays, kClasses), dx(d.data(), kRays, kClasses);
    semantic_cross_entropy<double>(x, targets, w, 4, 0.04, dx);
    const auto loss = [&] { return 0.04 / 4 * semantic_cross_entropy<double>(x, targets, w, 4, 0.04, {}).sum; };
    EXPECT_EQ(testkit::check_gradient(loss, x, dx, {1e-8, 1e-6, 100, 1}), "");
  }
}

TEST(Softmax, EmptyRayIsUniform) {  // D08, D09
  std::vector<float> p(28), logits(28, 0.f);
  float entropy = 0;
  softmax<float>(View<const float>(logits.data(), 1, 28), View<float>(p.data(), 1, 28));
  softmax_entropy<float>(View<const float>(logits.data(), 1, 28), View<float>(&entropy, 1, 1));
  for (const float x : p) EXPECT_EQ(x, 1.f / 28);
  EXPECT_FLOAT_EQ(entropy, std::log(28.f));
  logits[3] = 5;  // half of a margin of 10
  softmax<float>(View<const float>(logits.data(), 1, 28), View<float>(logits.data(), 1, 28));
  EXPECT_NEAR(logits[3], 1 / (1 + 27 * std::exp(-5.0)), 1e-6);  // 0.8461
}

}  // namespace
}  // namespace semfield
