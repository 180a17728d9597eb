// Where a run trains whose parts lack kernels for the device; the device itself is not needed.
#include <gtest/gtest.h>

#include "session/assembly.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

/// A run with a term of the loss, and a registry that has CUDA tables of every part but `without`.
struct PartsRun {
  explicit PartsRun(const std::string& device, const std::string& without = "") : registry(make_registry()) {
    Diagnostics diagnostics;
    const std::string more = "losses: [{type: near_density}]\nruntime: {device: " + device + "}\n";
    config = read_run_config(parse_config_text(hash_config(more), "test.yaml"), registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    static constexpr int kTable = 0;
    for (const PluginEntry* entry : registry.entries()) {
      const std::string owner = std::string(kind_name(entry->kind)) + " '" + entry->name + "'";
      if (owner != without) registry.kernels().add(Device::cuda, owner, &kTable);
    }
  }
  ChosenDevice choose() { return device_for_parts(config, registry, said); }
  Registry registry;
  RunConfig config;
  Diagnostics said;
};

std::string refusal_of(PartsRun& run) {
  try {
    run.choose();
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::unavailable);
    return error.what();
  }
  return "";
}

TEST(DeviceForParts, IsTheDeviceWhereEveryPartHasKernels) {
  EXPECT_EQ(PartsRun("auto").choose().device.kind, Device::cuda);
  EXPECT_EQ(PartsRun("cuda").choose().device.kind, Device::cuda);
}

TEST(DeviceForParts, APluginWithoutKernelsLeavesTheRunOnTheProcessorWithANote) {
  PartsRun run("auto", "encoder 'hash_grid'");
  EXPECT_EQ(run.choose().device.kind, Device::cpu);
  ASSERT_EQ(run.said.all().size(), 1u);
  EXPECT_EQ(run.said.all()[0].message, "encoder 'hash_grid' has no cuda kernels, so the run stays on the processor");
}

TEST(DeviceForParts, ALossTermWithoutKernelsDoesTheSame) {
  PartsRun run("auto");
  run.config.losses[0].type = "glow";  // which the build has no kernels of
  const ChosenDevice chosen = run.choose();
  EXPECT_EQ(chosen.device.kind, Device::cpu);
  EXPECT_EQ(chosen.no_cuda, "loss term 'glow' has no cuda kernels");
  ASSERT_EQ(run.said.all().size(), 1u);
  EXPECT_EQ(run.said.all()[0].severity, Severity::note);
  EXPECT_EQ(run.said.all()[0].message, "loss term 'glow' has no cuda kernels, so the run stays on the processor");
}

TEST(DeviceForParts, CudaAskedForIsRefusedByNameWithARemedy) {
  PartsRun plugin("cuda", "field 'tiny_mlp'");
  EXPECT_EQ(refusal_of(plugin),
            "runtime.device: cuda: field 'tiny_mlp' has no cuda kernels; set runtime.device: cpu, or auto, which "
            "stays on the processor then");
  PartsRun term("cuda");
  term.config.losses[0].type = "glow";
  EXPECT_EQ(refusal_of(term),
            "runtime.device: cuda: loss term 'glow' has no cuda kernels; set runtime.device: cpu, or auto, which "
            "stays on the processor then");
}

}  // namespace
}  // namespace semfield
