#include "app/scene/folder_scene.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <memory>
#include <tuple>

#include "config/params_read.h"
#include "core/text.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

constexpr int kLongestSide = 800;  // of images that train well on a few cores

ConfigNode text_node(const std::string& text, bool quoted = false) { return ConfigNode::make_scalar(text, quoted, {}); }

struct Recognised {
  const PluginEntry* reader = nullptr;
  std::unique_ptr<PluginParams> params;
  std::string what;
  SceneInfo info;
  bool opens = false;
};

std::vector<Recognised> recognised(const std::string& path, const Registry& registry) {
  std::vector<Recognised> out;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != PluginKind::dataset) continue;
    Recognised found{entry, entry->new_params(), "", {}, false};
    found.what = found.params->recognise(path);
    if (!found.what.empty()) out.push_back(std::move(found));
  }
  return out;
}

void open_scene(Recognised& found) {
  Diagnostics diagnostics;
  try {
    found.info = found.reader->dataset(*found.params, {})->open(diagnostics);
    found.opens = !diagnostics.has_errors();
  } catch (const Error&) {
    found.opens = false;  // whoever loads the scene says why
  }
}

auto worth(const Recognised& found) {
  const auto any = [&](bool FrameInfo::*channel) {
    return std::any_of(found.info.frames.begin(), found.info.frames.end(),
                       [&](const FrameInfo& f) { return f.*channel; });
  };
  return std::tuple{found.opens, any(&FrameInfo::has_labels), any(&FrameInfo::has_depth), !found.info.bounds.empty()};
}

// The parameters that are not the defaults, and by how many frames one is held out where it goes by that.
ConfigNode section_of(const Recognised& found) {
  const auto all = [](PluginParams& params) {
    return params_to_config([&](ParamVisitor& visit) { params.describe(visit); });
  };
  const ConfigNode set = all(*found.params), usual = all(*found.reader->new_params());
  ConfigNode out = ConfigNode::make_map({{"type", text_node(found.reader->name)}}, {});
  const auto tests = std::count_if(found.info.frames.begin(), found.info.frames.end(),
                                   [](const FrameInfo& f) { return f.split == Split::test; });
  for (const auto& [key, value] : set.entries()) {
    const ConfigNode* other = usual.find(key);
    double every = 0;
    const bool holds_out =
        key == "test_every" && parse_number(value.text(), every) && every > 0 && tests > 0 &&
        std::abs(static_cast<double>(tests) * every - static_cast<double>(found.info.frames.size())) < every;
    if (holds_out || other == nullptr || !equal_config(value, *other)) out = out.with(key, value);
  }
  return out;
}

// Letters, digits, '-' and '_', as names of files and runs have.
std::string plain_name(const fs::path& path) {
  std::error_code unknown;
  fs::path folder = fs::weakly_canonical(path, unknown);
  if (fs::is_regular_file(folder, unknown)) {
    folder = folder.extension() == ".json" ? folder.parent_path() : folder.replace_extension();
  }
  std::string name = folder.filename().string();
  for (char& c : name) {
    const auto byte = static_cast<unsigned char>(c);
    if (std::isalnum(byte) == 0 && c != '-') c = '_';
  }
  return name.empty() ? "scene" : name;
}

[[noreturn]] void refuse(const std::string& path, const AppContext& context) {
  std::error_code unknown;
  if (!fs::exists(path, unknown))
    throw Error(ErrorKind::no_input, "files.folder.missing", "no folder '" + path + "'", "check the path");
  for (const PluginEntry* entry : context.registry.entries()) {
    const std::string commands =
        entry->kind == PluginKind::dataset ? entry->new_params()->preparation(path) : std::string();
    if (!commands.empty()) throw Error(ErrorKind::no_input, "scene.poses.missing", commands);
  }
  throw Error(
      ErrorKind::no_input, "scene.dataset.unrecognised",
      "'" + path + "' holds no scene that a dataset knows: " + join(context.registry.names(PluginKind::dataset)),
      "docs/guide/own_data.md says what each reads; for another place of the files write the configuration by hand");
}

}  // namespace

bool names_a_scene(const std::string& word, const AppContext& context) {
  std::error_code unknown;
  const fs::path path(word);
  if (fs::exists(word + ".yaml", unknown)) return false;  // the ending of a configuration may be left out
  if (fs::is_directory(path, unknown)) return !fs::exists(path / "run.yaml", unknown);
  const std::string extension = path.extension().string();
  return fs::is_regular_file(path, unknown) && extension != ".yaml" && extension != ".yml" &&
         !recognised(word, context.registry).empty();
}

FolderScene find_scene(const std::string& path, const std::string& type, AppContext& context) {
  const std::string absolute = fs::absolute(path).lexically_normal().string();
  const std::string asked =
      absolute.size() > 1 && absolute.back() == '/' ? absolute.substr(0, absolute.size() - 1) : absolute;
  std::vector<Recognised> found = recognised(asked, context.registry);
  if (!type.empty()) {
    (void)context.registry.get(PluginKind::dataset, type);
    std::erase_if(found, [&](const Recognised& f) { return f.reader->name != type; });
    if (found.empty())
      throw Error(ErrorKind::no_input, "scene.dataset.unrecognised",
                  "'" + path + "' holds nothing that " + type + " knows", "leave --type out");
  }
  if (found.empty()) refuse(path, context);
  for (Recognised& f : found) open_scene(f);
  const auto best = std::max_element(found.begin(), found.end(),
                                     [](const Recognised& a, const Recognised& b) { return worth(a) < worth(b); });
  FolderScene out;
  out.path = path;
  out.name = plain_name(asked);
  out.what = best->what;
  out.type = best->reader->name;
  for (const Recognised& f : found) {
    if (f.reader != best->reader) out.others.push_back(f.reader->name + " (" + f.what + ")");
  }
  out.section = section_of(*best);
  for (const FrameInfo& f : best->info.frames) {
    out.labels = out.labels || f.has_labels;
    out.train_frames += f.split == Split::train ? 1 : 0;
    out.test_frames += f.split == Split::test ? 1 : 0;
    out.width_px = std::max(out.width_px, f.camera.width_px);
    out.height_px = std::max(out.height_px, f.camera.height_px);
  }
  return out;
}

int downscale_of(const FolderScene& scene) {
  const int longest = std::max(scene.width_px, scene.height_px);
  return std::max(1, (longest + kLongestSide - 1) / kLongestSide);
}

ConfigNode config_of(const FolderScene& scene, const std::string& preset) {
  ConfigNode section = scene.section;
  if (const int by = downscale_of(scene); by > 1)
    section = section.with("load", ConfigNode::make_map({{"downscale", text_node(std::to_string(by))}}, {}));
  ConfigNode tree = ConfigNode::make_map({{"include", text_node(preset)}, {"scene", section}}, {});
  return tree;
}

}  // namespace semfield::app
