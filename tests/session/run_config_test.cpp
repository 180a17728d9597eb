// Reading a run's configuration: every error at once, and the resolved form repeats it.
#include "settings/run_config.h"

#include <gtest/gtest.h>

#include <filesystem>

#include "compute/cpu_kernels.h"
#include "config/explain.h"
#include "core/device_id.h"
#include "session/assembly.h"
#include "settings/run_identity.h"
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
      "train: {rays: 0}\n");
  for (const char* part :
       {"room.yaml:1:", "unknown key 'framez'; did you mean 'frames'?",
        "unknown section 'sematics'; did you mean 'semantics'?", "passes.0.sampler.samples: expected int, got 'many'",
        "no encoder named 'hashgrid'", "did you mean 'hash_grid'?", "unknown key 'fild'; did you mean 'field'?",
        "key 'field' is missing", "train.rays: expected int in [1, 1048576], got 0"}) {
    EXPECT_NE(text.find(part), std::string::npos) << "missing: " << part << "\nin:\n" << text;
  }
}

TEST(RunConfig, RunsOfEarlierVersionsMayNameOurOwnKernels) {
  for (const char* gemm : {"auto", "builtin"})
    EXPECT_EQ(errors_of(hash_config("runtime: {threads: 1, gemm: " + std::string(gemm) + "}\n")), "");
  const std::string text = errors_of(hash_config("runtime: {gemm: onednn}\n"));
  EXPECT_NE(text.find("room.yaml:11:"), std::string::npos) << text;
  EXPECT_NE(text.find("gemm is gone"), std::string::npos) << text;
}

TEST(RunConfig, PrecisionAutoIsSettledWhenASessionOpens) {
  Registry registry = make_registry();
  Session s = open_text(hash_config("runtime: {device: cpu, precision: auto}\n"), registry);
  EXPECT_EQ(s.config.runtime.precision, bf16_is_faster() ? Precision::bf16 : Precision::fp32);
  const std::string said = bf16_is_faster() ? "precision: bf16" : "precision: fp32";
  EXPECT_NE(write_config(resolved_config(s.config)).find(said), std::string::npos);
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
    EXPECT_NE(text.find("room.yaml:11:"), std::string::npos) << device << ": " << text;
    EXPECT_NE(text.find("expected one of auto, cpu, cuda"), std::string::npos) << device << ": " << text;
    EXPECT_NE(text.find("auto, cpu, cuda, or cuda:N"), std::string::npos) << text;
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
  Registry registry = make_registry();
  const Session first = open_text(yaml, registry);
  ASSERT_EQ(first.chosen.size(), 2u);
  EXPECT_EQ(first.chosen[0].rfind("passes.main.position: finest_resolution ", 0), 0u) << first.chosen[0];
  EXPECT_EQ(first.chosen[1].rfind("passes.main.position: log2_entries ", 0), 0u) << first.chosen[1];
  EXPECT_NE(describe_session(first).find("chosen    " + first.chosen[0]), std::string::npos);
  const std::string resolved = write_config(resolved_config(first.config));
  EXPECT_EQ(resolved.find("finest_resolution: 0"), std::string::npos) << resolved;
  const Session second = open_text(resolved, registry);
  EXPECT_TRUE(second.chosen.empty());
  EXPECT_EQ(fingerprint(first.pipeline->store()), fingerprint(second.pipeline->store()));
}

TEST(RunConfig, EveryShippedConfigReadsWithoutError) {
  int read = 0;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(SEMFIELD_SOURCE_DIR "/configs")) {
    const std::string path = entry.path().string();
    if (entry.path().extension() != ".yaml" || path.find("/parts/") != std::string::npos ||
        path.find("/experiments/") != std::string::npos || path.find(".classes.") != std::string::npos)
      continue;  // sweep files are read by the tests of sweeps
    Registry registry = make_registry();
    EXPECT_NO_THROW(load_run_config(path, {}, registry)) << path;
    ++read;
  }
  EXPECT_GT(read, 0);
}

}  // namespace
}  // namespace semfield
