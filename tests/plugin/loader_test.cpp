// Modules join the registry whole or not at all; refusals name both sides.
#include "plugin/loader.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <stdexcept>

#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

void register_two_then_throw(Registry& registry) {
  static const int kernel_table = 3;
  registry.kernels().add(Device::cpu, "encoder 'half'", &kernel_table);
  registry.add_encoder<toy::ToyEncoder, toy::ToyParams>("half_a", "A toy that must not stay.");
  throw std::runtime_error("the second half is missing");
}

PluginModule sound_module() { return {kPluginApi, abi_tag_of_framework(), "toys", "1.0", toy::register_into}; }

std::string refusal_of(Registry& registry, const PluginModule& module) {
  try {
    register_module(registry, module);
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::unavailable);
    return error.what();
  }
  return "nothing was refused";
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
  EXPECT_NE(refusal.find("'other-world'"), std::string::npos) << refusal;
  EXPECT_NE(refusal.find(abi_tag_of_framework()), std::string::npos) << refusal;
  module.abi_tag = nullptr;
  EXPECT_NE(refusal_of(registry, module).find("ABI ''"), std::string::npos);
}

TEST(Loader, ADescriptorWithoutItsPartsIsRefused) {
  Registry registry;
  PluginModule module = sound_module();
  module.register_into = nullptr;
  EXPECT_NE(refusal_of(registry, module).find("lacks its name, version or register function"), std::string::npos);
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
  EXPECT_NE(refusal.find("while registering module 'copies 1.0': the encoder name 'toy' of module 'copies 1.0' is "
                         "taken by module 'toys 1.0'"),
            std::string::npos)
      << refusal;
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
  const std::string path =
      (std::filesystem::path(testing::TempDir()) / ("not_a_plugin_" + std::to_string(::getpid()) + ".so")).string();
  std::ofstream(path) << "plain text";
  Registry registry;
  try {
    load_module(registry, path);
    FAIL() << "a text file was loaded";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::unavailable);
    EXPECT_EQ(error.message().find("cannot load plugin '" + path + "': "), 0u) << error.message();
  }
  std::filesystem::remove(path);
}

}  // namespace
}  // namespace semfield
