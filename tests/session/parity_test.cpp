// The exact savings change no function and no gradient; the whole pipeline's gradient agrees with finite differences.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

// Rows of one are hard labels; spread over classes, the loss is the cross-entropy with that spread.
TEST(Parity, SoftRowsOfOneTrainAsHardLabels) {
  Registry registry = make_registry();
  Oracle hard(two_pass_config(), registry), soft(two_pass_config(), registry);
  const std::int32_t logits = static_cast<std::int32_t>(soft.session.plan.class_of_logit.size());
  BatchBuffers& batch = soft.batch;
  batch.more = {{std::string(channel::soft_label), logits, {}}};
  batch.of(channel::soft_label).assign(batch.label.size() * static_cast<std::size_t>(logits), 0.0F);
  for (std::size_t r = 0; r < batch.label.size(); ++r) {
    if (batch.label[r] != kVoid)
      batch.of(channel::soft_label)[r * static_cast<std::size_t>(logits) + static_cast<std::size_t>(batch.label[r])] =
          1;
  }
  const StepLosses a = hard.gradients(), b = soft.gradients();
  EXPECT_EQ(a.labelled, b.labelled);
  EXPECT_GT(a.labelled, 0);
  EXPECT_NEAR(a.semantic, b.semantic, 1e-12);
  for (const Tensor<double>& t : hard.pipeline->store().all()) {
    const Tensor<double>* other = soft.pipeline->store().find(t.name);
    for (std::int64_t i = 0; i < t.size() && t.learned(); ++i)
      ASSERT_NEAR(t.grad.data()[i], other->grad.data()[i], 1e-12) << t.name;
  }
  // Half of each label moved to another class: another loss, another gradient.
  for (std::size_t r = 0; r < batch.label.size(); ++r) {
    if (batch.label[r] == kVoid) continue;
    float* row = &batch.of(channel::soft_label)[r * static_cast<std::size_t>(logits)];
    row[batch.label[r]] = 0.5F;
    row[(batch.label[r] + 1) % logits] = 0.5F;
  }
  const StepLosses c = soft.gradients();
  EXPECT_EQ(c.labelled, a.labelled);
  EXPECT_NE(c.semantic, a.semantic);
}

void expect_unchanged_without(const std::string& switched_off) {
  expect_same_gradients(two_pass_config(), two_pass_config("runtime: {" + switched_off + ": false}\n"));
}

TEST(Parity, LanesAndTilesOnlyChangeTheOrderOfSums) {
  expect_same_gradients(two_pass_config("runtime: {lanes: 1, tile_rays: 64}\n"),
                        two_pass_config("runtime: {lanes: 3, tile_rays: 4}\n"));
  std::string hash = hash_config();
  hash.replace(hash.find("{type: occupancy_grid, resolution: 32, warmup_steps: 32, max_samples: 96, keep_last: true}"),
               90, "{type: stratified, samples: 24}");
  expect_same_gradients(hash + "runtime: {lanes: 1, tile_rays: 192}\n", hash + "runtime: {lanes: 5, tile_rays: 8}\n");
}

TEST(Parity, DeferredClassLayer) { expect_unchanged_without("deferred_class_layer"); }
TEST(Parity, FoldedFeatureLayer) { expect_unchanged_without("fold_feature_layer"); }
TEST(Parity, DirectionOncePerRay) { expect_unchanged_without("direction_once_per_ray"); }

TEST(PipelineGradient, OnePassWithSemantics) {
  // One pass: the sample positions do not depend on the parameters, so the loss is the derivative's own function.
  expect_finite_differences(
      "scene: {type: analytic_room}\nsemantics: {hidden_width: 8, weight: 0.5}\nrendering: {density_activation: "
      "softplus}\n"
      "passes:\n  - sampler: {type: stratified, samples: 12}\n    position: {type: frequency, frequencies: 3}\n"
      "    direction: {type: spherical_harmonics, degree: 2}\n    field: {type: nerf_mlp, depth: 3, width: 12, "
      "skip_at: 1, view_width: 8}\n"
      "train: {rays: 24}\n",
      2e-4);
}

TEST(PipelineGradient, HashGridAndTinyMlp) {
  expect_finite_differences(
      "scene: {type: analytic_room}\nsemantics: {hidden_width: 8, weight: 0.5}\nrendering: {density_activation: "
      "softplus, far: background}\n"
      "passes:\n  - sampler: {type: stratified, samples: 12}\n    position: {type: hash_grid, levels: 3, log2_entries: "
      "8, finest_resolution: 32}\n"
      "    direction: {type: spherical_harmonics, degree: 2}\n    field: {type: tiny_mlp, hidden_width: 8, "
      "color_width: 8}\n"
      "train: {rays: 24}\n",
      2e-4);
}

