// eval: metrics of a split as a table or one JSON object.
#include <fmt/format.h>

#include <cmath>
#include <cstdio>
#include <nlohmann/json.hpp>

#include "train/train_run.h"
#include "verbs.h"

namespace semfield::app {

namespace {

Split split_of(const std::string& name) {
  if (name == "test") return Split::test;
  if (name == "train") return Split::train;
  throw Error(ErrorKind::usage, "--split " + name + ": expected train or test");
}

void print_json(const OpenedRun& run, const SplitScore& score, const std::string& split) {
  nlohmann::ordered_json out;
  out["run"] = run.run_dir;
  out["split"] = split;
  out["step"] = run.step;
  out["train_s"] = run.train_s;
  out["frames"] = score.frames.size();
  for (const auto& [name, value] : score.values()) {
    if (value && std::isfinite(*value)) {
      out[name] = *value;
    } else {
      out[name] = value ? nlohmann::ordered_json("inf") : nlohmann::ordered_json(nullptr);
    }
  }
  const std::vector<ClassScore> classes = score.confusion.per_class();
  for (std::size_t c = 0; c < classes.size(); ++c) {
    nlohmann::ordered_json& slot = out["per_class_iou"][run.session.scene.info.classes.valid(static_cast<int>(c)).name];
    if (classes[c].iou)
      slot = *classes[c].iou;
    else
      slot = nullptr;
  }
  std::printf("%s\n", out.dump().c_str());
}

}  // namespace

int run_eval(const EvalOptions& options, AppContext& context) {
  const Split split = split_of(options.split);
  Diagnostics diagnostics;
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics,
                           split == Split::test ? OpenFor::evaluation : OpenFor::evaluation_of_training_frames);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.text());
  Session& s = run.session;
  const std::vector<int> frames = s.scene.frames_of(split);
  if (frames.empty())
    throw Error(ErrorKind::data, options.run + ": the scene has no frames in split '" + options.split + "'",
                "see `semfield inspect`");
  const SplitScore score = evaluate(*s.pipeline, s.eval_job(frames), s.limits, s.plan.class_of_logit);
  if (context.json) {
    print_json(run, score, options.split);
    return 0;
  }
  std::printf("%s: %zu %s frames, step %lld, %.1f s of training\n", options.run.c_str(), score.frames.size(),
              options.split.c_str(), static_cast<long long>(run.step), run.train_s);
  for (const auto& [name, value] : score.values())
    std::printf("  %-18s %s\n", name.c_str(), value ? fmt::format("{:.4f}", *value).c_str() : "no data");
  const std::vector<ClassScore> classes = score.confusion.per_class();
  if (!classes.empty()) std::printf("  %-18s %8s %8s %10s\n", "class", "iou", "recall", "pixels");
  for (std::size_t c = 0; c < classes.size(); ++c) {
    const ClassScore& k = classes[c];
    if (k.truth_px == 0 && k.predicted_px == 0) continue;
    std::printf("  %-18s %8s %8s %10lld\n", s.scene.info.classes.valid(static_cast<int>(c)).name.c_str(),
                k.iou ? fmt::format("{:.4f}", *k.iou).c_str() : "-",
                k.recall ? fmt::format("{:.4f}", *k.recall).c_str() : "-", static_cast<long long>(k.truth_px));
  }
  return 0;
}

}  // namespace semfield::app
