// train: start, resume, or only say what would be done.
#include <fmt/format.h>

#include <algorithm>
#include <climits>
#include <cmath>
#include <nlohmann/json.hpp>

#include "app/app_context.h"
#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "config/config_words.h"
#include "core/error.h"
#include "core/text.h"
#include "eval/metrics.h"
#include "eval/report/report.h"
#include "train/run.h"
#include "train/run_folder.h"
#include "train/run_scores.h"

namespace semfield::app {

namespace {

struct TrainOptions : Options {
  explicit TrainOptions(const Declaration& at) : Options(at) {
    threads(set);
    setting(set, "--memory GB", "runtime.memory_gb",
            "GB that the run may use; it ends after its first steps if it holds more (default: no limit)");
    device(set);
  }
  const std::string& config = operand("[config]", "configuration file (YAML)");
  std::vector<std::string>& set = settings();
  const std::string& out = value("--out FOLDER", "run folder to create (default: runs/<name>)");
  const std::string& resume =
      value("--resume RUN", "run folder to resume; with --time or --steps it trains that much more");
  const LengthWords length = training_length();
  const std::vector<std::string>& keep = repeated("--keep COMPONENT", "keep a component that would be left out");
  const bool& weak = flag("--weak", "under mpirun or srun: train.rays in each process, not in all together");
  const bool& flat = flag("--no-3d", "write a report without the view in 3D");
  const bool& dry_run = flag("--dry-run", "print the plan of the training, then stop");
};

std::optional<double> score_named(const TrainOutcome& outcome, std::string_view name) {
  for (const auto& [key, value] : outcome.values)
    if (key == name) return value;
  return {};
}

// What was reached, how sure that is, where to look, and whether to train on.
std::string outcome_text(const TrainOutcome& outcome, const std::vector<MetricsRow>& rows) {
  constexpr std::pair<double, const char*> kLevels[] = {{20, "which is far off"},
                                                        {kShown_db, "which is blurred"},
                                                        {30, "which shows the scene clearly"},
                                                        {INFINITY, "with fine detail"}};
  std::string text = fmt::format("Trained {} steps in {}.", outcome.step, clock_text(outcome.train_s));
  if (const std::optional<double> psnr_db = score_named(outcome, "psnr")) {
    const std::vector<double>& frames = outcome.frame_psnr_db;
    const auto* level =
        std::find_if(std::begin(kLevels), std::end(kLevels), [&](const auto& l) { return *psnr_db < l.first; });
    text += fmt::format(" Held-out views match their photographs to {:.1f} dB, {}", *psnr_db, level->second);
    text +=
        frames.size() < 2 ? "." : fmt::format("; single ones to {:.1f} to {:.1f} dB.", frames.front(), frames.back());
    if (const std::optional<double> right = score_named(outcome, "total_accuracy"))
      text += fmt::format(" {:.1f} % of their labels are right (mIoU {}).", 100 * *right,
                          figure_text(score_named(outcome, "miou_present")));
    text += " Measured on " + outcome.scored.text() + ".";
    if (const std::optional<Outlook> more = outlook(rows, outcome.train_s, *psnr_db))
      text += fmt::format(
          "\nThat is too brief to show. By its own curve, {0} more bring about {1:.1f} dB:\n"
          "`semfield train --resume {2} --time {0}`",
          more->more_s < 90 ? fmt::format("{:.0f}s", std::ceil(more->more_s))
                            : fmt::format("{:.0f}m", std::ceil(more->more_s / 60)),
          more->gain_db, shell_word(outcome.run_dir));
  }
  return text + (outcome.report_path.empty() ? "" : "\nLook at " + outcome.report_path + " first.");
}

// The figures that the scene can have, a blank behind each. Those of a part of the test frames have names of their own,
// so that nobody takes them for those of all.
std::string scores_text(const TrainOutcome& outcome) {
  const ScoredPart& part = outcome.scored;
  const bool whole = part.frames == 0 || part.whole();
  std::string text = whole ? "" : fmt::format("sample={}/{} ", part.frames, part.of);
  if (part.stride > 1) text += fmt::format("sample_pixels=1/{} ", part.stride * part.stride);
  const std::pair<const char*, const char*> figures[] = {{"miou_present", "{:.4f}"},
                                                         {"total_accuracy", "{:.4f}"},
                                                         {"psnr", "{:.2f}"},
                                                         {"psnr_fitted_colors", "{:.2f}"},
                                                         {"absrel", "{:.4f}"}};
  for (const auto& [name, format] : figures) {
    if (const std::optional<double> value = score_named(outcome, name))
      text += fmt::format("{}{}={} ", whole ? "" : "sample_", name, fmt::format(fmt::runtime(format), *value));
  }
  return text;
}

Json outcome_json(const TrainOutcome& outcome) {
  Json out{{"run", outcome.run_dir},
           {"step", outcome.step},
           {"train_s", outcome.train_s},
           {"trained_s", outcome.trained_s},
           {"peak_mb", outcome.peak_bytes >> 20},
           {"report", outcome.report_path},
           {"scored",
            {{"frames", outcome.scored.frames},
             {"split_frames", outcome.scored.of},
             {"pixel_stride", outcome.scored.stride}}}};
  for (const auto& [name, value] : outcome.values) out["values"][name] = number_json<Json>(value);
  return out;
}

std::vector<LinePart> progress_parts(const TrainProgress& p) {
  std::vector<LinePart> parts{{0, fmt::format("step {}{}", p.step, p.steps > 0 ? fmt::format("/{}", p.steps) : "")},
                              {2, fmt::format("  loss {:.4f}", p.loss)}};
  for (const auto& [type, value] : p.terms) parts.push_back({7, fmt::format("  {} {:.4f}", type, value)});
  parts.push_back({3, fmt::format("  train psnr {:.2f} dB", p.psnr)});
  if (p.miou_present) {
    parts.push_back({4, fmt::format("  miou_present {:.3f}", *p.miou_present)});
    parts.push_back({8, fmt::format(" ({})", p.scored.text())});
  }
  parts.push_back({6, fmt::format("  {:.0f} rays/s", p.rays_per_s)});
  parts.push_back({5, fmt::format("  {} elapsed", clock_text(p.train_s))});
  parts.push_back({1, fmt::format("  {} left", clock_text(p.remaining_s))});
  return parts;
}

// A run as the terminal shows it, and what signals request of it.
class ShownRun final : public RunListener {
 public:
  /// `scene`: the configuration, as a shell reads it.
  ShownRun(const AppContext& context, std::string out_dir, std::string scene, bool flat)
      : context_(context), out_dir_(std::move(out_dir)), scene_(std::move(scene)), flat_(flat) {}

