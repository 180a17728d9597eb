#include "studies/scale_trainings.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/error.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "system/files.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr const char* kRoom = "configs/bench/small_room.yaml";

// Narrow, for tests.
const std::vector<std::string> kNarrowPaper{"passes.0.sampler.samples=8", "passes.1.sampler.samples=8",
                                            "semantics.hidden_width=16", "passes.0.field.width=32",
                                            "passes.0.field.view_width=16"};

}  // namespace

ScaleTraining preset_training(const std::string& step, const std::string& device, int ranks, std::int64_t rays,
                              bool quick, const StudyTools& tools) {
  const bool paper = step == "paper", cuda = device == "cuda";
  ScaleTraining t;
  t.step = step;
  t.device = device;
  t.config = tools.shared_file(paper ? "configs/paper.yaml" : "configs/bench/hash_step.yaml");
  t.room = tools.shared_file(kRoom);
  t.ranks = ranks;
  t.threads = cuda ? std::max(1, hardware_threads() / ranks) : 1;
  t.rays = rays;
  t.precision = cuda ? "bf16" : "fp32";
  if (quick) {
    t.batch_steps = 2;
    t.batches = 2;
    if (paper) t.set = kNarrowPaper;
    return t;
  }
  if (cuda) {
    t.batch_steps = paper ? 32 : 64;
    t.batches = 5;
    // As `bench gpu` has it: 2^18 samples per step.
    if (!paper) {
      t.set = {"passes.0.sampler.samples=32", "passes.0.position.log2_entries=19",
               "passes.0.position.finest_resolution=2048"};
    }
    return t;
  }
  if (paper) {
    // A step takes seconds on one rank; the fewer it takes, the more are timed.
    const std::int64_t own = rays / ranks;
    t.batch_steps = own < 32 ? 4 : 1;
    t.batches = own >= 512 ? 2 : own >= 128 ? 3 : 5;
  } else {
    t.batch_steps = rays / ranks < 128 ? 40 : 10;
    t.batches = 5;
  }
  return t;
}

ScaleTraining bits_training(const std::string& config, const std::string& device, bool quick, const StudyTools& tools) {
  ScaleTraining t;
  t.step = "bits";
  t.device = device;
  t.config = config;
  t.room = tools.shared_file(kRoom);
  t.batch_steps = 1;
  t.batches = quick ? 3 : 19;
  t.rays = quick ? 64 : 256;
  t.deterministic = device == "cuda";
  return t;
}

std::vector<std::string> training_words(const ScaleTraining& t, const std::string& folder, const std::string& run) {
  Json config{{"include", {t.config, t.room}},
              {"name", fmt::format("scale_{}", t.step)},
              {"train", {{"steps", t.batch_steps * (t.batches + 1)}, {"rays", t.rays}}},
              {"runtime", {{"device", t.device}, {"threads", t.threads}, {"deterministic", t.deterministic}}},
              {"report", {{"log_every_steps", t.batch_steps}}}};
  if (!t.precision.empty()) config["runtime"]["precision"] = t.precision;
  const std::string file = (fs::path(folder) / (fs::path(run).filename().string() + ".yaml")).string();
  write_file_atomic(file, config.dump(1) + "\n");  // JSON is YAML
  std::vector<std::string> words{"train", file, "--out", run, "-q"};
  for (const std::string& setting : t.set) words.insert(words.end(), {"--set", setting});
  return words;
}

std::string sweep_file(int cells, const std::string& device, bool quick, const StudyTools& tools,
                       const std::string& folder) {
  Json seeds = Json::array();
  for (int seed = 1; seed <= cells; ++seed) seeds.push_back(seed);
  const int steps = quick ? 4 : device == "cuda" ? 2000 : 100;
  const std::string base = (fs::path(folder) / "sweep_base.yaml").string();
  const Json config{{"include", {tools.shared_file("configs/quickstart.yaml"), tools.shared_file(kRoom)}}};
  write_file_atomic(base, config.dump(1) + "\n");
  const Json sweep{{"base", base},
                   {"title", "cells of a sweep by one worker and by two"},
                   {"metrics", Json::array({"psnr"})},
                   {"seeds", seeds},
                   {"variants", {{"room", Json::object()}}},
                   {"set",
                    {{"scene.test_frames", 2},
                     {"train.steps", steps},
                     {"train.rays", quick ? 64 : 512},
                     {"runtime.device", device}}}};
  const std::string file = (fs::path(folder) / "sweep.yaml").string();
  write_file_atomic(file, sweep.dump(1) + "\n");
  return file;
}

std::vector<double> batch_seconds(const std::string& run) {
  const std::string file = RunFolder::read(run).metrics_path();
  std::vector<double> seconds;
  const MetricsRow* before = nullptr;
  const std::vector<MetricsRow> rows = read_metrics(file);
  for (const MetricsRow& row : rows) {
    if (row.kind != "train") continue;
    if (before != nullptr)
      seconds.push_back((row.train_s - before->train_s) / static_cast<double>(row.step - before->step));
    before = &row;
  }
  if (seconds.empty() || *std::min_element(seconds.begin(), seconds.end()) <= 0)
    throw Error(ErrorKind::data, "study.result.damaged",
                "'" + file + "' has no two rows of training whose time differs",
                "train it again; each row should be a batch of steps");
  return seconds;
}

GradientBytes gradient_bytes(const std::string& run) {
  Diagnostics diagnostics;
  const std::optional<CheckpointStore::Found> found =
      CheckpointStore::read(RunFolder::read(run).checkpoints_path()).find_latest(diagnostics);
  if (!found)
    throw Error(ErrorKind::no_input, "checkpoint.none.yet", "'" + run + "' has no checkpoint", "train it to its end");
  GradientBytes bytes;
  for (const TensorRef& tensor : found->file.tensors()) {
    if (!tensor.name.starts_with("adam/m/")) continue;  // every learned tensor has one, and nothing else
    const bool table = tensor.name.find("/position/") != std::string::npos;
    (table ? bytes.table : bytes.dense) += static_cast<double>(tensor.bytes.size());
  }
  return bytes;
}

}  // namespace semfield
