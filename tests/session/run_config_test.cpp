// Reading a run's configuration: every error at once, and the resolved form repeats it; which device a run gets.
#include "session/settings/run_config.h"

#include "compute/isa.h"
#include "config/compose.h"
#include "config/explain.h"
#include "core/device_id.h"
#include "session/assembly.h"
#include "session/settings/choices.h"
#include "session/settings/run_identity.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

std::string errors_of(const std::string& yaml) {
  Registry registry = make_registry();
  Diagnostics diagnostics;
  read_run_config(parse_config_text(yaml, "room.yaml"), registry, diagnostics);
  std::string text;
  for (const Diagnostic& finding : diagnostics.all()) text += finding.text() + "\n";
  return text;
}

TEST(RunConfig, CollectsEveryErrorWithItsPlace) {
  const std::string text = errors_of(
      "scene: {type: analytic_room, framez: 3}\n"
      "sematics: {weight: 1}\n"
      "passes:\n"
      "  - sampler: {type: stratified, samples: many}\n"
      "    position: {type: hashgrid}\n"
      "    fild: {type: tiny_mlp}\n"
      "train: {rays: -1}\n");
  for (const char* part :
       {"room.yaml:1:", "unknown key 'framez'; did you mean 'frames'?",
        "unknown section 'sematics'; did you mean 'semantics'?", "passes.0.sampler.samples: expected int, got 'many'",
        "no encoder named 'hashgrid'", "did you mean 'hash_grid'?", "unknown key 'fild'; did you mean 'field'?",
        "key 'field' is missing", "train.rays: expected int in [0, 1048576], got -1"}) {
    EXPECT_HAS(text, part) << "missing: " << part << "\nin:\n" << text;
  }
}

// What a preset leaves to the device; numbers that are written stay.
TEST(RunConfig, TheDeviceChoosesSizesThatAreLeftOpen) {
  Registry registry = make_registry();
  const auto chosen = [&](const std::string& levels, Device device) {
    const ConfigNode tree = parse_config_text(
        "scene: {type: analytic_room}\n"
        "passes:\n"
        "  - sampler: {type: occupancy_grid, max_samples: 0}\n"
        "    position: {type: hash_grid, levels: " +
            levels +
            "}\n"
            "    field: {type: tiny_mlp}\n"
            "train: {rays: 0}\n",
        "room.yaml");
    RunConfig config = run_config_of(tree, registry);
    const std::size_t lines = choose_for_device(config, device).size();
    const std::string resolved = write_config(resolved_config(config));
    return std::to_string(config.train.rays) + " " + std::to_string(lines) + "\n" + resolved;
  };
  EXPECT_HAS(chosen("0", Device::cpu), "1024 3\n", "levels: 8", "max_samples: 128");
  EXPECT_HAS(chosen("0", Device::cuda), "8192 3\n", "levels: 16", "max_samples: 256");
  EXPECT_HAS(chosen("5", Device::cuda), "8192 2\n", "levels: 5");
}

TEST(RunConfig, RunsOfEarlierVersionsMayNameOurOwnKernels) {
  for (const char* gemm : {"auto", "builtin"})
    EXPECT_EQ(errors_of(hash_config("runtime: {threads: 1, gemm: " + std::string(gemm) + "}\n")), "");
  const std::string text = errors_of(hash_config("runtime: {gemm: onednn}\n"));
  EXPECT_HAS(text, "room.yaml:11:", "gemm is gone");
}

TEST(RunConfig, DensityOfRunsOf1_0IsPerMetre) {
  Registry registry = make_registry();
  const ConfigNode now = resolved_config(open_text(hash_config()).config);
  EXPECT_NEAR(run_config_of(now, registry).rendering.unit_m, 1, 0.3) << "half of what the cameras see afar";
  const ConfigNode* rendering = now.find("rendering");
  const auto unit_of = [&](const ConfigNode& tree) { return run_config_of(tree, registry).rendering.unit_m; };
  EXPECT_EQ(unit_of(now.with("rendering", rendering->with("unit_m", ConfigNode::make_scalar("2.5", false, {})))), 2.5);
  const ConfigNode then = now.with("rendering", rendering->without("unit_m"));
  EXPECT_EQ(unit_of(then), 1) << "the resolved configuration of a run";
  EXPECT_EQ(unit_of(then.without("base_dir")), 0) << "one that is written by hand asks the scene";
}

