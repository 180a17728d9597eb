// The gradient hook: what a program sees and may change between backward and Adam.
#include <gtest/gtest.h>

#include <cmath>

#include "core/error.h"
#include "session/trainer.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

// A session with its trainer.
struct Subject {
  Subject(const std::string& yaml, Registry& registry) : session(open_text(yaml, registry)) {}
  void to(std::int64_t step) {
    while (trainer.step() < step) trainer.advance();
  }
  void call(GradientHook<float> hook) { session.pipeline->executor().set_gradient_hook(std::move(hook)); }
  ParamStore<float>& store() { return session.pipeline->store(); }

  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
};

TEST(GradientHook, SeesEveryLearnedTensorOfEveryStepAndKeepsTheBits) {
  Registry registry = make_registry();
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Subject plain(yaml, registry), hooked(yaml, registry);
    std::vector<std::int64_t> steps;
    hooked.call([&](const StepGradients<float>& gradients) {
      steps.push_back(gradients.step);
      EXPECT_EQ(gradients.stream, nullptr);
      std::size_t next = 0;
      double sum = 0;
      for (const Tensor<float>& t : hooked.store().all()) {
        if (!t.learned()) continue;
        ASSERT_LT(next, gradients.tensors.size());
        const View<float>& view = gradients.tensors[next++];
        EXPECT_EQ(view.data, t.grad.data()) << t.name;
        EXPECT_EQ(view.rows, t.spec.rows) << t.name;
        EXPECT_EQ(view.cols, t.spec.cols) << t.name;
        EXPECT_EQ(view.device, Device::cpu);
        for (std::int64_t i = 0; i < view.size(); ++i) sum += std::abs(static_cast<double>(view.data[i]));
      }
      EXPECT_EQ(next, gradients.tensors.size());
      EXPECT_GT(sum, 0);
    });
    plain.to(6);
    hooked.to(6);
    EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
    EXPECT_EQ(steps, (std::vector<std::int64_t>{0, 1, 2, 3, 4, 5}));
    hooked.call(nullptr);
    plain.to(8);
    hooked.to(8);
    EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
    EXPECT_EQ(steps.size(), 6u);
  }
}

// The first moment after the first step is (1 - beta1) times the gradient: unlike the update it keeps its scale. Of the
// fixed losses the semantic one has a weight, and the head learns from it alone.
TEST(GradientHook, HalfOfTheGradientsIsHalfOfTheWeight) {
  Registry registry = make_registry();
  const auto config = [](const std::string& weight) {
    std::string yaml = two_pass_config();
    return yaml.replace(yaml.find("weight: 0.3"), 11, "weight: " + weight);
  };
  Subject full(config("0.25"), registry), halved(config("0.25"), registry), light(config("0.125"), registry);
  halved.call([](const StepGradients<float>& gradients) {
    for (const View<float>& gradient : gradients.tensors) {
      for (std::int64_t i = 0; i < gradient.size(); ++i) gradient.data[i] *= 0.5F;
    }
  });
  for (Subject* run : {&full, &halved, &light}) run->to(1);
  int semantic = 0;
  for (std::size_t i = 0; i < full.store().all().size(); ++i) {
    const Tensor<float>& t = full.store().all()[i];
    if (!t.learned()) continue;
    const float* const of_halved = halved.store().all()[i].moment1.data();
    const float* const of_light = light.store().all()[i].moment1.data();
    for (std::int64_t e = 0; e < t.size(); ++e) {
      ASSERT_EQ(of_halved[e], 0.5F * t.moment1.data()[e]) << t.name << ' ' << e;
      ASSERT_TRUE(!t.rule.semantic || of_halved[e] == of_light[e]) << t.name << ' ' << e;
    }
    semantic += t.rule.semantic ? 1 : 0;
  }
  EXPECT_GT(semantic, 0);
}

TEST(GradientHook, AnErrorEndsTheStepAndChangesNothing) {
  Registry registry = make_registry();
  Subject plain(hash_config(), registry), hooked(hash_config(), registry);
  plain.to(3);
  hooked.to(3);
  hooked.call([](const StepGradients<float>&) {
    throw Error(ErrorKind::failure, "test.error.made", "rank 3 is gone", "start it again");
  });
  try {
    hooked.trainer.advance();
    FAIL() << "the step went on";
  } catch (const Error& error) {
    EXPECT_NE(error.message().find("rank 3 is gone"), std::string::npos) << error.message();
    EXPECT_EQ(error.remedy(), "start it again");
  }
  EXPECT_EQ(hooked.trainer.step(), 3);
  hooked.call(nullptr);
  plain.to(5);
  hooked.to(5);
  EXPECT_EQ(fingerprint(plain.store()), fingerprint(hooked.store()));
}

TEST(GradientHook, WhatItWritesIsChecked) {
  Registry registry = make_registry();
  Subject run(hash_config(), registry);
  run.to(2);
  run.call([](const StepGradients<float>& gradients) { gradients.tensors.back().data[0] = NAN; });
  const std::uint32_t before = fingerprint(run.store());
  EXPECT_THROW(run.trainer.advance(), Error);
  EXPECT_EQ(fingerprint(run.store()), before);
  EXPECT_EQ(run.trainer.step(), 2);
}

}  // namespace
}  // namespace semfield
