#include "run/run_scores.h"

#include <fmt/format.h>

#include <chrono>
#include <filesystem>
#include <functional>
#include <limits>
#include <set>

#include "core/text.h"
#include "eval/final_eval.h"
#include "labels/clicks/click_file.h"
#include "plugin/loader.h"
#include "run/run.h"
#include "session/checkpoint_facts.h"
#include "session/settings/choices.h"
#include "session/settings/run_identity.h"
#include "session/trainer.h"
#include "session/training.h"
#include "system/files.h"

namespace semfield {

namespace {

constexpr std::int64_t kProbe_px = 2048;     // scored once to learn what a pixel costs
constexpr std::int64_t kLeastMap_px = 1024;  // of a frame at a stride; fewer pixels say little
constexpr std::int64_t kLeastLast_px = 256;  // of one of many frames

const char* name_of(Split split) { return split == Split::test ? "test" : "train"; }

CheckpointStore::Found newest_checkpoint(const RunFolder& folder, Diagnostics& diagnostics) {
  std::optional<CheckpointStore::Found> found =
      CheckpointStore::read(folder.checkpoints_path()).find_latest(diagnostics);
  if (found) return *std::move(found);
  throw Error(ErrorKind::no_input, "checkpoint.none.yet", folder.path() + ": the run has no checkpoint yet",
              "train it from step 0 with `semfield train --resume " + shell_word(folder.path()) + "`");
}

struct Side {
  TensorFile file;
  CheckpointFacts facts;
  std::optional<ConfigNode> settings;  // of the checkpoint, with defaults of now; none: this program cannot read them
  ConfigNode text() const { return parse_config_text(facts.config, file.name()); }
};

std::vector<ConfigDifference> changes_of_identity(const ConfigNode& a, const ConfigNode& b) {
  std::vector<ConfigDifference> changes = config_differences(a, b);
  std::erase_if(changes, [](const ConfigDifference& change) { return !is_part_of_identity(change.key); });
  return changes;
}

// Those of the checkpoint are what trained. `config diff` compares run.yaml, so a difference from it is reported.
std::optional<ConfigNode> settings_of(const RunFolder& folder, const Side& side, Registry& registry,
                                      Diagnostics& diagnostics) {
  std::optional<RunConfig> written, trained;
  try {
    written = load_run_config(folder.config_path(), {}, registry);
    trained = settings_of_checkpoint(side.facts, registry);
  } catch (const Error&) {  // a plugin that is not loaded, for one: then their texts are compared
  }
  if (!written || !trained) return std::nullopt;
  ConfigNode settings = resolved_config(*trained);
  std::string edited;
  for (const ConfigDifference& change : changes_of_identity(settings, resolved_config(*written)))
    edited += (edited.empty() ? "" : ", ") + change.text();
  if (!edited.empty()) {
    diagnostics.warning("run.config.edited", folder.config_path(),
                        "it differs from what the run was trained with: " + edited,
                        "restore it; the settings in the checkpoints are compared");
  }
  return settings;
}

Side read_side(const std::string& run_dir, Registry& registry, Diagnostics& diagnostics) {
  const RunFolder folder = RunFolder::read(run_dir);
  CheckpointStore::Found found = newest_checkpoint(folder, diagnostics);
  Side side;
  side.facts = read_checkpoint_facts(found.file, found.step);
  side.file = std::move(found.file);
  side.settings = settings_of(folder, side, registry, diagnostics);
  return side;
}

// Of one tensor that both have.
std::string difference_of(const TensorRef& a, const TensorRef& b) {
  if (a.type != b.type || a.shape != b.shape) return fmt::format("tensor '{}' has another shape", a.name);
  const auto [left, right] = std::mismatch(a.bytes.begin(), a.bytes.end(), b.bytes.begin());
  if (left == a.bytes.end()) return {};
  const auto element = static_cast<std::size_t>(left - a.bytes.begin()) / tensor_type_bytes(a.type);
  return fmt::format("tensor '{}' differs from element {} on", a.name, element);
}

std::string difference_of_tensors(const TensorFile& a, const TensorFile& b) {
  for (const TensorRef& tensor : a.tensors()) {
    const TensorRef* other = b.find(tensor.name);
    if (other == nullptr) return fmt::format("tensor '{}' is in the first alone", tensor.name);
    if (const std::string found = difference_of(tensor, *other); !found.empty()) return found;
  }
  for (const TensorRef& tensor : b.tensors()) {
    if (a.find(tensor.name) == nullptr) return fmt::format("tensor '{}' is in the second alone", tensor.name);
  }
  return {};
}

std::string first_difference(const Side& a, const Side& b) {
  const bool read = a.settings && b.settings;
  const std::vector<ConfigDifference> changes =
      changes_of_identity(read ? *a.settings : a.text(), read ? *b.settings : b.text());
  if (!changes.empty()) return changes.front().text();
  if (a.facts.classes != b.facts.classes) return "the class tables differ";
  const std::vector<std::string> others = other_inputs(a.facts.inputs, b.facts.inputs);
  if (!others.empty()) return "the scenes differ: " + join(others);
  if (a.facts.step != b.facts.step) return fmt::format("step: {} -> {}", a.facts.step, b.facts.step);
  return difference_of_tensors(a.file, b.file);
}

// What training has shown of the scene already is not said again by each verb.
void add_untold(const Diagnostics& found, const std::string& told_path, Diagnostics& diagnostics) {
  std::set<std::string, std::less<>> told;
  const std::string text = std::filesystem::exists(told_path) ? read_text_file(told_path) : std::string();
  std::string_view rest = text, line;
  while (next_line(rest, line)) told.emplace(line);
  for (const Diagnostic& finding : found.all()) {
    if (!told.contains(finding.text())) diagnostics.add(finding);
  }
}

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

void write_final_eval(const RunFolder& folder, FinalEval detail, std::int64_t step, double train_s) {
  detail.step = step;
  detail.train_s = train_s;
  write_file_atomic(folder.final_eval_path(), final_eval_json(detail));
}

}  // namespace

double unix_seconds() {
  return std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch()).count();
}

