// Which modules the program runs code of: none that does not fit, and none that only a configuration names.
#include <elf.h>

#include <nlohmann/json.hpp>

#include "plugin/loader.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_program;
using testing_room::fresh_folder;
using Words = std::vector<std::string>;

std::string probe(const std::string& name) { return std::string(SEMFIELD_PROBES) + "/probe_" + name + ".so"; }

class ModuleTrust : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fresh_folder("modules");
    testing_sweep::write_sweep(folder_, 3);
    const std::string base = read_text_file(folder_ + "/base.yaml");
    fs::create_directories(folder_ + "/shared");
    write_file_atomic(folder_ + "/named.yaml", base + "plugins: [shared/probe_sound.so]\n");
    fs::copy_file(probe("sound"), folder_ + "/shared/probe_sound.so");
  }

  /// The program's result; ran_ says whether code of a probe ran.
  Result run(const Words& words, const std::string& trusted = "") {
    const std::string trace = folder_ + "/trace";
    fs::remove(trace);
    Process process(testing_program::program(), words, folder_,
                    {"SEMFIELD_PROBE_FILE=" + trace, "SEMFIELD_PLUGIN_PATH=" + trusted});
    Result r = process.wait();
    ran_ = fs::exists(trace);
    return r;
  }
  void expect_refused(const std::string& module, const std::string& why) {
    const Result r = run({"plugins", "list", "--plugin", module});
    EXPECT_EQ(r.code, 69) << r.err;
    EXPECT_HAS(r.err, "cannot load plugin '" + module + "': ", why);
    EXPECT_FALSE(ran_) << module << ": its static initialiser ran";
  }

  std::string folder_;
  bool ran_ = false;
};

TEST_F(ModuleTrust, NoInitialiserOfARefusedModuleRuns) {
  const Result sound = run({"plugins", "list", "--plugin", probe("sound")});
  EXPECT_EQ(sound.code, 0) << sound.err;
  EXPECT_TRUE(ran_) << "the probe tells nothing";
  expect_refused(probe("no_stamp"), "it has no section '.semfield_plugin', so it is not a plugin");
  expect_refused(probe("other_stamp"), "its section '.semfield_plugin' holds something else");
  expect_refused(probe("other_api"), "the module speaks plugin API 999, this framework speaks ");
  expect_refused(probe("other_abi"), "the module was built with ABI 'cxx0-another-library', this framework with '");
}

TEST_F(ModuleTrust, ModulesCutShortOrOfAnotherProcessorAreRefusedUnrun) {
  const std::string whole = read_text_file(probe("sound")), file = folder_ + "/broken.so";
  for (const std::size_t size :
       {std::size_t{20}, std::size_t{64}, whole.size() / 4, whole.size() / 2, whole.size() - 4096, whole.size() - 1}) {
    write_file_atomic(file, whole.substr(0, size));
    expect_refused(file, "the file is cut short: it ends at byte " + std::to_string(size));
  }
  const auto with = [&](std::size_t at, char value) {
    std::string changed = whole;
    changed[at] = value;
    write_file_atomic(file, changed);
  };
  with(offsetof(Elf64_Ehdr, e_machine), static_cast<char>(whole[offsetof(Elf64_Ehdr, e_machine)] == 62 ? 183 : 62));
  expect_refused(file, "it was built for another CPU");
  with(EI_CLASS, ELFCLASS32);
  expect_refused(file, "it was built for another CPU");
  with(offsetof(Elf64_Ehdr, e_type), ET_EXEC);
  expect_refused(file, "it is not a shared library");
  for (const std::string text : {"", "plain text"}) {
    write_file_atomic(file, text);
    expect_refused(file, "it is not a shared library; check that it is the right file");
  }
}

TEST_F(ModuleTrust, AThrowingInitialiserEndsInOrder) {
  const Result r = run({"plugins", "list", "--plugin", probe("throwing")});
  EXPECT_EQ(r.signal, 0);
  EXPECT_EQ(r.code, 69) << r.err;
  EXPECT_EQ(r.err, "semfield: cannot load plugin '" + probe("throwing") +
                       "': a static initialiser of it throws: no licence found; fix the module, or leave it out "
                       "[plugin.module.throws]\n");
}

TEST_F(ModuleTrust, AConfigurationAloneRunsNoCode) {
  const std::string config = folder_ + "/named.yaml", module = folder_ + "/shared/probe_sound.so";
  write_file_atomic(folder_ + "/sweep.yaml", "base: named.yaml\nvariants: {v: }\n");
  const std::vector<Words> verbs{{"config", "check", config},
                                 {"config", "explain", config},
                                 {"config", "diff", config, config},
                                 {"inspect", config},
                                 {"fuse", config},
                                 {"pack", config, "--out", folder_ + "/p.sfpack"},
                                 {"capture", config, "--out", folder_ + "/captured"},
                                 {"degrade", config, "--out", folder_ + "/degraded"},
                                 {"sweep", folder_ + "/sweep.yaml", "--dry-run"},
                                 {"train", config, "--dry-run"}};
  for (const Words& verb : verbs) {
    const Result r = run(verb);
    EXPECT_EQ(r.code, 78) << verb[0] << ": " << r.err;
    EXPECT_FALSE(ran_) << verb[0] << " ran code that a configuration names";
    EXPECT_HAS(r.err, "named.yaml:4:11: the module '" + module + "' was not loaded: it is code",
               "add --plugin " + module + " (in Python: ", ", or set SEMFIELD_PLUGIN_PATH");
  }
  // Both remedies, as written; and a module of that name which lies elsewhere.
  fs::create_directories(folder_ + "/mine");
  fs::copy_file(module, folder_ + "/mine/probe_sound.so");
  for (const std::string& file : {module, folder_ + "/mine/probe_sound.so"}) {
    const Result named = run({"config", "check", config, "--plugin", file});
    EXPECT_EQ(named.code, 0) << named.err;
    EXPECT_TRUE(ran_);
  }
  for (const std::string& trusted :
       {folder_ + "/shared", folder_ + "/none:" + folder_ + "/shared/", folder_ + "/mine"}) {
    const Result r = run({"config", "diff", config, config}, trusted);
    EXPECT_EQ(r.code, 0) << r.err;
    EXPECT_TRUE(ran_) << trusted;
  }
  // A folder above the module's is not one that holds it.
  for (const std::string& not_trusted : {folder_, std::string("/"), folder_ + "/sha", folder_ + "/mine/..x"}) {
    EXPECT_EQ(run({"config", "check", config}, not_trusted).code, 78);
    EXPECT_FALSE(ran_);
  }
  const Result relative = run({"config", "check", config}, "shared");
  EXPECT_EQ(relative.code, 78);
  EXPECT_HAS(relative.err, "SEMFIELD_PLUGIN_PATH: 'shared' is not an absolute path");
}

