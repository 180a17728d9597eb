#include "app/scene/label_folder.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "eval/image_output.h"
#include "eval/metrics.h"
#include "formats/image_io.h"
#include "formats/orientation.h"
#include "labels/label_files.h"
#include "scene/classes/void_class.h"
#include "scene/output_names.h"
#include "system/files.h"

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

}  // namespace semfield
