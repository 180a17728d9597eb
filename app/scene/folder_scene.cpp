#include "app/scene/folder_scene.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <memory>
#include <nlohmann/json.hpp>
#include <tuple>

#include "compute/parallel.h"
#include "config/params.h"
#include "core/text.h"
#include "eval/image_output.h"
#include "eval/metrics.h"
#include "formats/image_io.h"
#include "labels/label_files.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
#include "system/files.h"

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

namespace semfield {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

// Names of the classes in the order of internal indices: what the last axis of the probabilities means.
std::string class_order_json(const ClassTable& classes) {
  Json names = Json::array();
  for (int c = 0; c < classes.valid_count(); ++c) names.push_back(classes.valid(c).name);
  return names.dump(1, ' ', false, Json::error_handler_t::replace) + "\n";
}

// A new folder that takes its name when it is complete.
class UnfinishedFolder {
 public:
  explicit UnfinishedFolder(const std::string& name)
      : name_(fs::path(name).lexically_normal()), path_(unfinished(name_)) {
    create(path_);
  }
  ~UnfinishedFolder() {
    std::error_code ignored;
    if (!done_) fs::remove_all(path_, ignored);
  }
  UnfinishedFolder(const UnfinishedFolder&) = delete;
  UnfinishedFolder& operator=(const UnfinishedFolder&) = delete;

  void add(const std::string& folder) const { create(path_ / folder); }
  std::string operator/(const std::string& file) const { return (path_ / file).string(); }

  void finish() {
    std::error_code code;
    fs::rename(path_, name_, code);  // an empty folder of that name is replaced
    if (code)
      throw Error(ErrorKind::cannot_create, "files.output.create",
                  "cannot create '" + name_.string() + "': " + code.message());
    done_ = true;
  }

