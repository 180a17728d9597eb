// Which modules the program runs code of: none that does not fit, and none that only a configuration names.

#include <elf.h>

#include <atomic>
#include <nlohmann/json.hpp>

#include "plugin/loader.h"
#include "system/files.h"
#include "system/process.h"
#include "tests/plugin/toy_encoder.h"
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
    EXPECT_ENDED(run({"plugins", "list", "--plugin", module}), 69, "cannot load plugin '" + module + "': ", why);
    EXPECT_FALSE(ran_) << module << ": its static initialiser ran";
  }

  std::string folder_;
  bool ran_ = false;
};

TEST_F(ModuleTrust, NoInitialiserOfARefusedModuleRuns) {
  const Result sound = succeeded(run({"plugins", "list", "--plugin", probe("sound")}));
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
    const Result named = succeeded(run({"config", "check", config, "--plugin", file}));
    EXPECT_TRUE(ran_);
  }
  for (const std::string& trusted :
       {folder_ + "/shared", folder_ + "/none:" + folder_ + "/shared/", folder_ + "/mine"}) {
    const Result r = succeeded(run({"config", "diff", config, config}, trusted));
    EXPECT_TRUE(ran_) << trusted;
  }
  // A folder above the module's is not one that holds it.
  for (const std::string& not_trusted : {folder_, std::string("/"), folder_ + "/sha", folder_ + "/mine/..x"}) {
    EXPECT_EQ(run({"config", "check", config}, not_trusted).code, 78);
    EXPECT_FALSE(ran_);
  }
  EXPECT_ENDED(run({"config", "check", config}, "shared"), 78,
               "SEMFIELD_PLUGIN_PATH: 'shared' is not an absolute path");
}

TEST_F(ModuleTrust, ARunTrainedWithAModuleRecordsItAndAsksForItAgain) {
  const std::string out = folder_ + "/run", module = probe("sound");
  const Result trained = succeeded(run({"train", folder_ + "/base.yaml", "--out", out, "--plugin", module}));
  EXPECT_HAS(read_text_file(out + "/run.yaml"), "probe_sound.so");
  const std::vector<Words> verbs{
      {"eval", out}, {"render", out}, {"export", out, "--out", folder_ + "/labels.json"}, {"train", "--resume", out}};
  for (Words verb : verbs) {
    EXPECT_ENDED(run(verb), 78, "add --plugin " + module) << verb[0];
    EXPECT_FALSE(ran_) << verb[0] << " ran code that a run folder names";
    verb.insert(verb.end(), {"--plugin", folder_ + "/shared/probe_sound.so"});
    const Result named = succeeded(run(verb));
  }
}

TEST_F(ModuleTrust, ASweepHandsItsModulesToItsCells) {
  write_file_atomic(folder_ + "/sweep.yaml", "base: named.yaml\nmetrics: [psnr]\nvariants: {v: }\n");
  const Result r = succeeded(run(
      {"sweep", folder_ + "/sweep.yaml", "--plugin", folder_ + "/shared/probe_sound.so", "--out", folder_ + "/out"}));
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

// `semfield plugins check`, and what later loads make of what it found.

namespace fs = std::filesystem;
using nlohmann::json;

class PluginsCheck : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fresh_folder("checks");
    testing_sweep::write_sweep(folder_, 3);
  }
  Result run(const Words& words, const std::string& cache) {
    return Process(testing_program::program(), words, folder_, {"SEMFIELD_CACHE=" + cache}).wait();
  }
  Result run(const Words& words) { return run(words, folder_ + "/cache"); }
  Result train_with(const std::string& module) {
    return run({"train", folder_ + "/base.yaml", "--dry-run", "--plugin", module});
  }
  std::vector<fs::path> verdicts() const {
    std::vector<fs::path> found;
    for (const auto& entry : fs::directory_iterator(folder_ + "/cache/checks")) found.push_back(entry.path());
    return found;
  }

  std::string folder_;
};

TEST_F(PluginsCheck, LawsThatHoldAreToldALineEach) {
  write_file_atomic(folder_ + "/rows.txt", "# as conformance.txt\ndefaults\nbands=3 gain=0.5\n");
  const Result r = succeeded(run({"plugins", "check", probe("sound"), "--settings", folder_ + "/rows.txt"}));
  for (const char* subject :
       {"declaration", "defaults, positions", "defaults, directions", "bands=3 gain=0.5, positions"})
    EXPECT_HAS(r.out, subject);
  EXPECT_LACKS(r.out, "FAILED");
  EXPECT_HAS(r.out, "plugins check: passed=5 failed=0 refused=0 file=" + probe("sound") + "\n");
  EXPECT_EQ(verdicts().size(), 1U);
  EXPECT_EQ(train_with(probe("sound")).code, 0);
}

