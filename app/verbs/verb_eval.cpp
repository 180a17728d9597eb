// eval: metrics of a split as a table or one JSON object.
#include <fmt/format.h>

#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/progress_line.h"
#include "app/verb.h"
#include "core/findings.h"
#include "eval/final_eval.h"
#include "eval/json_number.h"
#include "run/open_run.h"
#include "session/refined_poses.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct EvalOptions {
  std::string run, out;
  std::string split = "test";
  bool refine_poses = false, fit_colors = false;
  std::vector<std::string> set;
};

Json results(const OpenedRun& run, const SplitScore& score, const std::string& split) {
  const ClassTable& table = run.session.scene.info.classes;
  Json out;
  out["run"] = run.run_dir;
  out["split"] = split;
  out["step"] = run.step;
  out["train_s"] = run.train_s;
  out["frames"] = score.frames.size();
  for (const auto& [name, value] : score.values()) out[name] = number_json<Json>(value);
  const std::vector<ClassScore> classes = score.confusion.per_class();
  for (std::size_t c = 0; c < classes.size(); ++c)
    out["per_class_iou"][table.valid(static_cast<int>(c)).name] = number_json<Json>(classes[c].iou);
  // Confusion matrix, reliability bins and scores of every frame, as in a run folder's final_eval.json.
  FinalEval detail = final_eval(score, table, split);
  detail.step = run.step;
  detail.train_s = run.train_s;
  out.update(Json::parse(final_eval_json(detail)));
  return out;
}

SplitScore score_frames(const Session& s, const EvalOptions& options, const std::vector<int>& frames,
                        const AppContext& context, const std::vector<FrameInfo>* infos = nullptr) {
  EvalJob job = s.eval_job(frames);
  if (infos != nullptr) job.infos = infos;
  job.fit_colors = options.fit_colors;
  if (options.split == "train") job.given = &s.labels;
  ProgressLine progress(context, "scored");
  job.progress = [&](double done) { progress.show(done, static_cast<double>(frames.size())); };
  return evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
}

int run(const EvalOptions& options, AppContext& context) {
  const Split split = options.split == "test" ? Split::test : Split::train;
  Diagnostics diagnostics;
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics,
                           split == Split::test ? OpenFor::evaluation : OpenFor::evaluation_of_training_frames,
                           context.ranks.get());
  context.adopt(run.session.config);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.shown());
  Session& s = run.session;
  const std::vector<int> frames = s.scene.frames_of(split);
  if (frames.empty())
    throw Error(ErrorKind::data, "scene.split.empty",
                options.run + ": the scene has no frames in split '" + options.split + "'", "see `semfield inspect`");
  const SplitScore score = score_frames(s, options, frames, context);
  Json found = results(run, score, options.split);
  std::optional<SplitScore> refined;
  if (options.refine_poses) {
    std::vector<FrameInfo> infos = s.scene.info.frames;
    const std::vector<Pose> poses = refine_poses(s, context.registry, frames);
    for (std::size_t i = 0; i < frames.size(); ++i)
      infos[static_cast<std::size_t>(frames[i])].world_from_camera = poses[i];
    refined = score_frames(s, options, frames, context, &infos);
    for (const auto& [name, value] : refined->values()) found["refined_poses"][name] = number_json<Json>(value);
  }
  if (!options.out.empty()) write_file_atomic(options.out, json_object(context, found));
  if (context.json) {
    print_json(context, found);
    return 0;
  }
  std::printf("%s: %zu %s frames, step %lld, %.1f s of training\n", options.run.c_str(), score.frames.size(),
              options.split.c_str(), static_cast<long long>(run.step), run.train_s);
  for (const auto& [name, value] : score.values())
    std::printf("  %-20s %s\n", name.c_str(), value ? fmt::format("{:.4f}", *value).c_str() : "no data");
  if (refined)
    for (const auto& [name, value] : refined->values())
      std::printf("  %-20s %s with refined poses\n", name.c_str(),
                  value ? fmt::format("{:.4f}", *value).c_str() : "no data");
  if (const std::string warning = score.resolution.warning(); !warning.empty())
    print_note(context, "warning: " + warning);
  if (split == Split::train) {
    const ConfusionMatrix given = score_training_labels(s, frames);
    if (given.scored_px() > 0)
      std::printf("  %-20s miou_present %.4f, total_accuracy %.4f over %lld pixels\n", "labels given",
                  *given.miou_present(), *given.total_accuracy(), static_cast<long long>(given.scored_px()));
  }
  const std::vector<ClassScore> classes = score.confusion.per_class();
  if (!classes.empty()) std::printf("  %-20s %8s %8s %10s\n", "class", "iou", "recall", "pixels");
  for (std::size_t c = 0; c < classes.size(); ++c) {
    const ClassScore& k = classes[c];
    if (k.truth_px == 0 && k.predicted_px == 0) continue;
    std::printf("  %-20s %8s %8s %10lld\n", s.scene.info.classes.valid(static_cast<int>(c)).name.c_str(),
                k.iou ? fmt::format("{:.4f}", *k.iou).c_str() : "-",
                k.recall ? fmt::format("{:.4f}", *k.recall).c_str() : "-", static_cast<long long>(k.truth_px));
  }
  return 0;
}

void words(VerbWords& verb, EvalOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.choice("--split SPLIT", options.split, {"test", "train"}, "frames to score");
  verb.value("--out FILE", options.out, "also write the JSON object to this file");
  verb.flag("--refine-poses", options.refine_poses,
            "score once more with poses of the frames fitted to the field, where they are not given to a pixel");
  verb.flag("--fit-colors", options.fit_colors,
            "score colours once more, each half of a frame under the map of colours that fits the other half");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_eval() {
  return with_launch(Launch::ranks,
                     with_json(make_verb<EvalOptions>("eval", 20, "evaluate a run's field on a split", words, run)));
}

}  // namespace semfield::app