 private:
  static fs::path unfinished(fs::path name) {
    if (!name.has_filename()) name = name.parent_path();  // "labels/"
    return name += ".unfinished-" + std::to_string(::getpid());
  }
  static void create(const fs::path& path) {
    std::error_code code;
    fs::create_directories(path, code);
    if (code) {
      throw Error(ErrorKind::cannot_create, "files.output.create",
                  "cannot create '" + path.string() + "': " + code.message(),
                  "choose a folder that you may write to with --out");
    }
  }
  fs::path name_, path_;
  bool done_ = false;
};

// Frames named rgb_N keep the Replica name of their label image.
std::string label_file(const std::string& name) {
  const bool numbered = name.size() > 4 && name.compare(0, 4, "rgb_") == 0 &&
                        std::all_of(name.begin() + 4, name.end(), [](char c) { return c >= '0' && c <= '9'; });
  return "semantic_class/" + (numbered ? "semantic_class_" + name.substr(4) : name + "_label") + ".png";
}

struct FrameFiles {
  std::size_t frame = 0;
  std::string label, preview, probability;
};

std::vector<FrameFiles> files_of(const LoadedScene& scene, const TrainingLabels& labels) {
  std::vector<FrameFiles> out;
  for (std::size_t f = 0; f < labels.frames.size(); ++f) {
    if (labels.frames[f].empty()) continue;
    const std::string name = output_name(scene.info.frames[f].name);
    out.push_back({f, label_file(name), "preview/" + name + "_label_vis.png",
                   labels.frames[f].soft.empty() ? "" : "probability/" + name + ".npy"});
  }
  if (out.empty()) {
    throw Error(ErrorKind::data, "labels.training.none", "no training frame keeps labels, so there is nothing to write",
                "see scene.labels.frames, and `semfield inspect`");
  }
  return out;
}

void write_probabilities(const std::string& path, MapSize size, const SoftMap& soft, const FrameInfo& frame) {
  const auto classes = static_cast<std::size_t>(soft.classes());
  std::vector<float> values(soft.pixels() * classes);
  for (std::size_t p = 0; p < soft.pixels(); ++p) soft.row(p, std::span(values).subspan(p * classes, classes));
  values = as_shown(std::move(values), frame.camera.width_px, frame.camera.height_px, frame.orientation, classes);
  write_npy(path, std::array<std::int64_t, 3>{size.height_px, size.width_px, soft.classes()}, values);
}

struct FrameScore {
  std::int64_t labelled_px = 0, changed_px = 0;
  bool has_truth = false;
  ConfusionMatrix confusion{0};
};

FrameScore write_frame(const LoadedScene& scene, const TrainingLabels::Frame& labels, const FrameFiles& files,
                       const UnfinishedFolder& folder, const ClassTable& classes) {
  const StoredFrame& frame = scene.frames[files.frame];
  const FrameInfo& info = scene.info.frames[files.frame];
  const Camera shown = as_shown(info).camera;
  const MapSize size{shown.width_px, shown.height_px};
  std::vector<std::int16_t> given(labels.size());
  for (std::size_t p = 0; p < given.size(); ++p) given[p] = labels[p];
  const std::vector<std::int16_t> drawn = as_shown(given, frame.width_px, frame.height_px, info.orientation);
  write_label_ids(folder / files.label, size, drawn, classes);
  write_label_colors(folder / files.preview, size, drawn, classes);
  if (!files.probability.empty()) write_probabilities(folder / files.probability, size, labels.soft, info);

  FrameScore score;
  score.confusion = ConfusionMatrix(classes.valid_count());
  score.labelled_px = std::count_if(given.begin(), given.end(), [](std::int16_t c) { return c != kVoid; });
  score.has_truth = !frame.label.empty();
  if (score.has_truth) {
    const std::vector<std::int16_t> truth = frame.label.expand();
    for (std::size_t p = 0; p < given.size(); ++p) score.changed_px += given[p] != truth[p] ? 1 : 0;
    score.confusion.add(truth, given);
  }
  return score;
}

Json number(const std::optional<double>& value) { return value ? Json(*value) : Json(nullptr); }

Json frame_json(const FrameInfo& info, const FrameFiles& files, const FrameScore& score) {
  Json out{{"name", info.name}, {"label", files.label}, {"preview", files.preview}};
  if (!files.probability.empty()) out["probability"] = files.probability;
  const Camera shown = as_shown(info).camera;
  out["width_px"] = shown.width_px;
  out["height_px"] = shown.height_px;
  out["labelled_px"] = score.labelled_px;
  out["changed_px"] = score.has_truth ? Json(score.changed_px) : Json(nullptr);
  out["accuracy"] = number(score.confusion.total_accuracy());
  out["miou_present"] = number(score.confusion.miou_present());
  return out;
}

Json total_json(const FrameScore& total, const ClassTable& classes, std::size_t frames) {
  const ConfusionMatrix& c = total.confusion;
  Json out{{"frames", frames},
           {"labelled_px", total.labelled_px},
           {"changed_px", total.has_truth ? Json(total.changed_px) : Json(nullptr)},
           {"scored_px", c.scored_px()},
           {"void_truth_px", c.void_truth_px()},
           {"void_given_px", c.void_predicted_px()},
           {"accuracy", number(c.total_accuracy())},
           {"average_accuracy", number(c.average_accuracy())},
           {"miou", number(c.miou())},
           {"miou_present", number(c.miou_present())}};
  const std::vector<ClassScore> scores = c.per_class();
  Json& iou = out["per_class_iou"] = Json::object();
  for (std::size_t k = 0; k < scores.size(); ++k) {
    if (scores[k].iou) iou[classes.valid(static_cast<int>(k)).name] = *scores[k].iou;
  }
  return out;
}

Json steps_json(const TrainingLabels& labels) {
  Json out = Json::array();
  for (const TrainingLabels::Step& step : labels.steps) {
    Json facts = Json::object();
    for (const auto& [name, value] : step.facts) facts[name] = value;
    out.push_back({{"type", step.type}, {"facts", std::move(facts)}});
  }
  return out;
}

}  // namespace

void refuse_used_folder(const std::string& folder) {
  std::error_code code;
  const fs::file_status status = fs::status(folder, code);
  if (status.type() == fs::file_type::not_found) return;
  if (!fs::is_directory(status)) {
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + folder + "' is not a folder",
                "choose another name with --out");
  }
  const bool empty = fs::is_empty(folder, code);
  if (code || !empty) {
    throw Error(ErrorKind::cannot_create, "files.output.exists",
                "the folder '" + folder + "' " + (code ? "cannot be read: " + code.message() : "holds files already"),
                "choose another folder with --out, or remove it");
  }
}

