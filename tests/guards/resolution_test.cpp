// A10: opacity that came in one or two long steps is told, with a remedy; short steps are not blamed.
#include <gtest/gtest.h>

#include <cmath>

#include "eval/final_eval.h"
#include "model/opacity_resolution.h"
#include "tests/session/train_testing.h"

namespace semfield {

struct SlabParams {
  double at_m = 1.2;
  double width_m = 0.02;
};
void describe(ParamVisitor& visit, SlabParams& p) {
  SEMFIELD_PARAM(visit, p, at_m, "x of the middle plane, metres", {-10, 10});
  SEMFIELD_PARAM(visit, p, width_m, "width, metres", {1e-6, 10});
}
void validate(const SlabParams&, Diagnostics&) {}

// Grey matter of optical depth 10 between two planes, nothing else.
template <class Real>
class Slab final : public Field<Real> {
 public:
  Slab(const SlabParams& p, const FieldBuild&, const KernelTables&) : p_(p) {}
  FieldTraits traits() const noexcept override { return {}; }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 64; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>& in, const FieldOut<Real>& out,
                  Saved) const override {
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const bool inside = std::abs(static_cast<double>(in.position(m, 0)) - p_.at_m) < 0.5 * p_.width_m;
      if (!out.sigma.empty()) out.sigma(m, 0) = static_cast<Real>(inside ? 10 / p_.width_m : -1);
      for (int c = 0; c < 3 && !out.rgb.empty(); ++c) out.rgb(m, c) = Real(0.5);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                   const FieldGrad<Real>&, Saved, View<Real>) const override {}

 private:
  SlabParams p_;
};

namespace {

using testing_train::make_registry;
using testing_train::open_text;

SplitScore score_of(int samples, double width_m) {
  Registry registry = make_registry();
  registry.add_field<Slab, SlabParams>("slab", "matter between two planes");
  const std::string yaml =
      "scene: {type: analytic_room, with_labels: false}\n"
      "rendering: {density_activation: relu, scene_scale: 1}\n"
      "passes:\n"
      "  - name: main\n"
      "    sampler: {type: stratified, samples: " +
      std::to_string(samples) +
      "}\n"
      "    position: {type: identity}\n"
      "    direction: {type: spherical_harmonics, degree: 1}\n"
      "    field: {type: slab, width_m: " +
      std::to_string(width_m) + "}\n";
  const Session s = open_text(yaml, registry);
  return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit);
}

TEST(Resolution, AThinSlabBetweenLongStepsIsTold) {
  const SplitScore score = score_of(24, 0.02);
  ASSERT_GT(score.resolution.opaque_px, 0) << "some rays meet the slab by chance";
  EXPECT_GT(*score.resolution.share(), 0.95) << "all but rays that graze the slab";
  const std::string warning = score.resolution.warning();
  EXPECT_NE(warning.find(" % of the pixels that meet something"), std::string::npos) << warning;
  EXPECT_NE(warning.find("raise the sampler's samples"), std::string::npos);
}

TEST(Resolution, ShortStepsAndThickMatterAreNot) {
  EXPECT_EQ(score_of(1024, 0.02).resolution.under_resolved_px, 0);
  // Matter that fades in over many long steps is resolved as well as it is sharp.
  const SplitScore thick = score_of(48, 3);
  ASSERT_GT(thick.resolution.opaque_px, 100);
  EXPECT_EQ(thick.resolution.under_resolved_px, 0);
  EXPECT_EQ(thick.resolution.warning(), "");
}

TEST(Resolution, TheShareIsAmongTheFiguresAndInTheFile) {
  const SplitScore score = score_of(24, 0.02);
  bool found = false;
  for (const auto& [name, value] : score.values())
    found = found || (name == "under_resolved" && value == score.resolution.share());
  EXPECT_TRUE(found);
  const FinalEval read = parse_final_eval(final_eval_json(final_eval(score, {}, "test")), "test");
  EXPECT_EQ(read.resolution.opaque_px, score.resolution.opaque_px);
  EXPECT_EQ(read.resolution.under_resolved_px, score.resolution.under_resolved_px);
  EXPECT_EQ(OpacityCounts{}.share(), std::nullopt);
}

struct OneRay {
  std::vector<float> t, delta, weight;
  std::vector<std::int32_t> ray, first;
  Samples<float> samples;
  OneRay(std::vector<float> weights, float step) : weight(std::move(weights)) {
    const auto n = static_cast<std::int32_t>(weight.size());
    for (std::int32_t k = 0; k < n; ++k) t.push_back(2.0F + step * static_cast<float>(k));
    delta.assign(weight.size(), step);
    ray.assign(weight.size(), 0);
    first = {0, n};
    samples.t = {t.data(), n, 1};
    samples.delta = {delta.data(), n, 1};
    samples.ray_of_sample = {ray.data(), n, 1};
    samples.first = {first.data(), 2, 1};
    samples.count = n;
  }
  OpacityResolution look(FarMode far = FarMode::open, double footprint_per_m = 0.01) const {
    return opacity_resolution<float>(samples, View<const float>(weight.data(), samples.count, 1), far, 0,
                                     footprint_per_m);
  }
};

TEST(Resolution, TheRule) {
  using R = OpacityResolution;
  EXPECT_EQ(OneRay({0.2F, 0.2F}, 0.1F).look(), R::clear);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0, 0.5F, 0.45F}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0.2F, 0.3F, 0.3F, 0.2F}, 0.1F).look(), R::resolved);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.01F).look(), R::resolved) << "a step below the pixel's 0.02 m";
  EXPECT_EQ(OneRay({0, 0.1F, 0.9F}, 0.1F).look(FarMode::background), R::clear) << "the rest is no density";
  EXPECT_EQ(OneRay({}, 0.1F).look(), R::clear);
}

TEST(Resolution, BandsBeyondTheCoordinatesAreSaid) {
  Registry registry = make_registry();
  std::string yaml = testing_train::two_pass_config();
  yaml.replace(yaml.find("frequencies: 3"), 14, "frequencies: 30, arithmetic: float32");
  const Session s = open_text(yaml, registry);
  ASSERT_EQ(s.chosen.size(), 1u);
  EXPECT_EQ(s.chosen[0].rfind("passes.coarse.position: warning: effective_bands is ", 0), 0u) << s.chosen[0];
}

}  // namespace
}  // namespace semfield