TEST(Parity, StoppedSemanticGradientLeavesTheDensityLayerAlone) {
  Registry registry = make_registry();
  const std::string off =
      "rendering: {density_activation: softplus}\npasses:\n  - sampler: {type: stratified, samples: 8}\n    position: "
      "{type: frequency, frequencies: 3}\n"
      "    direction: {type: frequency, frequencies: 2}\n    field: {type: nerf_mlp, depth: 2, width: 12, skip_at: 0, "
      "view_width: 8}\n";
  Oracle stopped(
      "scene: {type: analytic_room}\ntrain: {rays: 32}\nsemantics: {weight: 5, stop_gradient_to_density: true}\n" + off,
      registry);
  Oracle none("scene: {type: analytic_room, with_labels: false}\ntrain: {rays: 32}\n" + off, registry);
  Oracle flowing("scene: {type: analytic_room}\ntrain: {rays: 32}\nsemantics: {weight: 5}\n" + off, registry);
  ASSERT_FALSE(none.pipeline->has_semantics());
  stopped.gradients();
  none.gradients();
  flowing.gradients();
  const auto density_gradient = [](Oracle& o) {
    const Tensor<double>* t = o.pipeline->store().find("main/field/density/bias");
    EXPECT_NE(t, nullptr);
    return t == nullptr ? NAN : t->grad.data()[0];
  };
  EXPECT_EQ(density_gradient(stopped), density_gradient(none));
  EXPECT_NE(density_gradient(flowing), density_gradient(none));
}

// Widths that are multiples of 32 hand the feature on in bf16, 24 and 16 in full.
TEST(Parity, GradientsInBf16AreTheOraclesWithinItsPrecision) {
  for (const std::string field : {"{type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 24}",
                                  "{type: nerf_mlp, depth: 2, width: 24, skip_at: 0, view_width: 32}",
                                  "{type: tiny_mlp, hidden_width: 64, color_width: 24}",
                                  "{type: tiny_mlp, hidden_width: 24, feature: geometry}"}) {
    const std::string yaml =
        "scene: {type: analytic_room}\nsemantics: {hidden_width: 32, weight: 3}\nrendering: {density_activation: "
        "softplus}\ntrain: {rays: 48}\npasses:\n  - sampler: {type: stratified, samples: 24}\n    position: {type: "
        "frequency, frequencies: 3}\n    direction: {type: frequency, frequencies: 2}\n    field: " +
        field + "\nruntime: {device: cpu, precision: ";
    Registry registry = make_registry();
    Oracle oracle(yaml + "fp32}\n", registry);
    oracle.gradients();
    Session rounded = open_text(yaml + "bf16}\n", registry);
    ParamStore<float>& store = rounded.pipeline->store();
    rounded.pipeline->derive(3);
    const StepLosses losses = rounded.pipeline->gradients(3, oracle.batch.view(true));
    EXPECT_GT(losses.labelled, 0);
    int compared = 0;
    for (const Tensor<double>& t : oracle.pipeline->store().all()) {
      if (!t.learned()) continue;
      const Tensor<float>* other = store.find(t.name);
      ASSERT_NE(other, nullptr) << t.name;
      double difference = 0, size = 0;
      for (std::int64_t i = 0; i < t.size(); ++i) {
        difference += std::pow(static_cast<double>(other->grad.data()[i]) - t.grad.data()[i], 2);
        size += std::pow(t.grad.data()[i], 2);
      }
      EXPECT_LT(std::sqrt(difference), 0.03 * std::sqrt(size)) << field << ", " << t.name;
      ++compared;
    }
    EXPECT_GE(compared, 12) << field;
  }
}

/// Colour and logits of the batch's rays, as rendering makes them.
std::vector<float> rendered(Session& session, const BatchBuffers& batch) {
  Workspace arena;
  StepContext ctx;
  ctx.seed = session.pipeline->options().seed;
  ctx.workspace = &arena;
  const RayBatch rows = batch.view(true);
  const Pass<float>& pass = session.pipeline->passes().front();
  const PassTrace<float> trace =
      pass.forward(ctx, kMainGradient, {rows.origin, rows.direction, rows.near_far}, nullptr, 0, {rows.origin.rows});
  std::vector<float> values(trace.color.data, trace.color.data + trace.color.size());
  values.insert(values.end(), trace.semantic.rows.data, trace.semantic.rows.data + trace.semantic.rows.size());
  return values;
}

// Rays that may stop early take their samples in rounds, and hand hidden activations on from each, in bf16 too.
TEST(Parity, RoundsOfRenderingGiveWhatOneEvaluationGives) {
  for (const std::string precision : {"fp32", "bf16"}) {
    Registry registry = make_registry();
    const auto open = [&](const std::string& early_stop) {
      return open_text(
          "scene: {type: analytic_room}\nsemantics: {hidden_width: 32}\nrendering: {density_activation: softplus, "
          "early_stop: " +
              early_stop +
              "}\ntrain: {rays: 24}\npasses:\n  - sampler: {type: stratified, samples: 40}\n    position: {type: "
              "frequency, frequencies: 3}\n    direction: {type: frequency, frequencies: 2}\n    field: {type: "
              "tiny_mlp, hidden_width: 64}\nruntime: {device: cpu, precision: " +
              precision + "}\n",
          registry);
    };
    Session rounds = open("1e-12"), whole = open("0");
    rounds.pipeline->derive(0);
    whole.pipeline->derive(0);
    BatchBuffers batch;
    rounds.make_ray_source()->fill(3, batch);
    const std::vector<float> a = rendered(rounds, batch), b = rendered(whole, batch);
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) ASSERT_NEAR(a[i], b[i], 1e-6) << precision << ", value " << i;
  }
}

}  // namespace
}  // namespace semfield