DegradeReport write_degraded(const LoadedScene& scene, const TrainingLabels& labels, const DegradeSource& source,
                             const std::string& folder) {
  refuse_used_folder(folder);
  const std::vector<FrameFiles> files = files_of(scene, labels);
  const ClassTable classes = with_void(scene.info.classes);
  UnfinishedFolder unfinished(folder);
  unfinished.add("semantic_class");
  unfinished.add("preview");
  if (labels.soft) unfinished.add("probability");

  std::vector<FrameScore> scores(files.size());
  parallel_for(std::ssize(files), [&](std::int64_t i) {
    const FrameFiles& f = files[static_cast<std::size_t>(i)];
    scores[static_cast<std::size_t>(i)] = write_frame(scene, labels.frames[f.frame], f, unfinished, classes);
  });
  FrameScore total;
  total.confusion = ConfusionMatrix(classes.valid_count());
  Json frames = Json::array();
  for (std::size_t i = 0; i < files.size(); ++i) {
    total.labelled_px += scores[i].labelled_px;
    total.changed_px += scores[i].changed_px;
    total.has_truth = total.has_truth || scores[i].has_truth;
    total.confusion.merge(scores[i].confusion);
    frames.push_back(frame_json(scene.info.frames[files[i].frame], files[i], scores[i]));
  }
  Json manifest{{"format", "semfield-labels-1"},
                {"scene", scene.info.name},
                {"labels_from", source.labels_from.empty() ? "the scene" : source.labels_from},
                {"seed", source.seed},
                {"steps", steps_json(labels)},
                {"classes", "classes.yaml"},
                {"total", total_json(total, classes, files.size())},
                {"frames", std::move(frames)},
                {"config", source.config}};
  write_file_atomic(unfinished / "classes.yaml", classes.to_yaml());
  if (labels.soft) write_file_atomic(unfinished / "probability/classes.json", class_order_json(classes));
  write_file_atomic(unfinished / "manifest.json", manifest.dump(2, ' ', false, Json::error_handler_t::replace) + "\n");
  unfinished.finish();
  return {static_cast<int>(files.size()), total.labelled_px, total.confusion.total_accuracy(),
          total.confusion.miou_present()};
}

PackSummary pack_scene(Dataset& dataset, const std::string& path, const SceneLoadOptions& size,
                       const PackOptions& options, Diagnostics& diagnostics) {
  validate(size, diagnostics);
  SceneInfo info = dataset.open(diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene cannot be packed:");
  convert_info(info, size.convention);
  for (FrameInfo& frame : info.frames) {
    if (!scaled_camera(frame.camera, size, frame.camera)) {
      throw Error(ErrorKind::usage, "scene.load.size",
                  frame_place(frame) + ": frame is smaller than the size asked for", "ask for at most the stored size");
    }
  }
  if (size.near_m > 0) info.near_hint_m = size.near_m;
  if (size.far_m > 0) info.far_hint_m = size.far_m;
  if (size.bounds.size() == 6) {
    info.bounds.lo = {size.bounds[0], size.bounds[1], size.bounds[2]};
    info.bounds.hi = {size.bounds[3], size.bounds[4], size.bounds[5]};
  }
  write_packed_scene(
      path, info,
      [&](int frame, FrameBuffer& out) {
        FrameBuffer whole;
        for (const FrameChannelInfo& one : info.frames[static_cast<std::size_t>(frame)].channels)
          if (one.name == kAlphaChannel) whole.wanted.emplace_back(one.name);
        dataset.read(frame, whole);
        convert_depth(whole, size.convention);
        const Camera& camera = info.frames[static_cast<std::size_t>(frame)].camera;
        hide_masked(whole);  // before it is mixed into other pixels
        out = resize_frame(whole, camera.width_px, camera.height_px);
        hide_masked(out);
      },
      options);
  return {static_cast<int>(info.frames.size()), static_cast<std::uint64_t>(std::filesystem::file_size(path))};
}

}  // namespace semfield