TEST_F(PluginsCheck, TrainRefusesAFileThatBrokeALawUntilItIsMendedOrItsOwnerWantsIt) {
  const std::string file = folder_ + "/b e/bent.so";
  fs::create_directories(folder_ + "/b e");
  fs::copy_file(probe("bent"), file);
  EXPECT_EQ(train_with(file).code, 0) << "a file that nobody checked loads";
  const Result r = run({"plugins", "check", file, "--json"});
  EXPECT_EQ(r.code, 1) << r.out << r.err;
  const json said = json::parse(r.out);
  EXPECT_EQ(said["verb"], "plugins check");
  EXPECT_EQ(said["passed"], 1);
  EXPECT_EQ(said["failed"], 2);
  ASSERT_EQ(said["rows"].size(), 3U);
  EXPECT_EQ(said["rows"][0]["status"], "passed");
  EXPECT_EQ(said["rows"][1]["kind"], "encoder");
  EXPECT_EQ(said["rows"][1]["name"], "bent");
  EXPECT_EQ(said["rows"][1]["build"], "positions");
  EXPECT_EQ(said["rows"][1]["status"], "FAILED");
  const std::string found = said["rows"][1]["found"][0];
  EXPECT_HAS(found, "gradient");

  const Result refused = train_with(file);
  EXPECT_EQ(refused.code, 69) << refused.err;
  const std::string entry = verdicts().at(0).string();
  EXPECT_EQ(refused.err, "semfield: cannot load plugin '" + file +
                             "': it was checked, and broke a law: encoder 'bent', defaults, positions: " + found +
                             "; fix it and run `semfield plugins check '" + file + "'` again, or remove " + entry +
                             " to load it as it is [plugin.module.broken_law]\n");
  EXPECT_EQ(train_with(probe("bent")).code, 69) << "the same bytes elsewhere";
  EXPECT_EQ(run({"plugins", "check", file}).code, 1) << "a check loads what it checks";
  EXPECT_EQ(run({"plugins", "list", "--plugin", file}, "off").code, 0) << "without a cache nothing is known";

  std::string mended = read_text_file(file) + "mended";
  write_file_atomic(folder_ + "/b e/mended.so", mended);
  EXPECT_EQ(train_with(folder_ + "/b e/mended.so").code, 0) << "other bytes are another file";
  fs::remove(entry);
  EXPECT_EQ(train_with(file).code, 0) << "the remedy works as it says";
}

// An exit code of 0 is no law that holds.
TEST_F(PluginsCheck, APluginThatEndsTheProcessBreaksTheLawUnderWay) {
  const Result r = run({"plugins", "check", probe("quitting")});
  EXPECT_EQ(r.code, 1) << r.out << r.err;
  const std::string fault = "it ended the process with exit code 0 before the law was asked to its end";
  EXPECT_HAS(r.out, "quitting         defaults, positions                      FAILED\n    " + fault + "\n",
             "plugins check: passed=1 failed=1 refused=0 ");
  EXPECT_ENDED(train_with(probe("quitting")), 69, "broke a law: encoder 'quitting', defaults, positions: " + fault);
  EXPECT_ENDED(Process(testing_program::program(), {"plugins", "check", probe("quitting")}, folder_,
                       {"SEMFIELD_CACHE=" + folder_ + "/other", "SEMFIELD_PROBE_QUITS=1"})
                   .wait(),
               69, "cannot load plugin '" + probe("quitting") + "': it ended the process with exit code 0");
}

TEST_F(PluginsCheck, ACacheThatIsDamagedOrCannotBeWrittenStopsNothing) {
  ASSERT_EQ(run({"plugins", "check", probe("bent")}).code, 1);
  const fs::path entry = verdicts().at(0);
  const std::string whole = read_text_file(entry.string());
  for (const std::string& text : {std::string(), std::string("\n"), whole.substr(0, whole.size() / 2), whole + "x",
                                  "semfield-verdict-1\nanything\n00000000\n" + std::string()}) {
    write_file_atomic(entry.string(), text);
    const Result r = succeeded(train_with(probe("bent")));
    EXPECT_HAS(r.err, "is damaged in '" + entry.string() + "' and is not used");
  }
  fs::remove(entry);
  fs::create_directories(entry);  // no file can take its name
  const Result loaded = succeeded(train_with(probe("bent")));
  EXPECT_HAS(loaded.err, "whether it was checked cannot be read: ");
  EXPECT_ENDED(run({"plugins", "check", probe("bent")}), 1, "what the check found is not kept: ");
  EXPECT_ENDED(run({"plugins", "check", probe("bent")}, "off"), 1, "there is no folder for caches");
}

