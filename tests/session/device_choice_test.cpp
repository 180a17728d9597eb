// Where a run trains whose parts lack kernels for the device; the device itself is not needed.
#include "settings/device_choice.h"

#include <gtest/gtest.h>

#include <filesystem>

#include "config/compose.h"
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
  /// What is said of slow paths on `device` in `precision`.
  std::string slow_paths(DeviceId device, Precision precision, bool bf16_instructions = true) {
    config.runtime.precision = precision;
    Diagnostics found;
    say_slow_paths(config, registry, device, bf16_instructions, found);
    std::string text;
    for (const Diagnostic& finding : found.all()) text += finding.text() + "\n";
    return text;
  }
  ChosenDevice choose() { return device_for_parts(config, registry, said); }
  Registry registry;
  RunConfig config;
  Diagnostics said;
};

const std::string kStays =
    " has no cuda kernels, so the run stays on the CPU, which is tens to hundreds of times slower than a GPU; use "
    "parts "
    "that have kernels for it: `semfield plugins list --devices` lists them";

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
  EXPECT_EQ(run.said.all()[0].text(), "runtime.device: encoder 'hash_grid'" + kStays);
}

TEST(DeviceForParts, ALossWithoutKernelsDoesTheSame) {
  PartsRun run("auto");
  run.config.losses[0].type = "glow";  // which the build has no kernels of
  const ChosenDevice chosen = run.choose();
  EXPECT_EQ(chosen.device.kind, Device::cpu);
  EXPECT_EQ(chosen.no_cuda, "loss 'glow' has no cuda kernels");
  ASSERT_EQ(run.said.all().size(), 1u);
  EXPECT_EQ(run.said.all()[0].severity, Severity::warning);
  EXPECT_EQ(run.said.all()[0].text(), "runtime.device: loss 'glow'" + kStays);
}

TEST(DeviceForParts, CudaAskedForIsRefusedByNameWithARemedy) {
  PartsRun plugin("cuda", "field 'tiny_mlp'");
  EXPECT_EQ(refusal_of(plugin),
            "runtime.device: cuda: field 'tiny_mlp' has no cuda kernels; set runtime.device: cpu, or auto, which "
            "stays on the processor then");
  PartsRun term("cuda");
  term.config.losses[0].type = "glow";
  EXPECT_EQ(refusal_of(term),
            "runtime.device: cuda: loss 'glow' has no cuda kernels; set runtime.device: cpu, or auto, which "
            "stays on the processor then");
}

constexpr DeviceId kCpu{Device::cpu, 0}, kGpu{Device::cuda, 0};

TEST(SlowPaths, Fp32OnAGpuSaysWhatItCosts) {
  PartsRun run("auto");
  run.registry.kernels().add(Device::cuda, "field 'tiny_mlp'", &kStays, Precision::bf16);
  EXPECT_EQ(run.slow_paths(kGpu, Precision::fp32),
            "runtime.precision: fp32 runs layer by layer on a GPU, 3 to 15 times slower than bf16; set "
            "runtime.precision: auto\n");
  EXPECT_EQ(run.slow_paths(kGpu, Precision::bf16), "");
  EXPECT_EQ(run.slow_paths(kCpu, Precision::fp32), "");
}

TEST(SlowPaths, AFieldWithoutKernelsOfBf16IsNamed) {
  PartsRun run("auto");  // its registry has CUDA kernels of fp32 alone
  EXPECT_EQ(precision_of(run.config, run.registry, kGpu), Precision::fp32);
  EXPECT_EQ(run.slow_paths(kGpu, Precision::fp32),
            "runtime.precision: fp32 runs layer by layer on a GPU, 3 to 15 times slower than bf16; field 'tiny_mlp' "
            "has no kernels of bf16; use a field that has: `semfield plugins list --devices` lists them\n");
}

TEST(SlowPaths, EmulatedBf16OnACpuSaysSo) {
  PartsRun run("cpu");
  EXPECT_EQ(run.slow_paths(kCpu, Precision::bf16, false),
            "runtime.precision: this CPU has no bf16 instructions: they are emulated, which is slower than fp32; set "
            "runtime.precision: auto\n");
  EXPECT_EQ(run.slow_paths(kCpu, Precision::bf16, true), "");
}

// Every file of configs/ that has networks, with what it includes.
TEST(ShippedConfigurations, SettleTheirPrecision) {
  int with_networks = 0;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(SEMFIELD_SOURCE_DIR "/configs")) {
    if (entry.path().extension() != ".yaml") continue;
    const ConfigNode tree = compose_config(entry.path().string(), {});
    if (tree.find("passes") == nullptr) continue;
    ++with_networks;
    const ConfigNode* runtime = tree.find("runtime");
    const ConfigNode* precision = runtime == nullptr ? nullptr : runtime->find("precision");
    EXPECT_NE(precision, nullptr) << entry.path();
  }
  EXPECT_GE(with_networks, 18);
}

}  // namespace
}  // namespace semfield
