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
#include "tests/program.h"

namespace semfield::testkit {
namespace {

std::string name_of(const ::testing::TestParamInfo<Row>& info) { return info.param.text(); }

const Registry& registry_with_cuda() {
  static const Registry registry = [] {
    Registry filled;
    register_linked_plugins(filled);
    cuda_library().add_kernels(filled.kernels());
    return filled;
  }();
  return registry;
}

TwinOptions on_device(bool deterministic) { return {cuda_library().calls, deterministic}; }

LawOptions device_laws(int gradient_elements) {
  return LawOptions{.gradient_elements = gradient_elements, .scratch = cuda_library().calls.memory};
}

// A plugin may be of CPUs alone: that is said, and its device's laws do not apply.
#define SEMFIELD_NEEDS_KERNELS()                                                                                   \
  if (const std::string why = lacks_kernels(registry_with_cuda(), GetParam().kind, GetParam().name, Device::cuda); \
      !why.empty())                                                                                                \
  GTEST_SKIP() << why

class CudaEncoderConformance : public ::testing::TestWithParam<Row> {};
TEST_P(CudaEncoderConformance, Laws) {
  SEMFIELD_NEEDS_DEVICE();
  SEMFIELD_NEEDS_KERNELS();
  for (const bool deterministic : {true, false}) {
    SCOPED_TRACE(deterministic ? "deterministic" : "as fast as it can");
    LawOptions options = device_laws(2);
    options.same_bits_of_sums = deterministic;  // else rows are added to a table as they come
    hold_for_any_accepted(registry_with_cuda(), GetParam(), encoder_builds(Device::cuda),
                          [&](const Encoder<float>& single, const Encoder<double>& oracle, const EncoderBuild&) {
                            return encoder_laws(HostEncoder(single, on_device(deterministic)), oracle, options);
                          });
  }
}

class CudaFieldConformance : public ::testing::TestWithParam<Row> {};
TEST_P(CudaFieldConformance, Laws) {
  SEMFIELD_NEEDS_DEVICE();
  SEMFIELD_NEEDS_KERNELS();
  LawOptions options = device_laws(1);
  options.same_bits_in_parts = false;  // cuBLASLt's choice
  hold_for_any_accepted(registry_with_cuda(), GetParam(),
                        field_builds(registry_with_cuda(), GetParam().name, Device::cuda),
                        [&](const Field<float>& single, const Field<double>& oracle, const FieldBuild& build) {
                          return field_laws(HostField(single, on_device(false)), oracle, build, options);
                        });
}

class CudaSamplerConformance : public ::testing::TestWithParam<Row> {};
TEST_P(CudaSamplerConformance, Laws) {
  SEMFIELD_NEEDS_DEVICE();
  SEMFIELD_NEEDS_KERNELS();
  const LawOptions options = device_laws(1);
  hold_for_any_accepted(registry_with_cuda(), GetParam(), std::vector{sampler_build(Device::cuda)},
                        [&](const Sampler<float>& single, const Sampler<double>& oracle, const SamplerBuild& build) {
                          return sampler_laws(HostSampler(single, on_device(false)), oracle, build, options);
                        });
}

class CudaHeadConformance : public ::testing::TestWithParam<Row> {};
TEST_P(CudaHeadConformance, Laws) {
  SEMFIELD_NEEDS_DEVICE();
  SEMFIELD_NEEDS_KERNELS();
  LawOptions options = device_laws(1);
  options.same_bits_in_parts = false;  // cuBLASLt's choice
  std::vector<HeadBuild> builds = head_builds(Device::cuda);
  builds.push_back({Device::cuda, 16, 200});  // as wide as products of their own
  hold_for_any_accepted(registry_with_cuda(), GetParam(), builds,
                        [&](const Head<float>& single, const Head<double>& oracle, const HeadBuild& build) {
                          return head_laws(HostHead(single, on_device(false)), oracle, build, options);
                        });
}

INSTANTIATE_TEST_SUITE_P(Linked, CudaEncoderConformance,
                         ::testing::ValuesIn(rows_of(PluginKind::encoder, Device::cuda)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, CudaFieldConformance, ::testing::ValuesIn(rows_of(PluginKind::field, Device::cuda)),
                         name_of);
INSTANTIATE_TEST_SUITE_P(Linked, CudaSamplerConformance,
                         ::testing::ValuesIn(rows_of(PluginKind::sampler, Device::cuda)), name_of);
INSTANTIATE_TEST_SUITE_P(Linked, CudaHeadConformance, ::testing::ValuesIn(rows_of(PluginKind::head, Device::cuda)),
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
