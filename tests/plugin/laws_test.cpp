// The laws of encoders, samplers, losses and datasets hold for a sound plugin and catch each broken promise.
#include "testkit/laws.h"

#include <atomic>
#include <set>

#include "testkit/analytic_scene.h"
#include "tests/plugin/broken_case.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/says.h"

namespace semfield {
namespace {

using testkit::Failures;
using toy::Break;

Failures laws_of(Break broken, const testkit::LawOptions& options = {}) {
  const KernelTables kernels;
  const toy::ToyEncoder<float> encoder32(toy::ToyParams{}, EncoderBuild{}, kernels, broken);
  const toy::ToyEncoder<double> encoder64(toy::ToyParams{}, EncoderBuild{}, kernels, broken);
  return testkit::encoder_laws(encoder32, encoder64, options);
}

bool mentions(const Failures& failures, const std::string& words) {
  return testkit::to_text(failures).find(words) != std::string::npos;
}

TEST(EncoderLaws, HoldForASoundEncoder) {
  const Failures failures = laws_of(Break::none);
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

using Case = BrokenCase<Break>;
class BrokenEncoder : public testing::TestWithParam<Case> {};

TEST_P(BrokenEncoder, IsCaught) {
  const Failures failures = laws_of(GetParam().broken);
  EXPECT_TRUE(mentions(failures, GetParam().law)) << "failures were:\n" << testkit::to_text(failures);
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenEncoder,
                         testing::ValuesIn(std::vector<Case>{
                             {Break::skip_last_row, "every output written"},
                             {Break::write_past_cols, "outputs stay inside"},
                             {Break::wrong_dx, "gradient of x"},
                             {Break::wrong_table_gradient, "gradient of table"},
                             {Break::assign_gradient, "gradients accumulate"},
                             {Break::accumulate_dx, "every dx written"},
                             {Break::skip_dx, "every dx written"},
                             {Break::depend_on_row, "permuted rows"},
                             {Break::float_off, "float against double, y"},
                             {Break::sums_as_they_come, "1 and 3 threads, gradient of table"},
                             {Break::hides_scratch, "scratch_bytes, 33 rows: 96 bytes, but 192"},
                             {Break::claims_much_scratch, "scratch_bytes, 4097 rows: "}}),
                         NameOfCase{});

TEST(EncoderLaws, SumsWithoutSameBitsHaveATolerance) {
  testkit::LawOptions options{.same_bits_of_sums = false};
  const Failures failures = laws_of(Break::sums_as_they_come, options);
  EXPECT_FALSE(mentions(failures, "1 and 3 threads")) << testkit::to_text(failures);
}

TEST(DeclarationLaws, HoldForTheToy) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures = testkit::declaration_laws(registry.get(PluginKind::encoder, "toy"));
  EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
}

TEST(EncoderLaws, BuildFromTheRegistryWithSettings) {
  Registry registry;
  toy::register_into(registry);
  const Failures failures = testkit::encoder_laws(registry, "toy", {{"bands", "5"}, {"flip", "true"}}, {});
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
  EXPECT_TRUE(mentions(failures, "bands: expected int in [1, 8], got '9'"));
  EXPECT_TRUE(mentions(failures, "unknown parameter 'glow'"));
  EXPECT_THROW(testkit::make_params(entry, {{"gain", "0"}, {"flip", "true"}}), Error);
}

// The sampler laws hold for a sound sampler and catch each broken promise.

enum class SamplerBreak {
  none,
  descending,
  consumed_order,
  outside,
  zero_delta,
  wrong_first,
  jitter_without_training,
  fill_empty_rays
};

/// `kCount` jittered samples per ray in equal intervals; an empty ray has none.
template <class Real>
class ToySampler final : public Sampler<Real> {
 public:
  explicit ToySampler(SamplerBreak broken) : broken_(broken) {}
  SamplerTraits traits() const noexcept override { return {}; }
  std::int64_t capacity(std::int64_t rays, std::int64_t) const noexcept override { return rays * kCount; }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<Real>&, const Rays<Real>& rays, const Proposal<Real>*,
                 Samples<Real>& out) const override {
    const RandomAddress address = ctx.random("sampler/toy");
    const bool jitter = ctx.training || broken_ == SamplerBreak::jitter_without_training;
    const std::int64_t first_ray = broken_ == SamplerBreak::consumed_order ? 0 : ctx.first_ray;
    std::int64_t n = 0;
    for (std::int64_t r = 0; r < rays.origin.rows; ++r) {
      out.first(r, 0) = static_cast<std::int32_t>(n);
      const double width = (rays.near_far(r, 1) - rays.near_far(r, 0)) / kCount;
      if (width <= 0 && broken_ != SamplerBreak::fill_empty_rays) continue;
      for (std::int64_t k = 0; k < kCount; ++k, ++n) {
        const double u =
            jitter ? static_cast<double>(uniform01(address, static_cast<std::uint64_t>((first_ray + r) * kCount + k)))
                   : 0.5;
        const std::int64_t slot = broken_ == SamplerBreak::descending ? kCount - 1 - k : k;
        const double far_off = broken_ == SamplerBreak::outside && k == kCount - 1 ? 1.0 : 0.0;
        out.t(n, 0) = static_cast<Real>(rays.near_far(r, 0) + (static_cast<double>(slot) + u) * width + far_off);
        out.delta(n, 0) = broken_ == SamplerBreak::zero_delta && k == 2 ? Real(0) : static_cast<Real>(width);
        out.ray_of_sample(n, 0) = static_cast<std::int32_t>(r);
      }
    }
    out.first(rays.origin.rows, 0) = static_cast<std::int32_t>(broken_ == SamplerBreak::wrong_first ? n - 1 : n);
    out.count = n;
  }

