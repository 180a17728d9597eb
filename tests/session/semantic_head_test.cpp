// A pass trains with any head: one that is not the program's own needs its class alone.
#include <gtest/gtest.h>

#include "compute/gemm.h"
#include "compute/row_loops.h"
#include "plugin/head/one_layer_head.h"
#include "testkit/settings.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

/// logits = feature W: no hidden layer and no bias.
class LinearHead final : public Head<double> {
 public:
  LinearHead(std::int32_t feature, std::int32_t classes) : feature_(feature), classes_(classes) {}
  std::int32_t hidden_width() const override { return feature_; }
  std::int32_t width() const override { return classes_; }
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"weight", feature_, classes_, Init::uniform(0.5)});
    declarer.tensor({"weight_t", classes_, feature_, {}, TensorRole::derived});
  }
  void derive(const StepContext&, const Tensors<double>& t) const override {
    transpose<double>(t.value[0], t.value[1]);
  }
  void hidden_forward(const StepContext&, const Tensors<double>&, View<const double> feature,
                      View<double> hidden) const override {
    copy_rows<double>(feature, hidden);
  }
  void hidden_backward(const StepContext&, const Tensors<double>&, View<const double>, View<const double>,
                       View<double> d_hidden, View<double> d_feature) const override {
    copy_rows<double>(d_hidden, d_feature);
  }
  void output_forward(const StepContext&, const Tensors<double>& t, View<const double> h, View<const double>,
                      View<double> logits) const override {
    gemm<double>(h, t.value[0], logits);
  }
  void output_backward(const StepContext&, const Tensors<double>& t, View<const double> h, View<const double>,
                       View<const double> d_logits, View<double> d_h, View<double> d_share) const override {
    gemm_at_b_add<double>(h, d_logits, t.grad[0]);
    gemm<double>(d_logits, t.value[1], d_h);
    if (!d_share.empty()) fill(d_share, 0.0);
  }

 private:
  std::int32_t feature_, classes_;
};

PassParts<double> parts_with_linear_head(const Session& session, const Registry& registry) {
  const auto params = [&](PluginKind kind, const char* name, const testkit::Settings& settings) {
    return testkit::make_params(registry.get(kind, name), settings);
  };
  PassParts<double> parts;
  parts.name = "main";
  SamplerBuild sampler;
  sampler.bounds = session.extent.bounds;
  sampler.near_m = session.extent.near_m;
  sampler.far_m = session.extent.far_m;
  parts.sampler =
      registry.get(PluginKind::sampler, "stratified")
          .sampler64(*params(PluginKind::sampler, "stratified", {{"samples", "12"}}), sampler, registry.kernels());
  parts.position = registry.get(PluginKind::encoder, "frequency")
                       .encoder64(*params(PluginKind::encoder, "frequency", {{"frequencies", "3"}}), EncoderBuild{},
                                  registry.kernels());
  FieldBuild field;
  field.position_dims = parts.position->traits().out_dims;
  parts.field = registry.get(PluginKind::field, "tiny_mlp")
                    .field64(*params(PluginKind::field, "tiny_mlp", {{"hidden_width", "16"}, {"color_width", "16"}}),
                             field, registry.kernels());
  parts.head = std::make_unique<LinearHead>(parts.field->traits().feature_dims,
                                            static_cast<std::int32_t>(session.plan.class_of_logit.size()));
  parts.domain = DomainMap::make(Domain::metric, session.extent.bounds, session.config.rendering.scene_scale);
  return parts;
}

TEST(SemanticHeads, AnyHeadTrainsThroughThePass) {
  for (const bool deferred : {true, false}) {
    SCOPED_TRACE(deferred ? "class layer once a ray" : "class layer once a sample");
    Registry registry = make_registry();
    Oracle oracle(hash_config(), registry);
    PipelineOptions options;
    options.rules.rendering.density_activation = DensityActivation::softplus;
    options.rules.deferred_class_layer = deferred;
    std::vector<PassParts<double>> passes;
    passes.push_back(parts_with_linear_head(oracle.session, registry));
    oracle.pipeline = std::make_unique<Pipeline<double>>(std::move(passes), options, true);
    EXPECT_GT(oracle.gradients().labelled, 0);
    expect_finite_differences(oracle, 1e-5);
  }
}

// A head that says nothing of bf16 is never given any.
TEST(SemanticHeads, RefuseBf16ThatTheyDoNotTake) {
  const LinearHead head(3, 2);
  EXPECT_FALSE(head.takes_rounded());
  EXPECT_THROW((void)head.hidden_layer({}), Error);
  const Head<double>& base = head;
  EXPECT_THROW(base.rounded_hidden_forward({}, {}, View<const Bf16>(), View<Bf16>()), Error);
}

}  // namespace
}  // namespace semfield
