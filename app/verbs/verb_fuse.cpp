// fuse: predictions of a scene's training frames combined over views, scored, and written as maps. propagate: training
// labels of a run spread over the surface that it has learned, written as soft labels and scored.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "config/config_tree.h"
#include "config/params.h"
#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/label_files.h"
#include "run/run_scores.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "surface/fuse/fusion.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct FuseOptions : Options {
  explicit FuseOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& config = operand("config", "configuration file (YAML)");
  std::vector<std::string>& set = settings();
  const std::vector<std::string>& methods =
      list("--method LIST", "ways to combine, with commas (default: fuse.methods)", choice_names<FusionMethod>());
  const std::string& depth = choice("--depth DEPTH", "", {"true", "learned"}, "true or learned (default: fuse.depth)");
  const std::string& depth_from =
      value("--depth-from RUN", "run folder whose field gives depth, and another row of labels");
  const std::string& out = value("--out FOLDER", "folder for the fused maps and fuse.json");
};

// The words of the command line over the section `fuse`.
void apply(const FuseOptions& options, FusionParams& params) {
  if (!options.methods.empty()) params.methods = options.methods;
  if (!options.depth.empty()) params.depth = options.depth == "true" ? FusionDepth::truth : FusionDepth::learned;
  if (!options.depth_from.empty()) {
    if (options.depth == "true")
      throw Error(ErrorKind::usage, "usage.flag.conflict", "--depth true and --depth-from exclude each other",
                  "drop one of them");
    params.depth = FusionDepth::learned;
  }
  if (params.depth == FusionDepth::learned && options.depth_from.empty())
    throw Error(ErrorKind::usage, "usage.flag.missing", "learned depth is asked for, and no run is named",
                "name its folder: --depth-from RUN");
}

Json scores_json(const SceneFusion& fusion, const FusionParams& params) {
  Json rows = Json::array();
  for (const FusionScore& score : fusion.scores) {
    rows.push_back({{"method", score.method},
                    {"depth", choice_name(params.depth)},
                    {"miou", number_json<Json>(score.confusion.miou())},
                    {"miou_present", number_json<Json>(score.confusion.miou_present())},
                    {"total_accuracy", number_json<Json>(score.confusion.total_accuracy())},
                    {"average_accuracy", number_json<Json>(score.confusion.average_accuracy())},
                    {"visible_views_mean", number_json<Json>(score.views_mean)},
                    {"scored_px", score.confusion.scored_px()},
                    {"void_predicted_px", score.confusion.void_predicted_px()}});
  }
  return rows;
}

// Maps of one folder: OUT/METHOD/FRAME_label.png, of images as viewers show them, readable again
// as label images through the class table beside them.
class MapWriter {
 public:
  MapWriter(std::string folder, const SceneInfo& info)
      : folder_(std::move(folder)), info_(info), classes_(with_void(info.classes.entries())) {
    refuse_used_folder(folder_);
    create_output_folder(folder_);
    write_file_atomic((fs::path(folder_) / "classes.yaml").string(), classes_.to_yaml());
  }
  void write(const std::string& method, int frame, const std::vector<std::int16_t>& label) const {
    const FrameInfo& info = info_.frames[static_cast<std::size_t>(frame)];
    const std::string stem = output_name(info.name);
    const fs::path folder = fs::path(folder_) / method;
    create_output_folder(folder);
    const Camera shown = as_shown(info).camera;
    const MapSize size{shown.width_px, shown.height_px};
    const std::vector<std::int16_t> drawn =
        as_shown(label, info.camera.width_px, info.camera.height_px, info.orientation);
    write_label_ids((folder / (stem + "_label.png")).string(), size, drawn, classes_);
    write_label_colors((folder / (stem + "_label_vis.png")).string(), size, drawn, classes_);
  }
  void write_manifest(const Json& manifest) const {
    write_file_atomic((fs::path(folder_) / "fuse.json").string(), json_text(manifest, 1) + "\n");
  }

 private:
  std::string folder_;
  const SceneInfo& info_;
  ClassTable classes_;  // with an id for void
};

Json manifest_of(const Session& s, const FusionParams& params, const FrameMaps& maps, const SceneFusion& fusion) {
  Json out;
  out["format"] = "semfield-fuse-1";
  out["scene"] = s.scene.info.name;
  out["frames"] = maps.frames.size();
  out["labels_from"] = s.config.labels.from.type.empty() ? "scene" : s.config.labels.from.type;
  out["degrade"] = Json::array();
  for (const TrainingLabels::Step& step : s.labels.steps) {
    Json facts = {{"type", step.type}};
    for (const auto& [name, value] : step.facts) facts[name] = value;
    out["degrade"].push_back(facts);
  }
  FusionParams written = params;
  out["parameters"] = write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, written); }));
  out["pixels"] = fusion.counts.pixels;
  out["without_depth_px"] = fusion.counts.without_depth;
  out["without_prediction_px"] = fusion.counts.unlabelled;
  out["filled_px"] = fusion.counts.filled;
  out["scores"] = scores_json(fusion, params);
  return out;
}

