// init: looks at the folder of a scene and writes the configuration that trains on it.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>

#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

struct InitOptions {
  std::string folder, out, type;
  bool replace = false;
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

int run(const InitOptions& options, AppContext& context) {
  const FolderScene found = find_scene(options.folder, options.type, context);
  const std::string file = options.out.empty() ? "configs/" + found.name + ".yaml" : options.out;
  std::error_code unknown;
  if (!options.replace && fs::exists(file, unknown)) {
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
    for (NextStep& step : next_of_config({file, fs::path(file).stem().string(), found.labels}))
      next.push_back(std::move(step));
  print_next(context, next);
  return diagnostics.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

void words(VerbWords& verb, InitOptions& options) {
  verb.operand("folder", options.folder, "folder of the scene, or an index in it");
  verb.value("--out FILE", options.out, "configuration to write (default: configs/<folder>.yaml)");
  verb.value("--type DATASET", options.type, "dataset that is to read it, where several could");
  verb.flag("--replace", options.replace, "write over a configuration that is there");
}

}  // namespace

Verb verb_init() {
  return make_verb<InitOptions>("init", 8, "look at the folder of a scene and write a configuration for it", words,
                                run);
}

}  // namespace semfield::app
