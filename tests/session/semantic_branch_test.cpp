// A network of its own for semantics: gradients, what it leaves alone, what leaving samples out may change, its
// settings.
#include "compute/gemm.h"
#include "compute/layers.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "plugin/head.h"
#include "session/trainer.h"
#include "testkit/laws.h"
#include "tests/session/oracle.h"

namespace semfield {
namespace {

using namespace testing_train;

// `branch` is the body of the pass's section `semantic`, "" for none.
std::string config_of(const std::string& branch, const std::string& more = "") {
  return stratified_config("type: analytic_room", branch.empty() ? "" : "    semantic: {" + branch + "}\n", "rays: 24",
                           more);
}
const std::string kPlugins =
    "position: {type: frequency, frequencies: 3}, field: {type: tiny_mlp, hidden_width: 12, hidden_layers: 2}";

// Of the tensors of branch and head: weights are constants to them, and so is which samples are left out.
TEST(HeadBranch, GradientsAreThoseOfFiniteDifferences) {
  for (const char* more : {"", ", reads_feature: false", ", dropout: 0.3", ", least_weight: 0.02"}) {
    SCOPED_TRACE(more);
    expect_finite_differences(config_of(kPlugins + more), 2e-4, "/semantic",
                              8 * 3);  // two layers of branch and of head
  }
}

TEST(HeadBranch, TilesLanesAndTheDeferredClassLayerChangeNoGradient) {
  for (const char* more : {"", ", dropout: 0.25", ", least_weight: 0.05"}) {
    expect_same_gradients(config_of(kPlugins + more, "runtime: {lanes: 1, tile_rays: 24}\n"),
                          config_of(kPlugins + more, "runtime: {lanes: 3, tile_rays: 4}\n"));
    expect_same_gradients(config_of(kPlugins + more),
                          config_of(kPlugins + more, "runtime: {deferred_class_layer: false}\n"));
  }
}

// Colour and geometry learn as they do in a scene without labels, to the last bit.
TEST(HeadBranch, LabelsDoNotShapeTheField) {
  Registry registry = make_registry();
  Oracle labelled(config_of(kPlugins), registry);
  std::string none = config_of(kPlugins);
  none = with_scene(none, "{type: analytic_room, with_labels: false}");
  Oracle unlabelled(none, registry);
  ASSERT_FALSE(unlabelled.pipeline->has_semantics());
  EXPECT_GT(labelled.gradients().semantic, 0);
  unlabelled.gradients();
  int compared = 0;
  for (const Tensor<double>& t : unlabelled.pipeline->store().all()) {
    if (!t.learned()) continue;
    const Tensor<double>* other = labelled.pipeline->store().find(t.name);
    ASSERT_NE(other, nullptr) << t.name;
    for (std::int64_t i = 0; i < t.size(); ++i)
      ASSERT_EQ(t.grad.data()[i], other->grad.data()[i]) << t.name << " " << i;
    ++compared;
  }
  EXPECT_GT(compared, 5);
}

// |change of a logit| <= sum of the weights left out times the largest logit of a sample.
TEST(HeadBranch, LeavingSamplesOutChangesLogitsWithinTheBound) {
  Registry registry = make_registry();
  const std::string off = "runtime: {deferred_class_layer: false, tile_rays: 24, lanes: 1}\n";
  Oracle all(config_of(kPlugins + ", least_weight: 0", off), registry);
  const auto trace_of = [](Oracle& o, Workspace& arena) {
    StepContext ctx{.workspace = &arena};
    const RayBatch batch = o.batch.view(true);
    return o.pipeline->passes()[0].forward(ctx, 0, {batch.origin, batch.direction, batch.near_far}, nullptr, 0,
                                           {batch.origin.rows});
  };
  Workspace arena_all;
  const PassTrace<double> a = trace_of(all, arena_all);
  std::vector<double> weights(a.weight.data, a.weight.data + a.samples.count);
  std::sort(weights.begin(), weights.end());
  std::int64_t before = 0;
  for (const std::size_t part : {8, 4, 2}) {
    const double least = weights[weights.size() / part];
    ASSERT_LT(least, 0.1);
    Oracle some(config_of(kPlugins + ", least_weight: " + std::to_string(least), off), registry);
    Workspace arena_some;
    const PassTrace<double> b = trace_of(some, arena_some);
    double largest = 0;
    for (std::int64_t k = 0; k < a.semantic.sample_rows.rows; ++k) {
      for (std::int32_t c = 0; c < a.semantic.sample_rows.cols; ++c)
        largest = std::max(largest, std::abs(a.semantic.sample_rows(k, c)));
    }
    double moved = 0;
    for (std::int64_t r = 0; r < a.semantic.rows.rows; ++r) {
      const double left_out = a.semantic.branch.share(r, 0) - b.semantic.branch.share(r, 0);
      EXPECT_GE(left_out, -1e-15);
      for (std::int32_t c = 0; c < a.semantic.rows.cols; ++c) {
        const double change = std::abs(a.semantic.rows(r, c) - b.semantic.rows(r, c));
        EXPECT_LE(change, left_out * largest + 1e-12);
        moved = std::max(moved, change);
      }
    }
    EXPECT_GT(moved, 0);
    const std::int64_t left = a.semantic.branch.samples.count - b.semantic.branch.samples.count;
    EXPECT_GT(left, before) << "samples of weight below " << least;
    before = left;
    EXPECT_GT(b.semantic.branch.samples.count, 0);
  }
}

// One step from the same values: its tensors move by the factor, and lose their part first; all others move alike.
TEST(HeadBranch, ItsRateAndDecayHoldForBranchAndHeadAlone) {
  const auto stepped = [](const std::string& more, std::vector<float>& before, std::vector<float>& after,
                          std::vector<bool>& semantic) {
    Session s = open_text(config_of(kPlugins + more));
    const auto rays = s.make_ray_source();
    Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule);
    const auto copy = [&](std::vector<float>& to) {
      for (const Tensor<float>& t : s.pipeline->store().all()) {
        if (t.spec.role == TensorRole::dense) to.insert(to.end(), t.value.data(), t.value.data() + t.size());
      }
    };
    for (const Tensor<float>& t : s.pipeline->store().all()) {
      if (t.spec.role == TensorRole::dense)
        semantic.insert(semantic.end(), static_cast<std::size_t>(t.size()), t.rule.semantic);
    }
    copy(before);
    trainer.advance();
    copy(after);
    return s.config.adam.learning_rate;
  };
  std::vector<float> start, plain, start_own, own;
  std::vector<bool> semantic, same;
  stepped("", start, plain, semantic);
  const double rate = stepped(", learning_rate: 0.25, weight_decay: 8", start_own, own, same);
  ASSERT_EQ(start, start_own);
  int moved = 0;
  for (std::size_t i = 0; i < start.size(); ++i) {
    if (!semantic[i]) {
      ASSERT_EQ(own[i], plain[i]) << i;
      continue;
    }
    const double was = static_cast<double>(start[i]), step = static_cast<double>(plain[i]) - was;
    ASSERT_NEAR(own[i], was * (1 - rate * 0.25 * 8) + 0.25 * step, 1e-6) << i;
    moved += std::abs(step) > 1e-5 ? 1 : 0;
  }
  EXPECT_GT(moved, 100);
}

TEST(HeadBranch, RunsHaveTheSameBitsForAnyThreadsAndLearn) {
  const std::string yaml =
      hash_config().insert(hash_config().find("train: "), "    semantic: {" + kPlugins +
                                                              ", dropout: 0.1, "
                                                              "weight_decay: 0.01, learning_rate: 0.2}\n");
  const auto train = [&](int threads) {
    Session s = open_text(yaml);
    set_thread_count(threads);
    const auto rays = s.make_ray_source();
    Trainer trainer(*s.pipeline, *rays, s.config.adam, s.config.schedule);
    StepLosses last;
    const double first = trainer.advance().semantic;
    while (trainer.step() < 80) last = trainer.advance();
    set_thread_count(0);
    EXPECT_LT(last.semantic, 0.7 * first);
    return fingerprint(s.pipeline->store());
  };
  EXPECT_EQ(train(1), train(3));
}

// What is wrong in the section is said with the key that is wrong.
TEST(HeadBranch, WrongSettingsAreNamed) {
  const auto refusal = [](const std::string& branch) { return error_of([&] { open_text(config_of(branch)); }); };
  EXPECT_HAS(refusal("field: {type: tiny_mlp}"), "passes.0.semantic: key 'position' is missing");
  EXPECT_HAS(refusal("position: {type: frequency}"), "passes.0.semantic: key 'field' is missing");
  EXPECT_HAS(refusal(kPlugins + ", least_wieght: 0.1"), "least_weight");
  EXPECT_HAS(refusal(kPlugins + ", dropout: 1"), "dropout");
  EXPECT_HAS(refusal("position: {type: hash_grid}, field: {type: tiny_mlp}"), "learned tensors");
  EXPECT_HAS(refusal("position: {type: spherical_harmonics}, field: {type: tiny_mlp}"), "semantic.position");
  EXPECT_EQ(refusal(kPlugins), "");
}

// run.yaml says what was trained.
TEST(HeadBranch, TheResolvedConfigurationHoldsIt) {
  Registry registry = make_registry();
  const Session s = open_text(config_of(kPlugins + ", learning_rate: 0.3, weight_decay: 0.02, dropout: 0.1"), registry);
  Diagnostics diagnostics;
  const RunConfig again = read_run_config(resolved_config(s.config), registry, diagnostics);
  EXPECT_EQ(diagnostics.error_count(), 0);
  const SemanticBranchConfig* const branch = again.passes[0].branch();
  ASSERT_NE(branch, nullptr);
  EXPECT_EQ(branch->rules.learning_rate, 0.3);
  EXPECT_EQ(branch->rules.weight_decay, 0.02);
  EXPECT_EQ(branch->rules.dropout, 0.1);
  EXPECT_EQ(branch->rules.least_weight, 1e-3);
  for (const Tensor<float>& t : s.pipeline->store().all()) {
    EXPECT_EQ(t.rule.rate, t.rule.semantic ? 0.3 : 1) << t.name;
    EXPECT_LACKS(t.name, "semantic/field/color") << "a branch has no colour: " << t.name;
  }
}

// A pass trains with any head: one that is not the program's own needs its class alone.

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
  PassParts<double> parts{.name = "main"};
  SamplerBuild sampler{.bounds = session.extent.bounds, .near_m = session.extent.near_m, .far_m = session.extent.far_m};
  parts.sampler =
      registry.get(PluginKind::sampler, "stratified")
          .sampler64(*params(PluginKind::sampler, "stratified", {{"samples", "12"}}), sampler, registry.kernels());
  parts.position = registry.get(PluginKind::encoder, "frequency")
                       .encoder64(*params(PluginKind::encoder, "frequency", {{"frequencies", "3"}}), EncoderBuild{},
                                  registry.kernels());
  FieldBuild field{.position_dims = parts.position->traits().out_dims};
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
    SCOPED_TRACE(deferred ? "class layer once per ray" : "class layer once per sample");
    Registry registry = make_registry();
    Oracle oracle(hash_config(), registry);
    PipelineOptions options{
        .rules = {.rendering = {.density_activation = DensityActivation::softplus}, .deferred_class_layer = deferred}};
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
