// The registry: names, near misses, order, kernel tables; its reference pages; the testkit itself.

#include <unistd.h>

#include <algorithm>
#include <stdexcept>

#include "plugin/field.h"
#include "plugin/loader.h"
#include "plugin/reference.h"
#include "testkit/benches.h"
#include "testkit/compare.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/says.h"

namespace semfield {
namespace {

using namespace testkit;

TEST(Registry, FindsMakesAndListsEntries) {
  Registry registry;
  registry.set_current_module("toys 1.0");
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("zigzag", "A toy that comes last.");
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("arc", "A toy that comes first.");
  EXPECT_EQ(registry.names(PluginKind::encoder), (std::vector<std::string>{"arc", "zigzag"}));
  EXPECT_TRUE(registry.names(PluginKind::field).empty());
  ASSERT_EQ(registry.entries().size(), 2u);
  const PluginEntry& entry = registry.get(PluginKind::encoder, "arc");
  EXPECT_EQ(entry.module, "toys 1.0");
  const auto encoder = entry.encoder64(*entry.new_params(), EncoderBuild{}, registry.kernels());
  EXPECT_EQ(encoder->traits().out_dims, 2);
  EXPECT_FALSE(static_cast<bool>(entry.field32));
  EXPECT_EQ(registry.find(PluginKind::field, "arc"), nullptr);
}

TEST(Registry, AnUnknownNameListsTheKnownAndTheNearest) {
  Registry registry;
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("hash_grid", "A toy under a known name.");
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("identity", "A toy under a known name.");
  EXPECT_HAS(error_of(ErrorKind::config, [&] { registry.get(PluginKind::encoder, "hashgrid"); }), "hashgrid",
             "hash_grid");
  EXPECT_THROW(registry.get(PluginKind::sampler, "identity"), Error);
}

TEST(Registry, ATakenNameNamesBothModules) {
  Registry registry;
  registry.set_current_module("first 1.0");
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("toy", "A toy with a name.");
  registry.set_current_module("second 2.0");
  try {
    registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("toy", "Another toy of that name.");
    FAIL() << "a taken name was given again";
  } catch (const Error& error) {
    EXPECT_EQ(error.message(), "the encoder name 'toy' of module 'second 2.0' is taken by module 'first 1.0'");
  }
  EXPECT_EQ(registry.get(PluginKind::encoder, "toy").module, "first 1.0");
}

struct TableA {
  int value;
};
struct TableB {
  int value;
};

// What is put together from blocks has their kernels, in bf16 only where it takes that.
TEST(KernelTables, AComposedOwnerHasTheKernelsOfItsBlock) {
  struct BlockTable {};
  static const BlockTable table;
  KernelTables tables;
  tables.add(Device::cpu, "block", &table);
  tables.add(Device::cpu, "block", &table, Precision::bf16);
  tables.compose("field 'any'", "block", true);
  tables.compose("field 'exact'", "block", false);
  EXPECT_EQ(tables.devices_of("field 'any'"), "cpu, cpu bf16");
  EXPECT_EQ(tables.devices_of("field 'exact'"), "cpu");
  EXPECT_TRUE(tables.has(Device::cpu, "field 'exact'"));
  EXPECT_FALSE(tables.has(Device::cpu, "field 'exact'", Precision::bf16));
  EXPECT_FALSE(tables.has(Device::cuda, "field 'any'"));
  EXPECT_FALSE(tables.has(Device::cpu, "field 'none'"));
  tables.add(Device::cuda, "field 'half'", &table, Precision::bf16);
  EXPECT_TRUE(tables.has(Device::cuda, "field 'half'"));
  EXPECT_EQ(&tables.get<BlockTable>(Device::cpu, "field 'any'", Precision::bf16), &table);
  EXPECT_EQ(&tables.get<BlockTable>(Device::cpu, "field 'exact'"), &table);
  EXPECT_THROW(tables.get<BlockTable>(Device::cpu, "field 'exact'", Precision::bf16), Error);
  EXPECT_EQ(tables.find<BlockTable>(Device::cuda), nullptr);
}

TEST(KernelTables, AMissingPairIsASentence) {
  static const TableA cpu_table{7};
  KernelTables tables;
  tables.add(Device::cpu, "encoder 'hash_grid'", &cpu_table);
  tables.add(Device::cpu, "encoder 'hash_grid'", &cpu_table);
  EXPECT_EQ(tables.get<TableA>(Device::cpu, "encoder 'hash_grid'").value, 7);
  EXPECT_EQ(tables.devices_of("encoder 'hash_grid'"), "cpu");
  EXPECT_EQ(tables.devices_of("encoder 'other'"), "");
  EXPECT_HAS(error_of(ErrorKind::unavailable, [&] { tables.get<TableA>(Device::cuda, "encoder 'hash_grid'"); }),
             "hash_grid", "cpu");
  EXPECT_THROW(tables.get<TableB>(Device::cpu, "encoder 'other'"), Error);
}

TEST(KernelTables, TwoTablesForOneDeviceAreRefused) {
  static const TableA first{1};
  static const TableA second{2};
  KernelTables tables;
  tables.add(Device::cpu, "encoder 'hash_grid'", &first);
  EXPECT_THROW(tables.add(Device::cpu, "encoder 'hash_grid'", &second), Error);
  EXPECT_EQ(tables.get<TableA>(Device::cpu, "encoder 'hash_grid'").value, 1);
}

// The reference is derived from declarations, and the committed pages are what it derives.

Registry toy_registry() {
  Registry registry;
  registry.set_current_module("toys 1.0");
  toy::register_into(registry);
  return registry;
}

TEST(Reference, TheTableHasEveryParameterOnce) {
  const Registry registry = toy_registry();
  EXPECT_EQ(parameter_table_markdown(registry.get(PluginKind::encoder, "toy")),
            "| parameter | type | default | allowed | meaning |\n|---|---|---|---|---|\n"
            "| `bands` | int | `2` | [1, 8] | number of sine bands a coordinate |\n"
            "| `gain` | number | `1.5` | [0, 4] | factor of every output |\n"
            "| `flip` | bool | `false` |  | changes the sign of every output |\n");
}

TEST(Reference, ListShowAndMatrixNameThePlugin) {
  const Registry registry = toy_registry();
  EXPECT_EQ(plugins_list_text(registry), "encoders\n  toy  Sines with a learned amplitude. [toys 1.0]\n");
  EXPECT_HAS(plugin_details_text(registry, "toy"), "gain: number = 1.5   ([0, 4])\n      factor of every output");
  EXPECT_HAS(support_matrix_text(registry), "| encoder | toy | cpu | toys 1.0 |");
  EXPECT_HAS(error_of([&] { plugin_details_text(registry, "toi"); }), "toi", "toy");
}

// The testkit's instruments notice what they are for.

TEST(Guarded, FindsUnwrittenElementsAndWritesOutside) {
  Guarded<float> buffer(3, 2, 1);
  EXPECT_EQ(buffer.unwritten(), "element (0, 0) was not written");
  buffer.fill(1.0F);
  EXPECT_EQ(buffer.unwritten(), "");
  EXPECT_EQ(buffer.broken_guard(), "");
  buffer(2, 1) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(buffer.unwritten(), "element (2, 1) is NaN");
  buffer.view().data[2] = 0;
  EXPECT_EQ(buffer.broken_guard(), "wrote into the padding of row 0");
  Guarded<double> before(1, 1);
  before.view().data[-3] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(before.broken_guard(), "wrote 3 elements before the buffer");
  Guarded<std::int32_t> after(1, 1);
  after.view().data[1] = 0;
  EXPECT_EQ(after.broken_guard(), "wrote 0 elements past the buffer");
}

TEST(Compare, NamesTheWorstElement) {
  Guarded<float> got(2, 2);
  Guarded<double> want(2, 2);
  got.fill(1);
  want.fill(1);
  EXPECT_EQ((compare<float, double>(got.view(), want.view(), 1e-6)), "");
  got(1, 0) = 1.5F;
  EXPECT_EQ((compare<float, double>(got.view(), want.view(), 1e-6)).find("element (1, 0) is 1.5, expected 1"), 0u);
  got(1, 0) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_NE((compare<float, double>(got.view(), want.view(), 1e9)), "");
}

TEST(Compare, OtherShapesAreNoEqualNumbers) {
  Guarded<double> want(2, 2), longer(3, 2), wider(2, 3);
  for (Guarded<double>* one : {&want, &longer, &wider}) one->fill(1);
  for (Guarded<double>* got : {&longer, &wider}) {
    const std::string shapes = got == &longer ? "has shape 3 x 2, expected 2 x 2" : "has shape 2 x 3, expected 2 x 2";
    EXPECT_EQ((compare<double, double>(got->view(), want.view(), 1)), shapes);
    EXPECT_EQ((compare_norms<double, double>(got->view(), want.view(), 1)), shapes);
    EXPECT_EQ(compare_bits<double>(got->view(), want.view()), shapes);
    EXPECT_THROW((void)(difference<double, double>(got->view(), want.view())), Error);
  }
}

TEST(Compare, BitsTellZeroFromMinusZero) {
  Guarded<double> a(1, 1);
  Guarded<double> b(1, 1);
  a.fill(0.0);
  b.fill(-0.0);
  EXPECT_NE(compare_bits<double>(a.view(), b.view()), "");
  EXPECT_EQ(compare_bits<double>(a.view(), a.view()), "");
}

TEST(GradientCheck, AcceptsTheTruthAndRejectsOnePerMille) {
  Guarded<double> x(4, 3);
  Guarded<double> gradient(4, 3);
  for (std::int64_t i = 0; i < 12; ++i) x(i / 3, static_cast<std::int32_t>(i % 3)) = 0.1 * static_cast<double>(i);
  const auto loss = [&x] {
    double sum = 0;
    for (std::int64_t r = 0; r < 4; ++r) {
      for (std::int32_t c = 0; c < 3; ++c) sum += std::sin(3 * x(r, c)) + std::max(0.0, x(r, c) - 0.45);
    }
    return sum;
  };
  for (std::int64_t r = 0; r < 4; ++r) {
    for (std::int32_t c = 0; c < 3; ++c) gradient(r, c) = 3 * std::cos(3 * x(r, c)) + (x(r, c) > 0.45 ? 1 : 0);
  }
  EXPECT_EQ(check_gradient(loss, x.view(), gradient.view(), {}), "");
  gradient(3, 2) *= 1.001;
  EXPECT_EQ(check_gradient(loss, x.view(), gradient.view(), {}).find("gradient (3, 2) is "), 0u);
}

TEST(TensorBox, FloatAndDoubleHoldTheSameNumbers) {
  const KernelTables kernels;
  const toy::ToyEncoder<float> encoder32(toy::ToyParams{}, EncoderBuild{}, kernels);
  const toy::ToyEncoder<double> encoder64(toy::ToyParams{}, EncoderBuild{}, kernels);
  const TensorBox<float> single(encoder32, 5);
  const TensorBox<double> twin(encoder64, 5);
  const TensorBox<double> other(encoder64, 6);
  ASSERT_EQ(single.count(), 1u);
  EXPECT_EQ((difference<float, double>(single.value(0), twin.value(0)).max_abs), 0);
  EXPECT_NE(compare_bits<double>(twin.value(0), other.value(0)), "");
}

// Modules join the registry whole or not at all, with refusals that name both sides; wrappers refuse wrong shapes.

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

TEST(Loader, ARefusedModuleLeavesTheRegistryUnchanged) {
  const struct {
    void (*spoil)(PluginModule&);
    const char* said;
  } cases[] = {
      {[](PluginModule& m) { m.register_into = register_two_then_throw; },
       "while registering module 'half 1.0': the second half is missing"},
      {[](PluginModule& m) { m.register_into = [](Registry&) { throw 7; }; },
       "while registering module 'half 1.0': an unknown exception"},
      {[](PluginModule& m) { m.register_into = toy::register_into; }, "taken"},
      {[](PluginModule& m) { m.register_into = nullptr; }, "register function"},
      {[](PluginModule& m) { m.name = nullptr; }, "lacks its name"},
      {[](PluginModule& m) { m.version = nullptr; }, "lacks its name, version"},
      {[](PluginModule& m) { m.abi_tag = nullptr; }, "ABI ''"},
  };
  Registry registry;
  register_module(registry, sound_module());
  for (const auto& [spoil, said] : cases) {
    PluginModule module = sound_module();
    module.name = "half";
    spoil(module);
    EXPECT_HAS(refusal_of(registry, module), said);
    EXPECT_EQ(registry.names(PluginKind::encoder), std::vector<std::string>{"toy"});
    EXPECT_EQ(registry.kernels().devices_of("encoder 'half'"), "");
  }
}

// The public wrappers refuse wrong shapes with a sentence, and never call an implementation with nothing to do.

template <class Call>
std::string message_of(const Call& call) {
  return error_of(ErrorKind::internal, call);
}

struct CheckedEncoder : testing::Test {
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
  EXPECT_HAS(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), y.view().row_range(0, 3)); }),
             "expected [");
  EXPECT_HAS(message_of([&] { encoder.forward(ctx, box.tensors(), x.view().col_range(0, 2), y.view()); }),
             "expected [");
}

