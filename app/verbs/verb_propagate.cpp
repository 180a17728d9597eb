// propagate: training labels of a run spread over the surface that it has learned, written as soft labels and scored.
#include <fmt/format.h>

#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "run/run_scores.h"
#include "surface/fuse/fusion.h"

namespace semfield::app {

namespace {

struct PropagateOptions {
  std::string run, out;
  std::vector<std::string> set;
};

std::string method_name(const PropagationParams& params) {
  return std::string(ChoiceNames<PropagationMethod>::names[static_cast<std::size_t>(params.method)]);
}

// Labels as they were and as they became: of all training pixels, and against the scene's own.
struct Worth {
  double share = 0;
  std::optional<double> accuracy, miou_present;
};

Worth worth_of_given(const Session& s) {
  const ConfusionMatrix score = score_training_labels(s, s.scene.frames_of(Split::train));
  std::int64_t labelled = 0;
  for (const int f : s.scene.frames_of(Split::train)) {
    const std::vector<std::int64_t>& counts = s.labels.class_pixels[static_cast<std::size_t>(f)];
    for (std::size_t c = 0; c + 1 < counts.size(); ++c) labelled += counts[c];
  }
  return {static_cast<double>(labelled) / static_cast<double>(s.manifest.train_pixels), score.total_accuracy(),
          score.miou_present()};
}

void print_worth(const AppContext& context, const PropagateOptions& options, const PropagationParams& params,
                 const Worth& before, const Worth& after) {
  const auto pair = [](Json a, Json b) { return Json{{"before", std::move(a)}, {"after", std::move(b)}}; };
  print_results(
      context,
      {{"method", method_name(params)},
       {"labelled_share", pair(before.share, after.share)},
       {"accuracy", pair(number_json<Json>(before.accuracy), number_json<Json>(after.accuracy))},
       {"miou_present", pair(number_json<Json>(before.miou_present), number_json<Json>(after.miou_present))},
       {"folder", options.out}},
      fmt::format("propagate: method={} labelled_share={:.4f}->{:.4f} accuracy={}->{} miou_present={}->{} folder={}",
                  method_name(params), before.share, after.share, figure_text(before.accuracy),
                  figure_text(after.accuracy), figure_text(before.miou_present), figure_text(after.miou_present),
                  options.out));
}

int run(const PropagateOptions& options, AppContext& context) {
  refuse_used_folder(options.out);
  OpenedRun run = run_of(options.run, options.set, OpenFor::evaluation_of_training_frames, context);
  const Session& s = run.session;
  if (s.classes() == 0) {
    throw Error(ErrorKind::data, "labels.classes.none",
                options.run + ": the run's scene has no classes, so there are no labels to spread",
                "give the scene labels, see `semfield inspect`");
  }
  if (s.manifest.train_pixels == 0)
    throw Error(ErrorKind::data, "scene.split.empty", "the scene has no training frames");
  const PropagationParams& params = s.config.propagate;
  if (params.method == PropagationMethod::surface && params.cell_m == 0) {
    print_note(context,
               fmt::format("propagate.cell_m is {:.4g}: three pixels at the scene's middle depth, at least 1/500 "
                           "of its longest side",
                           default_cell_m(s.scene)));
  }
  const auto frames = static_cast<double>(s.scene.frames_of(Split::train).size());
  FrameMaps maps;
  {
    ProgressLine progress(context, "rendered");
    maps = learned_depth({run.session, run.run_dir}, s.scene, params.min_opacity,
                         [&](int done) { progress.show(done, frames); });
  }
  TrainingLabels spread;
  {
    const bool surface = params.method == PropagationMethod::surface;
    ProgressLine progress(context, surface ? "spread" : "pooled", surface ? "classes" : "sizes of cells");
    spread = propagate_labels(s.scene, s.labels, maps, params, [&](int done, int of) { progress.show(done, of); });
  }
  const DegradeReport report = write_degraded(s.scene, spread, s.config, options.out);
  print_worth(context, options, params, worth_of_given(s),
              {static_cast<double>(report.labelled_px) / static_cast<double>(s.manifest.train_pixels), report.accuracy,
               report.miou_present});
  return 0;
}

void words(VerbWords& verb, PropagateOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.required("--out FOLDER", options.out, "folder to create");
  verb.run_settings(options.set);
  verb.setting(options.set, "--method METHOD", "propagate.method",
               "surface (diffusion) or vote (pooling) (default: propagate.method)", choice_names<PropagationMethod>());
}

}  // namespace

Verb verb_propagate() {
  return make_verb<PropagateOptions>("propagate", 120, "spread training labels over the surface that a run has learned",
                                     words, run);
}

}  // namespace semfield::app