TEST_F(ModuleTrust, ARunTrainedWithAModuleRecordsItAndAsksForItAgain) {
  const std::string out = folder_ + "/run", module = probe("sound");
  const Result trained = run({"train", folder_ + "/base.yaml", "--out", out, "--plugin", module});
  ASSERT_EQ(trained.code, 0) << trained.err;
  EXPECT_HAS(read_text_file(out + "/run.yaml"), "probe_sound.so");
  const std::vector<Words> verbs{
      {"eval", out}, {"render", out}, {"export", out, "--out", folder_ + "/labels.json"}, {"train", "--resume", out}};
  for (Words verb : verbs) {
    const Result alone = run(verb);
    EXPECT_EQ(alone.code, 78) << verb[0] << ": " << alone.err;
    EXPECT_HAS(alone.err, "add --plugin " + module);
    EXPECT_FALSE(ran_) << verb[0] << " ran code that a run folder names";
    verb.insert(verb.end(), {"--plugin", folder_ + "/shared/probe_sound.so"});
    const Result named = run(verb);
    EXPECT_EQ(named.code, 0) << verb[0] << ": " << named.err;
  }
}

TEST_F(ModuleTrust, ASweepHandsItsModulesToItsCells) {
  write_file_atomic(folder_ + "/sweep.yaml", "base: named.yaml\nmetrics: [psnr]\nvariants: {v: }\n");
  const Result r = run(
      {"sweep", folder_ + "/sweep.yaml", "--plugin", folder_ + "/shared/probe_sound.so", "--out", folder_ + "/out"});
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_HAS(r.out, "cells=1 done=1 failed=0");
}

TEST_F(ModuleTrust, SchemasHoldTheParametersOfOutsidePlugins) {
  const Result without = run({"config", "schema"}), with = run({"config", "schema", "--plugin", probe("sound")});
  ASSERT_EQ(with.code, 0) << with.err;
  EXPECT_TRUE(nlohmann::json::accept(with.out));
  EXPECT_HAS(with.out, "number of sine bands a coordinate");
  EXPECT_LACKS(without.out, "number of sine bands a coordinate");
  const Result sweep = run({"config", "schema", "--sweep"});
  EXPECT_TRUE(nlohmann::json::parse(sweep.out)["properties"].contains("variants")) << sweep.err;
}

std::string refusal_of_kernels(Registry& registry) {
  return error_of(ErrorKind::unavailable, [&] { add_cuda_kernels_of_modules(registry); });
}

// No device is needed: its kernels are tables of addresses.
TEST(ModuleKernels, OfACudaDeviceComeFromTheLibraryBesideTheModule) {
  Registry registry;
  load_module(registry, probe("sound"));
  EXPECT_FALSE(registry.kernels().has(Device::cuda, "encoder 'toy'"));
  EXPECT_EQ(refusal_of_kernels(registry), "");
  EXPECT_TRUE(registry.kernels().has(Device::cuda, "encoder 'toy'"));
  EXPECT_EQ(refusal_of_kernels(registry), "") << "a second session asks again";
}

TEST(ModuleKernels, AreCheckedBeforeTheyAreLoaded) {
  const std::string folder = fresh_folder("kernels"), module = folder + "/toys.so", kernels = folder + "/toys_cuda.so";
  fs::copy_file(probe("sound"), module);
  Registry registry;
  load_module(registry, module);
  EXPECT_EQ(refusal_of_kernels(registry), "") << "nothing lies beside it";
  const auto expect_refused = [&](const std::string& why) {
    const std::string text = refusal_of_kernels(registry);
    EXPECT_HAS(text, "cannot load the CUDA kernels '" + kernels + "' of plugin '" + module + "': ", why);
    EXPECT_FALSE(registry.kernels().has(Device::cuda, "encoder 'toy'"));
  };
  write_file_atomic(kernels, "plain text");
  expect_refused("it is not a shared library");
  fs::remove(kernels);
  fs::copy_file(probe("other_api"), kernels);
  expect_refused("the module speaks plugin API 999");
  fs::remove(kernels);
  fs::copy_file(probe("sound"), kernels);
  expect_refused("it does not export 'semfield_plugin_cuda_kernels'");
}

}  // namespace
}  // namespace semfield
