// eval and report: what came out of training.
#include <fmt/format.h>

#include <cmath>
#include <nlohmann/json.hpp>

#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "eval/metrics.h"
#include "eval/report/report.h"
#include "train/run.h"

namespace semfield::app {

// eval: metrics of a split as a table or one JSON object.

namespace {

struct EvalOptions : Options {
  using Options::Options;
  const std::string& run = operand("run", "run folder");
  const std::string& split = choice("--split SPLIT", "test", {"test", "train"}, "frames to score");
  const std::string& protocol =
      choice("--protocol NAME", "", protocol_names(),
             "also mIoU and accuracies by the classes and void pixels of a published evaluation, with a checksum of "
             "the truth");
  const std::string& out = value("--out FILE", "also write the JSON object to this file");
  const bool& refine_poses =
      flag("--refine-poses",
           "score once more with poses of the frames fitted to the field, where they are not given to a pixel; always "
           "where the run has learned poses");
  const bool& fit_colors =
      flag("--fit-colors",
           "score colours once more, each half of a frame under the map of colours that fits the other half; always "
           "where the run has learned colours");
  const std::vector<std::string>& set = run_settings();
};

Json results(const OpenedRun& run, const SplitScore& score, const std::string& split) {
  const ClassTable& table = run.session.scene.info.classes;
  Json out;
  out["run"] = run.run_dir;
  out["split"] = split;
  out["step"] = run.step;
  out["train_s"] = run.train_s;
  out["frames"] = score.frames.size();
  out["pixels"] = score.pixels;
  for (const auto& [name, value] : score.values()) out[name] = number_json<Json>(value);
  const std::vector<ClassScore> classes = score.confusion.per_class();
  for (std::size_t c = 0; c < classes.size(); ++c)
    out["per_class_iou"][table.valid(static_cast<int>(c)).name] = number_json<Json>(classes[c].iou);
  // Confusion matrix, reliability bins and scores of every frame, as in a run folder's final_eval.json.
  out.update(Json::parse(final_eval_json(score, table, split, run.step, run.train_s)));
  return out;
}

SplitScore score_frames(const Session& s, const EvalOptions& options, const std::vector<int>& frames,
                        const AppContext& context, const std::vector<FrameInfo>* infos = nullptr) {
  EvalJob job = s.eval_job(frames);
  if (infos != nullptr) job.infos = infos;
  job.fit_colors = job.fit_colors || options.fit_colors;
  if (options.split == "train") job.given = &s.labels;
  ProgressLine progress(context, "scored");
  job.progress = [&](double done) { progress.show(done, static_cast<double>(frames.size())); };
  return evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
}

ProtocolScore score_by_protocol(const EvalOptions& options, const Session& s, const SplitScore& score) {
  if (!s.pipeline->has_semantics())
    throw Error(ErrorKind::data, "run.semantics.none",
                "--protocol " + options.protocol + ": " + options.run + " has no semantics",
                "train with labels, or leave --protocol out");
  return protocol_score(protocol_named(options.protocol), score.confusion, s.scene.info.classes);
}

Json protocol_json(const ProtocolScore& score, const Session& s, const std::vector<int>& frames) {
  Json out{{"name", score.protocol.name},
           {"cites", score.protocol.cites},
           {"frames", Json::array()},
           {"pooled", true},
           {"void", score.protocol.void_rule},
           {"void_classes", score.void_classes},
           {"truth", truth_hash(frames, s.scene.info.frames, s.scene.frames, s.scene.info.classes)},
           {"scored_px", score.scored_px},
           {"miou", number_json<Json>(score.miou)},
           {"total_accuracy", number_json<Json>(score.total_accuracy)},
           {"average_accuracy", number_json<Json>(score.average_accuracy)},
           {"classes", Json::array()}};
  for (const int f : frames) out["frames"].push_back(s.scene.info.frames[static_cast<std::size_t>(f)].name);
  for (const ProtocolClass& c : score.classes)
    out["classes"].push_back({{"name", c.name}, {"truth_px", c.truth_px}, {"iou", number_json<Json>(c.iou)}});
  return out;
}

std::string protocol_text(const Json& of) {
  const auto figure = [&](const char* key) {
    return of[key].is_null() ? std::string("-") : fmt::format("{:.4f}", of[key].get<double>());
  };
  return fmt::format("protocol: name={} miou={} total_accuracy={} average_accuracy={} frames={} classes={} truth={}\n",
                     of["name"].get<std::string>(), figure("miou"), figure("total_accuracy"),
                     figure("average_accuracy"), of["frames"].size(), of["classes"].size(),
                     of["truth"].get<std::string>());
}

// A figure as its unit asks; shares and mIoU are of 1.
std::string with_unit(const std::string& name, double value, bool metric) {
  if (name.starts_with("psnr")) return fmt::format("{:.2f} dB", value);
  if (name.ends_with("_px")) return fmt::format("{:.0f} pixels", value);
  const bool small = value != 0 && std::abs(value) < 1e-3;  // a length of a scene in another unit
  const bool length = name == "absdiff" || name == "sqrel" || name == "rmse",
             nats = name == "nll" || name.ends_with("_entropy");
  return (small ? fmt::format("{:.4g}", value) : fmt::format("{:.4f}", value)) + (length ? metric ? " m" : " units"
                                                                                  : nats ? " nats"
                                                                                         : "");
}

/// A line per value that there was something to score by; the names of the others go to `missing`.
std::string values_text(const SplitScore& score, const char* how, bool metric, std::vector<std::string>& missing) {
  std::string text;
  for (const auto& [name, value] : score.values()) {
    if (value)
      text += fmt::format("  {:<21} {}{}\n", name, with_unit(name, *value, metric), how);
    else
      missing.push_back(name);
  }
  return text;
}

int run(const EvalOptions& options, AppContext& context) {
  if (!options.protocol.empty() && options.split != "test")
    throw Error(ErrorKind::usage, "eval.protocol.split", "--protocol " + options.protocol + ": scores held-out frames",
                "leave --split out");
  const Split split = options.split == "test" ? Split::test : Split::train;
  Diagnostics diagnostics;  // whether the settings are the run's own is said there, and decides what is kept
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics,
                           split == Split::test ? OpenFor::evaluation : OpenFor::evaluation_of_training_frames,
                           context.ranks.get());
  context.adopt(run.session.config);
  print_findings(context, diagnostics);
  Session& s = run.session;
  const std::vector<int> frames = s.scene.frames_of(split);
  if (frames.empty())
    throw Error(ErrorKind::data, "scene.split.empty",
                options.run + ": the scene has no frames in split '" + options.split + "'", "see `semfield inspect`");
  const SplitScore score = score_frames(s, options, frames, context);
  Json found = results(run, score, options.split);
  if (!options.protocol.empty()) found["protocol"] = protocol_json(score_by_protocol(options, s, score), s, frames);
  std::optional<SplitScore> refined;
  if (options.refine_poses || s.config.cameras.poses == CameraTrust::learned) {
    std::vector<FrameInfo> infos = s.scene.info.frames;
    const std::vector<Pose> poses = refine_poses(s, context.registry, frames);
    for (std::size_t i = 0; i < frames.size(); ++i)
      infos[static_cast<std::size_t>(frames[i])].world_from_camera = poses[i];
    refined = score_frames(s, options, frames, context, &infos);
    for (const auto& [name, value] : refined->values()) found["refined_poses"][name] = number_json<Json>(value);
  }
  const std::string not_kept = keep_scores(run, options.split, score, refined ? &*refined : nullptr, diagnostics);
  if (!not_kept.empty()) print_note(context, "the run's folder does not keep these scores: " + not_kept);
  if (!options.out.empty()) write_file_atomic(options.out, json_object(context, found));
  const bool metric = s.scene.info.metric;
  std::vector<std::string> missing, again;
  std::string text = fmt::format("{}: {} {} frames, step {}, {:.1f} s of training\n", options.run, score.frames.size(),
                                 options.split, run.step, run.train_s);
  text += values_text(score, "", metric, missing);
  if (refined) text += values_text(*refined, " with refined poses", metric, again);
  if (!missing.empty()) text += fmt::format("  {:<21} {}\n", "no data for", join(missing));
  if (split == Split::train) {
    const ConfusionMatrix given = score_training_labels(s, frames);
    if (given.scored_px() > 0)
      text += fmt::format("  {:<21} miou_present {:.4f}, total_accuracy {:.4f} over {} pixels\n", "labels given",
                          *given.miou_present(), *given.total_accuracy(), given.scored_px());
  }
  const std::vector<ClassScore> classes = score.confusion.per_class();
  const bool has_labels = score.confusion.scored_px() > 0;
  if (has_labels) text += fmt::format("  {:<21} {:>8} {:>8} {:>10}\n", "class", "iou", "recall", "pixels");
  for (std::size_t c = 0; c < classes.size(); ++c) {
    const ClassScore& k = classes[c];
    if (k.truth_px == 0 && k.predicted_px == 0) continue;
    text += fmt::format("  {:<21} {:>8} {:>8} {:>10}\n", s.scene.info.classes.valid(static_cast<int>(c)).name,
                        figure_text(k.iou), figure_text(k.recall), k.truth_px);
  }
  if (found.contains("protocol")) text += protocol_text(found["protocol"]);
  print_results(context, found, text);
  if (context.json) return 0;
  if (!has_labels)
    print_note(context, "no frame of split '" + options.split + "' has labels to score against" +
                            (split == Split::test ? "; --split train compares with the labels given" : ""));
  if (const std::string warning = score.resolution.warning(); !warning.empty())
    print_note(context, "warning: " + warning);
  if (not_kept.empty())
    print_next(context, {{"report " + shell_word(options.run), "writes its report again, with these scores"}});
  return 0;
}

}  // namespace