TEST_F(CheckedEncoder, RefusesEmptyOverlappingAndForeignViews) {
  EXPECT_HAS(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(nullptr, 4, 2)); }), "not be");
  EXPECT_HAS(message_of([&] { encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 1)); }),
             "its columns");
  EXPECT_HAS(message_of([&] {
               encoder.forward(ctx, box.tensors(), x.view(), View<float>(y.view().data, 4, 2, 2, Device::cuda));
             }),
             "first argument");
}

TEST_F(CheckedEncoder, BackwardWantsGradients) {
  y.fill(1);
  EXPECT_HAS(message_of([&] { encoder.backward(ctx, box.values_only(), x.view(), y.view(), {}); }), "no gradients");
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

struct CheckedFieldForms : testing::Test {
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
  EXPECT_EQ(forward(full, rounded()), "field.forward: fused.feature is wanted of a field that has no such form");
  EXPECT_EQ(forward(two, rounded()), "");
  EXPECT_EQ(forward(two, hidden(3)), "field.forward: hidden is wanted of a field that does not compute such a layer");
  EXPECT_EQ(forward(all, hidden(4)), "field.forward: hidden is wanted of a field that does not compute such a layer");
  EXPECT_EQ(forward(all, hidden(3)), "");
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
  EXPECT_EQ(backward(all, hidden(3), grad), "");
  EXPECT_EQ(full.calls + all.calls, 1);
}

}  // namespace
}  // namespace semfield