void print_scores(const SceneFusion& fusion, const FusionParams& params) {
  const FusionCounts& counts = fusion.counts;
  for (const FusionScore& score : fusion.scores) {
    const ConfusionMatrix& m = score.confusion;
    const bool fused = score.method != "monocular" && score.method != "field";
    std::printf(
        "fuse: method=%s depth=%s miou_present=%s miou=%s total_accuracy=%s average_accuracy=%s filled=%lld "
        "views=%s\n",
        score.method.c_str(), choice_name(params.depth).c_str(), figure_text(m.miou_present(), "none").c_str(),
        figure_text(m.miou(), "none").c_str(), figure_text(m.total_accuracy(), "none").c_str(),
        figure_text(m.average_accuracy(), "none").c_str(), static_cast<long long>(fused ? counts.filled : 0),
        figure_text(score.views_mean, "none").c_str());
  }
}

int run(const FuseOptions& options, AppContext& context) {
  Diagnostics diagnostics;
  std::optional<OpenedRun> run;
  RunConfig config = load_run_config(options.config, options.set, context.registry);
  context.adopt(config);
  apply(options, config.fuse);
  if (config.fuse.depth == FusionDepth::learned)
    run = open_run(options.depth_from, {}, context.registry, diagnostics, OpenFor::rendering);
  SessionOptions opening;
  opening.build = false;
  opening.depth = DepthKept::all;
  const Session s = open_session(std::move(config), context.registry, opening, diagnostics);
  print_findings(context, diagnostics);
  if (s.classes() == 0)
    throw Error(ErrorKind::data, "labels.classes.none", "the scene has no classes, so there is nothing to fuse",
                "see `semfield inspect`");
  if (!s.config.labels.from.reader && s.config.labels.degrade.empty())
    print_note(context, "predictions are the scene's own labels: name others in scene.labels.from or .degrade");
  const FusionParams params = settled(s.config.fuse, s.scene);

  const auto frames = static_cast<double>(s.scene.frames_of(Split::train).size());
  if (frames == 0)
    throw Error(ErrorKind::data, "scene.split.empty", "the scene has no training frames", "see `semfield inspect`");
  ProgressLine progress(context, "rendered");
  const FrameMaps maps = run ? learned_depth({run->session, run->run_dir}, s.scene, params.min_opacity,
                                             [&](int done) { progress.show(done, frames); })
                             : true_depth(s.scene);
  progress.restart("fused");
  if (run && run->session.pipeline->has_semantics() && maps.label.front().empty())
    print_note(context, options.depth_from + ": another class table, so the field's own labels are not scored");
  std::optional<MapWriter> writer;
  if (!options.out.empty()) writer.emplace(options.out, s.scene.info);
  const SceneFusion fusion =
      fuse_scene(s.scene, s.labels, maps, params,
                 [&](const std::string& method, int frame, const std::vector<std::int16_t>& label) {
                   if (writer) writer->write(method, frame, label);
                   const auto done = std::find(maps.frames.begin(), maps.frames.end(), frame) - maps.frames.begin() + 1;
                   progress.show(done, frames);
                 });
  if (writer) {
    Json manifest = manifest_of(s, params, maps, fusion);
    if (run) manifest["depth_from"] = {{"run", run->run_dir}, {"step", run->step}, {"train_s", run->train_s}};
    writer->write_manifest(manifest);
  }
  if (context.json) {
    print_json(context, {{"scores", scores_json(fusion, params)}});
  } else {
    print_scores(fusion, params);
  }
  return 0;
}

struct PropagateOptions : Options {
  explicit PropagateOptions(const Declaration& at) : Options(at) {
    setting(set, "--method METHOD", "propagate.method",
            "surface (diffusion) or vote (pooling) (default: propagate.method)", choice_names<PropagationMethod>());
  }
  const std::string& run = operand("run", "run folder");
  const std::string& out = required("--out FOLDER", "folder to create");
  std::vector<std::string>& set = run_settings();
};

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
      {{"method", choice_name(params.method)},
       {"labelled_share", pair(before.share, after.share)},
       {"accuracy", pair(number_json<Json>(before.accuracy), number_json<Json>(after.accuracy))},
       {"miou_present", pair(number_json<Json>(before.miou_present), number_json<Json>(after.miou_present))},
       {"folder", options.out}},
      fmt::format("propagate: method={} labelled_share={:.4f}->{:.4f} accuracy={}->{} miou_present={}->{} folder={}",
                  choice_name(params.method), before.share, after.share, figure_text(before.accuracy),
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

}  // namespace

Verb verb_fuse() {
  return make_verb<FuseOptions>("fuse", 110, "combine predictions of several views by depth, and score them", run);
}

Verb verb_propagate() {
  return make_verb<PropagateOptions>("propagate", 120, "spread training labels over the surface that a run has learned",
                                     run);
}

}  // namespace semfield::app
