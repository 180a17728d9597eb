// A plugin that breaks one promise, and the law that must say so.

#include "testkit/laws.h"

#include <atomic>
#include <set>
#include <string>

#include "compute/gemm.h"
#include "tests/analytic_scene.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/says.h"

namespace semfield {
namespace {

using toy::Broken;

struct BrokenCase {
  std::string (*laws)(Broken);  ///< what the laws say of a plugin of a kind
  std::string how;              ///< it breaks this promise
  const char* law;              ///< words of the law's sentence
};

std::vector<BrokenCase> cases_of(std::string (*laws)(Broken),
                                 const std::vector<std::pair<const char*, const char*>>& promises) {
  std::vector<BrokenCase> cases;
  for (const auto& [how, law] : promises) cases.push_back({laws, how, law});
  return cases;
}

class BrokenPlugin : public testing::TestWithParam<BrokenCase> {};

TEST_P(BrokenPlugin, IsCaught) { EXPECT_HAS(GetParam().laws(GetParam().how), GetParam().law); }

std::string name_of(const testing::TestParamInfo<BrokenCase>& info) { return info.param.how; }

// The laws of encoders, samplers, losses and datasets hold for a sound plugin and catch each broken promise.

using testkit::Failures;

std::string laws_with(const testkit::LawOptions& options, Broken how) {
  const KernelTables kernels;
  const toy::ToyEncoder<float> encoder32(toy::ToyParams{}, EncoderBuild{}, kernels, how);
  const toy::ToyEncoder<double> encoder64(toy::ToyParams{}, EncoderBuild{}, kernels, how);
  return testkit::to_text(testkit::encoder_laws(encoder32, encoder64, options));
}
std::string encoder_laws_of(Broken how) { return laws_with({}, how); }

TEST(EncoderLaws, HoldForASoundEncoder) { EXPECT_EQ(encoder_laws_of("none"), ""); }

INSTANTIATE_TEST_SUITE_P(Encoder, BrokenPlugin,
                         testing::ValuesIn(cases_of(encoder_laws_of,
                                                    {{"skip_last_row", "every y written"},
                                                     {"write_past_cols", "y stays inside"},
                                                     {"wrong_dx", "gradient of x"},
                                                     {"wrong_table_gradient", "gradient of table"},
                                                     {"assign_gradient", "gradients accumulate"},
                                                     {"accumulate_dx", "every dx written"},
                                                     {"skip_dx", "every dx written"},
                                                     {"depend_on_row", "permuted rows"},
                                                     {"float_off", "float against double, y"},
                                                     {"sums_as_they_come", "1 and 3 threads, gradient of table"}})),
                         name_of);

TEST(EncoderLaws, SumsWithoutSameBitsHaveATolerance) {
  EXPECT_LACKS(laws_with({.same_bits_of_sums = false}, "sums_as_they_come"), "1 and 3 threads");
}

TEST(DeclarationLaws, HoldForTheToy) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures = testkit::declaration_laws(registry.get(PluginKind::encoder, "toy"));
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

/// Parameters each of which breaks one promise.
struct Careless {
  std::int64_t Bands = 2;
  double empty = 1.5, outside = 9;
  std::vector<double> some{1, 9};
  bool mute = false;
};
void describe(ParamVisitor& visit, Careless& p) {
  SEMFIELD_PARAM(visit, p, Bands, "has a capital letter");
  SEMFIELD_PARAM(visit, p, empty, "has a range without a number", {2, 1});
  SEMFIELD_PARAM(visit, p, outside, "has a default above its range", {0, 4});
  SEMFIELD_PARAM(visit, p, some, "has an element above its range", {0, 4});
  SEMFIELD_PARAM(visit, p, mute, "short");
}

TEST(DeclarationLaws, CatchEachCarelessDeclaration) {
  Registry registry;
  toy::register_into(registry);
  PluginEntry entry = registry.get(PluginKind::encoder, "toy");
  entry.summary = "Sines.";
  entry.new_params = [] { return std::make_unique<ParamsOf<Careless>>(); };
  EXPECT_HAS(testkit::to_text(testkit::declaration_laws(entry)), "entry: no sentence says what the plugin does",
             "parameter 'Bands': ", "parameter 'empty': its range is empty",
             "parameter 'outside': the default is outside its range",
             "parameter 'some': the default is outside its range", "parameter 'mute': no sentence says what it is",
             "config round trip: ");
}

TEST(EncoderLaws, BuildFromTheRegistryWithSettings) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures =
      testkit::plugin_laws(registry, PluginKind::encoder, "toy", {{"bands", "5"}, {"flip", "true"}});
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

TEST(Settings, RefuseUnknownNamesWrongTypesAndRanges) {
  Registry registry;
  toy::register_into(registry);
  const PluginEntry& entry = registry.get(PluginKind::encoder, "toy");
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const Failures failures =
      testkit::apply_settings(*params, {{"bands", "9"}, {"gain", "much"}, {"flip", "yes"}, {"glow", "1"}});
  EXPECT_EQ(failures.size(), 4u) << testkit::to_text(failures);
  EXPECT_HAS(testkit::to_text(failures), "bands: expected int in [1, 8], got 9", "unknown key 'glow'");
  EXPECT_THROW(testkit::make_params(entry, {{"gain", "0"}, {"flip", "true"}}), Error);
}

// The sampler laws hold for a sound sampler and catch each broken promise.

/// `kCount` jittered samples per ray in equal intervals; an empty ray has none.
template <class Real>
class ToySampler final : public Sampler<Real> {
 public:
  explicit ToySampler(Broken broken) : broken_(broken) {}
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t, bool) const noexcept override { return rays * kCount; }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>&, const Rays<Real>& rays, const Proposal<Real>*,
                 Samples<Real>& out) const override {
    const RandomAddress address = ctx.random("sampler/toy");
    const bool jitter = ctx.training || broken_ == "jitter_without_training";
    const std::int64_t first_ray = broken_ == "consumed_order" ? 0 : ctx.first_ray;
    std::int64_t n = 0;
    for (std::int64_t r = 0; r < rays.origin.rows; ++r) {
      out.first(r, 0) = static_cast<std::int32_t>(n);
      const double width = (rays.near_far(r, 1) - rays.near_far(r, 0)) / kCount;
      if (width <= 0 && broken_ != "fill_empty_rays") continue;
      for (std::int64_t k = 0; k < kCount; ++k, ++n) {
        const double u =
            jitter ? static_cast<double>(uniform01(address, static_cast<std::uint64_t>((first_ray + r) * kCount + k)))
                   : 0.5;
        const std::int64_t slot = broken_ == "descending" ? kCount - 1 - k : k;
        const double far_off = broken_ == "outside" && k == kCount - 1 ? 1.0 : 0.0;
        out.t(n, 0) = static_cast<Real>(rays.near_far(r, 0) + (static_cast<double>(slot) + u) * width + far_off);
        out.delta(n, 0) = broken_ == "zero_delta" && k == 2 ? Real(0) : static_cast<Real>(width);
        out.ray_of_sample(n, 0) = static_cast<std::int32_t>(r);
      }
    }
    out.first(rays.origin.rows, 0) = static_cast<std::int32_t>(broken_ == "wrong_first" ? n - 1 : n);
    out.count = n;
  }

