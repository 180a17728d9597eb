#include "train/run_scores.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/files.h"
#include "core/text.h"
#include "eval/final_eval.h"
#include "labels/training_labels.h"
#include "scene/classes/class_table.h"
#include "train/run.h"

namespace semfield {

namespace {

constexpr std::int64_t kProbe_px = 2048;     // scored once to learn what a pixel costs
constexpr std::int64_t kLeastMap_px = 1024;  // of a frame at a stride; fewer pixels say little
constexpr std::int64_t kLeastLast_px = 256;  // of one of many frames

const char* name_of(Split split) { return split == Split::test ? "test" : "train"; }

std::int64_t pixels_of(const EvalJob& job) {
  std::int64_t pixels = 0;
  for (const int f : job.frames) {
    const Camera& camera = (*job.infos)[static_cast<std::size_t>(f)].camera;
    pixels += std::int64_t{strided_px(camera.width_px, job.stride)} * strided_px(camera.height_px, job.stride);
  }
  return pixels;
}

// The largest stride that leaves every frame a map of `least_px` at least.
std::int32_t most_stride(const EvalJob& job, std::int64_t least_px) {
  std::int32_t most = INT32_MAX;
  for (const int f : job.frames) {
    const Camera& camera = (*job.infos)[static_cast<std::size_t>(f)].camera;
    std::int32_t stride = 1;
    while (std::int64_t{strided_px(camera.width_px, stride + 1)} * strided_px(camera.height_px, stride + 1) >= least_px)
      ++stride;
    most = std::min(most, stride);
  }
  return most;
}

// A row of metrics.jsonl for a scored part of `split`, "test" or "train".
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

// Adds what the labels that trained are worth against the scene's own, on these frames.
void add_given_scores(MetricsRow& row, const Session& session, const std::vector<int>& frames) {
  const ConfusionMatrix given = score_training_labels(session, frames);
  row.set("given_miou", given.miou());
  row.set("given_miou_present", given.miou_present());
  row.set("given_total_accuracy", given.total_accuracy());
  row.set("given_px", static_cast<double>(given.scored_px()));
}

}  // namespace

RunScores::RunScores(const Trainer& training, const RunFolder& folder, MetricsLog& log, RunListener& listener)
    : training_(training),
      folder_(folder),
      log_(log),
      listener_(listener),
      start_s_(training.train_s()),
      budget_(session().config.report.eval_share, end_s(session().config)),
      test_(session().scene.frames_of(Split::test)) {}

void RunScores::score_sample() {
  if (test_.empty() || !budget_.has_time_for_sample(training_.train_s() - start_s_)) return;
  EvalJob job = session().eval_job(evenly_spaced(test_, session().config.report.eval_frames));
  if (!sample_stride_) {
    if (budget_.bounds_samples()) measure_cost(job);
    sample_stride_ = budget_.sample_stride(static_cast<double>(pixels_of(job)), session().config.report.eval_every_s,
                                           most_stride(job, kLeastMap_px));
  }
  job.stride = *sample_stride_;
  job.stop = [this] { return listener_.stop_signal() != 0; };
  const SplitScore found = score(job, Split::test);
  if (found.frames.size() < job.frames.size()) return;  // stopped between frames: no partial figures
  const ScoredPart part{std::ssize(job.frames), std::ssize(test_), job.stride};
  log_test(part, found);
}

ScoreValues RunScores::score_end() {
  const ReportParams& report = session().config.report;
  if (report.eval_every_s > 0 && training_.train_s() >= report.eval_every_s) score_sample();  // the curve's last point
  EvalJob test_job = session().eval_job(test_),
          train_job = session().eval_job(
              evenly_spaced(session().scene.frames_of(Split::train), session().config.report.training_frames));
  test_job.stride = train_job.stride = report.eval_stride;
  double left_s = budget_.left_s(training_.train_s());
  if (budget_.bounds_last() && !(test_.empty() && train_job.frames.empty())) {
    measure_cost(test_.empty() ? train_job : test_job);
    left_s = budget_.left_s(training_.train_s());
    const auto pixels = static_cast<double>(pixels_of(test_job) + pixels_of(train_job));
    // Frames are left out by no budget: figures of other frames say something else. Pictures get half of it.
    const std::int32_t most = std::min(most_stride(test_job, kLeastLast_px), most_stride(train_job, kLeastLast_px));
    if (budget_.stride_within(left_s, pixels, most) > 1)
      test_job.stride = train_job.stride = budget_.stride_within(left_s / 2, pixels, most);
  }
  ScoreValues values;
  if (!test_.empty()) values = score_test_frames(test_job, left_s / 2);
  if (train_job.frames.empty()) return values;
  // The field at the training poses against the scene's own labels, then the labels given.
  train_job.given = &session().labels;
  const ScoredPart part{std::ssize(train_job.frames), std::ssize(session().scene.frames_of(Split::train)),
                        train_job.stride};
  MetricsRow row = score_row(training_.step(), training_.train_s(), "train", part, score(train_job, Split::train),
                             session().scene.info.classes);
  add_given_scores(row, session(), train_job.frames);
  log_.append(row);
  log_.sync();
  return values;
}

// What a pixel costs, from a few of the job's, unless an evaluation showed it already.
void RunScores::measure_cost(EvalJob job) {
  if (budget_.knows_cost()) return;
  job.frames = evenly_spaced(job.frames, 1);
  const std::int32_t most = most_stride(job, kLeastMap_px);
  while (job.stride < most && pixels_of(job) > kProbe_px) ++job.stride;
  const double begin_s = listener_.now_s();
  session().evaluate(job);
  budget_.spend(listener_.now_s() - begin_s, static_cast<double>(pixels_of(job)));
}

SplitScore RunScores::score(EvalJob job, Split split) {
  job.progress = [&](double done) { listener_.scoring({name_of(split), done, std::ssize(job.frames)}); };
  const double begin_s = listener_.now_s();
  SplitScore found = session().evaluate(job);
  job.frames.resize(found.frames.size());
  if (!job.frames.empty()) budget_.spend(listener_.now_s() - begin_s, static_cast<double>(pixels_of(job)));
  return found;
}

void RunScores::log_test(const ScoredPart& part, const SplitScore& score) {
  const MetricsRow row =
      score_row(training_.step(), training_.train_s(), "test", part, score, session().scene.info.classes);
  log_.append(row);
  log_.sync();
  last_miou_present = score.confusion.miou_present();
  last_part = part;
}

// `pictures_s`: what the report's pictures may take where the scores do not make them.
ScoreValues RunScores::score_test_frames(EvalJob job, double pictures_s) {
  const ScoredPart part{std::ssize(job.frames), std::ssize(test_), job.stride};
  if (!part.whole())
    listener_.note(
        fmt::format("the last evaluation scores {} to end near the time asked for (report.eval_share {}); "
                    "`semfield eval {}` scores every pixel",
                    part.text(), session().config.report.eval_share, shell_word(folder_.path())));
  report_frames =
      ReportFrames(evenly_spaced(job.frames, session().config.report.strips), session().config.report.worst_frames);
  job.on_frame = [this](const FrameScore& frame, const RenderedFrame& maps) { report_frames.add(frame, maps); };
  const SplitScore found = score(job, Split::test);
  if (part.stride > 1) draw_report_frames(pictures_s, part.stride);
  log_test(part, found);
  for (const FrameScore& frame : found.frames)
    if (frame.psnr_db) frame_psnr_db.push_back(*frame.psnr_db);
  std::sort(frame_psnr_db.begin(), frame_psnr_db.end());
  if (const std::string warning = found.resolution.warning(); !warning.empty()) listener_.note("warning: " + warning);
  const std::string split = part.whole() ? "test" : "test" + kSampleSuffix;
  write_file_atomic(folder_.final_eval_path(),
                    final_eval_json(found, session().scene.info.classes, split, training_.step(), training_.train_s()));
  return found.values();
}

// Finer than the scores, where the time allows it.
void RunScores::draw_report_frames(double budget_s, std::int32_t scored_stride) {
  EvalJob job = session().eval_job(report_frames.frames());
  job.stride = budget_.stride_within(budget_s, static_cast<double>(pixels_of(job)), scored_stride);
  if (job.stride == scored_stride) return;
  report_frames.draw([&](int frame) {
    const FrameInfo& info = session().scene.info.frames[static_cast<std::size_t>(frame)];
    FrameOptions options;
    options.stride = job.stride;
    return render_named_frame(*session().pipeline, info.name, {info.camera, info.world_from_camera, job.undistort},
                              session().limits, session().plan.class_of_logit, {}, options);
  });
}

std::string ScoredPart::text() const {
  const std::string count =
      frames == of ? fmt::format("all {} frames", of) : fmt::format("{} of {} frames", frames, of);
  return stride == 1 ? count : fmt::format("{} at 1 pixel in {}", count, stride * stride);
}

std::optional<Outlook> outlook(const std::vector<MetricsRow>& rows, double train_s, double psnr_db) {
  constexpr int kMostDoublings = 4;
  constexpr double kWindow = 0.75;  // of a length, from there to its end
  // PSNR of the training rays at the end of a run of that length; NaN where no row lies there.
  const auto level = [&](double length_s) {
    double mse = 0;
    int count = 0;
    for (const MetricsRow& row : rows) {
      const std::optional<double> psnr = row.kind == "train" ? row.get("psnr") : std::nullopt;
      if (!psnr || row.train_s <= kWindow * length_s || row.train_s > length_s) continue;
      mse += std::pow(10, -*psnr / 10);
      ++count;
    }
    return -10 * std::log10(mse / count);
  };
  const double last = level(train_s) - level(train_s / 2), before = level(train_s / 2) - level(train_s / 4);
  // Gains shrink from one doubling to the next as they did, within what curves of this field do.
  const double shrinks = before > 0 ? std::clamp(last / before, 0.5, 0.8) : 0.65;
  Outlook out{0, 0};
  double gain = last * shrinks, length_s = train_s;
  for (int n = 0; n < kMostDoublings && gain >= kWorthwhile_db && psnr_db + out.gain_db < kShown_db; ++n) {
    out.gain_db += gain;
    out.more_s += length_s;
    length_s *= 2;
    gain *= shrinks;
  }
  return out.more_s > 0 ? std::optional(out) : std::nullopt;  // NaN is no gain
}

std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const SplitScore* refined, const Diagnostics& found) {
  // Figures of other data or settings are not the run's.
  for (const Diagnostic& finding : found.all())
    if (finding.code == "run.scene.changed" || finding.code == "run.config.settings") return finding.message;
  const ClassTable& classes = run.session.scene.info.classes;
  const std::int64_t frames = std::ssize(score.frames);
  MetricsRow row = score_row(run.step, run.train_s, split, {frames, frames, 1}, score, classes);
  if (refined != nullptr) row.set("psnr_refined_poses", refined->color.psnr_db());
  if (split == "train") {
    std::vector<int> all;
    for (const FrameScore& frame : score.frames) all.push_back(frame.frame);
    add_given_scores(row, run.session, all);
  }
  try {
    const RunFolder folder = RunFolder::resume(run.run_dir);  // nobody trains it meanwhile
    const std::vector<CheckpointStore::Entry> saved = CheckpointStore::read(folder.checkpoints_path()).list();
    if (saved.empty() || saved.front().step != run.step)
      return fmt::format("the run's newest checkpoint is not that of step {}, which was read", run.step);
    const bool logged = fs::exists(folder.metrics_path());
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
    write_file_atomic(folder.final_eval_path(), final_eval_json(score, classes, split, run.step, run.train_s));
  } catch (const Error& error) {
    return error.message();
  }
  return {};
}

}  // namespace semfield
