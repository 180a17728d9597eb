// The field laws hold for a sound field and catch each broken promise.
#include "compute/gemm.h"
#include "testkit/laws.h"
#include "tests/plugin/broken_case.h"
#include "tests/says.h"

namespace semfield {
namespace {

enum class Break {
  none,
  sigma_sees_direction,
  feature_sees_direction,
  wrong_gradient,
  assign_gradient,
  ignore_feature_gradient,
  lies_about_direction,
  colour_out_of_range,
  sigma_needs_colour,
  forget_d_position,
  sums_as_they_come,
  rounds_by_size,
  changes_by_size,
  hides_scratch,
  claims_much_scratch,
  hides_a_layer,
  nameless_layer,
  adds_up_wrongly
};

constexpr std::int32_t kFeature = 2;

/// p = mean of position, as a product with ones; sigma = w0 p, feature_f = w_f sin(p), rgb_c = logistic(w_c p + mean of
/// the ray's direction).
template <class Real>
class ToyField final : public Field<Real> {
 public:
  ToyField(const FieldBuild& build, Break broken) : build_(build), broken_(broken) {}
  FieldTraits traits() const noexcept override {
    return {kFeature, build_.direction_dims > 0 && broken_ != Break::lies_about_direction};
  }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t) const noexcept override {
    return sizeof(Real) * static_cast<std::size_t>(samples);
  }
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t) const noexcept override {
    ScratchSum sum;
    sum.take<Real>(samples, 1);
    sum.take<Real>(build_.position_dims, 1);
    return broken_ == Break::hides_scratch         ? sum.bytes() - 1
           : broken_ == Break::claims_much_scratch ? 3 * sum.bytes()
                                                   : sum.bytes();
  }
  std::vector<LayerShape> layers() const override {
    if (broken_ == Break::hides_a_layer) return {};
    return {{broken_ == Break::nameless_layer ? "" : "mean", build_.position_dims, 1}};
  }
  std::int64_t multiply_adds(std::int64_t samples, std::int64_t rays) const override {
    return Field<Real>::multiply_adds(samples, rays) + (broken_ == Break::adds_up_wrongly ? samples : 0);
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
      const double leak = broken_ == Break::sigma_sees_direction                    ? 1e-3 * d
                          : broken_ == Break::sigma_needs_colour && out.rgb.empty() ? 0.1
                                                                                    : 0;
      const double off = broken_ == Break::rounds_by_size ? 1e-6 : broken_ == Break::changes_by_size ? 1e-2 : 0;
      const double of_size = off * static_cast<double>(in.position.rows);
      if (!out.sigma.empty()) out.sigma(m, 0) = static_cast<Real>(w(tensors, 0) * p + leak + of_size / 33);
      for (std::int32_t c = 0; c < 3 && !out.rgb.empty(); ++c) {
        const double scale = broken_ == Break::colour_out_of_range ? 3 : 1;
        out.rgb(m, c) = static_cast<Real>(scale / (1 + std::exp(-w(tensors, c) * p - d)));
      }
      const double feature_leak = broken_ == Break::feature_sees_direction ? 1e-3 * d : 0;
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
        dw[0] += (broken_ == Break::wrong_gradient ? 1.01 : 1.0) * g * p;
        dp += g * w(tensors, 0);
      }
      for (std::int32_t c = 0; c < 3 && !grad.rgb.empty(); ++c) {
        const auto y = static_cast<double>(out.rgb(m, c));
        const double g = static_cast<double>(grad.rgb(m, c)) * y * (1 - y);
        dw[c] += g * p;
        dp += g * w(tensors, c);
      }
      for (std::int32_t f = 0; f < kFeature && !grad.feature.empty() && broken_ != Break::ignore_feature_gradient;
           ++f) {
        const auto g = static_cast<double>(grad.feature(m, f));
        dw[f] += g * std::sin(p);
        dp += g * w(tensors, f) * std::cos(p);
      }
      for (std::int32_t k = 0; k < in.position.cols && !d_position.empty() && broken_ != Break::forget_d_position;
           ++k) {
        d_position(m, k) = static_cast<Real>(dp / in.position.cols);
      }
    }
    if (broken_ == Break::sums_as_they_come) dw[1] *= 1 + 1e-6 * (++calls_ % 2);
    for (std::int32_t c = 0; c < 3; ++c) {
      Real& into = tensors.grad[0](c, 0);
      into = static_cast<Real>(broken_ == Break::assign_gradient ? dw[c] : static_cast<double>(into) + dw[c]);
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
  Break broken_;
  mutable int calls_ = 0;
};

std::string laws_of(Break broken, std::int32_t direction_dims = 4, const testkit::LawOptions& options = {}) {
  FieldBuild build{.position_dims = 5, .direction_dims = direction_dims};
  const bool of_float_alone =
      broken == Break::sums_as_they_come || broken == Break::rounds_by_size || broken == Break::changes_by_size;
  return testkit::to_text(testkit::field_laws(
      ToyField<float>(build, broken), ToyField<double>(build, of_float_alone ? Break::none : broken), build, options));
}

TEST(FieldLaws, HoldForASoundField) {
  EXPECT_EQ(laws_of(Break::none), "");
  EXPECT_EQ(laws_of(Break::none, 0), "");
}

using Case = BrokenCase<Break>;
class BrokenField : public testing::TestWithParam<Case> {};

TEST_P(BrokenField, IsCaught) {
  const std::string failures = laws_of(GetParam().broken);
  EXPECT_HAS(failures, GetParam().law) << "failures were:\n" << failures;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenField,
                         testing::Values(Case{Break::sigma_sees_direction, "sigma does not see the direction"},
                                         Case{Break::feature_sees_direction, "feature does not see the direction"},
                                         Case{Break::wrong_gradient, "gradient of w"},
                                         Case{Break::assign_gradient, "gradients accumulate, w"},
                                         Case{Break::ignore_feature_gradient, "gradient of position"},
                                         Case{Break::lies_about_direction, "uses_direction is false"},
                                         Case{Break::colour_out_of_range, "outside [0, 1]"},
                                         Case{Break::sigma_needs_colour, "sigma with others unwanted"},
                                         Case{Break::forget_d_position, "every d_position written"},
                                         Case{Break::sums_as_they_come, "again, gradient of w"},
                                         Case{Break::rounds_by_size, "split batch, sigma"},
                                         Case{Break::hides_scratch, "scratch_bytes, 1 samples: 127 bytes, but 128"},
                                         Case{Break::claims_much_scratch, "less than 1/2 of it"},
                                         Case{Break::hides_a_layer, "say 0 multiply-adds, derive and forward made 165"},
                                         Case{Break::nameless_layer, "layers: ''"},
                                         Case{Break::adds_up_wrongly, "but the layers add up to 5000"}),
                         NameOfCase{});

// A device's library may choose other kernels for other shapes: then the law is one of size, and stays one.
TEST(FieldLaws, WithoutSameBitsATolerance) {
  testkit::LawOptions options{.same_bits_in_parts = false, .same_bits_of_sums = false};
  EXPECT_EQ(laws_of(Break::rounds_by_size, 4, options), "");
  EXPECT_EQ(laws_of(Break::sums_as_they_come, 4, options), "");
  EXPECT_HAS(laws_of(Break::changes_by_size, 4, options), "split batch, sigma");
}

}  // namespace
}  // namespace semfield
