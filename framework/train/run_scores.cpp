#include "train/run_scores.h"

#include <chrono>

#include "core/files.h"
#include "train/final_eval.h"

namespace semfield {

double unix_seconds() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

SplitScore RunScores::score(const EvalJob& job) const {
  return evaluate(*session_.pipeline, job, session_.limits, session_.plan.class_of_logit);
}

MetricsRow RunScores::row_of(const Moment& at, const std::string& split, const SplitScore& score) const {
  MetricsRow row;
  row.kind = "eval";
  row.step = at.step;
  row.train_s = at.train_s;
  row.split = split;
  row.values = score.values();
  row.set("frames", static_cast<double>(score.frames.size()));
  return row;
}

void RunScores::log_test(MetricsRow row, const SplitScore& score) {
  const std::vector<ClassScore> per_class = score.confusion.per_class();
  for (std::size_t c = 0; c < per_class.size(); ++c) {
    row.per_class_iou.emplace_back(session_.scene.info.classes.valid(static_cast<int>(c)).name, per_class[c].iou);
  }
  files_.log.append(row);
  files_.log.sync();
  for (const auto& [name, value] : row.values) {
    if (value) files_.events.scalar("eval/" + name, row.step, *value, unix_seconds());
  }
  last_miou_ = score.confusion.miou_present();
}

void RunScores::score_sample(const Moment& at) {
  const std::vector<int> test = session_.scene.frames_of(Split::test);
  if (test.empty()) return;
  EvalJob job = session_.eval_job(evenly_spaced(test, session_.config.report.eval_frames));
  if (hooks_.stop_signal) job.stop = [this] { return hooks_.stop_signal() != 0; };
  const SplitScore found = score(job);
  if (found.frames.size() < job.frames.size()) return;  // stopped between frames: no partial figures
  log_test(row_of(at, job.frames.size() < test.size() ? std::string("test") + kSampleSuffix : "test", found), found);
}

ScoreValues RunScores::score_test_frames(const Moment& at) {
  const std::vector<int> test = session_.scene.frames_of(Split::test);
  if (test.empty()) return {};
  EvalJob job = session_.eval_job(test);
  report_frames_ =
      ReportFrames(evenly_spaced(test, session_.config.report.strips), session_.config.report.worst_frames);
  job.on_frame = [this](const FrameScore& frame, const RenderedFrame& maps) { report_frames_.add(frame, maps); };
  const SplitScore found = score(job);
  log_test(row_of(at, "test", found), found);
  if (const std::string warning = found.resolution.warning(); !warning.empty() && hooks_.note)
    hooks_.note("warning: " + warning);
  FinalEval detail = final_eval(found, session_.scene.info.classes, "test");
  detail.step = at.step;
  detail.train_s = at.train_s;
  write_file_atomic(files_.folder.final_eval_path(), final_eval_json(detail));
  return found.values();
}

void RunScores::score_training_frames(const Moment& at) {
  const std::vector<int> frames =
      evenly_spaced(session_.scene.frames_of(Split::train), session_.config.report.training_frames);
  MetricsRow row = row_of(at, "train", score(session_.eval_job(frames)));
  const ConfusionMatrix given = score_training_labels(session_, frames);
  row.set("given_miou", given.miou());
  row.set("given_miou_present", given.miou_present());
  row.set("given_total_accuracy", given.total_accuracy());
  row.set("given_px", static_cast<double>(given.scored_px()));
  files_.log.append(row);
  files_.log.sync();
}

}  // namespace semfield
