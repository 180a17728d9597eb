// Trains every golden configuration for 20 steps on the CPU and prints a line for each: its name and the checksum
// of all parameters, moments and states.
#include <cstdio>

#include "run/run_folder.h"
#include "session/trainer.h"
#include "tests/session/train_testing.h"

namespace semfield {
namespace {

using namespace testing_train;

constexpr std::int64_t kSteps = 20, kSaved = 10;

const std::string kHash = "{type: hash_grid, levels: 4, log2_entries: 10, finest_resolution: 64}";
const std::string kFrequency = "{type: frequency, frequencies: 4}";
const std::string kHarmonics = "{type: spherical_harmonics, degree: 3}";
const std::string kTiny = "{type: tiny_mlp, hidden_width: 32, color_width: 24}";
const std::string kDeep = "{type: nerf_mlp, depth: 4, width: 32, skip_at: 2, view_width: 16}";
// Updated in steps 4, 8, ..., from step 8 on a part of the cells at a time.
const std::string kGrid = "{type: occupancy_grid, resolution: 32, update_every: 4, warmup_steps: 8, max_samples: 48}";
const std::string kEven = "{type: stratified, samples: 12}";
const std::string kWeighted = "{type: importance, samples: 12}";
const std::string kBranch =
    "    semantic: {position: {type: one_blob, bins: 8}, field: {type: tiny_mlp, hidden_width: 16, hidden_layers: 2}, "
    "dropout: 0.2}\n";

struct Golden {
  std::string name, yaml;
  bool resumed = false;
};

std::string pass(const std::string& name, const std::string& sampler, const std::string& position,
                 const std::string& direction, const std::string& field) {
  return "  - name: " + name + "\n    sampler: " + sampler + "\n    position: " + position +
         "\n    direction: " + direction + "\n    field: " + field + "\n";
}

// Lanes and tiles order the sums: fixed here, so that a better choice of the defaults changes no golden value.
std::string tile_rays(const std::string& passes) {
  if (passes.find("occupancy_grid") != std::string::npos) return "32";
  return passes.find("importance") != std::string::npos ? "42" : "64";
}

/// `scene` is what stands beside its type, `more` follows the passes.
Golden golden(const std::string& name, const std::string& passes, const std::string& more = "",
              const std::string& scene = "", const std::string& train = "") {
  const bool bf16 = name.ends_with("bf16");
  return {name, "scene: {type: analytic_room" + scene +
                    "}\nsemantics: {hidden_width: 16, weight: 0.1}\n"
                    "rendering: {density_activation: softplus, far: background, unit_m: 1}\npasses:\n" +
                    passes + more + "train: {steps: 20, rays: 128, adam: {learning_rate: 0.01}" + train +
                    "}\nruntime: {device: cpu, lanes: 8, tile_rays: " + tile_rays(passes) +
                    ", precision: " + (bf16 ? "bf16" : "fp32") + "}\n"};
}

std::vector<Golden> goldens() {
  const std::string hash = pass("main", kGrid, kHash, kHarmonics, kTiny);
  const std::string paper = pass("coarse", kEven, kFrequency, "{type: frequency, frequencies: 2}", kDeep) +
                            pass("fine", kWeighted, kFrequency, "{type: frequency, frequencies: 2}", kDeep);
  std::vector<Golden> all{
      golden("tiny_hash_grid_occupancy", hash),
      golden("tiny_hash_grid_occupancy_bf16", hash),
      golden("nerf_frequency_importance", paper),
      golden("nerf_frequency_importance_bf16", paper),
      golden("nerf_hash_grid_occupancy", pass("main", kGrid, kHash, "{type: frequency, frequencies: 2}", kDeep)),
      golden("tiny_frequency_occupancy_bf16", pass("main", kGrid, kFrequency, kHarmonics, kTiny)),
      golden("tiny_one_blob_importance", pass("coarse", kEven, "{type: one_blob}", kHarmonics, kTiny) +
                                             pass("fine", kWeighted, "{type: one_blob}", kHarmonics, kTiny)),
      golden("nerf_identity_stratified", pass("main", kEven, "{type: identity}", "{type: identity}", kDeep)),
      golden("sparse_labels", hash, "", ", labels: {frames: 2}", ", ray_source: label_balanced"),
      golden("soft_labels", hash, "", ", labels: {degrade: [{type: simulated_predictions}]}"),
      golden("semantic_branch", hash, kBranch),
  };
  all.push_back(all.front());
  all.back().name = "resumed_at_step_10";
  all.back().resumed = true;
  return all;
}

struct Run {
  Session session;
  std::unique_ptr<RaySource> rays = session.make_ray_source();
  Trainer trainer{*session.pipeline, *rays, session.config.adam, session.config.schedule};
  void to(std::int64_t step) {
    while (trainer.step() < step) trainer.advance();
  }
};

std::uint32_t trained(const Golden& golden, Registry& registry) {
  Run run{open_text(golden.yaml, registry)};
  if (!golden.resumed) {
    run.to(kSteps);
    return fingerprint(run.session.pipeline->store());
  }
  run.to(kSaved);
  const TempDir dir;
  CheckpointStore store(dir.path());
  store.save(kSaved, run.trainer.state(), {{"train_s", "1"}});
  Run resumed{open_text(golden.yaml, registry)};
  Diagnostics diagnostics;
  auto found = store.find_latest(diagnostics);
  if (!found) throw Error(ErrorKind::failure, "test.error.made", "the checkpoint of step 10 is not found");
  resumed.trainer.load(found->file, found->step);
  resumed.to(kSteps);
  return fingerprint(resumed.session.pipeline->store());
}

}  // namespace
}  // namespace semfield

int main() {
  try {
    semfield::Registry registry = semfield::testing_train::make_registry();
    for (const semfield::Golden& golden : semfield::goldens())
      std::printf("%s %08x\n", golden.name.c_str(), semfield::trained(golden, registry));
    return 0;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
