#include "run/ended_run.h"

#include <filesystem>

#include "eval/final_eval.h"
#include "run/metrics_log.h"
#include "system/files.h"
#include "system/memory_limit.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

// The scores that ended training, as metrics.jsonl has them: figures, and the part of the split that they are of.
void read_scores(const RunFolder& folder, TrainOutcome& outcome) {
  for (const MetricsRow& row : read_metrics(folder.metrics_path())) {
    if (row.kind != "eval" || row.step != outcome.step || !row.split.starts_with("test")) continue;
    outcome.values.clear();
    outcome.scored = {};
    for (const auto& [name, value] : row.values) {
      const auto number = static_cast<std::int64_t>(value.value_or(0));
      if (name == "frames") {
        outcome.scored.frames = number;
      } else if (name == "split_frames") {
        outcome.scored.of = number;
      } else if (name == "pixel_stride") {
        outcome.scored.stride = static_cast<std::int32_t>(number);
      } else if (name != "pixels") {
        outcome.values.emplace_back(name, value);
      }
    }
    if (outcome.scored.of == 0) outcome.scored.of = outcome.scored.frames;
  }
}

}  // namespace

std::optional<TrainOutcome> ended_run(const RunFolder& folder, const RunConfig& config, const ResumePoint& point) {
  if (!point.facts || !point.changed.empty()) return std::nullopt;
  if (last_step(config) == 0 || point.step() < last_step(config)) return std::nullopt;
  if (!fs::exists(folder.report_path())) return std::nullopt;
  // A scene without test frames has no last evaluation.
  if (fs::exists(folder.final_eval_path()) &&
      parse_final_eval(read_text_file(folder.final_eval_path()), folder.final_eval_path()).step != point.step())
    return std::nullopt;
  TrainOutcome outcome;
  outcome.step = point.step();
  outcome.train_s = point.facts->train_s;
  outcome.run_dir = folder.path();
  outcome.report_path = folder.report_path();
  outcome.peak_bytes = peak_resident_bytes();
  read_scores(folder, outcome);
  return outcome;
}

}  // namespace semfield