 private:
  static constexpr std::int64_t kCount = 6;
  Broken broken_;
};

std::string sampler_laws_of(Broken broken) {
  SamplerBuild build{.bounds = {{-2, -2, -1}, {2, 2, 1}}, .near_m = 0.1, .far_m = 4.0};
  return testkit::to_text(testkit::sampler_laws(ToySampler<float>(broken), ToySampler<double>(broken), build));
}

TEST(SamplerLaws, HoldForASoundSampler) { EXPECT_EQ(sampler_laws_of("none"), ""); }

INSTANTIATE_TEST_SUITE_P(Sampler, BrokenPlugin,
                         testing::ValuesIn(cases_of(sampler_laws_of,
                                                    {{"descending", "not ascending"},
                                                     {"consumed_order", "a ray alone"},
                                                     {"outside", "outside [near, far]"},
                                                     {"zero_delta", "delta is not positive"},
                                                     {"wrong_first", "first[rays] is not the count"},
                                                     {"jitter_without_training", "without training, another seed"},
                                                     {"fill_empty_rays", "near == far"}})),
                         name_of);

// The loss laws hold for a sound loss and catch each broken promise.

struct ToyParams : LossRule {
  ToyParams() { weight = 1; }
  Broken broken = "none";
};

/// s_y^2 of the label's logit.
class Toy final : public LossOf<Toy, ToyParams> {
 public:
  using LossOf::LossOf;
  LossTraits traits() const override {
    LossTraits traits;
    traits.targets = {channel::label};
    traits.heads = {channel::logits};
    traits.moves = {channel::logits};
    if (params.broken == "says_more") traits.moves.push_back(channel::color);
    return traits;
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override {
    if (params.broken == "counts_unlabelled") return rays;
    std::int64_t labelled = 0;
    for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
    return labelled;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const Broken b = params.broken;
    const View<const Real> logits = values.heads[channel::logits];
    const View<Real> d_logits = gradients.heads[channel::logits];
    double sum = b == "loss_of_nothing" ? 0.1 : 0;
    if (targets.label.empty()) return b == "needs_no_label" ? 1 : sum;
    for (std::int64_t r = 0; r < logits.rows; ++r) {
      const std::int16_t label = targets.label(r, 0);
      if (label < 0 && b == "pulls_unlabelled") d_logits(r, 0) += Real(1e-9);
      if (label < 0) continue;
      const auto s = static_cast<double>(logits(r, label));
      double value = s * s, slope = 2 * s;
      if (b == "wrong_slope") slope *= 1.001;
      if (b == "hidden_slope") value += static_cast<double>(values.color(r, 0));
      if (b == "depends_on_row") slope += 1e-5 * static_cast<double>(r);
      if (b == "float_off" && sizeof(Real) == 4) value *= 1.01;
      if (b == "scaled_loss") value *= scale;
      if (b == "divides_by_zero" && s > 1000) value /= s - 1e4;
      sum += value;
      Real& d = d_logits(r, label);
      d = (b == "assigns" ? Real(0) : d) + static_cast<Real>(scale * slope);
    }
    return sum;
  }
};

std::string loss_laws_of(Broken broken) {
  ToyParams params;
  params.broken = broken;
  return testkit::to_text(testkit::loss_laws(Toy(params)));
}

TEST(LossLaws, HoldForASoundLoss) { EXPECT_EQ(loss_laws_of("none"), ""); }

INSTANTIATE_TEST_SUITE_P(Loss, BrokenPlugin,
                         testing::ValuesIn(cases_of(loss_laws_of,
                                                    {{"wrong_slope", "gradient of logits"},
                                                     {"hidden_slope", "gradient of color"},
                                                     {"says_more", "does not move color"},
                                                     {"assigns", "gradients accumulate, logits"},
                                                     {"scaled_loss", "the loss is before its scale"},
                                                     {"depends_on_row", "rays are independent, gradient of logits"},
                                                     {"float_off", "float against double, loss"},
                                                     {"loss_of_nothing", "no ray: has a loss"},
                                                     {"needs_no_label", "without label: there is a loss"},
                                                     {"pulls_unlabelled", "rays without a label: have a gradient"},
                                                     {"counts_unlabelled", "without label: rays are counted"},
                                                     {"divides_by_zero", "extremes: the loss is not finite"}})),
                         name_of);

// The dataset laws hold for the analytic room and catch each broken promise.

/// The analytic room with one promise broken.
class BrokenRoom final : public Dataset {
 public:
  explicit BrokenRoom(Broken broken) : broken_(broken), room_(testkit::make_analytic_scene()) {}
  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo scene = room_->open(diagnostics);
    if (broken_ == "reports_error") diagnostics.error("test.finding.made", "view_03", "is truncated", {});
    for (FrameInfo& frame : scene.frames) {
      for (auto& row : frame.world_from_camera.r) {
        if (broken_ == "mirrored") row[0] = -row[0];
        if (broken_ == "opengl_axes") {
          row[1] = -row[1];
          row[2] = -row[2];
        }
      }
    }
    return scene;
  }
  void read(int frame, FrameBuffer& out) const override {
    room_->read(frame, out);
    const int reads = ++reads_;
    if (broken_ == "depth_unit" && frame % 2 == 1) {
      for (float& depth : out.depth_m) depth *= 1.25F;
    }
    if (broken_ == "label_range") out.label[7] = 5;
    if (broken_ == "short_depth") out.depth_m.pop_back();
    if (broken_ == "unsafe_read" && reads > 12) out.rgb[0] ^= 1;
  }

