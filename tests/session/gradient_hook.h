// What the gradient hook promises on every device: `runtime` is the body of that section.
#pragma once

#include "tests/session/train_testing.h"

namespace semfield::testing_train {

inline TestRun hook_run(const std::string& yaml, const std::string& runtime) {
  return TestRun(yaml + "runtime: {" + runtime + "}\n");
}
inline void call(TestRun& run, GradientHook<float> hook) {
  run.session.pipeline->executor().set_gradient_hook(std::move(hook));
}

/// Every learned tensor of every step, in the order of the store, with `look` at each view; and the bits stay. Graphs
/// of a device are captured in the third step, one without a hook and two with it.
inline void expect_hook_sees_every_tensor(
    const std::string& runtime,
    const std::function<void(const StepGradients<float>&, const Tensor<float>&, const View<float>&)>& look) {
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    TestRun plain = hook_run(yaml, runtime), hooked = hook_run(yaml, runtime);
    std::vector<std::int64_t> steps;
    call(hooked, [&](const StepGradients<float>& gradients) {
      steps.push_back(gradients.step);
      std::size_t next = 0;
      for (const Tensor<float>& t : hooked.store().all()) {
        if (!t.learned()) continue;
        ASSERT_LT(next, gradients.tensors.size());
        const View<float>& view = gradients.tensors[next++];
        EXPECT_EQ(view.rows, t.spec.rows) << t.name;
        EXPECT_EQ(view.cols, t.spec.cols) << t.name;
        look(gradients, t, view);
      }
      EXPECT_EQ(next, gradients.tensors.size());
    });
    plain.to(12);
    hooked.to(12);
    EXPECT_EQ(plain.bits(), hooked.bits());
    for (std::size_t i = 0; i < steps.size(); ++i) EXPECT_EQ(steps[i], i);
    call(hooked, nullptr);
    plain.to(18);
    hooked.to(18);
    EXPECT_EQ(plain.bits(), hooked.bits());
    EXPECT_EQ(steps.size(), 12u);
  }
}

/// The first moment after the first step is (1 - beta1) times the gradient: unlike the update it keeps its scale. Of
/// the fixed losses the semantic one has a weight, and the head learns from it alone.
inline void expect_half_of_the_gradients_is_half_of_the_weight(const std::string& runtime, GradientHook<float> halve) {
  const auto weighted = [&](const std::string& weight) {
    std::string yaml = two_pass_config();
    return hook_run(yaml.replace(yaml.find("weight: 0.3"), 11, "weight: " + weight), runtime);
  };
  TestRun full = weighted("0.25"), halved = weighted("0.25"), light = weighted("0.125");
  call(halved, std::move(halve));
  for (TestRun* run : {&full, &halved, &light}) run->to(1);
  int semantic = 0;
  for (std::size_t i = 0; i < full.store().all().size(); ++i) {
    const Tensor<float>& t = full.store().all()[i];
    if (!t.learned()) continue;
    const float* const of_halved = halved.store().all()[i].moment1.data();
    const float* const of_light = light.store().all()[i].moment1.data();
    double largest = 0;
    for (std::int64_t e = 0; e < t.size(); ++e) {
      ASSERT_EQ(of_halved[e], 0.5F * t.moment1.data()[e]) << t.name << ' ' << e;
      ASSERT_TRUE(!t.rule.semantic || of_halved[e] == of_light[e]) << t.name << ' ' << e;
      largest = std::max<double>(largest, std::abs(of_halved[e]));
    }
    EXPECT_GT(largest, 0) << t.name;
    semantic += t.rule.semantic ? 1 : 0;
  }
  EXPECT_GT(semantic, 0);
}

inline void expect_an_error_of_the_hook_ends_the_step(const std::string& runtime) {
  TestRun plain = hook_run(hash_config(), runtime), hooked = hook_run(hash_config(), runtime);
  hooked.to(5);
  call(hooked, [](const StepGradients<float>& gradients) {
    if (gradients.step == 7) throw Error(ErrorKind::failure, "test.error.made", "rank 3 is gone", "start it again");
  });
  EXPECT_HAS(error_of([&] { hooked.to(10); }), "rank 3 is gone", "start it again");
  EXPECT_EQ(hooked.trainer.step(), 7);
  call(hooked, nullptr);
  plain.to(9);
  hooked.to(9);
  EXPECT_EQ(plain.bits(), hooked.bits());
}

}  // namespace semfield::testing_train