RunScores::RunScores(const Session& session, const ScoreFiles& files, RunListener& listener, const Moment& start)
    : session_(session),
      files_(files),
      listener_(listener),
      start_(start),
      budget_(session.config.report.eval_share, end_s(session.config)),
      test_(session.scene.frames_of(Split::test)) {}

void RunScores::measure_cost(EvalJob job) {
  if (budget_.knows_cost()) return;
  job.frames = evenly_spaced(job.frames, 1);
  const std::int32_t most = most_stride(job, kLeastMap_px);
  while (job.stride < most && pixels_of(job) > kProbe_px) ++job.stride;
  const double begin_s = listener_.now_s();
  evaluate(*session_.pipeline, job, session_.limits, session_.plan.class_of_logit);
  budget_.spend(listener_.now_s() - begin_s, static_cast<double>(pixels_of(job)));
}

SplitScore RunScores::score(EvalJob job, Split split) {
  job.progress = [&](double done) { listener_.scoring({name_of(split), done, std::ssize(job.frames)}); };
  const double begin_s = listener_.now_s();
  SplitScore found = evaluate(*session_.pipeline, job, session_.limits, session_.plan.class_of_logit);
  job.frames.resize(found.frames.size());
  if (!job.frames.empty()) budget_.spend(listener_.now_s() - begin_s, static_cast<double>(pixels_of(job)));
  return found;
}

void RunScores::log_test(const Moment& at, const ScoredPart& part, const SplitScore& score) {
  const MetricsRow row = score_row(at.step, at.train_s, "test", part, score, session_.scene.info.classes);
  files_.log.append(row);
  files_.log.sync();
  // One tag a meaning: a sample's figures are not those of the split.
  const std::string tag = part.whole() ? "eval/" : "eval_sample/";
  for (const auto& [name, value] : row.values) {
    if (value) files_.events.scalar(tag + name, row.step, *value, unix_seconds());
  }
  last_miou_present_ = score.confusion.miou_present();
  last_part_ = part;
}

void RunScores::score_sample(const Moment& at) {
  if (test_.empty() || !budget_.has_time_for_sample(at.train_s - start_.train_s)) return;
  EvalJob job = session_.eval_job(evenly_spaced(test_, session_.config.report.eval_frames));
  if (!sample_stride_) {
    if (budget_.bounds_samples()) measure_cost(job);
    sample_stride_ = budget_.sample_stride(static_cast<double>(pixels_of(job)), session_.config.report.eval_every_s,
                                           most_stride(job, kLeastMap_px));
  }
  job.stride = *sample_stride_;
  job.stop = [this] { return listener_.stop_signal() != 0; };
  const SplitScore found = score(job, Split::test);
  if (found.frames.size() < job.frames.size()) return;  // stopped between frames: no partial figures
  const ScoredPart part{std::ssize(job.frames), std::ssize(test_), job.stride};
  log_test(at, part, found);
}

ScoreValues RunScores::score_end(const Moment& at) {
  const ReportParams& report = session_.config.report;
  if (report.eval_every_s > 0 && at.train_s >= report.eval_every_s) score_sample(at);  // the curve's last point
  EvalJob test_job = session_.eval_job(test_),
          train_job = session_.eval_job(
              evenly_spaced(session_.scene.frames_of(Split::train), session_.config.report.training_frames));
  double left_s = budget_.left_s(at.train_s);
  if (budget_.bounds_last() && !(test_.empty() && train_job.frames.empty())) {
    measure_cost(test_.empty() ? train_job : test_job);
    left_s = budget_.left_s(at.train_s);
    const auto pixels = static_cast<double>(pixels_of(test_job) + pixels_of(train_job));
    // Frames are left out by no budget: figures of other frames say something else. Pictures get half of it.
    const std::int32_t most = std::min(most_stride(test_job, kLeastLast_px), most_stride(train_job, kLeastLast_px));
    if (budget_.stride_within(left_s, pixels, most) > 1)
      test_job.stride = train_job.stride = budget_.stride_within(left_s / 2, pixels, most);
  }
  ScoreValues values;
  if (!test_.empty()) values = score_test_frames(at, test_job, left_s / 2);
  if (train_job.frames.empty()) return values;
  // The field at the training poses against the scene's own labels, then the labels given.
  train_job.given = &session_.labels;
  const ScoredPart part{std::ssize(train_job.frames), std::ssize(session_.scene.frames_of(Split::train)),
                        train_job.stride};
  MetricsRow row =
      score_row(at.step, at.train_s, "train", part, score(train_job, Split::train), session_.scene.info.classes);
  add_given_scores(row, session_, train_job.frames);
  files_.log.append(row);
  files_.log.sync();
  return values;
}

