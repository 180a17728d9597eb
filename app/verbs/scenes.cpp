// init, inspect, prepare: a scene looked at, configured and made; pack, labels degrade: written in other forms.
#include <fmt/format.h>

#include <numeric>
#include <set>

#include "app/child_process.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "config/config_words.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "scene/camera_rig.h"
#include "scene/loading/capture/fix_cameras.h"
#include "scene/loading/capture/prepare.h"

namespace semfield::app {

// init: looks at the folder of a scene and writes the configuration that trains on it. inspect: what a scene holds, and
// what training would find wrong with it.

namespace {

// The dataset that a configuration names: the verb works under its limits from here on.
struct OpenedDataset {
  RunConfig config;
  std::unique_ptr<Dataset> dataset;
};

OpenedDataset dataset_of(RunConfig config, AppContext& context) {
  OpenedDataset opened;
  opened.config = std::move(config);
  context.adopt(opened.config);
  DatasetBuild build;
  build.config_dir = opened.config.base_dir;
  opened.dataset = opened.config.dataset.entry->dataset(*opened.config.dataset.params, build);
  return opened;
}

OpenedDataset dataset_of(const std::string& config, const std::vector<std::string>& set, AppContext& context) {
  return dataset_of(load_run_config(config, set, context.registry), context);
}

// The same of a tree that no file holds.
OpenedDataset dataset_of(const ConfigNode& tree, const std::vector<std::string>& set, AppContext& context) {
  return dataset_of(run_config_of(compose_config_tree(tree, parse_overrides(set)), context.registry), context);
}

// The scene with what its label steps require.
LoadedScene load_for_labels(OpenedDataset& opened, Diagnostics& diagnostics) {
  SceneLoadOptions load = opened.config.load;
  load.depth = opened.config.labels.wants_depth() ? DepthKept::all : DepthKept::none;
  load.with_instances = opened.config.labels.needs_instances();
  LoadedScene scene = load_scene(*opened.dataset, load, diagnostics);
  open_label_files(scene, opened.config.labels, diagnostics);
  return scene;
}

struct InitOptions : Options {
  using Options::Options;
  const std::string& folder = operand("folder", "folder of the scene, or an index in it");
  const std::string& out = value("--out FILE", "configuration to write (default: configs/<folder>.yaml)");
  const std::string& type = value("--type DATASET", "dataset that is to read it, where several could");
  const bool& replace = flag("--replace", "write over a configuration that is there");
};

// As the file at `file` may say it: relative to its folder, unless that leads far up.
std::string path_from(const fs::path& file, const std::string& absolute) {
  constexpr int kMostUp = 4;
  const fs::path relative =
      fs::path(absolute).lexically_relative(fs::weakly_canonical(fs::absolute(file)).parent_path());
  int up = 0;
  for (const fs::path& part : relative) up += part == ".." ? 1 : 0;
  return relative.empty() || up > kMostUp ? absolute : relative.string();
}

std::string frames_text(const FolderScene& scene) {
  if (scene.train_frames + scene.test_frames == 0) return "none that could be read";
  return fmt::format("{} training and {} test frames of {} x {} pixels", scene.train_frames, scene.test_frames,
                     scene.width_px, scene.height_px);
}

std::string config_text(const FolderScene& found, const PresetAdvice& advice, const std::string& file) {
  ConfigNode tree = config_of(found, advice.preset);
  ConfigNode section = *tree.find("scene");
  for (const char* key : {"root", "file"}) {
    if (const ConfigNode* path = section.find(key))
      section = section.with(key, ConfigNode::make_scalar(path_from(file, path->text()), true, {}));
  }
  tree = tree.with("scene", section);
  if (advice.background) {
    std::vector<ConfigNode> color;
    for (const double c : *advice.background)
      color.push_back(ConfigNode::make_scalar(fmt::format("{:.4g}", c), false, {}));
    tree =
        tree.with("rendering", ConfigNode::make_map({{"background", ConfigNode::make_list(std::move(color), {})}}, {}));
  }
  return fmt::format("# {}: {}.\n# The preset: {}.\n{}", found.what, frames_text(found), advice.why,
                     write_config(tree));
}

// The scene under the usual preset, however little of it can be read.
LoadedScene look_at(const FolderScene& found, AppContext& context, Diagnostics& diagnostics) {
  try {
    OpenedDataset opened = dataset_of(config_of(found, kUsualPreset), {}, context);
    return load_for_labels(opened, diagnostics);
  } catch (const Error& e) {
    diagnostics.error(e.code(), "", e.message(), e.remedy());
    return {};
  }
}

// `run`, or with the first number behind it that nothing has yet.
std::string unused(const std::string& run) {
  std::error_code unknown;
  std::string free = run;
  for (int number = 2; is_there(free) && !fs::is_empty(free, unknown); ++number)
    free = run + "_" + std::to_string(number);
  return free;
}

// Training, and labelling in a run of its own, so that either works after the other. A run that is there already keeps
// its folder. `name` is of its runs; `set` is what --set and its short forms gave.
std::vector<NextStep> next_of_config(const std::string& file, const std::string& name, [[maybe_unused]] bool labels,
                                     const std::vector<std::string>& set = {}) {
  std::string words = " " + shell_word(file);
  for (const std::string& setting : set) {
    // "--threads runtime.threads=2" was typed as "--threads 2".
    const bool is_short = setting.starts_with("--");
    words += " --set " + shell_word(is_short ? setting.substr(setting.find(' ') + 1) : setting);
  }
  // What suits the scene comes first and gets the folder that pages call the run.
  const auto with_folder = [&](const char* verb, const std::string& ending, const char* what) -> NextStep {
    const std::string usual = "runs/" + name, run = unused(usual + ending);
    return {verb + words + (run == usual ? "" : " --out " + shell_word(run)), what + run};
  };
#ifdef SEMFIELD_WITH_SERVE
  if (!labels)
    return {with_folder("serve", "", "label by clicks while it trains; writes "),
            with_folder("train", "_unlabelled", "trains without labels; writes ")};
  return {with_folder("train", "", "writes "),
          with_folder("serve", "_clicks", "label by clicks while it trains; writes ")};
#else
  return {with_folder("train", "", "writes ")};
#endif
}

// What fixes the cameras of a scene that do not fit its photographs; none where they do. `scene` is its folder, or a
// configuration; `name` is what it is called.
std::vector<NextStep> next_of_cameras(bool off, const std::string& scene, const std::string& name) {
  if (!off) return {};
  return {{"prepare " + shell_word(scene) + " --out " + shell_word(unused(name + "_fixed")),
           "fixes the cameras, in a scene of its own"}};
}

int run(const InitOptions& options, AppContext& context) {
  const FolderScene found = find_scene(options.folder, options.type, context);
  const std::string file = options.out.empty() ? "configs/" + found.name + ".yaml" : options.out;
  if (!options.replace && is_there(file)) {
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + file + "' is there already",
                "name another file with --out, or give --replace to overwrite it");
  }
  Diagnostics diagnostics;
  const LoadedScene scene = look_at(found, context, diagnostics);
  const PresetAdvice advice =
      advised_preset(scene).value_or(PresetAdvice{kUsualPreset, "nothing could be read that speaks for another", {}});
  if (fs::path(file).has_parent_path()) fs::create_directories(fs::path(file).parent_path());
  write_file_atomic(file, config_text(found, advice, file));
  Json out = inspect_json(scene, diagnostics);
  out.update({{"file", file}, {"type", found.type}, {"others", found.others}, {"downscale", downscale_of(found)}});
  std::string text = fmt::format("{} written: {}\n", file, found.what);
  text += fmt::format("frames      {}{}\n", frames_text(found),
                      downscale_of(found) > 1 ? fmt::format(", divided by {}", downscale_of(found)) : "");
  text += fmt::format("preset      {}\n", advice.text());
  for (const std::string& other : found.others) text += fmt::format("also here   {}; --type takes it\n", other);
  for (const Diagnostic& finding : folded(diagnostics)) {
    if (finding.severity != Severity::note)
      text += fmt::format("{:<11} {}\n", finding.severity == Severity::error ? "error" : "warning", finding.shown());
  }
  print_results(context, out, text);
  std::vector<NextStep> next{{"inspect " + shell_word(file), "bounds, classes, and every problem"}};
  for (NextStep& step : next_of_cameras(scene.cameras_are_off(), found.path, found.name))
    next.insert(next.begin(), std::move(step));
  if (!diagnostics.has_errors()) {
    for (NextStep& step : next_of_config(file, fs::path(file).stem().string(), found.labels))
      next.push_back(std::move(step));
    next.push_back({"tune " + shell_word(file), "finds the settings that the scene asks for"});
  }
  print_next(context, next);
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

struct InspectOptions : Options {
  explicit InspectOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& config = operand("config", "configuration file (YAML), or the folder of a scene");
  std::vector<std::string>& set = settings();
};

// What an inspection shows of training frames are the labels that would train.
void show_training_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  read_test_labels(scene, config, diagnostics);
  TrainingLabels labels;
  try {
    labels = make_training_labels(scene, config, diagnostics);
  } catch (const Error& e) {
    if (!diagnostics.has_errors()) diagnostics.error(e.code(), "", e.message(), e.remedy());
    return;
  }
  for (const int f : scene.frames_of(Split::train)) {
    const auto i = static_cast<std::size_t>(f);
    scene.info.frames[i].has_labels = !labels.frames[i].empty();
    scene.class_pixels[i] = labels.class_pixels[i];
  }
}

// What training would say of where rays come from, or refuse at its first step.
void check_ray_source(const LoadedScene& scene, const RunConfig& config, Diagnostics& diagnostics) {
  LabelCount labels;
  labels.may_come = config.labels.selection.class_room > 0;
  for (const int f : scene.frames_of(Split::train)) {
    const Camera& camera = scene.info.frames[static_cast<std::size_t>(f)].camera;
    const std::vector<std::int64_t>& pixels = scene.class_pixels[static_cast<std::size_t>(f)];
    labels.train_px += std::int64_t{camera.width_px} * camera.height_px;
    if (!pixels.empty()) labels.labelled_px += std::accumulate(pixels.begin(), pixels.end() - 1, std::int64_t{0});
  }
  warn_of_rare_labels(config.train, labels, diagnostics);
  if (config.train.ray_source != RaySourceKind::label_balanced || labels.labelled_px > 0 || labels.may_come) return;
  const Error refused = no_labelled_pixel();
  diagnostics.error(refused.code(), "", refused.message(), refused.remedy());
}

int run(const InspectOptions& options, AppContext& context) {
  const std::string& what = options.config;
  const bool folder = names_a_scene(what, context);
  const FolderScene found = folder ? find_scene(what, "", context) : FolderScene();
  OpenedDataset opened = folder ? dataset_of(config_of(found, kUsualPreset), options.set, context)
                                : dataset_of(options.config, options.set, context);
  Diagnostics diagnostics;
  LoadedScene scene = load_for_labels(opened, diagnostics);
  if (!diagnostics.has_errors()) show_training_labels(scene, opened.config.labels, diagnostics);
  if (!diagnostics.has_errors()) check_ray_source(scene, opened.config, diagnostics);
  std::string depth;
  if (!diagnostics.has_errors()) depth = depth_use(opened.config.losses, training_depth(scene), diagnostics);
  print_results(context, inspect_json(scene, diagnostics, depth), inspect_report(scene, diagnostics, depth));
  std::vector<NextStep> next = next_of_cameras(scene.cameras_are_off(), what, scene.info.name);
  const auto then = [&](std::vector<NextStep> more) {
    std::move(more.begin(), more.end(), std::back_inserter(next));
    print_next(context, next);
  };
  if (folder) {
    then(next_of_scene(what, found.name));
  } else if (!diagnostics.has_errors()) {
    const bool labels = std::any_of(scene.class_pixels.begin(), scene.class_pixels.end(),
                                    [](const std::vector<std::int64_t>& pixels) { return !pixels.empty(); });
    then(next_of_config(what, opened.config.name, labels, options.set));
  }
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

}  // namespace

Verb verb_init() {
  return make_verb<InitOptions>("init", 8, "look at the folder of a scene and write a configuration for it",
                                {"data/my_photos", "data/my_photos --out configs/second.yaml"}, run);
}

Verb verb_inspect() {
  return make_verb<InspectOptions>("inspect", 70, "print what a scene contains, and every problem with its remedy",
                                   {"configs/my_photos.yaml", "data/my_photos"}, run);
}

// prepare: a scene out of a video or of photographs.

namespace {

struct PrepareVerbOptions : Options {
  using Options::Options;
  const std::string& source =
      operand("source",
              "video, or folder of photographs; folders in it are one camera each. Or a scene that has poses, or its "
              "configuration: its lens, poses and depth camera are fixed");
  const std::string& out = required("--out FOLDER", "scene to write; what was interrupted continues there");
  const long long& frames =
      value_in("--frames N", 0LL, 0, 10000, "frames to keep of a video at most; 0: three a second, 30 to 300");
  const std::string& lens = choice("--lens KIND", "auto", {"auto", "fisheye"},
                                   "of the camera; auto: perspective, and a fisheye where that does not fit");
  const int& attempts =
      value_in("--attempts N", 0, 0, kMostAttempts,
               "attempts to give every photograph a pose, at most; each takes longer than the one before. 0: 4, or as "
               "many as a finished scene was given; more than that continue it");
  const int& threads = value_in("--threads N", 0, 0, 4096, "threads of COLMAP; 0: every core");
};

struct Stopped {};

// Programs and steps end at the first stop signal; the folder's steps remember what is done. False where it came.
template <class Work>
bool stoppable(AppContext& context, const Work& work) {
  const auto stop_if_asked = [] {
    if (stop_signal() != 0) throw Stopped{};
  };
  const Programs programs{program_in_path, [&](const std::vector<std::string>& words, const std::string& log,
                                               const std::function<void()>& tick) {
                            const int code = run_logged_child(words, log, tick);
                            stop_if_asked();
                            return code;
                          }};
  std::optional<ProgressLine> line;
  std::string shown;
  const CaptureProgress progress = [&](const CaptureStep& step, double done, double total) {
    stop_if_asked();
    if (shown != step.doing) line.emplace(context, step.doing, step.unit);
    shown = step.doing;
    line->show(done, total);
  };
  const auto note = [&](const std::string& text) {
    line.reset();
    shown.clear();
    print_note(context, text);
  };
  try {
    work(programs, progress, note);
    return true;
  } catch (const Stopped&) {
    line.reset();
    print_note(context, "stopped; the same command continues");
    return false;
  }
}

// The scene that was written, as the verb's results, with what `inspect` would say of it. `text` says it for people.
int written(const PrepareVerbOptions& options, Diagnostics& found, Json results, std::string text,
            AppContext& context) {
  const FolderScene scene = find_scene(options.out, "", context);
  OpenedDataset opened = dataset_of(config_of(scene, kUsualPreset), {}, context);
  const std::string geometry = load_for_labels(opened, found).geometry;
  print_findings(context, found);
  results["folder"] = options.out;
  if (!geometry.empty()) text += "geometry    " + geometry + "\n";
  print_results(context, results, text);
  if (!found.has_errors()) print_next(context, next_of_scene(scene.path, scene.name));
  return found.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

// What a scene that has poses is fixed to.
std::string fixed_text(const FixedCameras& fixed, const SceneInfo& info) {
  std::string text =
      fmt::format("frames      {}, {} points found in several of them\n", info.frames.size(), fixed.points);
  const std::string judges = fmt::format("median over {} points that took no part", fixed.judges);
  text += fixed.kept
              ? fmt::format("cameras     right: the photographs ask for no change ({:.2f} pixels, {})\n",
                            fixed.given_px, judges)
              : fmt::format("cameras     {:.2f} -> {:.2f} pixels ({})\n", fixed.given_px, fixed.fixed_px, judges);
  if (fixed.given_on_depth >= 0)
    text += fmt::format("depth       {:.0f} % -> {:.0f} % of points lie on the depth shown\n",
                        100 * fixed.given_on_depth, 100 * fixed.fixed_on_depth);
  for (const std::string& one : fixed.changes) text += "changed     " + one + "\n";
  return text;
}

bool names_a_config(const std::string& source) { return source.ends_with(".yaml") || source.ends_with(".yml"); }

// The scene that a dataset reads in the folder; nothing of a video and of photographs without poses.
std::optional<FolderScene> posed_scene_in(const std::string& source, AppContext& context) {
  if (names_a_config(source)) return {};
  try {
    return find_scene(source, "", context);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::no_input) throw;
    return {};
  }
}

// Poses are there: what asks how to find them would be ignored.
void refuse_other_options(const PrepareVerbOptions& options) {
  if (options.frames == 0 && options.attempts == 0 && options.lens == "auto") return;
  throw Error(ErrorKind::usage, "capture.options.poses",
              "'" + options.source +
                  "' has poses, which are corrected; --frames, --lens and --attempts are for those "
                  "without",
              "leave them out; or copy the photographs alone into another folder, to find poses again");
}

int run_posed(const PrepareVerbOptions& options, const std::optional<FolderScene>& folder, AppContext& context) {
  refuse_other_options(options);
  OpenedDataset opened =
      folder ? dataset_of(config_of(*folder, kUsualPreset), {}, context) : dataset_of(options.source, {}, context);
  const PoseConvention convention = opened.config.load.convention;
  Diagnostics found;
  PosedScene scene;
  scene.info = opened.dataset->open(found);
  found.throw_if_errors(ErrorKind::data, "the scene cannot be prepared:");
  convert_info(scene.info, convention);
  scene.read = [&](int frame, FrameBuffer& out) {
    opened.dataset->read(frame, out);
    convert_depth(out, convention);
  };
  std::optional<FixedCameras> fixed;
  const bool whole = stoppable(context, [&](const Programs& programs, const CaptureProgress& progress, const auto&) {
    fixed = fix_cameras(scene, options.out, options.threads, programs, progress);
    write_fixed_scene(scene, *fixed, options.out, progress);
  });
  if (!whole) return 128 + stop_signal();
  std::set<std::string> left;
  for (const FrameInfo& frame : scene.info.frames) {
    for (const FrameChannelInfo& one : frame.channels) left.insert(one.name);
  }
  for (const std::string& name : left)
    found.note(
        "scene.channel.left", options.out,
        "maps of '" + name + "' are not in it: copy their files, and name them in each frame as " + name + "_path");
  return written(options, found,
                 {{"frames", scene.info.frames.size()},
                  {"points", fixed->points},
                  {"kept", fixed->kept},
                  {"given_px", fixed->given_px},
                  {"fixed_px", fixed->fixed_px},
                  {"given_on_depth", fixed->given_on_depth},
                  {"fixed_on_depth", fixed->fixed_on_depth},
                  {"changes", fixed->changes}},
                 fixed_text(*fixed, scene.info), context);
}

std::string report_text(const PrepareReport& report) {
  std::string text = report.cut.empty() ? "" : "video       " + report.cut + "\n";
  text += fmt::format("photographs {} of {} x {} pixels\n", report.photographs, report.width_px, report.height_px);
  text += fmt::format("registered  {} of {} ({:.0f} %), reprojection error {:.2f} pixels, {} points, {} {}\n",
                      report.registered, report.photographs,
                      100.0 * static_cast<double>(report.registered) / static_cast<double>(report.photographs),
                      report.error_px, report.points, report.attempts, report.attempts == 1 ? "attempt" : "attempts");
  for (const Missing& one : report.missing) text += "missing     " + one.text + "\n";
  return text;
}

int run(const PrepareVerbOptions& options, AppContext& context) {
  install_stop_signals(!context.quiet);
  const std::optional<FolderScene> posed = posed_scene_in(options.source, context);
  if (posed || names_a_config(options.source)) return run_posed(options, posed, context);
  PrepareReport report;
  const bool whole =
      stoppable(context, [&](const Programs& programs, const CaptureProgress& progress, const auto& note) {
        report = prepare_scene({options.source, options.out, static_cast<std::size_t>(options.frames), options.threads,
                                options.lens == "fisheye", options.attempts, note},
                               programs, progress);
      });
  if (!whole) return 128 + stop_signal();
  print_findings(context, report.findings);
  std::vector<std::string> missing;
  for (const Missing& one : report.missing) missing.push_back(one.text);
  Diagnostics found;
  return written(options, found,
                 {{"photographs", report.photographs},
                  {"registered", report.registered},
                  {"error_px", report.error_px},
                  {"points", report.points},
                  {"attempts", report.attempts},
                  {"missing", missing}},
                 report_text(report), context);
}

}  // namespace

Verb verb_prepare() {
  return make_verb<PrepareVerbOptions>(
      "prepare", 7, "make a scene from a video or photographs, or fix the cameras of a scene",
      {"walk.mp4 --out data/my_photos", "data/my_photos --out data/my_photos_fixed"}, run);
}

// pack, labels degrade: a scene as one file or in Replica layout, and its training labels as images.

namespace {

struct WriteOptions : Options {
  explicit WriteOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& config = operand("config", "configuration file (YAML)");
  std::vector<std::string>& set = settings();
};

struct PackVerbOptions : WriteOptions {
  using WriteOptions::WriteOptions;
  const std::string& format =
      choice("--format FORMAT", "packed", {"packed", "replica"}, "one file, or a folder of images in Replica layout");
  const std::string& out = required("--out PATH", "file to write (.sfpack), or folder to create");
};

struct DegradeOptions : WriteOptions {
  using WriteOptions::WriteOptions;
  const std::string& out = required("--out FOLDER", "folder to create");
};

PackSummary write_replica(const PackVerbOptions& options, OpenedDataset& opened, AppContext& context) {
  Diagnostics diagnostics;
  SceneInfo info = opened.dataset->open(diagnostics);
  convert_info(info, opened.config.load.convention);
  for (const Diagnostic& finding : folded(diagnostics)) {
    if (finding.severity != Severity::error) print_note(context, finding.shown());
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  ProgressLine progress(context, "written");
  return capture_replica(
      *opened.dataset, info, options.out, [&](int done, int total) { progress.show(done, total); },
      opened.config.load.convention);
}

PackSummary write_packed(const PackVerbOptions& options, OpenedDataset& opened, AppContext& context) {
  Diagnostics diagnostics;
  const PackSummary summary = pack_scene(*opened.dataset, options.out, opened.config.load, diagnostics);
  print_findings(context, diagnostics);
  return summary;
}

int pack(const PackVerbOptions& options, AppContext& context) {
  OpenedDataset opened = dataset_of(options.config, options.set, context);
  const bool replica = options.format == "replica";
  const PackSummary written =
      replica ? write_replica(options, opened, context) : write_packed(options, opened, context);
  const char* const what = replica ? "folder" : "file";
  print_results(context, {{"frames", written.frames}, {"bytes", written.bytes}, {what, options.out}},
                fmt::format("pack: frames={} bytes={} {}={}", written.frames, written.bytes, what, options.out));
  return 0;
}

int degrade(const DegradeOptions& options, AppContext& context) {
  refuse_used_folder(options.out);
  OpenedDataset opened = dataset_of(options.config, options.set, context);
  Diagnostics diagnostics;
  const LoadedScene scene = load_for_labels(opened, diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene has problems:");
  const TrainingLabels labels = make_training_labels(scene, opened.config.labels, diagnostics);
  print_findings(context, diagnostics);
  const DegradeReport report = write_degraded(scene, labels, opened.config, options.out);
  print_results(
      context,
      {{"frames", report.frames},
       {"labelled_px", report.labelled_px},
       {"accuracy", number_json<Json>(report.accuracy)},
       {"miou_present", number_json<Json>(report.miou_present)},
       {"folder", options.out}},
      fmt::format("degrade: frames={} labelled_px={} accuracy={} miou_present={} folder={}", report.frames,
                  report.labelled_px, figure_text(report.accuracy), figure_text(report.miou_present), options.out));
  return 0;
}

}  // namespace

Verb verb_pack() {
  return make_verb<PackVerbOptions>(
      "pack", 90, "write a scene as one file, or its frames in Replica layout",
      {"configs/my_photos.yaml --out my_photos.sfpack", "configs/my_photos.yaml --format replica --out replica"}, pack);
}

Verb verb_labels_degrade() {
  return make_verb<DegradeOptions>(
      "labels degrade", 10, "write the training labels, degraded as the configuration says",
      {"configs/my_photos.yaml --out labels", "configs/my_photos.yaml --set scene.labels.frames=50% --out half"},
      degrade);
}

}  // namespace semfield::app
