// The public wrappers refuse wrong shapes with a sentence, and never call an implementation with nothing to do.
#include <gtest/gtest.h>

#include "plugin/field.h"
#include "testkit/guarded.h"
#include "testkit/tensor_box.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

using testkit::Guarded;

std::string message_of(const std::function<void()>& call) {
  try {
    call();
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::internal);
    return error.message();
  }
  return "nothing was thrown";
}

class CheckedEncoder : public testing::Test {
 protected:
  KernelTables kernels;
  toy::ToyEncoder<float> encoder{toy::ToyParams{}, EncoderBuild{}, kernels};
  testkit::TensorBox<float> box{encoder, 1};
  Workspace workspace;
  StepContext ctx{1, 0, true, 0, 0, &workspace};
  Guarded<double> x{4, 3};
  Guarded<float> y{4, 2};
  CheckedEncoder() { x.fill(0.25); }
};

TEST_F(CheckedEncoder, NamesTheViewOfAWrongShape) {
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), y.view().row_range(0, 3)); }),
            "encoder.forward: y is [3, 2], expected [4, 2]");
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view().col_range(0, 2), y.view()); }),
            "encoder.forward: x is [4, 2], expected [4, 3]");
}

TEST_F(CheckedEncoder, RefusesEmptyOverlappingAndForeignViews) {
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(nullptr, 4, 2)); }),
            "encoder.forward: y is empty and must not be");
  EXPECT_EQ(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 1)); }),
            "encoder.forward: y has a row stride below its columns");
  EXPECT_EQ(message_of([&] {
              encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 2, Device::cuda));
            }),
            "encoder.forward: y lives on another device than the first argument");
}

TEST_F(CheckedEncoder, BackwardWantsGradients) {
  y.fill(1);
  EXPECT_EQ(message_of([&] { encoder.backward(ctx, box.values_only(), x.view(), y.view(), {}); }),
            "encoder.backward: the tensors have no gradients");
}

TEST_F(CheckedEncoder, ZeroRowsWriteNothing) {
  encoder.forward(ctx, box.tensors(), x.view().row_range(0, 0), y.view().row_range(0, 0));
  encoder.forward(ctx, box.tensors(), View<const double>(nullptr, 0, 3), View<float>(nullptr, 0, 2));
  EXPECT_NE(y.unwritten(), "");
}

/// Hands its feature on in the forms up to `most`, and counts the calls that came through.
class FormField final : public Field<float> {
 public:
  explicit FormField(FeatureForm most) : most_(most) {}
  FieldTraits traits() const noexcept override { return {2, false}; }
  FeatureForm feature_form(std::int32_t width) const noexcept override {
    return most_ == FeatureForm::hidden_layer && width != 3 ? FeatureForm::rounded : most_;
  }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 0; }
  mutable int calls = 0;

 protected:
  void do_forward(const StepContext&, const Tensors<float>&, const FieldIn<float>&, const FieldOut<float>&,
                  Saved) const override {
    ++calls;
  }
  void do_backward(const StepContext&, const Tensors<float>&, const FieldIn<float>&, const FieldOut<float>&,
                   const FieldGrad<float>&, Saved, View<float>) const override {
    ++calls;
  }

 private:
  FeatureForm most_;
};

class CheckedFieldForms : public testing::Test {
 protected:
  std::string forward(const FormField& field, const FieldOut<float>& out) {
    return message_of([&] { field.forward(StepContext{}, {}, in(), out, {}); });
  }
  std::string backward(const FormField& field, const FieldOut<float>& out, const FieldGrad<float>& grad) {
    return message_of([&] { field.backward(StepContext{}, {}, in(), out, grad, {}, {}); });
  }
  FieldIn<float> in() {
    FieldIn<float> inputs;
    inputs.position = position.view();
    return inputs;
  }
  FieldOut<float> rounded() {
    FieldOut<float> out;
    out.rounded_feature = {numbers, 4, 2};
    return out;
  }
  FieldOut<float> hidden(std::int32_t width) {
    FieldOut<float> out;
    out.hidden = {numbers, 3, width};
    out.layer.weight = {layer, 2, width};
    out.layer.bias = {layer, 1, width};
    return out;
  }
  Guarded<float> position{4, 5}, feature{4, 2};
  Bf16 numbers[16]{};
  float layer[16]{};
};

TEST_F(CheckedFieldForms, AFieldGetsOnlyTheFormsThatItHas) {
  const FormField full(FeatureForm::full), two(FeatureForm::rounded), all(FeatureForm::hidden_layer);
  const std::string nothing = "nothing was thrown";
  EXPECT_EQ(forward(full, rounded()), "field.forward: rounded_feature is wanted of a field that has no such form");
  EXPECT_EQ(forward(two, rounded()), nothing);
  EXPECT_EQ(forward(two, hidden(3)), "field.forward: hidden is wanted of a field that does not compute such a layer");
  EXPECT_EQ(forward(all, hidden(4)), "field.forward: hidden is wanted of a field that does not compute such a layer");
  EXPECT_EQ(forward(all, hidden(3)), nothing);
  EXPECT_EQ(full.calls + two.calls + all.calls, 2);
}

TEST_F(CheckedFieldForms, TheFeatureIsWantedOnce) {
  const FormField all(FeatureForm::hidden_layer);
  FieldOut<float> out = rounded();
  out.feature = feature.view();
  EXPECT_EQ(forward(all, out), "field.forward: the feature is wanted in more than one form");
  out = hidden(3);
  out.layer.weight = {layer, 3, 3};
  EXPECT_EQ(forward(all, out), "field.forward: layer.weight is [3, 3], expected [2, 3]");
  out = hidden(3);
  out.hidden.rows = 5;
  EXPECT_EQ(forward(all, out), "field.forward: hidden has more rows than there are samples");
  EXPECT_EQ(all.calls, 0);
}

TEST_F(CheckedFieldForms, GradientsComeInAFormThatTheFieldHas) {
  const FormField full(FeatureForm::full), all(FeatureForm::hidden_layer);
  FieldGrad<float> grad;
  grad.rounded_feature = View<Bf16>(numbers, 4, 2);
  const std::string other = "field.backward: the feature's gradient comes in a form that the field does not have";
  EXPECT_EQ(backward(full, {}, grad), other);
  grad = {};
  grad.hidden = numbers;
  EXPECT_EQ(backward(all, hidden(4), grad), other);
  EXPECT_EQ(backward(all, hidden(3), grad), "nothing was thrown");
  EXPECT_EQ(full.calls + all.calls, 1);
}

}  // namespace
}  // namespace semfield