ScoreValues RunScores::score_test_frames(const Moment& at, EvalJob job, double pictures_s) {
  const ScoredPart part{std::ssize(job.frames), std::ssize(test_), job.stride};
  if (!part.whole())
    listener_.note(
        fmt::format("the last evaluation scores {} to end near the time asked for (report.eval_share {}); "
                    "`semfield eval {}` scores every pixel",
                    part.text(), session_.config.report.eval_share, shell_word(files_.folder.path())));
  report_frames_ =
      ReportFrames(evenly_spaced(job.frames, session_.config.report.strips), session_.config.report.worst_frames);
  job.on_frame = [this](const FrameScore& frame, const RenderedFrame& maps) { report_frames_.add(frame, maps); };
  const SplitScore found = score(job, Split::test);
  if (part.stride > 1) draw_report_frames(pictures_s, part.stride);
  log_test(at, part, found);
  if (const std::string warning = found.resolution.warning(); !warning.empty()) listener_.note("warning: " + warning);
  const std::string split = part.whole() ? "test" : "test" + kSampleSuffix;
  write_final_eval(files_.folder, final_eval(found, session_.scene.info.classes, split), at.step, at.train_s);
  return found.values();
}

void RunScores::draw_report_frames(double budget_s, std::int32_t scored_stride) {
  EvalJob job = session_.eval_job(report_frames_.frames());
  job.stride = budget_.stride_within(budget_s, static_cast<double>(pixels_of(job)), scored_stride);
  if (job.stride == scored_stride) return;
  report_frames_.draw([&](int frame) {
    const FrameInfo& info = session_.scene.info.frames[static_cast<std::size_t>(frame)];
    FrameOptions options;
    options.stride = job.stride;
    return render_named_frame(*session_.pipeline, info.name, {info.camera, info.world_from_camera, job.undistort},
                              session_.limits, session_.plan.class_of_logit, {}, options);
  });
}

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
    write_final_eval(folder, final_eval(score, classes, split), run.step, run.train_s);
  } catch (const Error& error) {
    return error.message();
  }
  return {};
}

// Two runs' newest checkpoints against each other.

RunComparison compare_runs(const std::string& folder_a, const std::string& folder_b, Registry& registry,
                           Diagnostics& diagnostics) {
  const Side a = read_side(folder_a, registry, diagnostics), b = read_side(folder_b, registry, diagnostics);
  return {first_difference(a, b), a.facts.step, a.file.tensors().size()};
}

OpenedRun open_run(const std::string& run_dir, const std::vector<std::string>& overrides, Registry& registry,
                   Diagnostics& diagnostics, OpenFor purpose, Ranks* ranks) {
  OpenedRun run;
  const RunFolder folder = RunFolder::read(run_dir);
  run.run_dir = folder.path();
  const CheckpointStore::Found found = newest_checkpoint(folder, diagnostics);
  const CheckpointFacts facts = read_checkpoint_facts(found.file, found.step);
  RunConfig config = load_run_config(folder.config_path(), overrides, registry);
  require_scene_places(config, run_dir);
  require_clicks({true, facts.clicks}, config.labels, run_dir, diagnostics);
  SessionOptions options;
  options.trained_classes = facts.classes;
  options.trainable = false;
  options.ranks = ranks;
  options.depth = purpose == OpenFor::evaluation                                 ? DepthKept::test
                  : purpose == OpenFor::rendering || purpose == OpenFor::objects ? DepthKept::none
                                                                                 : DepthKept::all;
  options.known = facts.scene;
  options.pixels = purpose != OpenFor::rendering;
  options.instances = purpose == OpenFor::objects;
  options.labels = purpose == OpenFor::evaluation_of_training_frames;
  const bool same_scene = compare_settings_with_training(facts, config, folder, overrides, registry, diagnostics);
  Diagnostics of_scene;
  run.session = open_session(std::move(config), registry, options, of_scene);
  add_untold(of_scene, folder.findings_path(), diagnostics);
  if (same_scene) warn_of_other_inputs(facts.inputs, scene_inputs(run.session.scene, run.session.labels), diagnostics);
  warn_of_other_modules(facts.modules, run.session.config.plugins, diagnostics);
  load_pipeline(*run.session.pipeline, found.file);
  use_learned_poses(run.session, found.file, diagnostics);
  run.step = facts.step;
  run.train_s = facts.train_s;
  return run;
}

}  // namespace semfield
