// The registry: names, near misses, order, kernel tables; its reference pages; the testkit itself.
#include "plugin/registry.h"

#include <algorithm>

#include "plugin/reference.h"
#include "testkit/compare.h"
#include "testkit/gradient_check.h"
#include "testkit/guarded.h"
#include "testkit/tensor_box.h"
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
  EXPECT_EQ(error_of(ErrorKind::config, [&] { registry.get(PluginKind::encoder, "hashgrid"); }),
            "no encoder named 'hashgrid'; known: hash_grid, identity; did you mean 'hash_grid'?");
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
  EXPECT_EQ(error_of(ErrorKind::unavailable, [&] { tables.get<TableA>(Device::cuda, "encoder 'hash_grid'"); }),
            "encoder 'hash_grid' has no cuda kernels in this build (has: cpu)");
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
  EXPECT_EQ(error_of([&] { plugin_details_text(registry, "toi"); }),
            "no plugin named 'toi'; known: toy; did you mean 'toy'?");
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

}  // namespace
}  // namespace semfield