 private:
  static constexpr std::int64_t kCount = 6;
  SamplerBreak broken_;
};

std::string sampler_laws_of(SamplerBreak broken) {
  SamplerBuild build{.bounds = {{-2, -2, -1}, {2, 2, 1}}, .near_m = 0.1, .far_m = 4.0};
  return testkit::to_text(testkit::sampler_laws(ToySampler<float>(broken), ToySampler<double>(broken), build));
}

TEST(SamplerLaws, HoldForASoundSampler) { EXPECT_EQ(sampler_laws_of(SamplerBreak::none), ""); }

using SamplerCase = BrokenCase<SamplerBreak>;
class BrokenSampler : public testing::TestWithParam<SamplerCase> {};

TEST_P(BrokenSampler, IsCaught) {
  const std::string failures = sampler_laws_of(GetParam().broken);
  EXPECT_HAS(failures, GetParam().law) << "failures were:\n" << failures;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenSampler,
                         testing::ValuesIn(std::vector<SamplerCase>{
                             {SamplerBreak::descending, "not ascending"},
                             {SamplerBreak::consumed_order, "a ray alone"},
                             {SamplerBreak::outside, "outside [near, far]"},
                             {SamplerBreak::zero_delta, "delta is not positive"},
                             {SamplerBreak::wrong_first, "first[rays] is not the count"},
                             {SamplerBreak::jitter_without_training, "without training, another seed"},
                             {SamplerBreak::fill_empty_rays, "near == far"}}),
                         NameOfCase{});

// The loss laws hold for a sound loss and catch each broken promise.

enum class LossBreak {
  none,
  wrong_slope,
  hidden_slope,
  says_more,
  assigns,
  scaled_loss,
  depends_on_row,
  float_off,
  loss_of_nothing,
  needs_no_label,
  pulls_unlabelled,
  counts_unlabelled,
  divides_by_zero,
};

struct ToyParams : LossRule {
  ToyParams() { weight = 1; }
  LossBreak broken = LossBreak::none;
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
    if (params.broken == LossBreak::says_more) traits.moves.push_back(channel::color);
    return traits;
  }
  std::int64_t counted_rays(const RayTargets& batch, std::int64_t rays) const override {
    if (params.broken == LossBreak::counts_unlabelled) return rays;
    std::int64_t labelled = 0;
    for (std::int64_t r = 0; r < batch.label.rows; ++r) labelled += batch.label(r, 0) >= 0 ? 1 : 0;
    return labelled;
  }
  template <class Real>
  double sum(const RayTargets& targets, const RayValues<Real>& values, double scale,
             const RayGradients<Real>& gradients) const {
    const LossBreak b = params.broken;
    const View<const Real> logits = values.heads[channel::logits];
    const View<Real> d_logits = gradients.heads[channel::logits];
    double sum = b == LossBreak::loss_of_nothing ? 0.1 : 0;
    if (targets.label.empty()) return b == LossBreak::needs_no_label ? 1 : sum;
    for (std::int64_t r = 0; r < logits.rows; ++r) {
      const std::int16_t label = targets.label(r, 0);
      if (label < 0 && b == LossBreak::pulls_unlabelled) d_logits(r, 0) += Real(1e-9);
      if (label < 0) continue;
      const auto s = static_cast<double>(logits(r, label));
      double value = s * s, slope = 2 * s;
      if (b == LossBreak::wrong_slope) slope *= 1.001;
      if (b == LossBreak::hidden_slope) value += static_cast<double>(values.color(r, 0));
      if (b == LossBreak::depends_on_row) slope += 1e-5 * static_cast<double>(r);
      if (b == LossBreak::float_off && sizeof(Real) == 4) value *= 1.01;
      if (b == LossBreak::scaled_loss) value *= scale;
      if (b == LossBreak::divides_by_zero && s > 1000) value /= s - 1e4;
      sum += value;
      Real& d = d_logits(r, label);
      d = (b == LossBreak::assigns ? Real(0) : d) + static_cast<Real>(scale * slope);
    }
    return sum;
  }
};

