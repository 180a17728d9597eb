// The registry: names, near misses, order, kernel tables.
#include "plugin/registry.h"

#include <gtest/gtest.h>

#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

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
  try {
    registry.get(PluginKind::encoder, "hashgrid");
    FAIL() << "an unknown name was found";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    EXPECT_STREQ(error.what(), "no encoder named 'hashgrid'; known: hash_grid, identity; did you mean 'hash_grid'?");
  }
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
  try {
    tables.get<TableA>(Device::cuda, "encoder 'hash_grid'");
    FAIL() << "a table that was never added was found";
  } catch (const Error& error) {
    EXPECT_STREQ(error.what(), "encoder 'hash_grid' has no cuda kernels in this build (has: cpu)");
    EXPECT_EQ(error.kind(), ErrorKind::unavailable);
  }
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

}  // namespace
}  // namespace semfield
