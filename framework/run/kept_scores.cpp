#include "run/kept_scores.h"

#include <algorithm>
#include <filesystem>
#include <limits>

#include "eval/final_eval.h"
#include "run/checkpoint_store.h"
#include "run/run_folder.h"
#include "system/files.h"

namespace semfield {

MetricsRow score_row(std::int64_t step, double train_s, const std::string& split, const ScoredPart& part,
                     const SplitScore& score, const ClassTable& classes) {
  MetricsRow row;
  row.kind = "eval";
  row.step = step;
  row.train_s = train_s;
  row.split = split;
  row.values = score.values();
  row.set("frames", static_cast<double>(part.frames));
  row.set("pixels", static_cast<double>(score.pixels));
  if (!part.whole()) {
    row.split += kSampleSuffix;
    row.set("split_frames", static_cast<double>(part.of));
    row.set("pixel_stride", part.stride);
  }
  if (split != "test") return row;
  const std::vector<ClassScore> per_class = score.confusion.per_class();
  for (std::size_t c = 0; c < per_class.size(); ++c)
    row.per_class_iou.emplace_back(classes.valid(static_cast<int>(c)).name, per_class[c].iou);
  return row;
}

void add_given_scores(MetricsRow& row, const Session& session, const std::vector<int>& frames) {
  const ConfusionMatrix given = score_training_labels(session, frames);
  row.set("given_miou", given.miou());
  row.set("given_miou_present", given.miou_present());
  row.set("given_total_accuracy", given.total_accuracy());
  row.set("given_px", static_cast<double>(given.scored_px()));
}

std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const Diagnostics& found) {
  // Figures of other data or settings are not the run's.
  for (const Diagnostic& finding : found.all())
    if (finding.code == "run.scene.changed" || finding.code == "run.config.settings") return finding.message;
  const ClassTable& classes = run.session.scene.info.classes;
  const std::int64_t frames = std::ssize(score.frames);
  MetricsRow row = score_row(run.step, run.train_s, split, {frames, frames, 1}, score, classes);
  if (split == "train") {
    std::vector<int> all;
    for (const FrameScore& frame : score.frames) all.push_back(frame.frame);
    add_given_scores(row, run.session, all);
  }
  try {
    const RunFolder folder = RunFolder::resume(run.run_dir);  // nobody trains it meanwhile
    const std::vector<CheckpointStore::Entry> saved = CheckpointStore::read(folder.checkpoints_path()).list();
    if (saved.empty() || saved.front().step != run.step) return "the run has gone on since it was opened";
    const bool logged = std::filesystem::exists(folder.metrics_path());
    const std::vector<MetricsRow> rows = logged ? read_metrics(folder.metrics_path()) : std::vector<MetricsRow>();
    const std::string line = metrics_line(row);
    const auto last = std::find_if(rows.rbegin(), rows.rend(), [&](const MetricsRow& old) {
      return old.kind == "eval" && old.split.starts_with(split);
    });
    if (last == rows.rend() || metrics_line(*last) != line) {
      MetricsLog log = MetricsLog::resume(folder.metrics_path(), std::numeric_limits<std::int64_t>::max());
      log.append(row);
      log.sync();
    }
    if (split != "test") return {};
    FinalEval detail = final_eval(score, classes, split);
    detail.step = run.step;
    detail.train_s = run.train_s;
    write_file_atomic(folder.final_eval_path(), final_eval_json(detail));
  } catch (const Error& error) {
    return error.message();
  }
  return {};
}

}  // namespace semfield