testkit::Failures loss_laws_of(LossBreak broken) {
  ToyParams params;
  params.broken = broken;
  return testkit::loss_laws(Toy(params));
}

TEST(LossLaws, HoldForASoundLoss) { EXPECT_EQ(testkit::to_text(loss_laws_of(LossBreak::none)), ""); }

using LossCase = BrokenCase<LossBreak>;
class BrokenLoss : public testing::TestWithParam<LossCase> {};

TEST_P(BrokenLoss, IsCaught) {
  const std::string found = testkit::to_text(loss_laws_of(GetParam().broken));
  EXPECT_HAS(found, GetParam().law) << "failures were:\n" << found;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenLoss,
                         testing::ValuesIn(std::vector<LossCase>{
                             {LossBreak::wrong_slope, "gradient of logits"},
                             {LossBreak::hidden_slope, "gradient of color"},
                             {LossBreak::says_more, "does not move color"},
                             {LossBreak::assigns, "gradients accumulate, logits"},
                             {LossBreak::scaled_loss, "the loss is before its scale"},
                             {LossBreak::depends_on_row, "rays are independent, gradient of logits"},
                             {LossBreak::float_off, "float against double, loss"},
                             {LossBreak::loss_of_nothing, "no ray: has a loss"},
                             {LossBreak::needs_no_label, "without label: there is a loss"},
                             {LossBreak::pulls_unlabelled, "rays without a label: have a gradient"},
                             {LossBreak::counts_unlabelled, "without label: rays are counted"},
                             {LossBreak::divides_by_zero, "extremes: the loss is not finite"}}),
                         NameOfCase{});

// The dataset laws hold for the analytic room and catch each broken promise.

enum class DatasetBreak {
  none,
  mirrored,
  opengl_axes,
  depth_unit,
  label_range,
  short_depth,
  unsafe_read,
  reports_error
};

/// The analytic room with one promise broken.
class BrokenRoom final : public Dataset {
 public:
  explicit BrokenRoom(DatasetBreak broken) : broken_(broken), room_(testkit::make_analytic_scene()) {}
  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo scene = room_->open(diagnostics);
    if (broken_ == DatasetBreak::reports_error) diagnostics.error("test.finding.made", "view_03", "is truncated", {});
    for (FrameInfo& frame : scene.frames) {
      for (auto& row : frame.world_from_camera.r) {
        if (broken_ == DatasetBreak::mirrored) row[0] = -row[0];
        if (broken_ == DatasetBreak::opengl_axes) {
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
    if (broken_ == DatasetBreak::depth_unit && frame % 2 == 1) {
      for (float& depth : out.depth_m) depth *= 1.25F;
    }
    if (broken_ == DatasetBreak::label_range) out.label[7] = 5;
    if (broken_ == DatasetBreak::short_depth) out.depth_m.pop_back();
    if (broken_ == DatasetBreak::unsafe_read && reads > 12) out.rgb[0] ^= 1;
  }

 private:
  DatasetBreak broken_;
  std::unique_ptr<Dataset> room_;
  mutable std::atomic<int> reads_{0};
};

std::string dataset_laws_of(DatasetBreak broken) {
  BrokenRoom room(broken);
  testkit::DatasetExpectation expected{.frames = 12, .depth = true, .labels = true};
  return testkit::to_text(testkit::dataset_laws(room, expected));
}

TEST(DatasetLaws, HoldForTheAnalyticRoom) { EXPECT_EQ(dataset_laws_of(DatasetBreak::none), ""); }

using DatasetCase = BrokenCase<DatasetBreak>;
class BrokenDataset : public testing::TestWithParam<DatasetCase> {};

TEST_P(BrokenDataset, IsCaught) {
  const std::string failures = dataset_laws_of(GetParam().broken);
  EXPECT_HAS(failures, GetParam().law) << "failures were:\n" << failures;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenDataset,
                         testing::ValuesIn(std::vector<DatasetCase>{
                             {DatasetBreak::mirrored, "left-handed"},
                             {DatasetBreak::opengl_axes, "depth"},
                             {DatasetBreak::depth_unit, "reprojected depths agree"},
                             {DatasetBreak::label_range, "label 5 is outside"},
                             {DatasetBreak::short_depth, "depth has 1727 values"},
                             {DatasetBreak::unsafe_read, "parallel reading"},
                             {DatasetBreak::reports_error, "open: view_03: is truncated"}}),
                         NameOfCase{});

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

}  // namespace
}  // namespace semfield
