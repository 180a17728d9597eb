// Kernels of modules and their laws; the program's part is modules_test.py.

#include <atomic>

#include "core/files.h"
#include "core/process.h"
#include "plugin/loader.h"
#include "tests/plugin/toy_encoder.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::fresh_folder;

std::string probe(const std::string& name) { return std::string(SEMFIELD_PROBES) + "/probe_" + name + ".so"; }

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

TEST(LibrariesOfTheProgram, AMissingOneNamesTheTargetThatBuildsIt) {
  EXPECT_HAS(error_of(ErrorKind::unavailable, [] { (void)part_symbol("semfield_absent", "symbol", "what it is for"); }),
             "what it is for: ", "libsemfield_absent.so", "--target semfield_absent");
}

}  // namespace
}  // namespace semfield