 private:
  Broken broken_;
  std::unique_ptr<Dataset> room_;
  mutable std::atomic<int> reads_{0};
};

std::string dataset_laws_of(Broken broken) {
  BrokenRoom room(broken);
  testkit::DatasetExpectation expected{.frames = 12, .depth = true, .labels = true};
  return testkit::to_text(testkit::dataset_laws(room, expected));
}

TEST(DatasetLaws, HoldForTheAnalyticRoom) { EXPECT_EQ(dataset_laws_of("none"), ""); }

INSTANTIATE_TEST_SUITE_P(Dataset, BrokenPlugin,
                         testing::ValuesIn(cases_of(dataset_laws_of,
                                                    {{"mirrored", "left-handed"},
                                                     {"opengl_axes", "depth"},
                                                     {"depth_unit", "reprojected depths agree"},
                                                     {"label_range", "label 5 is outside"},
                                                     {"short_depth", "depth has 1727 values"},
                                                     {"unsafe_read", "parallel reading"},
                                                     {"reports_error", "open: view_03: is truncated"}})),
                         name_of);

TEST(AnalyticScene, ShowsEveryClassInBothSplits) {
  const std::unique_ptr<Dataset> room = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo scene = room->open(diagnostics);
  std::set<int> seen[2];
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    FrameBuffer pixels;
    room->read(static_cast<int>(i), pixels);
    for (const std::int16_t label : pixels.label) seen[scene.frames[i].split == Split::test ? 1 : 0].insert(label);
  }
  EXPECT_EQ(seen[0].size(), 5u);
  EXPECT_EQ(seen[1].size(), 5u);
  EXPECT_EQ(scene.classes.valid_count(), 5);
}

