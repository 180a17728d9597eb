// The generalised cross-entropy by hand: its ends, and what a contradicted label is worth.
#include "losses/generalised_cross_entropy/generalised_cross_entropy.h"

#include <gtest/gtest.h>

#include "model/losses/semantic_cross_entropy.h"
#include "testkit/loss_rays.h"

namespace semfield {
namespace {

using testkit::LossRays;

GeneralisedCrossEntropy with(double q) {
  GeneralisedCrossEntropyParams params;
  params.q = q;
  return GeneralisedCrossEntropy(params);
}

// One ray of two classes whose softmax is (p, 1 - p), labelled 0.
struct OneRay {
  explicit OneRay(double p) : rays({1}) {
    logits = {std::log(p), std::log1p(-p)};
    d_logits = {0, 0};
  }
  double add(const Loss& loss) {
    RayTargets targets = rays.targets();
    RayValues<double> values = rays.values();
    RayGradients<double> gradients = rays.gradients();
    values.heads.set(channel::logits, {logits.data(), 1, 2});
    gradients.heads.set(channel::logits, {d_logits.data(), 1, 2});
    return loss.add(targets, values, 1, gradients);
  }
  LossRays<double> rays;
  std::vector<double> logits, d_logits;
};

TEST(GeneralisedCrossEntropy, WithQ1IsOneMinusTheProbability) {
  OneRay ray(0.3);
  EXPECT_NEAR(ray.add(with(1)), 0.7, 1e-15);
  EXPECT_NEAR(ray.d_logits[0], -0.3 * 0.7, 1e-15);
  EXPECT_NEAR(ray.d_logits[1], 0.3 * 0.7, 1e-15);
}

TEST(GeneralisedCrossEntropy, TowardsQ0IsTheCrossEntropy) {
  LossRays<double> rays({1, 1, 1, 1, 1, 1, 1, 1});
  View<const double> logits = rays.values().heads[channel::logits];
  const SemanticTargets targets{rays.targets().label.row_range(0, logits.rows), {}};
  const double entropy = semantic_cross_entropy<double>(logits, targets, {}, 1, 1, {}).sum;
  EXPECT_NEAR(rays.add(with(0.01), 1), entropy, 0.02 * entropy);
}

// The slope is p^q times that of the cross-entropy: a label that the network contradicts pulls little.
TEST(GeneralisedCrossEntropy, AContradictedLabelPullsLittle) {
  for (const double p : {0.5, 0.01}) {
    OneRay ray(p);
    ray.add(with(0.7));
    EXPECT_NEAR(ray.d_logits[0], -std::pow(p, 0.7) * (1 - p), 1e-15) << p;
  }
}

TEST(GeneralisedCrossEntropy, CountsLabelledRaysAlone) {
  LossRays<double> rays({1, 1, 1, 1, 1, 1, 1, 1});
  EXPECT_EQ(with(0.7).counted_rays(rays.targets(), rays.rays()), 3) << "rays 0, 2 and 3";
}

TEST(GeneralisedCrossEntropy, ACertainSoftLabelIsAHardOne) {
  LossRays<double> hard({1, 1, 1, 1, 1, 1, 1, 1}), soft = hard;
  soft.soft.assign(soft.label.size() * static_cast<std::size_t>(soft.kClasses), 0);
  for (std::size_t r = 0; r < soft.label.size(); ++r) {
    if (soft.label[r] >= 0)
      soft.soft[r * static_cast<std::size_t>(soft.kClasses) + static_cast<std::size_t>(soft.label[r])] = 0.5F;
  }
  EXPECT_DOUBLE_EQ(soft.add(with(0.7), 1), hard.add(with(0.7), 1));
  EXPECT_EQ(soft.d_logits, hard.d_logits);
}

}  // namespace
}  // namespace semfield
