// Which kernels of an outside plugin run: "ripples: isa_avx2 of generic avx2 avx512 avx512_bf16". Its laws on the
// CPU, and on a device where the package has CUDA and the machine a device. Usage: levels FOLDER_OF_MODULES.
#include <cstdio>
#include <filesystem>

#include "compute/isa.h"
#include "execution/device_library.h"
#include "plugin/loader.h"
#include "ripples_kernels.h"
#include "testkit/host_twin.h"
#include "testkit/laws.h"
#include "train/assembly.h"

namespace {

using namespace semfield;

int check_device(Registry& registry, const std::string& folder) {
  const bool has_file = std::filesystem::exists(folder + "/ripples_cuda.so");
  if (!has_cuda_library()) {
    std::printf("cuda: the package has none\n");
    return has_file ? 1 : 0;
  }
  if (!has_file) {
    std::printf("cuda: no compiler was found\n");
    return 0;
  }
  add_cuda_kernels(registry);
  const auto& table = registry.kernels().get<outside::RipplesKernels<float>>(Device::cuda, "encoder 'ripples'");
  std::string why_not;
  if (!cuda_available(&why_not)) {
    std::printf("cuda: kernels '%s' are there; not run, %s\n", table.variant, why_not.c_str());
    return 0;
  }
  const PluginEntry& entry = registry.get(PluginKind::encoder, "ripples");
  EncoderBuild build;
  const auto oracle = entry.encoder64(*entry.new_params(), build, registry.kernels());
  build.device = Device::cuda;
  const auto there = entry.encoder32(*entry.new_params(), build, registry.kernels());
  testkit::LawOptions options;
  options.gradient_elements = 2;
  options.scratch = cuda_library().calls.memory;
  const testkit::Failures failures =
      testkit::encoder_laws(*testkit::host_twin(*there, {cuda_library().calls, false}), *oracle, options);
  std::printf("cuda: laws on the device, %zu failures\n%s", failures.size(), testkit::to_text(failures).c_str());
  return failures.empty() ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  try {
    Registry registry;
    load_module(registry, std::string(argv[1]) + "/ripples.so");
    const auto& table = registry.kernels().get<outside::RipplesKernels<float>>(Device::cpu, "encoder 'ripples'");
    std::printf("ripples: %s of %s\n", table.variant, isas_of_build().c_str());
    const testkit::Failures failures = testkit::plugin_laws(registry, PluginKind::encoder, "ripples");
    std::fputs(testkit::to_text(failures).c_str(), stderr);
    return failures.empty() ? check_device(registry, argv[1]) : 1;
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return error.kind() == ErrorKind::config ? 78 : 1;
  }
}
