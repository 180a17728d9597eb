// Modules join the registry whole or not at all, with refusals that name both sides; wrappers refuse wrong shapes.
#include "plugin/loader.h"

#include <unistd.h>

#include <stdexcept>

#include "plugin/field.h"
#include "testkit/compare.h"
#include "testkit/field_bench.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using testkit::Guarded;

void register_two_then_throw(Registry& registry) {
  static const int kernel_table = 3;
  registry.kernels().add(Device::cpu, "encoder 'half'", &kernel_table);
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("half_a", "A toy that must not stay.");
  throw std::runtime_error("the second half is missing");
}

PluginModule sound_module() { return {kPluginApi, abi_tag_of_framework(), "toys", "1.0", toy::register_into}; }

std::string refusal_of(Registry& registry, const PluginModule& module) {
  return error_of(ErrorKind::unavailable, [&] { register_module(registry, module); });
}

TEST(Loader, RegistersASoundModuleUnderItsName) {
  Registry registry;
  register_module(registry, sound_module());
  EXPECT_EQ(registry.get(PluginKind::encoder, "toy").module, "toys 1.0");
}

TEST(Loader, AnotherApiIsRefusedWithBothNumbers) {
  Registry registry;
  PluginModule module = sound_module();
  module.api = 99;
  EXPECT_EQ(refusal_of(registry, module), "the module speaks plugin API 99, this framework speaks " +
                                              std::to_string(kPluginApi) +
                                              "; rebuild the plugin against the installed headers");
}

TEST(Loader, AnotherAbiIsRefusedWithBothTags) {
  Registry registry;
  PluginModule module = sound_module();
  module.abi_tag = "other-world";
  const std::string refusal = refusal_of(registry, module);
  EXPECT_HAS(refusal, "'other-world'", abi_tag_of_framework());
  module.abi_tag = nullptr;
  EXPECT_HAS(refusal_of(registry, module), "ABI ''");
}

TEST(Loader, ADescriptorWithoutItsPartsIsRefused) {
  Registry registry;
  PluginModule module = sound_module();
  module.register_into = nullptr;
  EXPECT_HAS(refusal_of(registry, module), "lacks its name, version or register function");
}

TEST(Loader, AThrowingModuleLeavesTheRegistryUnchanged) {
  Registry registry;
  register_module(registry, sound_module());
  PluginModule module = sound_module();
  module.name = "half";
  module.register_into = register_two_then_throw;
  EXPECT_EQ(refusal_of(registry, module), "while registering module 'half 1.0': the second half is missing");
  EXPECT_EQ(registry.names(PluginKind::encoder), std::vector<std::string>{"toy"});
  EXPECT_EQ(registry.kernels().devices_of("encoder 'half'"), "");
}

TEST(KernelTables, KnowForWhichDeviceAnOwnerHasKernels) {
  KernelTables tables;
  static const int fp32 = 0;
  static const float bf16 = 0;
  tables.add(Device::cpu, "field 'a'", &fp32);
  tables.add(Device::cuda, "field 'b'", &bf16, Precision::bf16);
  EXPECT_TRUE(tables.has(Device::cpu, "field 'a'"));
  EXPECT_FALSE(tables.has(Device::cuda, "field 'a'"));
  EXPECT_TRUE(tables.has(Device::cuda, "field 'b'"));
  EXPECT_FALSE(tables.has(Device::cpu, "field 'b'"));
  EXPECT_FALSE(tables.has(Device::cpu, "field 'c'"));
}

TEST(Loader, ADuplicateNameLeavesTheRegistryUnchanged) {
  Registry registry;
  register_module(registry, sound_module());
  PluginModule module = sound_module();
  module.name = "copies";
  const std::string refusal = refusal_of(registry, module);
  EXPECT_HAS(refusal,
             "while registering module 'copies 1.0': the encoder name 'toy' of module 'copies 1.0' is "
             "taken by module 'toys 1.0'");
  EXPECT_EQ(registry.entries().size(), 1u);
}

TEST(Loader, AMissingFileIsNamed) {
  Registry registry;
  try {
    load_module(registry, "/no/such/plugin.so");
    FAIL() << "a missing file was loaded";
  } catch (const Error& error) {
    EXPECT_EQ(error.message(), "cannot load plugin '/no/such/plugin.so': there is no such file");
  }
}

TEST(Loader, AFileThatIsNoLibraryIsNamed) {
  const TempDir dir;
  const std::string path = dir.write("not_a_plugin.so", "plain text");
  Registry registry;
  const std::string error = error_of(ErrorKind::unavailable, [&] { load_module(registry, path); });
  EXPECT_TRUE(error.starts_with("cannot load plugin '" + path + "': ")) << error;
}

// The public wrappers refuse wrong shapes with a sentence, and never call an implementation with nothing to do.

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
  FieldIn<float> in() { return FieldIn<float>{.position = position.view()}; }
  FieldOut<float> rounded() { return FieldOut<float>{.fused = {.feature = {numbers, 4, 2}}}; }
  FieldOut<float> hidden(std::int32_t width) {
    return FieldOut<float>{
        .fused = {.hidden = {numbers, 3, width}, .layer = {.weight = {layer, 2, width}, .bias = {layer, 1, width}}}};
  }
  Guarded<float> position{4, 5}, feature{4, 2};
  Bf16 numbers[16]{};
  float layer[16]{};
};

TEST_F(CheckedFieldForms, AFieldGetsOnlyTheFormsThatItHas) {
  const FormField full(FeatureForm::full), two(FeatureForm::rounded), all(FeatureForm::hidden_layer);
  const std::string nothing = "nothing was thrown";
  EXPECT_EQ(forward(full, rounded()), "field.forward: fused.feature is wanted of a field that has no such form");
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
  out.fused.layer.weight = {layer, 3, 3};
  EXPECT_EQ(forward(all, out), "field.forward: layer.weight is [3, 3], expected [2, 3]");
  out = hidden(3);
  out.fused.hidden.rows = 5;
  EXPECT_EQ(forward(all, out), "field.forward: hidden has more rows than there are samples");
  EXPECT_EQ(all.calls, 0);
}

TEST_F(CheckedFieldForms, GradientsComeInAFormThatTheFieldHas) {
  const FormField full(FeatureForm::full), all(FeatureForm::hidden_layer);
  FieldGrad<float> grad{.fused = {.feature = View<Bf16>(numbers, 4, 2)}};
  const std::string other = "field.backward: the feature's gradient comes in a form that the field does not have";
  EXPECT_EQ(backward(full, {}, grad), other);
  grad = {};
  grad.fused.hidden = numbers;
  EXPECT_EQ(backward(all, hidden(4), grad), other);
  EXPECT_EQ(backward(all, hidden(3), grad), "nothing was thrown");
  EXPECT_EQ(full.calls + all.calls, 1);
}

}  // namespace
}  // namespace semfield