TEST(AnalyticScene, HitsLieOnTheirSurfaces) {
  const testkit::AnalyticHit floor = testkit::intersect_analytic_room({1.5, -1.2, 0}, {0, 0, -1});
  EXPECT_EQ(floor.label, 1);
  EXPECT_DOUBLE_EQ(floor.t_m, 1.0);
  const testkit::AnalyticHit ball = testkit::intersect_analytic_room({0.35, 0.3, 0.9}, {0, 0, -1});
  EXPECT_EQ(ball.label, 3);
  EXPECT_NEAR(ball.t_m, 1.1, 1e-12);
  const testkit::AnalyticHit crate = testkit::intersect_analytic_room({-0.2, 0.6, 0.9}, {0, 0, -1});
  EXPECT_EQ(crate.label, 4);
  EXPECT_NEAR(crate.t_m, 1.2, 1e-12);
}

// The field laws hold for a sound field and catch each broken promise.

constexpr std::int32_t kFeature = 2;

/// p = mean of position, as a product with ones; sigma = w0 p, feature_f = w_f sin(p), rgb_c = logistic(w_c p + mean of
/// the ray's direction).
template <class Real>
class ToyField final : public Field<Real> {
 public:
  ToyField(const FieldBuild& build, Broken broken) : build_(build), broken_(broken) {}
  FieldTraits traits() const noexcept override {
    return {kFeature, build_.direction_dims > 0 && broken_ != "lies_about_direction"};
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t) const noexcept override {
    return sizeof(Real) * static_cast<std::size_t>(samples);
  }
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"w", 3, 1, Init::uniform(1.0), TensorRole::dense});
  }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, const FieldIn<Real>& in,
                  const FieldOut<Real>& out, Saved saved) const override {
    const Workspace::Scope scope(*ctx.workspace);
    const View<Real> sums = ctx.workspace->take<Real>(in.position.rows, 1);
    const View<Real> ones = ctx.workspace->take<Real>(in.position.cols, 1);
    for (std::int64_t c = 0; c < ones.rows; ++c) ones(c, 0) = 1;
    gemm<Real>(in.position, ones, sums);
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const double p = static_cast<double>(sums(m, 0)) / in.position.cols;
      const double d = in.direction.empty() ? 0 : mean(in.direction, in.ray_of_sample(m, 0));
      if (!saved.empty()) reinterpret_cast<Real*>(saved.data())[m] = static_cast<Real>(p);
      const double leak = broken_ == "sigma_sees_direction"                    ? 1e-3 * d
                          : broken_ == "sigma_needs_colour" && out.rgb.empty() ? 0.1
                                                                               : 0;
      const double off = broken_ == "rounds_by_size" ? 1e-6 : broken_ == "changes_by_size" ? 1e-2 : 0;
      const double of_size = off * static_cast<double>(in.position.rows);
      if (!out.sigma.empty()) out.sigma(m, 0) = static_cast<Real>(w(tensors, 0) * p + leak + of_size / 33);
      for (std::int32_t c = 0; c < 3 && !out.rgb.empty(); ++c) {
        const double scale = broken_ == "colour_out_of_range" ? 3 : 1;
        out.rgb(m, c) = static_cast<Real>(scale / (1 + std::exp(-w(tensors, c) * p - d)));
      }
      const double feature_leak = broken_ == "feature_sees_direction" ? 1e-3 * d : 0;
      for (std::int32_t f = 0; f < kFeature && !out.feature.empty(); ++f)
        out.feature(m, f) = static_cast<Real>(w(tensors, f) * std::sin(p) + feature_leak);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>& tensors, const FieldIn<Real>& in, const FieldOut<Real>& out,
                   const FieldGrad<Real>& grad, Saved saved, View<Real> d_position) const override {
    double dw[3] = {0, 0, 0};
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const double p = mean(in.position, m);
      (void)saved;
      double dp = 0;
      if (!grad.sigma.empty()) {
        const auto g = static_cast<double>(grad.sigma(m, 0));
        dw[0] += (broken_ == "wrong_gradient" ? 1.01 : 1.0) * g * p;
        dp += g * w(tensors, 0);
      }
      for (std::int32_t c = 0; c < 3 && !grad.rgb.empty(); ++c) {
        const auto y = static_cast<double>(out.rgb(m, c));
        const double g = static_cast<double>(grad.rgb(m, c)) * y * (1 - y);
        dw[c] += g * p;
        dp += g * w(tensors, c);
      }
      for (std::int32_t f = 0; f < kFeature && !grad.feature.empty() && broken_ != "ignore_feature_gradient"; ++f) {
        const auto g = static_cast<double>(grad.feature(m, f));
        dw[f] += g * std::sin(p);
        dp += g * w(tensors, f) * std::cos(p);
      }
      for (std::int32_t k = 0; k < in.position.cols && !d_position.empty() && broken_ != "forget_d_position"; ++k) {
        d_position(m, k) = static_cast<Real>(dp / in.position.cols);
      }
    }
    if (broken_ == "sums_as_they_come") dw[1] *= 1 + 1e-6 * (++calls_ % 2);
    for (std::int32_t c = 0; c < 3; ++c) {
      Real& into = tensors.grad[0](c, 0);
      into = static_cast<Real>(broken_ == "assign_gradient" ? dw[c] : static_cast<double>(into) + dw[c]);
    }
  }

 private:
  static double mean(View<const Real> rows, std::int64_t r) {
    double sum = 0;
    for (std::int32_t c = 0; c < rows.cols; ++c) sum += static_cast<double>(rows(r, c));
    return sum / rows.cols;
  }
  static double w(const Tensors<Real>& tensors, std::int32_t i) { return static_cast<double>(tensors.value[0](i, 0)); }
  FieldBuild build_;
  Broken broken_;
  mutable int calls_ = 0;
};