TEST(RunConfig, PrecisionAutoIsSettledWhenASessionOpens) {
  Registry registry = make_registry();
  Session s = open_text(hash_config("runtime: {device: cpu, precision: auto}\n"), registry);
  EXPECT_EQ(s.config.runtime.precision, bf16_is_faster() ? Precision::bf16 : Precision::fp32);
  const std::string said = bf16_is_faster() ? "precision: bf16" : "precision: fp32";
  EXPECT_HAS(write_config(resolved_config(s.config)), said);
  s.config.runtime.precision = Precision::bf16;
  EXPECT_EQ(precision_of(s.config, registry, {Device::cpu, 0}), Precision::bf16) << "a named one stays";
}

TEST(RunConfig, ADeviceIsNamedByKindAndOrdinal) {
  EXPECT_EQ(device_of("cpu"), DeviceId{});
  EXPECT_EQ(device_of("cuda"), (DeviceId{Device::cuda, 0}));
  EXPECT_EQ(device_of("cuda:0"), (DeviceId{Device::cuda, 0}));
  EXPECT_EQ(device_of("cuda:12"), (DeviceId{Device::cuda, 12}));
  const auto of = [](const std::string& device) {
    return errors_of(hash_config("runtime: {threads: 1, device: " + device + "}\n"));
  };
  for (const char* device : {"auto", "cpu", "cuda", "cuda:1"}) EXPECT_EQ(of(device), "") << device;
  for (const char* device : {"gpu", "'cuda:'", "cuda:x", "cuda1", "cuda:-1", "cuda:1000", "Cuda", "''"}) {
    const std::string text = of(device);
    EXPECT_HAS(text, "room.yaml:11:", "expected one of auto, cpu, cuda") << device << ": " << text;
    EXPECT_HAS(text, "auto, cpu, cuda, or cuda:N");
  }
}

TEST(RunConfig, ResolvedFormReadsBackTheSame) {
  for (const std::string& yaml : {hash_config(), two_pass_config()}) {
    Registry registry = make_registry();
    Diagnostics diagnostics;
    const RunConfig first = read_run_config(parse_config_text(yaml, "/tmp/a.yaml"), registry, diagnostics);
    const ConfigNode resolved = resolved_config(first);
    const RunConfig second =
        read_run_config(parse_config_text(write_config(resolved), "/elsewhere/run.yaml"), registry, diagnostics);
    EXPECT_FALSE(diagnostics.has_errors()) << diagnostics.all().front().text();
    EXPECT_EQ(diff_config(resolved, resolved_config(second)), "");
    EXPECT_EQ(second.base_dir, first.base_dir);
  }
}

TEST(RunConfig, WhatIsChosenFromTheSceneStandsInTheResolvedForm) {
  std::string yaml = hash_config();
  const std::string written = "log2_entries: 11, finest_resolution: 64";
  ASSERT_NE(yaml.find(written), std::string::npos);
  yaml.replace(yaml.find(written), written.size(), "log2_entries: 0, finest_resolution: 0");
  const Session first = open_text(yaml);
  ASSERT_EQ(first.chosen.size(), 2u);
  EXPECT_EQ(first.chosen[0].rfind("passes.main.position: finest_resolution ", 0), 0u) << first.chosen[0];
  EXPECT_EQ(first.chosen[1].rfind("passes.main.position: log2_entries ", 0), 0u) << first.chosen[1];
  EXPECT_HAS(describe_session(first), "chosen    " + first.chosen[0]);
  const std::string resolved = write_config(resolved_config(first.config));
  EXPECT_LACKS(resolved, "finest_resolution: 0");
  const Session second = open_text(resolved);
  EXPECT_TRUE(second.chosen.empty());
  EXPECT_EQ(fingerprint(first.pipeline->store()), fingerprint(second.pipeline->store()));
}

TEST(RunConfig, EveryShippedConfigReadsWithoutError) {
  int read = 0;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(SEMFIELD_SOURCE_DIR "/configs")) {
    const std::string path = entry.path().string();
    if (entry.path().extension() != ".yaml" || path.find("/presets/") != std::string::npos ||
        path.find("small_room") != std::string::npos || path.find("/experiments/") != std::string::npos ||
        path.find(".classes.") != std::string::npos)
      continue;  // sweep files are read by the tests of sweeps
    Registry registry = make_registry();
    EXPECT_NO_THROW(load_run_config(path, {}, registry)) << path;
    ++read;
  }
  EXPECT_GT(read, 0);
}

// Where a run trains whose parts lack kernels for the device; the device itself is not needed.

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
  return error_of(ErrorKind::unavailable, [&] { run.choose(); });
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
            "stays on the CPU then");
  PartsRun term("cuda");
  term.config.losses[0].type = "glow";
  EXPECT_EQ(refusal_of(term),
            "runtime.device: cuda: loss 'glow' has no cuda kernels; set runtime.device: cpu, or auto, which "
            "stays on the CPU then");
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
