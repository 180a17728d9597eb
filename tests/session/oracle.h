// The whole pipeline in float64: its gradients against finite differences, and against those of another configuration.
#pragma once

#include "execution/lane_executor.h"
#include "tests/session/train_testing.h"

namespace semfield::testing_train {

/// A run's pipeline in float64 and one batch of its rays.
struct Oracle {
  Session session;
  std::unique_ptr<RaySource> rays;
  std::unique_ptr<Pipeline<double>> pipeline;
  BatchBuffers batch;

  explicit Oracle(const std::string& yaml, Registry& registry = all_plugins()) : session(open_text(yaml, registry)) {
    rays = session.make_ray_source();
    pipeline = assemble(make_parts<double>(session.config, registry, session.plan, session.extent), {}, true);
    rays->fill(3, batch);
  }
  StepLosses gradients() {
    for (Tensor<double>& t : pipeline->store().all()) std::fill_n(t.grad.data(), t.grad.size(), 0.0);
    pipeline->derive(3);
    return pipeline->lanes().gradients(3, batch.view(pipeline->has_semantics()));
  }
};

/// One pass of the paper's network, narrow: its sample positions do not depend on the parameters, so that the loss is
/// the derivative's own function.
inline std::string one_pass_config(const std::string& more = "") {
  return "scene: {type: analytic_room}\nsemantics: {hidden_width: 8, weight: 0.5}\n"
         "rendering: {density_activation: softplus}\npasses:\n  - sampler: {type: stratified, samples: 12}\n"
         "    position: {type: frequency, frequencies: 3}\n    direction: {type: spherical_harmonics, degree: 2}\n"
         "    field: {type: nerf_mlp, depth: 3, width: 12, skip_at: 1, view_width: 8}\ntrain: {rays: 24}\n" +
         more;
}

/// Losses and gradients of the same tensors, each of which must have one.
inline void expect_same_gradients(const std::string& yaml, const std::string& other_yaml) {
  Oracle with(yaml), without(other_yaml);
  const StepLosses a = with.gradients();
  const StepLosses b = without.gradients();
  EXPECT_GT(a.labelled, 0);
  EXPECT_NEAR(a.total, b.total, 1e-12);
  EXPECT_NEAR(a.semantic, b.semantic, 1e-12);
  int compared = 0;
  for (const Tensor<double>& t : with.pipeline->store().all()) {
    if (!t.learned()) continue;
    const Tensor<double>* other = without.pipeline->store().find(t.name);
    ASSERT_NE(other, nullptr) << t.name;
    double largest = 0;
    for (std::int64_t i = 0; i < t.size(); ++i) largest = std::max(largest, std::abs(t.grad.data()[i]));
    for (std::int64_t i = 0; i < t.size(); ++i)
      ASSERT_NEAR(t.grad.data()[i], other->grad.data()[i], 1e-9 * std::max(1.0, largest)) << t.name << " element " << i;
    EXPECT_GT(largest, 0) << t.name << " got no gradient at all";
    ++compared;
  }
  EXPECT_GT(compared, 10);
}

/// Central differences of the total loss in a few elements of every learned tensor whose name contains `part`, at least
/// `fewest` in all.
inline void expect_finite_differences(Oracle& oracle, double tolerance, const std::string& part = "", int fewest = 16) {
  oracle.gradients();
  std::map<std::string, std::vector<double>> analytic;
  for (const Tensor<double>& t : oracle.pipeline->store().all()) {
    if (t.learned()) analytic[t.name] = std::vector<double>(t.grad.data(), t.grad.data() + t.size());
  }
  int checked = 0;
  for (Tensor<double>& t : oracle.pipeline->store().all()) {
    if (!t.learned() || t.name.find(part) == std::string::npos) continue;
    const std::vector<double>& gradient = analytic[t.name];
    // The largest gradient of the tensor and two more: an element that does nothing shows nothing.
    const auto largest =
        static_cast<std::int64_t>(std::max_element(gradient.begin(), gradient.end(),
                                                   [](double a, double b) { return std::abs(a) < std::abs(b); }) -
                                  gradient.begin());
    EXPECT_NE(gradient[largest], 0) << t.name << " got no gradient at all";
    for (const std::int64_t i : {largest, t.size() / 3, t.size() - 1}) {
      double& value = t.value.data()[i];
      const double keep = value, h = 1e-6;
      value = keep + h;
      const double up = oracle.gradients().total;
      value = keep - h;
      const double down = oracle.gradients().total;
      value = keep;
      const double numeric = (up - down) / (2 * h);
      EXPECT_NEAR(gradient[i], numeric, tolerance * std::max(1e-2, std::abs(numeric))) << t.name << " element " << i;
      ++checked;
    }
  }
  EXPECT_GE(checked, fewest);
}
inline void expect_finite_differences(const std::string& yaml, double tolerance, const std::string& part = "",
                                      int fewest = 16) {
  Oracle oracle(yaml);
  expect_finite_differences(oracle, tolerance, part, fewest);
}

}  // namespace semfield::testing_train
