// init: looks at the folder of a scene and writes the configuration that trains on it. inspect: what a scene holds, and
// what training would find wrong with it.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>
#include <numeric>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield::app {

namespace {

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
std::vector<NextStep> next_of_config(const std::string& file, const std::string& name, bool labels,
                                     const std::vector<std::string>& set = {},
                                     const std::vector<std::string>& modules = {}) {
  std::string words = " " + shell_word(file);
  for (const std::string& module : modules) words += " --plugin " + shell_word(module);
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
  if (context.json) {
    Json out = inspect_json(scene, diagnostics);
    out["file"] = file;
    out["type"] = found.type;
    out["others"] = found.others;
    out["downscale"] = downscale_of(found);
    print_json(context, out);
  } else {
    std::printf("%s written: %s\n", file.c_str(), found.what.c_str());
    std::printf("frames      %s%s\n", frames_text(found).c_str(),
                downscale_of(found) > 1 ? fmt::format(", divided by {}", downscale_of(found)).c_str() : "");
    std::printf("preset      %s\n", advice.text().c_str());
    for (const std::string& other : found.others) std::printf("also here   %s; --type takes it\n", other.c_str());
    for (const Diagnostic& finding : folded(diagnostics)) {
      if (finding.severity != Severity::note)
        std::printf("%-11s %s\n", finding.severity == Severity::error ? "error" : "warning", finding.shown().c_str());
    }
  }
  std::vector<NextStep> next{{"inspect " + shell_word(file), "bounds, classes, and every problem"}};
  for (NextStep& step : next_of_cameras(scene.cameras_are_off(), found.path, found.name))
    next.insert(next.begin(), std::move(step));
  if (!diagnostics.has_errors())
    for (NextStep& step : next_of_config(file, fs::path(file).stem().string(), found.labels))
      next.push_back(std::move(step));
  print_next(context, next);
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

struct InspectOptions : Options {
  explicit InspectOptions(const Declaration& at) : Options(at) { threads(set); }
  const std::string& config = operand("config", "configuration file (YAML), or the folder of a scene");
  std::vector<std::string>& set = settings();
  const std::string& frusta = value("--frusta FILE", "write the cameras as a PLY file");
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
  if (context.json) {
    print_json(context, inspect_json(scene, diagnostics, depth));
  } else {
    std::fputs(inspect_report(scene, diagnostics, depth).c_str(), stdout);
  }
  if (!options.frusta.empty()) {
    write_frusta_ply(options.frusta, scene);
    print_note(context, "cameras written to " + options.frusta);
  }
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
    then(next_of_config(what, opened.config.name, labels, options.set, context.registry.module_files()));
  }
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

}  // namespace

Verb verb_init() {
  return make_verb<InitOptions>("init", 8, "look at the folder of a scene and write a configuration for it", run);
}

Verb verb_inspect() {
  return make_verb<InspectOptions>("inspect", 70, "print what a scene contains, and every problem with its remedy",
                                   run);
}

}  // namespace semfield::app