  void note(const std::string& text) override { print_note(context_, text); }
  void warning(const std::string& text) override { print_note(context_, "warning: " + text); }
  void opened(const Diagnostics& diagnostics, const Session& session) override {
    if (!context_.terminal) return RunListener::opened(diagnostics, session);
    print_findings(context_, diagnostics, scene_);
    if (const std::size_t chosen = session.choices().size(); chosen > 0)
      print_note(context_,
                 fmt::format("{} settings suit this scene and machine; `semfield train {} --dry-run` lists them",
                             chosen, scene_));
  }
  void progress(const TrainProgress& p) override {
    scoring_.reset();  // one that a stop cut short
    if (!context_.quiet) print_progress(p);
  }
  void scoring(const ScoreProgress& p) override {
    if (!scoring_) scoring_.emplace(context_, fmt::format("scored {}", p.split));
    scoring_->show(p.done, static_cast<double>(p.frames));
    if (p.done >= static_cast<double>(p.frames)) scoring_.reset();
  }
  int stop_signal() override { return app::stop_signal(); }
  bool save_request() override { return take_save_request(); }
  void stop_waits(bool waits) override {
    app::stop_waits(waits,
                    "stopped; every step is saved; resume with `semfield train --resume " + shell_word(out_dir_) + "`");
  }
  std::string write_report(const RunFolder& folder, const Session& session, const ReportFrames& frames) override {
    std::string scene;
    const std::vector<CheckpointStore::Entry> saved = CheckpointStore::read(folder.checkpoints_path()).list();
    if (!flat_ && !context_.ranks && !saved.empty())
      scene = report_scene(session, folder.path(), saved.front().step, context_);
    return write_run_report(folder, session, frames, scene);
  }