TEST_F(PluginsCheck, WordsThatFitNothingAreRefusedBeforeALawRuns) {
  const auto refused = [&](Words more, int code, const std::string& text) {
    Words words{"plugins", "check"};
    words.insert(words.end(), more.begin(), more.end());
    const Result r = run(words);
    EXPECT_EQ(r.code, code) << r.err;
    EXPECT_HAS(r.err, text);
    EXPECT_EQ(r.out, "");
    EXPECT_FALSE(fs::exists(folder_ + "/cache/checks") && !verdicts().empty()) << "a verdict without laws";
  };
  const std::string rows = folder_ + "/rows.txt";
  for (const std::string& none : {folder_ + "/none.so", folder_}) refused({none}, 69, "there is no such file");
  refused({probe("other_api")}, 69, "plugin API 999");
  refused({probe("sound"), "--settings", folder_ + "/none.txt"}, 66, "none.txt");
  write_file_atomic(rows, "\nbands\n");
  refused({probe("sound"), "--settings", rows}, 78, rows + ":2: 'bands' sets nothing; write name=value name=value");
  write_file_atomic(rows, "bandz=2\n");
  refused({probe("sound"), "--settings", rows}, 78, rows + ":1: no plugin has the parameters of 'bandz=2'; known: ");
  refused({probe("sound"), "--scene", "root=x"}, 2, "--scene is for datasets, and the file registers none");
  refused({probe("sound"), "--scene", "root"}, 2, "--scene root: expected NAME=VALUE");
  write_file_atomic(rows, "defaults\nbands=99\n");
  refused({probe("sound"), "--settings", rows}, 78, rows + ":2: toy: bands: expected int in [1, 8]");
}

// Counts the rows that are requested.
std::atomic<std::int64_t> g_rows{0};
template <class Real>
class Counted final : public toy::ToyEncoder<Real> {
 public:
  Counted(const toy::ToyParams& params, const EncoderBuild& build, const KernelTables& kernels)
      : toy::ToyEncoder<Real>(params, build, kernels) {}

 protected:
  void do_forward(const StepContext& ctx, const Tensors<Real>& tensors, View<const double> x,
                  View<Real> y) const override {
    g_rows += x.rows;
    toy::ToyEncoder<Real>::do_forward(ctx, tensors, x, y);
  }
};

TEST(LawSuite, AsksPluginsThatAreSlowForFewerRows) {
  const auto suite = reinterpret_cast<LawSuite>(library_symbol("libsemfield_laws.so", kLawSuiteSymbol, "laws", ""));
  const auto rows_of = [&](bool slow) {
    Registry registry;
    registry.add_encoder<Counted, toy::ToyParams>("counted", "A toy that counts.");
    PluginEntry entry = registry.get(PluginKind::encoder, "counted");
    entry.slow = slow;
    LawRequest request{.entries = {&entry}};
    int rows = 0;
    request.on_row = [&](const LawRow& row) {
      ++rows;
      EXPECT_EQ(row.status, LawStatus::passed) << row.found.front();
    };
    g_rows = 0;
    suite(registry, request);
    EXPECT_EQ(rows, 3);
    return g_rows.load();
  };
  const std::int64_t all = rows_of(false), few = rows_of(true);
  EXPECT_GT(few, 1000);
  EXPECT_LT(10 * few, 3 * all) << few << " of " << all;
}

TEST(FileVerdicts, GoWithBytesAndVersion) {
  const std::string folder = fresh_folder("verdicts"), file = folder + "/a.so";
  ::setenv("SEMFIELD_CACHE", (folder + "/cache").c_str(), 1);
  write_file_atomic(file, "bytes");
  Diagnostics notes;
  EXPECT_FALSE(read_verdict(file, "1.0", notes));
  keep_verdict(file, "1.0", "line\nand another", notes);
  EXPECT_EQ(read_verdict(file, "1.0", notes)->fault, "line\nand another");
  EXPECT_FALSE(read_verdict(file, "1.1", notes));
  fs::copy_file(file, folder + "/b.so");
  EXPECT_FALSE(read_verdict(folder + "/b.so", "1.0", notes)->passed());
  keep_verdict(folder + "/b.so", "1.0", "", notes);
  EXPECT_TRUE(read_verdict(file, "1.0", notes)->passed());
  write_file_atomic(file, "bytez");
  EXPECT_FALSE(read_verdict(file, "1.0", notes));
  EXPECT_TRUE(notes.all().empty());
  ::setenv("SEMFIELD_CACHE", "off", 1);
}

TEST(LibrariesOfTheProgram, AMissingOneNamesTheTargetThatBuildsIt) {
  EXPECT_HAS(error_of(ErrorKind::unavailable, [] { (void)part_symbol("semfield_absent", "symbol", "what it is for"); }),
             "what it is for: ", "libsemfield_absent.so", "--target semfield_absent");
}

}  // namespace
}  // namespace semfield