std::string field_laws_with(Broken broken, std::int32_t direction_dims, const testkit::LawOptions& options = {}) {
  FieldBuild build{.position_dims = 5, .direction_dims = direction_dims};
  const bool of_float_alone =
      broken == "sums_as_they_come" || broken == "rounds_by_size" || broken == "changes_by_size";
  return testkit::to_text(testkit::field_laws(
      ToyField<float>(build, broken), ToyField<double>(build, of_float_alone ? "none" : broken), build, options));
}

std::string field_laws_of(Broken broken) { return field_laws_with(broken, 4); }

TEST(FieldLaws, HoldForASoundField) {
  EXPECT_EQ(field_laws_of("none"), "");
  EXPECT_EQ(field_laws_with("none", 0), "");
}

INSTANTIATE_TEST_SUITE_P(Field, BrokenPlugin,
                         testing::ValuesIn(cases_of(field_laws_of,
                                                    {{"sigma_sees_direction", "sigma does not see the direction"},
                                                     {"feature_sees_direction", "feature does not see the direction"},
                                                     {"wrong_gradient", "gradient of w"},
                                                     {"assign_gradient", "gradients accumulate, w"},
                                                     {"ignore_feature_gradient", "gradient of position"},
                                                     {"lies_about_direction", "uses_direction is false"},
                                                     {"colour_out_of_range", "outside [0, 1]"},
                                                     {"sigma_needs_colour", "sigma with others unwanted"},
                                                     {"forget_d_position", "every d_position written"},
                                                     {"sums_as_they_come", "again, gradient of w"},
                                                     {"rounds_by_size", "split batch, sigma"}})),
                         name_of);

// A device's library may choose other kernels for other shapes: then the law is one of size, and stays one.
TEST(FieldLaws, WithoutSameBitsATolerance) {
  testkit::LawOptions options{.same_bits_in_parts = false, .same_bits_of_sums = false};
  EXPECT_EQ(field_laws_with("rounds_by_size", 4, options), "");
  EXPECT_EQ(field_laws_with("sums_as_they_come", 4, options), "");
  EXPECT_HAS(field_laws_with("changes_by_size", 4, options), "split batch, sigma");
}

}  // namespace
}  // namespace semfield
