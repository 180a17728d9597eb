// Reading transforms.json.
#include "datasets/transforms_json/transforms_index.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <unordered_set>

#include "core/text.h"
#include "datasets/transforms_json/transforms_keys.h"
#include "formats/input_limits.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;
using nlohmann::json;

namespace {

// Blender leaves the extension out.
std::string with_extension(const fs::path& path) {
  std::error_code ignored;
  if (fs::exists(path, ignored)) return path.string();
  for (const char* extension : {".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".exr", ".webp", ".tif"}) {
    const fs::path longer = path.string() + extension;
    if (fs::exists(longer, ignored)) return longer.string();
  }
  return path.string();
}

class FileReader {
 public:
  FileReader(std::string path, std::optional<Split> split, const std::string& label_key,
             const std::vector<std::string>& channels, TransformsIndex& out, Diagnostics& diagnostics)
      : path_(std::move(path)),
        folder_(fs::path(path_).parent_path()),
        split_(split),
        label_key_(label_key),
        channels_(channels),
        keys_(label_key, channels),
        out_(out),
        diagnostics_(diagnostics) {}

  void read() {
    json root;
    try {
      root = json::parse(read_pose_file(path_));
    } catch (const json::exception& e) {
      throw Error(ErrorKind::data, "scene.index.format", "'" + path_ + "' is not valid JSON: " + json_cause(e.what()),
                  "export the poses again");
    }
    if (!root.is_object() || !root.contains("frames") || !root["frames"].is_array()) {
      throw Error(ErrorKind::data, "scene.index.format", "'" + path_ + "' has no list 'frames'",
                  "give a transforms.json of nerfstudio, instant-ngp or Blender");
    }
    const std::optional<LensKind> kind = read_model(root, LensKind::perspective, path_);
    if (!kind) return;
    TransformsLens lens = read_lens(root, {}, path_);
    lens.kind = *kind;
    if (const auto unit = number(root, "depth_unit_m", path_)) out_.depth_unit_m = *unit;
    if (!(out_.depth_unit_m >= 0))
      diagnostics_.error("scene.index.value", path_, "depth_unit_m must be positive",
                         "write the metres of one step, such as 0.001");
    read_classes(root);
    read_limit(root);
    // What is missing in every frame for a key that the file misspells would be said of every frame.
    const bool sound = check_keys(root, false, path_);
    const SplitLists lists = read_split_lists(root);
    for (std::size_t i = 0; i < root["frames"].size(); ++i) {
      TransformsFrame frame = read_frame(root["frames"][i], i, lens, sound);
      if (!frame.file_path.empty()) frame.split = split_in(lists, frame);
      out_.frames.push_back(std::move(frame));
    }
    for (const std::string& name : keys_.unread_maps())
      diagnostics_.note("scene.channel.unread", path_,
                        "frames name maps of '" + name + "', which nothing reads; scene.channels: [" + name +
                            "] offers them to heads and losses");
  }

 private:
  using Names = std::unordered_set<std::string>;
  struct SplitLists {
    Names train, test, val;
  };

  SplitLists read_split_lists(const json& root) {
    const auto listed = [&](const char* key) {
      Names names;
      if (!root.contains(key) || !root[key].is_array()) return names;
      for (const json& name : root[key]) {
        if (name.is_string()) names.insert(name.get<std::string>());
      }
      return names;
    };
    return {listed("train_filenames"), listed("test_filenames"), listed("val_filenames")};
  }

  std::optional<Split> split_in(const SplitLists& lists, const TransformsFrame& frame) {
    if (lists.train.empty()) return split_;
    const Names& held_out = lists.test.empty() ? lists.val : lists.test;
    const bool trains = lists.train.count(frame.file_path) > 0, tests = held_out.count(frame.file_path) > 0;
    if (trains && tests) {
      diagnostics_.error("scene.split.overlap", frame.place, "is both in train_filenames and among the frames held out",
                         "keep it in one of the two lists");
    }
    return trains ? Split::train : tests ? Split::test : Split::unused;
  }

  std::optional<double> number(const json& node, const char* key, const std::string& place) {
    if (!node.contains(key) || node[key].is_null()) return std::nullopt;
    if (!node[key].is_number()) {
      diagnostics_.error("scene.index.value", place, std::string("'") + key + "' is not a number", "write a number");
      return std::nullopt;
    }
    return node[key].get<double>();
  }

  // nerfstudio writes a flag, instant-ngp 0 or 1, and hand-made files "true". Nothing when reported.
  std::optional<bool> flag(const json& node, const char* key, const std::string& place) {
    if (!node.contains(key) || node[key].is_null()) return false;
    const json& value = node[key];
    if (value.is_boolean()) return value.get<bool>();
    for (const auto& [means, as_written] :
         {std::pair{true, json{1, "true", "True", "1"}}, std::pair{false, json{0, "false", "False", "0", ""}}}) {
      if (std::find(as_written.begin(), as_written.end(), value) != as_written.end()) return means;
    }
    diagnostics_.error("scene.index.value", place,
                       std::string("'") + key + "' is " + value.dump() + ", neither true nor false",
                       "write true or false");
    return std::nullopt;
  }

  // The lens of a file or of one of its frames, which may leave it to the file; nothing when reported.
  std::optional<LensKind> read_model(const json& node, LensKind otherwise, const std::string& place) {
    std::string model;
    if (node.contains("camera_model") && !node["camera_model"].is_null()) {
      if (!node["camera_model"].is_string()) {
        diagnostics_.error("scene.index.value", place,
                           "'camera_model' is " + node["camera_model"].dump() + ", which is not a name",
                           "write \"camera_model\": \"OPENCV\", or leave the key out");
        return std::nullopt;
      }
      model = node["camera_model"].get<std::string>();
    }
    const std::optional<bool> fisheye = flag(node, "is_fisheye", place);
    if (!fisheye) return std::nullopt;
    if (*fisheye) model = "OPENCV_FISHEYE";
    if (model.empty()) return otherwise;
    static const std::map<std::string, LensKind> known{
        {"OPENCV", LensKind::perspective},         {"PINHOLE", LensKind::perspective},
        {"SIMPLE_PINHOLE", LensKind::perspective}, {"SIMPLE_RADIAL", LensKind::perspective},
        {"RADIAL", LensKind::perspective},         {"PERSPECTIVE", LensKind::perspective},
        {"OPENCV_FISHEYE", LensKind::fisheye},     {"EQUIRECTANGULAR", LensKind::equirectangular}};
    if (const auto found = known.find(model); found != known.end()) return found->second;
    diagnostics_.error(
        "scene.camera.model", place,
        "camera model '" + model +
            "' is not supported (only OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE, "
            "EQUIRECTANGULAR)",
        "undistort the images to a pinhole camera, for example with colmap image_undistorter");
    return std::nullopt;
  }

  // nerfstudio's list of all coefficients, which takes the place of the single keys there.
  void read_distortion(const json& node, TransformsLens& lens, const std::string& place) {
    if (!node.contains("distortion_params") || node["distortion_params"].is_null()) return;
    const json& list = node["distortion_params"];
    const std::pair<const char*, double*> fields[] = {{"k1", &lens.k1}, {"k2", &lens.k2}, {"k3", &lens.k3},
                                                      {"k4", &lens.k4}, {"p1", &lens.p1}, {"p2", &lens.p2}};
    if (!list.is_array() || list.size() != std::size(fields) ||
        !std::all_of(list.begin(), list.end(), [](const json& v) { return v.is_number(); })) {
      diagnostics_.error("scene.index.value", place, "'distortion_params' is not a list of six numbers",
                         "write [k1, k2, k3, k4, p1, p2]");
      return;
    }
    for (std::size_t i = 0; i < std::size(fields); ++i) {
      const auto& [key, field] = fields[i];
      const double value = list[i].get<double>();
      if (node.contains(key) && node[key].is_number() && node[key].get<double>() != value) {
        diagnostics_.error("scene.index.value", place,
                           std::string("'") + key + "' is not what 'distortion_params' has in its place",
                           "keep one of the two");
        return;
      }
      *field = value;
    }
  }

  TransformsLens read_lens(const json& node, const TransformsLens& base, const std::string& place) {
    TransformsLens lens = base;
    const std::pair<const char*, double*> fields[] = {{"w", &lens.w},
                                                      {"h", &lens.h},
                                                      {"fl_x", &lens.fl_x},
                                                      {"fl_y", &lens.fl_y},
                                                      {"camera_angle_x", &lens.camera_angle_x},
                                                      {"camera_angle_y", &lens.camera_angle_y},
                                                      {"k1", &lens.k1},
                                                      {"k2", &lens.k2},
                                                      {"k3", &lens.k3},
                                                      {"k4", &lens.k4},
                                                      {"p1", &lens.p1},
                                                      {"p2", &lens.p2}};
    for (const auto& [key, field] : fields) {
      if (const auto value = number(node, key, place)) *field = *value;
    }
    if (const auto value = number(node, "cx", place)) lens.cx = value;
    if (const auto value = number(node, "cy", place)) lens.cy = value;
    read_distortion(node, lens, place);
    return lens;
  }

  // A pose's place p is scale p + offset in instant-ngp, whose scene is the cube of side aabb_scale about (0.5, 0.5,
  // 0.5) [Mueller22]; scale and offset are 0.33 and 0.5 where the file tells no others.
  void read_limit(const json& root) {
    const auto side = number(root, "aabb_scale", path_);
    if (!side) return;
    const double scale = root.contains("scale") ? number(root, "scale", path_).value_or(0) : 0.33;
    Vec3d offset{0.5, 0.5, 0.5};
    if (root.contains("offset")) {
      const json& given = root["offset"];
      for (std::size_t a = 0; a < 3; ++a) {
        const json& one = given.is_array() && given.size() == 3 ? given[a] : given;
        if (!one.is_number()) {
          diagnostics_.error("scene.index.value", path_, "'offset' is neither a number nor a list of 3",
                             "write [0.5, 0.5, 0.5]");
          return;
        }
        offset[static_cast<int>(a)] = one.get<double>();
      }
    }
    if (!(*side > 0) || !(scale > 0) || !std::isfinite(*side / scale)) {
      diagnostics_.error("scene.index.value", path_, "'aabb_scale' and 'scale' must be positive",
                         "write \"aabb_scale\": 1 or a power of two");
      return;
    }
    for (int a = 0; a < 3; ++a) {
      out_.limit.lo[a] = (0.5 - 0.5 * *side - offset[a]) / scale;
      out_.limit.hi[a] = (0.5 + 0.5 * *side - offset[a]) / scale;
    }
  }

  void read_classes(const json& root) {
    if (!root.contains("classes")) return;
    const json& classes = root["classes"];
    if (classes.is_string()) {
      out_.classes = (folder_ / classes.get<std::string>()).string();
      return;
    }
    const bool valid = classes.is_array() && std::all_of(classes.begin(), classes.end(), [](const json& c) {
                         return c.is_object() && c.contains("id") && c["id"].is_number_integer() &&
                                c.contains("name") && c["name"].is_string() &&
                                (!c.contains("ignore") || c["ignore"].is_boolean());
                       });
    if (!valid) {
      diagnostics_.error("scene.index.value", path_, "'classes' is neither a path nor a list of {id, name, ignore}",
                         "write \"classes\": \"classes.yaml\"");
      return;
    }
    for (const json& c : classes) {
      const auto id = c["id"].get<std::int64_t>();
      ClassEntry entry;
      entry.id = id < -1 || id > 70000
                     ? -1
                     : static_cast<std::int32_t>(id);  // out of range stays out of range: the table refuses it
      entry.name = c["name"].get<std::string>();
      entry.ignore = c.value("ignore", false);
      entry.color = ClassTable::default_color(std::max(entry.id, 0));
      out_.class_list.push_back(std::move(entry));
    }
  }

  TransformsFrame read_frame(const json& item, std::size_t index, const TransformsLens& lens, bool sound) {
    TransformsFrame frame;
    frame.place = path_ + ": frame " + std::to_string(index);
    if (!item.is_object()) {
      diagnostics_.error("scene.index.format", frame.place, "is not a map",
                         "write {\"file_path\": ..., \"transform_matrix\": ...}");
      return frame;
    }
    const auto path_of = [&](const char* key) {
      return item.contains(key) && item[key].is_string() ? item[key].get<std::string>() : std::string();
    };
    frame.file_path = path_of("file_path");
    const bool keys_are_read = check_keys(item, true, frame.place + " (" + frame.file_path + ")");
    if (frame.file_path.empty() && !keys_are_read) return frame;
    if (frame.file_path.empty()) {
      diagnostics_.error("scene.index.format", frame.place, "has no 'file_path'", "name the image of the frame");
      return frame;
    }
    frame.place += " (" + frame.file_path + ")";
    const std::optional<LensKind> kind = read_model(item, lens.kind, frame.place);
    if (!kind || !sound || !keys_are_read) return frame;
    frame.lens = read_lens(item, lens, frame.place);
    frame.lens.kind = *kind;
    frame.files.color = with_extension(folder_ / frame.file_path);
    std::string depth = path_of("depth_path");
    if (depth.empty()) depth = path_of("depth_file_path");  // nerfstudio's name for it
    if (!depth.empty()) frame.files.depth = with_extension(folder_ / depth);
    if (const std::string label = label_key_.empty() ? "" : path_of(label_key_.c_str()); !label.empty())
      frame.files.label = with_extension(folder_ / label);
    if (const std::string instance = path_of("instance_path"); !instance.empty())
      frame.files.instance = with_extension(folder_ / instance);
    if (const std::string mask = path_of("mask_path"); !mask.empty()) frame.files.mask = with_extension(folder_ / mask);
    for (const std::string& name : channels_)
      if (const std::string file = path_of((name + "_path").c_str()); !file.empty())
        frame.channels[name] = (folder_ / file).string();
    read_matrix(item, frame);
    return frame;
  }

  // Reports keys that look like one that is read, and intrinsics that are not 0 and are not read. False when it did:
  // what is missing then, the key was meant to give.
  bool check_keys(const json& node, bool of_frame, const std::string& place) {
    const int before = diagnostics_.error_count();
    for (const auto& [key, value] : node.items()) {
      if (of_frame && value.is_string()) keys_.look_for_map(key, value.get<std::string>());
      const std::string& meant = keys_.meant_by(key, of_frame);
      if (meant.empty() || node.contains(meant)) continue;
      std::string remedy = "write '" + meant + "'";
      if (meant == "label_path") remedy += ", or read it as it is with --set scene.label_key=" + key;
      diagnostics_.error("scene.index.key", place, "key '" + key + "' is not read; it looks like '" + meant + "'",
                         remedy);
    }
    for (const char* key : {"skew", "k5", "k6", "rolling_shutter"}) {
      if (!node.contains(key)) continue;
      const json& value = node[key];
      const auto is_zero = [](const json& v) { return v.is_null() || (v.is_number() && v.get<double>() == 0); };
      if (value.is_array() ? std::all_of(value.begin(), value.end(), is_zero) : is_zero(value)) continue;
      diagnostics_.error("scene.camera.model", place, std::string("'") + key + "' is not 0: such cameras are not read",
                         "undistort the images to a pinhole camera, for example with colmap image_undistorter");
    }
    return diagnostics_.error_count() == before;
  }

  // Poses as exporters of trackers write them.
  static std::string quaternion_in(const json& item) {
    for (const auto& [key, value] : item.items()) {
      const bool numbers =
          value.is_array() && std::all_of(value.begin(), value.end(), [](const json& v) { return v.is_number(); });
      if (numbers && (value.size() == 4 || value.size() == 7 || value.size() == 8))
        return "; '" + key + "' looks like a quaternion, which is not read";
    }
    return "";
  }

  void read_matrix(const json& item, TransformsFrame& frame) {
    const json* rows = item.contains("transform_matrix") ? &item["transform_matrix"] : nullptr;
    bool valid = rows != nullptr && rows->is_array() && (rows->size() == 4 || rows->size() == 3);
    for (std::size_t r = 0; valid && r < rows->size(); ++r) {
      valid = (*rows)[r].is_array() && (*rows)[r].size() == 4;
      for (std::size_t c = 0; valid && c < 4; ++c) {
        const json& v = (*rows)[r][c];
        // Exporters write a lost pose as null; it is skipped and counted like NaN.
        if (v.is_null())
          frame.matrix.push_back(std::nan(""));
        else if (v.is_number())
          frame.matrix.push_back(v.get<double>());
        else
          valid = false;
      }
    }
    if (valid) return;
    frame.matrix.clear();
    diagnostics_.error(
        "scene.pose.format", frame.place,
        (rows == nullptr ? "has no 'transform_matrix'" : "'transform_matrix' is not 4 rows of 4 numbers") +
            quaternion_in(item),
        "write the camera-to-world matrix row by row");
  }

  std::string path_;
  fs::path folder_;
  std::optional<Split> split_;
  std::string label_key_;
  std::vector<std::string> channels_;
  TransformsKeys keys_;
  TransformsIndex& out_;
  Diagnostics& diagnostics_;
};

}  // namespace

TransformsIndex read_transforms(const std::string& root, const std::string& label_key,
                                const std::vector<std::string>& channels, Diagnostics& diagnostics) {
  TransformsIndex out;
  std::error_code ignored;
  const auto read = [&](const std::string& path, std::optional<Split> split) {
    FileReader(path, split, label_key, channels, out, diagnostics).read();
  };
  const fs::path folder(root);
  if (fs::exists(root, ignored) && !fs::is_directory(root, ignored)) {
    read(root, std::nullopt);
    return out;
  }
  if (!fs::is_directory(root, ignored))
    throw Error(ErrorKind::no_input, "files.folder.missing", "folder '" + root + "' is missing", "check scene.root");
  if (fs::exists(folder / "transforms.json", ignored)) {
    read((folder / "transforms.json").string(), std::nullopt);
    return out;
  }
  const bool has_test = fs::exists(folder / "transforms_test.json", ignored);
  const std::pair<const char*, Split> parts[] = {{"transforms_train.json", Split::train},
                                                 {"transforms_test.json", Split::test},
                                                 {"transforms_val.json", has_test ? Split::unused : Split::test}};
  bool any = false;
  for (const auto& [name, split] : parts) {
    if (!fs::exists(folder / name, ignored)) continue;
    any = true;
    read((folder / name).string(), split);
  }
  if (!any) {
    throw Error(ErrorKind::no_input, "scene.poses.missing",
                "no transforms.json or transforms_train.json in '" + root + "'",
                "check scene.root; it names the folder of one scene");
  }
  return out;
}

}  // namespace semfield
