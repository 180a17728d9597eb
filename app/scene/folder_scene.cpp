#include "app/scene/folder_scene.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <memory>
#include <tuple>

#include "app/scene/inspect_report.h"
#include "compute/parallel.h"
#include "config/params.h"
#include "core/files.h"
#include "core/non_copyable.h"
#include "core/text.h"
#include "eval/image_output.h"
#include "eval/metrics.h"
#include "formats/image_io.h"
#include "labels/label_files.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"

namespace semfield::app {

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
std::string plain_name(fs::path folder) {
  if (is_file(folder)) {
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
  if (!is_there(path))
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
  const fs::path path(word);
  if (is_there(word + ".yaml")) return false;  // the ending of a configuration may be left out
  if (is_folder(path)) return !is_there(path / "run.yaml");
  const std::string extension = path.extension().string();
  return is_file(path) && extension != ".yaml" && extension != ".yml" && !recognised(word, context.registry).empty();
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
  return ConfigNode::make_map({{"include", text_node(preset)}, {"scene", section}}, {});
}

// Training labels as images.

namespace {

// A new folder that takes its name when it is complete.
class UnfinishedFolder : NonCopyable {
 public:
  explicit UnfinishedFolder(const std::string& name)
      : name_(fs::path(name).lexically_normal()), path_(unfinished(name_)) {
    create_output_folder(path_);
  }
  ~UnfinishedFolder() {
    std::error_code ignored;
    if (!done_) fs::remove_all(path_, ignored);
  }

  void add(const std::string& folder) const { create_output_folder(path_ / folder); }
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
  fs::path name_, path_;
  bool done_ = false;
};

// Frames named rgb_N keep the Replica name of their label image.
std::string label_file(const std::string& name) {
  const bool numbered = name.size() > 4 && name.compare(0, 4, "rgb_") == 0 &&
                        std::all_of(name.begin() + 4, name.end(), [](char c) { return c >= '0' && c <= '9'; });
  return "semantic_class/" + (numbered ? "semantic_class_" + name.substr(4) : name + "_label") + ".png";
}

struct WrittenFiles {
  std::size_t frame = 0;
  std::string label, preview, probability;
};

std::vector<WrittenFiles> files_of(const LoadedScene& scene, const TrainingLabels& labels) {
  std::vector<WrittenFiles> out;
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

struct WrittenScore {
  std::int64_t labelled_px = 0, changed_px = 0;
  bool has_truth = false;
  ConfusionMatrix confusion{0};
};

WrittenScore write_frame(const LoadedScene& scene, const TrainingLabels::Frame& labels, const WrittenFiles& files,
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

  WrittenScore score;
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

// Always a real number, as the scores of classes beside it.
Json number(const std::optional<double>& value) { return value ? Json(*value) : Json(nullptr); }

Json frame_json(const FrameInfo& info, const WrittenFiles& files, const WrittenScore& score) {
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

Json total_json(const WrittenScore& total, const ClassTable& classes, std::size_t frames) {
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

DegradeReport write_degraded(const LoadedScene& scene, const TrainingLabels& labels, const RunConfig& config,
                             const std::string& folder) {
  refuse_used_folder(folder);
  const std::vector<WrittenFiles> files = files_of(scene, labels);
  const ClassTable classes = with_void(scene.info.classes.entries());
  UnfinishedFolder unfinished(folder);
  unfinished.add("semantic_class");
  unfinished.add("preview");
  if (labels.soft) unfinished.add("probability");

  std::vector<WrittenScore> scores(files.size());
  parallel_for(std::ssize(files), [&](std::int64_t i) {
    const WrittenFiles& f = files[static_cast<std::size_t>(i)];
    scores[static_cast<std::size_t>(i)] = write_frame(scene, labels.frames[f.frame], f, unfinished, classes);
  });
  WrittenScore total;
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
                {"labels_from", config.labels.from.type.empty() ? "the scene" : config.labels.from.type},
                {"seed", config.labels.selection.seed},
                {"steps", steps_json(labels)},
                {"classes", "classes.yaml"},
                {"total", total_json(total, classes, files.size())},
                {"frames", std::move(frames)},
                {"config", write_config(resolved_config(config))}};
  write_file_atomic(unfinished / "classes.yaml", classes.to_yaml());
  if (labels.soft) write_file_atomic(unfinished / "probability/classes.json", class_order_json(classes));
  write_file_atomic(unfinished / "manifest.json", json_text(manifest, 2) + "\n");
  unfinished.finish();
  return {static_cast<int>(files.size()), total.labelled_px, total.confusion.total_accuracy(),
          total.confusion.miou_present()};
}

PackSummary pack_scene(Dataset& dataset, const std::string& path, const SceneLoadOptions& size,
                       Diagnostics& diagnostics) {
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
  if (size.bounds.size() == 6) info.bounds = box_of(size.bounds);
  write_packed_scene(path, info, [&](int frame, FrameBuffer& out) {
    FrameBuffer whole;
    for (const FrameChannelInfo& one : info.frames[static_cast<std::size_t>(frame)].channels)
      if (one.name == kAlphaChannel) whole.wanted.emplace_back(one.name);
    dataset.read(frame, whole);
    convert_depth(whole, size.convention);
    const Camera& camera = info.frames[static_cast<std::size_t>(frame)].camera;
    hide_masked(whole);  // before it is mixed into other pixels
    out = resize_frame(whole, camera.width_px, camera.height_px);
    hide_masked(out);
  });
  return {static_cast<int>(info.frames.size()), static_cast<std::uint64_t>(fs::file_size(path))};
}

namespace {

void check_cameras(const SceneInfo& info) {
  Diagnostics diagnostics;
  for (const FrameInfo& frame : info.frames) {
    const std::string where = "frame " + frame.name;
    if (frame.camera.has_distortion())
      diagnostics.error("capture.camera.distortion", where, "has lens distortion", "undistort the images first");
    if (!(frame.camera == info.frames.front().camera)) {
      diagnostics.error("capture.camera.differs", where, "has another camera than frame " + info.frames.front().name,
                        "the layout has one camera for all");
    }
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the scene does not fit the Replica layout");
}

std::string numbered(const fs::path& folder, const std::string& stem, std::size_t index) {
  return (folder / stem / (stem + "_" + std::to_string(index) + ".png")).string();
}

std::vector<std::uint16_t> instance_ids(const FrameInfo& info, const FrameBuffer& frame) {
  std::vector<std::uint16_t> ids;
  for (const std::int32_t id : frame.instance) {
    if (id < 0 || id > 65535)
      throw Error(ErrorKind::data, "capture.instance.range",
                  "frame " + info.name + ": instance " + std::to_string(id) + " does not fit 16 bits");
    ids.push_back(static_cast<std::uint16_t>(id));
  }
  return ids;
}

void write_frame(const FrameInfo& info, const FrameBuffer& frame, const ClassTable& classes, const fs::path& folder,
                 std::size_t index) {
  const MapSize size{frame.width_px, frame.height_px};
  write_png_rgb(numbered(folder, "rgb", index), size.width_px, size.height_px, frame.rgb);
  if (info.has_depth) write_depth(numbered(folder, "depth", index), size, frame.depth_m, 1e-3);
  if (info.has_labels) write_label_ids(numbered(folder, "semantic_class", index), size, frame.label, classes);
  if (!info.has_instances) return;
  const std::string path = numbered(folder, "semantic_instance", index);
  const std::vector<std::uint16_t> ids = instance_ids(info, frame);
  if (std::any_of(ids.begin(), ids.end(), [](std::uint16_t id) { return id > 255; })) {
    write_png_gray16(path, size.width_px, size.height_px, ids);
  } else {
    write_png_gray8(path, size.width_px, size.height_px, std::vector<std::uint8_t>(ids.begin(), ids.end()));
  }
}

}  // namespace

std::string class_order_json(const ClassTable& classes) {
  Json names = Json::array();
  for (int c = 0; c < classes.valid_count(); ++c) names.push_back(classes.valid(c).name);
  return json_text(names, 1) + "\n";
}

PackSummary capture_replica(const Dataset& dataset, const SceneInfo& info, const std::string& out_dir,
                            const std::function<void(int done, int total)>& progress,
                            const PoseConvention& convention) {
  if (info.frames.empty()) throw Error(ErrorKind::data, "scene.frames.none", "the scene has no frames");
  check_cameras(info);
  const fs::path folder(out_dir);
  if (fs::exists(folder / "traj_w_c.txt")) {
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + out_dir + "' already holds a captured scene",
                "choose another folder or remove it");
  }
  const FrameInfo& first = info.frames.front();
  const std::pair<const char*, bool> channels[] = {{"rgb", true},
                                                   {"depth", first.has_depth},
                                                   {"semantic_class", first.has_labels},
                                                   {"semantic_instance", first.has_instances}};
  for (const auto& [name, has] : channels)
    if (has) create_output_folder(folder / name);
  PackSummary report;
  FrameBuffer frame;
  const ClassTable classes = info.classes.empty() ? info.classes : with_void(info.classes.entries());
  std::string trajectory;
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    dataset.read(static_cast<int>(i), frame);
    convert_depth(frame, convention);
    write_frame(info.frames[i], frame, classes, folder, i);
    const Pose& p = info.frames[i].world_from_camera;
    for (int row = 0; row < 3; ++row) {
      const auto& r = p.r[static_cast<std::size_t>(row)];
      trajectory += fmt::format("{:.17g} {:.17g} {:.17g} {:.17g} ", r[0], r[1], r[2], p.t[row]);
    }
    trajectory += "0 0 0 1\n";
    ++report.frames;
    if (progress) progress(report.frames, static_cast<int>(info.frames.size()));
  }
  const Camera& c = first.camera;
  const double hfov_deg = 2 * std::atan(0.5 * c.width_px / c.fx) * 180 / M_PI;
  write_file_atomic((folder / "intrinsics.txt").string(),
                    fmt::format("{} {} {:.17g} {:.17g} {:.17g} {:.17g} {:.10g}\n", c.width_px, c.height_px, c.fx, c.fy,
                                c.cx, c.cy, hfov_deg));
  if (!classes.empty()) write_file_atomic((folder / "classes.yaml").string(), classes.to_yaml());
  // Last, because its presence says that the scene is complete.
  write_file_atomic((folder / "traj_w_c.txt").string(), trajectory);
  for (const auto& entry : fs::recursive_directory_iterator(folder)) {
    if (entry.is_regular_file()) report.bytes += entry.file_size();
  }
  return report;
}

namespace {

constexpr const char* kLensModels[] = {"OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"};

Json lens_json(const Camera& c) {
  Json out{{"camera_model", kLensModels[static_cast<std::size_t>(c.lens)]},
           {"w", c.width_px},
           {"h", c.height_px},
           {"fl_x", c.fx},
           {"fl_y", c.fy},
           {"cx", c.cx},
           {"cy", c.cy}};
  for (const auto& [key, value] :
       {std::pair{"k1", c.k1}, {"k2", c.k2}, {"k3", c.k3}, {"k4", c.k4}, {"p1", c.p1}, {"p2", c.p2}})
    if (value != 0) out[key] = value;
  return out;
}

// OpenGL axes, as this format has them; `turned` false: as they are.
Json matrix_json(const Pose& pose, bool turned) {
  Json out = Json::array();
  for (int r = 0; r < 3; ++r) {
    const auto& row = pose.r[static_cast<std::size_t>(r)];
    const double sign = turned ? -1 : 1;
    out.push_back({row[0], sign * row[1], sign * row[2], pose.t[r]});
  }
  out.push_back({0, 0, 0, 1});
  return out;
}

// A power of ten of the unit with which the farthest depth fits 16 bits.
double step_for(double farthest) {
  return farthest > 0 ? std::pow(10.0, std::ceil(std::log10(farthest / kMostDepthSteps))) : 1e-3;
}

}  // namespace

void write_fixed_scene(const PosedScene& scene, const FixedCameras& cameras, const std::string& folder,
                       const CaptureProgress& progress) {
  const SceneInfo& info = scene.info;
  const ClassTable classes = info.classes.empty() ? info.classes : with_void(info.classes.entries());
  const fs::path out(folder);
  Json index = lens_json(cameras.cameras.front());
  // The file names one depth camera. Where lenses differ, depth is drawn into the colour images here.
  const std::vector<Camera>& of_depth = cameras.depth_cameras;
  const bool one_depth_camera =
      std::all_of(of_depth.begin(), of_depth.end(), [&](const Camera& c) { return c == of_depth.front(); });
  Json frames = Json::array(), train = Json::array(), test = Json::array();
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    const FrameInfo& frame = info.frames[i];
    progress({"writing", "frames"}, static_cast<double>(i), static_cast<double>(info.frames.size()));
    FrameBuffer pixels;
    scene.read(static_cast<int>(i), pixels);
    const MapSize size{pixels.width_px, pixels.height_px};
    Json one;
    const auto file = [&](const char* key, const char* kind, const std::string& end) {
      const std::string name = std::string(kind) + "/" + frame.name + end;
      create_folders((out / name).parent_path().string());
      one[key] = name;
      return (out / name).string();
    };
    if (is_photograph_file(frame) && frame.orientation == 1) {
      write_file_atomic(file("file_path", "images", fs::path(frame.source).extension().string()),
                        read_text_file(frame.source, std::size_t{1} << 32));
    } else {
      write_png_rgb(file("file_path", "images", ".png"), size.width_px, size.height_px, pixels.rgb);
    }
    (frame.split == Split::test ? test : train).push_back(one["file_path"]);
    if (frame.split == Split::unused) train.erase(train.size() - 1);
    if (frame.has_depth) {
      if (cameras.depth_apart && !one_depth_camera)
        pixels.depth_m = drawn_depth({pixels.width_px, pixels.height_px, 1, std::move(pixels.depth_m)},
                                     {of_depth[i], cameras.depth_from_color}, cameras.cameras[i]);
      double farthest = 0;
      for (const float d : pixels.depth_m) farthest = std::max(farthest, std::isfinite(d) ? static_cast<double>(d) : 0);
      const double step = step_for(farthest);
      write_depth(file("depth_path", "depth", ".png"), size, pixels.depth_m, step);
      one["depth_unit_m"] = step;
    }
    if (frame.has_labels) write_label_ids(file("label_path", "label", ".png"), size, pixels.label, classes);
    if (frame.has_instances)
      write_png_gray16(file("instance_path", "instance", ".png"), size.width_px, size.height_px,
                       instance_ids(frame, pixels));
    if (!pixels.used.empty()) {
      std::vector<std::uint8_t> used;
      for (const std::uint8_t u : pixels.used) used.push_back(u != 0 ? 255 : 0);
      write_png_gray8(file("mask_path", "mask", ".png"), size.width_px, size.height_px, used);
    }
    one["transform_matrix"] = matrix_json(cameras.poses[i], true);
    const Json lens = lens_json(cameras.cameras[i]);
    for (const auto& [key, value] : lens.items())
      if (!index.contains(key) || index[key] != value) one[key] = value;
    for (const char* key : {"k1", "k2", "k3", "k4", "p1", "p2"})
      if (index.contains(key) && !lens.contains(key)) one[key] = 0;
    frames.push_back(std::move(one));
  }
  if (cameras.depth_apart && one_depth_camera) {
    index["depth_camera"] = lens_json(of_depth.front());
    index["depth_camera"]["depth_from_color"] = matrix_json(cameras.depth_from_color, false);
  }
  if (!classes.empty()) {
    write_file_atomic((out / "classes.yaml").string(), classes.to_yaml());
    index["classes"] = "classes.yaml";
  }
  if (!test.empty()) {
    index["train_filenames"] = std::move(train);
    index["test_filenames"] = std::move(test);
  }
  if (info.metric) index["metric"] = true;
  index["prepared_from"] = info.name;
  index["camera_changes"] = cameras.changes;
  index["frames"] = std::move(frames);
  write_file_atomic((out / "transforms.json").string(), json_text(index, 1) + "\n");
}

}  // namespace semfield::app
