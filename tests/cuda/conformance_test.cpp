// The laws of its kind for every registered encoder, field, sampler and head on the device, against the CPU's double.
#include <stdlib.h>

#include <filesystem>
#include <iostream>
#include <set>
#include <sstream>

#include "device_fixture.h"
#include "execution/device_library.h"
#include "plugin/loader.h"
#include "plugin/reference.h"
#include "testkit/host_twin.h"
#include "tests/conformance/rows.h"
#include "tests/cuda/device_fixture.h"
#include "tests/program.h"

namespace semfield::testkit {
namespace {

std::string name_of(const ::testing::TestParamInfo<Row>& info) { return info.param.text(); }

using testing::registry_with_cuda;

LawOptions device_laws(int gradient_elements) {
  return LawOptions{.gradient_elements = gradient_elements, .scratch = cuda_library().calls.memory};
}

// A plugin may be of CPUs alone: that is said, and its device's laws do not apply.
#define SEMFIELD_NEEDS_KERNELS()                                                                                   \
  if (const std::string why = lacks_kernels(registry_with_cuda(), GetParam().kind, GetParam().name, Device::cuda); \
      !why.empty())                                                                                                \
  GTEST_SKIP() << why

class CudaPluginLaws : public ::testing::TestWithParam<Row> {};
TEST_P(CudaPluginLaws, Hold) {
  SEMFIELD_NEEDS_DEVICE();
  SEMFIELD_NEEDS_KERNELS();
  const Row& row = GetParam();
  const bool is_encoder = row.kind == PluginKind::encoder, is_head = row.kind == PluginKind::head;
  for (const bool deterministic : {true, false}) {
    if (deterministic && !is_encoder) continue;
    SCOPED_TRACE(deterministic ? "deterministic" : "as fast as it can");
    LawOptions options = device_laws(is_encoder ? 2 : 1);
    // Else rows are added to a table as they come.
    options.same_bits_of_sums = deterministic || !is_encoder;
    options.same_bits_in_parts = row.kind != PluginKind::field && !is_head;  // cuBLASLt's choice
    const auto laws = [&](const auto& single, const auto& oracle, const auto& build) {
      return laws_of(*host_twin(single, {cuda_library().calls, deterministic}), oracle, build, options);
    };
    hold_for_any_accepted(registry_with_cuda(), row, laws);
    if (is_head)  // as wide as products of their own
      hold_for_any_accepted(registry_with_cuda(), row, std::vector{HeadBuild{Device::cuda, 16, 200}}, laws);
  }
}

INSTANTIATE_TEST_SUITE_P(Linked, CudaPluginLaws,
                         ::testing::ValuesIn(rows_of_kinds({PluginKind::encoder, PluginKind::field, PluginKind::sampler,
                                                            PluginKind::head},
                                                           Device::cuda)),
                         name_of);

std::set<std::string> variants_of(const std::string& owner) {
  std::istringstream list(registry_with_cuda().kernels().devices_of(owner));
  std::set<std::string> variants;
  for (std::string one; std::getline(list >> std::ws, one, ',');) variants.insert(one);
  return variants;
}

std::set<std::string> plugins_with_cuda_sources() {
  std::istringstream list(SEMFIELD_CUDA_PLUGINS);
  std::set<std::string> names;
  for (std::string name; list >> name;) names.insert(name);
  return names;
}

// Zero cases, a plugin without a row, or one whose CUDA sources gave no kernels is a failure and not a pass. A plugin
// without such sources is named, unless it is a field whose layers are the framework's. Needs no device: the library is
// loaded for its tables.
TEST(CudaConformance, EveryRegisteredPluginHasKernelsAndARow) {
  for (const PluginKind kind :
       {PluginKind::encoder, PluginKind::field, PluginKind::sampler, PluginKind::head, PluginKind::loss}) {
    std::set<std::string> with_row;
    for (const Row& row : rows_of(kind, Device::cuda)) with_row.insert(row.name);
    EXPECT_FALSE(with_row.empty()) << "no " << kind_name(kind) << " is registered";
    for (const PluginEntry* entry : registry_with_cuda().entries()) {
      if (entry->kind != kind) continue;
      const std::string owner = std::string(kind_name(kind)) + " '" + entry->name + "'";
      EXPECT_TRUE(with_row.contains(entry->name)) << owner << " has no row";
      const std::set<std::string> variants = variants_of(owner);
      EXPECT_TRUE(variants.contains("cuda") || !plugins_with_cuda_sources().contains(entry->name))
          << owner << " is built with a .cu file and has no cuda kernels";
      if (const std::string why = lacks_kernels(registry_with_cuda(), kind, entry->name, Device::cuda); !why.empty()) {
        RecordProperty(owner, why);
        std::cout << why << ": its laws hold on CPUs alone\n";
        continue;
      }
      EXPECT_EQ(variants.contains("cuda bf16"), variants.contains("cpu bf16")) << owner << " in bf16";
    }
  }
}

// Needs no device either.
TEST(CudaConformance, TheProgramsMatrixShowsTheKernelsOfTheBuild) {
  std::string folder = ::testing::TempDir() + "semfield_matrix_XXXXXX";
  ASSERT_NE(::mkdtemp(folder.data()), nullptr);
  const testing_program::Result result =
      testing_program::succeeded(testing_program::semfield_run("plugins list --devices", folder));
  EXPECT_EQ(result.err, "");
  EXPECT_EQ(result.out, support_matrix_text(registry_with_cuda()));
  EXPECT_HAS(result.out, "| encoder | hash_grid | cpu, cuda |");
  std::filesystem::remove_all(folder);
}

}  // namespace
}  // namespace semfield::testkit