 private:
  // One line that is overwritten on a terminal; plain lines elsewhere, about one every two seconds.
  void print_progress(const TrainProgress& p) {
    if (context_.terminal) return show_live(fitted(progress_parts(p), terminal_columns() - 1));
    if (p.train_s < next_line_s_ && p.step != p.steps) return;
    next_line_s_ = p.train_s + 2;
    say(fitted(progress_parts(p), INT_MAX), false);
  }

  const AppContext& context_;
  std::string out_dir_, scene_;
  bool flat_;
  double next_line_s_ = 0;
  std::optional<ProgressLine> scoring_;
};

int run(const TrainOptions& options, AppContext& context) {
  const bool resume = !options.resume.empty();
  if (resume == !options.config.empty()) {
    throw Error(ErrorKind::usage, "usage.flag.conflict", "train: expected either a configuration file or --resume RUN",
                "see `semfield train --help`");
  }
  const AskedLength asked = asked_length(options.length);
  if (options.weak && resume)
    throw Error(ErrorKind::usage, "usage.flag.conflict",
                "train: --weak multiplies the rays of a new run, and a resumed one keeps its own", "leave out --weak");
  const std::string config_file = resume ? RunFolder::read(options.resume).config_path() : options.config;
  RunConfig config = load_run_config(config_file, options.set, context.registry);
  if (!resume && asked.any()) ask(config, asked);
  if (options.weak && context.ranks) config.train.rays *= context.ranks->size();
  if (options.dry_run) {
    Diagnostics diagnostics;
    SessionOptions session_options;
    session_options.keep = options.keep;
    const Session session = open_session(std::move(config), context.registry, session_options, diagnostics);
    print_findings(context, diagnostics, shell_word(config_file));
    const std::string plan = describe_session(session);
    Json found{{"plan", Json::array()}, {"left_out", Json::parse(left_out_json(session.plan.left_out))}};
    std::string_view lines = plan, line;
    while (next_line(lines, line)) found["plan"].push_back(line);
    print_results(context, found, plan);
    return 0;
  }
  TrainRequest request{.driver = Driver::command};
  request.resume = resume;
  if (resume) request.more = asked;
  request.keep = options.keep;
  request.ranks = context.ranks.get();
  request.out_dir = resume ? options.resume : !options.out.empty() ? options.out : "runs/" + config.name;
  ShownRun shown(context, request.out_dir, shell_word(config_file), options.flat);
  install_stop_signals(!context.quiet);
  install_save_signal();
  stop_waits(false, "stopped before the first step");
  const TrainOutcome outcome = Run(std::move(config), context.registry, request, &shown).finish();
  clear_live();
  if (outcome.signal != 0) {
    print_note(context, fmt::format("stopped at step {} after its checkpoint; resume with `semfield train --resume {}`",
                                    outcome.step, shell_word(outcome.run_dir)));
    return 128 + outcome.signal;
  }
  if (outcome.scored.frames == 0)
    print_note(context, "the scene has no test frames, so the field was not scored; see `semfield inspect`");
  print_note(context, outcome_text(outcome, read_metrics(RunFolder::read(outcome.run_dir).metrics_path())));
  print_results(
      context, outcome_json(outcome),
      fmt::format("train: {}train_s={:.1f} trained_s={:.1f} steps={} peak_mb={} report={}", scores_text(outcome),
                  outcome.train_s, outcome.trained_s, outcome.step, outcome.peak_bytes >> 20, outcome.report_path));
  print_next(context, next_of_run(outcome.run_dir, outcome.scored.frames > 0));
  return 0;
}

}  // namespace

Verb verb_train() {
  return make_verb<TrainOptions>("train", 10, "train a field on a scene; writes a run folder",
                                 {"configs/my_photos.yaml --time 10m", "--resume runs/my_photos --time 10m"}, run,
                                 Launch::ranks);
}

}  // namespace semfield::app
