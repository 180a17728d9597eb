// labels fuse, propagate, export, classes: labels combined over views, spread, and handed to labelling tools.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>

#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "config/config_tree.h"
#include "core/error.h"
#include "core/files.h"
#include "eval/image_output.h"
#include "eval/photo_edges.h"
#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/label_export.h"
#include "labels/label_files.h"
#include "labels/mask_outlines.h"
#include "labels/serve/view_pictures.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "surface/fuse/fusion.h"
#include "train/opened_run.h"
#include "train/run_folder.h"

namespace semfield::app {

// fuse: predictions of a scene's training frames combined over views, scored, and written as maps. propagate: training
// labels of a run spread over the surface that it has learned, written as soft labels and scored.

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

std::string scores_text(const SceneFusion& fusion, const FusionParams& params) {
  const auto figure = [](const std::optional<double>& value) { return figure_text(value, "none"); };
  std::string lines;
  for (const FusionScore& score : fusion.scores) {
    const ConfusionMatrix& m = score.confusion;
    const bool fused = score.method != "monocular" && score.method != "field";
    lines += fmt::format(
        "fuse: method={} depth={} miou_present={} miou={} total_accuracy={} average_accuracy={} filled={} views={}\n",
        score.method, choice_name(params.depth), figure(m.miou_present()), figure(m.miou()), figure(m.total_accuracy()),
        figure(m.average_accuracy()), fused ? fusion.counts.filled : 0, figure(score.views_mean));
  }
  return lines;
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
  print_results(context, {{"scores", scores_json(fusion, params)}}, scores_text(fusion, params));
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

Verb verb_labels() { return make_group("labels", 100, "write labels: degraded, combined, spread, for other tools"); }

Verb verb_labels_fuse() {
  return make_verb<FuseOptions>("labels fuse", 20, "combine predictions of several views by depth, and score them",
                                {"configs/my_photos.yaml", "configs/my_photos.yaml --method bayesian --out fused"},
                                run);
}

Verb verb_labels_propagate() {
  return make_verb<PropagateOptions>("labels propagate", 30,
                                     "spread training labels over the surface that a run has learned",
                                     {"runs/my_photos --out spread", "runs/my_photos --method vote --out voted"}, run);
}

// export: label maps of a run's field for labelling tools.

namespace {

struct ExportVerbOptions : Options {
  using Options::Options;
  const std::string& run = operand("run", "run folder");
  const std::string& split = choice("--split SPLIT", "test", {"test", "train"}, "frames to export");
  const std::string& format = choice(
      "--format FORMAT", "coco", {"coco", "coco_rle", "labelme", "png"},
      "coco (polygons), coco_rle (run lengths), labelme, or png (label images with class ids, and classes.yaml)");
  const std::string& size = choice(
      "--size SIZE", "stored", {"stored", "trained"},
      "size of the labels, which cling to the edges of the photographs: stored, that of the images in their files; or "
      "trained, the size at which the run loads them");
  const std::optional<long long>& min_area = value_in<std::optional<long long>>(
      "--min-area N", {}, 0, 1e9,
      "merge regions of fewer pixels into the class around them; 0: none (default: 1/4096 of an image's pixels)");
  const std::string& out = required("--out PATH", "file to write for COCO, folder for labelme and png");
  const std::vector<std::string>& set = run_settings();
};

constexpr std::int64_t kPixelsOfARegion = 4096;  // of an image, for one of the least region that stands by itself

// The stored image of a frame, "" when its dataset has none.
std::string image_of(const FrameInfo& info) { return is_file(info.source) ? info.source : std::string(); }

// What a frame's labels are rendered at, and what becomes of them.
class Exporter {
 public:
  Exporter(const ExportVerbOptions& options, const Session& session)
      : options_(options), session_(session), pictures_(picture_names(session.scene.info.frames)) {
    if (options.format == "coco" || options.format == "coco_rle") {
      coco_.emplace(classes(), options.format == "coco" ? CocoMasks::polygons : CocoMasks::run_lengths);
      return;
    }
    create_output_folder(options.out);
  }

  void add(int number, const std::function<void(double)>& progress) {
    const FrameInfo& info = session_.scene.info.frames[static_cast<std::size_t>(number)];
    const std::optional<StoredSize> stored = options_.size == "stored" ? stored_size_of(info) : std::nullopt;
    const Camera& camera = stored ? stored->camera : info.camera;
    FrameOptions rendering{stored ? stored->stride : 1, progress};
    rendering.probability = true;
    rendering.classes = session_.classes();
    const RenderedFrame rendered =
        render_named_frame(*session_.pipeline, info.name, {camera, info.world_from_camera, session_.plan.undistortion},
                           session_.limits, session_.plan.class_of_logit, {}, rendering);
    LabelledFrame frame{info.name, image_of(info), camera.width_px, camera.height_px, {}};
    frame.label = clinging_labels(&info, rendered, rendering.classes, camera.width_px, camera.height_px);
    for (std::int16_t& label : frame.label)
      if (label >= 0 && is_unnamed_class(classes().valid(label).name)) label = kVoid;
    const std::int64_t all = std::ssize(frame.label);
    const SmallRegions small = fill_small_regions(frame.label, frame.width_px, frame.height_px,
                                                  options_.min_area.value_or(all / kPixelsOfARegion));
    if (const std::optional<Annotations>& clicks = session_.config.labels.clicks)
      clicks->clear_ignored(number, frame.width_px, frame.height_px, frame.label);
    // Tools draw over the image as they show it.
    frame.label = as_shown(std::move(frame.label), frame.width_px, frame.height_px, info.orientation);
    if (turned_by_quarter(info.orientation)) std::swap(frame.width_px, frame.height_px);
    frame.picture = pictures_[static_cast<std::size_t>(number)];
    filled_.regions += small.regions;
    filled_.pixels += small.pixels;
    pixels_ += all;
    ++frames_;
    write(frame);
  }

  void finish() {
    if (coco_) {
      coco_->write(options_.out);
      shapes_ = coco_->annotations();
    } else if (options_.format == "png") {
      write_file_atomic((fs::path(options_.out) / "classes.yaml").string(), named_classes(classes()).to_yaml());
    }
  }
  int frames() const { return frames_; }
  std::int64_t shapes() const { return shapes_; }
  /// A sentence about regions that took the class around them; "" without any.
  std::string told() const {
    if (filled_.regions == 0) return {};
    return fmt::format(
        "{} regions of fewer than {} pixels took the class around them: {} of {} pixels", filled_.regions,
        options_.min_area ? std::to_string(*options_.min_area) : fmt::format("1/{} of an image's", kPixelsOfARegion),
        filled_.pixels, pixels_);
  }

 private:
  const ClassTable& classes() const { return session_.scene.info.classes; }
  void write(const LabelledFrame& frame) {
    if (coco_) {
      coco_->add(frame);
    } else if (options_.format == "png") {
      write_label_ids((fs::path(options_.out) / (output_name(frame.name) + "_label.png")).string(),
                      {frame.width_px, frame.height_px}, frame.label, classes());
      ++shapes_;
    } else {
      shapes_ += write_labelme(options_.out, frame, classes());
    }
  }

  const ExportVerbOptions& options_;
  const Session& session_;
  std::vector<std::string> pictures_;  // by frame
  std::optional<CocoExport> coco_;
  SmallRegions filled_;
  std::int64_t shapes_ = 0, pixels_ = 0;
  int frames_ = 0;
};

int run(const ExportVerbOptions& options, AppContext& context) {
  OpenedRun run = run_of(options.run, options.set, OpenFor::rendering, context);
  Session& s = run.session;
  if (s.plan.class_of_logit.empty())
    throw Error(ErrorKind::data, "run.semantics.none", options.run + ": the run has no semantics", "train with labels");
  const std::vector<int> frames = s.scene.frames_of(options.split == "test" ? Split::test : Split::train);
  if (frames.empty())
    throw Error(ErrorKind::data, "scene.split.empty", options.run + ": no frames in split '" + options.split + "'",
                "see `semfield inspect`");
  Exporter exporter(options, s);
  {
    ProgressLine progress(context, "exported");
    for (const int f : frames) {
      const auto part_done = [&](double share) {
        progress.show(exporter.frames() + share, static_cast<double>(frames.size()));
      };
      exporter.add(f, part_done);
    }
  }
  exporter.finish();
  if (const std::string told = exporter.told(); !told.empty()) print_note(context, told);
  print_results(context,
                {{"run", options.run},
                 {"step", run.step},
                 {"split", options.split},
                 {"frames", exporter.frames()},
                 {"shapes", exporter.shapes()},
                 {"format", options.format},
                 {"out", options.out}},
                fmt::format("export: frames={} shapes={} format={} out={}", exporter.frames(), exporter.shapes(),
                            options.format, options.out));
  return 0;
}

}  // namespace

Verb verb_labels_export() {
  return make_verb<ExportVerbOptions>("labels export", 40, "write the labels of a run's field for labelling tools",
                                      {"runs/my_photos --out labels.json", "runs/my_photos --format png --out labels"},
                                      run);
}

// classes: class tables from and to the forms of other tools.

namespace {

struct ClassesOptions : Options {
  using Options::Options;
  const std::string& in =
      operand("table", "table (.yaml, .csv, .json, CVAT's .txt, ScanNet's .tsv), or nyu13, nyu40, scannet20");
  const std::string& format =
      choice("--format FORMAT", "yaml", {"yaml", "csv", "cvat"}, "form of the table that is written");
  const std::string& ids =
      choice("--ids IDS", "raw", {"raw", "nyu40", "nyu13"}, "ids to take from ScanNet's .tsv: raw, nyu40 or nyu13");
  const std::string& colors = choice("--colors COLORS", "keep", {"keep", "pascal", "semfield"},
                                     "keep them, or pascal (VOC's bit pattern) or semfield");
  const std::string& out = value("--out FILE", "file to write (default: stdout)");
};

ClassTable table_of(const ClassesOptions& options) {
  const bool is_tsv = fs::path(options.in).extension() == ".tsv";
  if (options.ids != "raw" && !is_tsv) {
    throw Error(ErrorKind::usage, "usage.flag.conflict",
                "--ids " + options.ids + ": '" + options.in + "' is not a table of ScanNet",
                "give scannetv2-labels.combined.tsv");
  }
  const std::vector<std::string> published = published_class_names();
  const fs::path path(options.in);
  const bool is_word = !path.has_parent_path() && !path.has_extension() && !is_there(path);
  if (is_word || std::find(published.begin(), published.end(), options.in) != published.end())
    return published_classes(options.in);
  if (is_tsv) {
    return load_scannet_classes(options.in, options.ids == "raw"     ? ScannetIds::raw
                                            : options.ids == "nyu40" ? ScannetIds::nyu40
                                                                     : ScannetIds::nyu13);
  }
  return import_classes(options.in);
}

ClassTable recolored(const ClassTable& table, const std::string& colors) {
  std::vector<ClassEntry> entries = table.entries();
  for (ClassEntry& entry : entries) {
    if (colors == "pascal") entry.color = pascal_color(entry.id);
    if (colors == "semfield") entry.color = ClassTable::default_color(entry.id);
  }
  return ClassTable(std::move(entries));
}

Json classes_json(const ClassTable& table) {
  Json classes = Json::array();
  for (const ClassEntry& entry : table.entries()) {
    const std::string color = fmt::format("#{:02x}{:02x}{:02x}", entry.color[0], entry.color[1], entry.color[2]);
    classes.push_back({{"id", entry.id}, {"name", entry.name}, {"color", color}, {"ignored", entry.ignore}});
  }
  return classes;
}

int run(const ClassesOptions& options, AppContext& context) {
  const ClassTable table = recolored(table_of(options), options.colors);
  const std::string text = options.format == "yaml"  ? table.to_yaml()
                           : options.format == "csv" ? to_class_csv(table)
                                                     : to_cvat_labelmap(table);
  if (!options.out.empty()) write_file_atomic(options.out, text);
  Json out{{"classes", classes_json(table)}};
  if (!options.out.empty()) out["file"] = options.out;
  print_results(context, out,
                options.out.empty() ? text
                                    : fmt::format("classes: {} classes, {} entries, file={}", table.valid_count(),
                                                  table.entries().size(), options.out));
  return 0;
}

}  // namespace

Verb verb_labels_classes() {
  return make_verb<ClassesOptions>("labels classes", 50, "convert class tables from and to the formats of other tools",
                                   {"nyu13", "nyu40 --format csv --out classes.csv"}, run);
}

}  // namespace semfield::app