Verb verb_eval() {
  return make_verb<EvalOptions>("eval", 20, "evaluate a run's field on a split, and keep the scores for its report",
                                {"runs/my_photos", "runs/my_photos --split train"}, run, Launch::ranks);
}

// report: error against run time of one or several runs, one self-contained page.

namespace {

struct ReportOptions : Options {
  using Options::Options;
  const std::vector<std::string>& runs = operands("run", "run folders");
  const bool& flat = flag("--no-3d", "leave out the view of the first run in 3D");
  const std::string& out = value("--out FILE", "file to write (default: report.html of the first run)");
};

// A report needs no scene, a view of it does: where the run does not open, the note says why.
std::string scene_of(const std::string& run_dir, AppContext& context) {
  try {
    const OpenedRun run = run_of(run_dir, {}, OpenFor::surface, context);
    return report_scene(run.session, run_dir, run.step, context);
  } catch (const Error& e) {
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

int run(const ReportOptions& options, AppContext& context) {
  const std::string path = options.out.empty() ? options.runs.front() + "/report.html" : options.out;
  const std::string data = read_report(options.runs);
  write_file_atomic(path, report_page(data, options.flat ? "" : scene_of(options.runs.front(), context)));
  print_results(context, {{"runs", options.runs}, {"file", path}},
                fmt::format("report: runs={} file={}", options.runs.size(), path));
  return 0;
}

}  // namespace

Verb verb_report() {
  return make_verb<ReportOptions>("report", 40, "write one HTML page about a run, or several side by side",
                                  {"runs/my_photos", "runs/my_photos runs/my_clicks --out both.html"}, run);
}

}  // namespace semfield::app
