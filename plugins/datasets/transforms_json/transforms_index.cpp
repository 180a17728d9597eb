// Reading transforms.json.
#include "datasets/transforms_json/transforms_index.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <unordered_map>

#include "core/unicode_forms.h"
#include "datasets/transforms_json/transforms_keys.h"
#include "datasets/transforms_json/transforms_values.h"
#include "loading/file_names.h"
#include "loading/json_file.h"

namespace semfield {

namespace fs = std::filesystem;
using nlohmann::json;

namespace {

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
        values_(diagnostics),
        out_(out),
        diagnostics_(diagnostics) {}

  void read() {
    const int before = diagnostics_.error_count();
    const json root = read_pose_json<json>(path_, "export the poses again");
    if (!root.is_object() || !root.contains("frames") || !root["frames"].is_array()) {
      throw Error(ErrorKind::data, "scene.index.format", "'" + path_ + "' has no list 'frames'",
                  "give a transforms.json of nerfstudio, instant-ngp or Blender");
    }
    const std::optional<LensKind> kind = values_.model(root, LensKind::perspective, path_);
    if (!kind) return;
    TransformsLens lens = values_.lens(root, {}, path_);
    lens.kind = *kind;
    const double depth_unit_m = values_.depth_unit(root, 0, path_);
    read_depth_camera(root);
    read_classes(root);
    read_limit(root);
    // What is missing in every frame for a key that the file misspells would be said of every frame.
    const bool sound = check_keys(root, false, path_);
    SplitLists lists = read_split_lists(root);
    for (std::size_t i = 0; i < root["frames"].size(); ++i) {
      TransformsFrame frame = read_frame(root["frames"][i], i, lens, sound);
      if (frame.files.color.empty()) {
        frame.split = split_;
      } else {
        frame.split = split_in(lists, frame);
        frame.depth_unit_m = values_.depth_unit(root["frames"][i], depth_unit_m, frame.place);
      }
      out_.frames.push_back(std::move(frame));
    }
    if (diagnostics_.error_count() == before) report_unmatched(lists);
    if (out_.unclear_depth_key.empty()) out_.unclear_depth_key = values_.unclear_depth_key();
    for (const std::string& name : keys_.unread_maps())
      diagnostics_.note("scene.channel.unread", path_,
                        "frames name maps of '" + name + "', which nothing reads; scene.channels: [" + name +
                            "] offers them to heads and losses");
  }

 private:
  // A list of names: each by its path, and whether a frame has it.
  struct SplitList {
    const char* key;
    std::unordered_map<std::string, std::pair<std::string, bool>> names;
    bool holds(const TransformsFrame& frame, const std::string& as_written) {
      bool found = false;
      for (const std::string& path :
           {as_written, decomposed(fs::absolute(frame.files.color).lexically_normal().string())}) {
        const auto name = names.find(path);
        if (name == names.end()) continue;
        found = name->second.second = true;
      }
      return found;
    }
  };
  struct SplitLists {
    SplitList train{"train_filenames", {}}, test{"test_filenames", {}}, val{"val_filenames", {}};
    bool any() const { return !train.names.empty() || !test.names.empty() || !val.names.empty(); }
  };

  // Names are compared as the paths that they mean.
  std::string path_of_name(const std::string& name) const {
    return decomposed(fs::absolute(folder_ / with_slashes(name)).lexically_normal().string());
  }

  SplitLists read_split_lists(const json& root) {
    SplitLists lists;
    for (SplitList* list : {&lists.train, &lists.test, &lists.val}) {
      if (!root.contains(list->key) || root[list->key].is_null()) continue;
      const json& names = root[list->key];
      if (!names.is_array() || !std::all_of(names.begin(), names.end(), [](const json& n) { return n.is_string(); })) {
        diagnostics_.error("scene.index.value", path_, std::string("'") + list->key + "' is not a list of names",
                           "write the 'file_path' of each frame");
        continue;
      }
      for (const json& name : names) {
        const auto text = name.get<std::string>();
        list->names.try_emplace(path_of_name(text), text, false);
      }
    }
    return lists;
  }

  // Where no list of training frames is given, all that no other list names train.
  std::optional<Split> split_in(SplitLists& lists, const TransformsFrame& frame) {
    if (!lists.any()) return split_;
    const std::string path = path_of_name(frame.file_path);
    const bool in_train = lists.train.holds(frame, path), in_test = lists.test.holds(frame, path),
               in_val = lists.val.holds(frame, path);
    const bool tests = lists.test.names.empty() ? in_val : in_test;
    if (in_train && tests) {
      diagnostics_.error("scene.split.overlap", frame.place, "is both in train_filenames and among the frames held out",
                         "keep it in one of the two lists");
    }
    if (tests) return Split::test;
    return in_train || (lists.train.names.empty() && !in_val) ? Split::train : Split::unused;
  }

  void report_unmatched(const SplitLists& lists) {
    for (const SplitList* list : {&lists.train, &lists.test, &lists.val}) {
      std::vector<std::string> unmatched;
      for (const auto& [path, name] : list->names)
        if (!name.second) unmatched.push_back(name.first);
      if (unmatched.empty()) continue;
      const auto least = std::min_element(unmatched.begin(), unmatched.end());
      diagnostics_.error("scene.split.unknown", path_,
                         std::to_string(unmatched.size()) + " of " + std::to_string(list->names.size()) +
                             " names of '" + list->key + "' are no frame's, such as '" + *least + "'",
                         "write each as the 'file_path' of its frame");
    }
  }

  // A pose's place p is scale p + offset in instant-ngp, whose scene is the cube of side aabb_scale about (0.5, 0.5,
  // 0.5) [Mueller22]; scale and offset are 0.33 and 0.5 where the file tells no others.
  void read_limit(const json& root) {
    const auto side = values_.number(root, "aabb_scale", path_);
    if (!side) return;
    const double scale = root.contains("scale") ? values_.number(root, "scale", path_).value_or(0) : 0.33;
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

  void read_depth_camera(const json& root) {
    if (!root.contains("depth_camera") || root["depth_camera"].is_null()) return;
    const json& node = root["depth_camera"];
    const std::string place = path_ + ": 'depth_camera'";
    const json* rows = node.is_object() && node.contains("depth_from_color") ? &node["depth_from_color"] : nullptr;
    if (rows == nullptr || !read_rows(*rows, out_.depth_from_color)) {
      diagnostics_.error("scene.pose.format", place, "has no 'depth_from_color' of 4 rows of 4 numbers",
                         "write the lens of the depth images (w, h, fl_x, fl_y, cx, cy), and the matrix that takes "
                         "points from the axes of the colour camera (x right, y down, z forward) to those of the depth "
                         "camera");
      return;
    }
    const std::optional<LensKind> kind = values_.model(node, LensKind::perspective, place);
    if (!kind) return;
    out_.depth_lens = values_.lens(node, {}, place);
    out_.depth_lens->kind = *kind;
  }

  void read_classes(const json& root) {
    if (!root.contains("classes")) return;
    const json& classes = root["classes"];
    if (classes.is_string()) {
      out_.classes = names_.of((folder_ / classes.get<std::string>()).string());
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

  // Blender leaves the extension out.
  std::string file_of(const fs::path& path) {
    std::error_code ignored;
    std::string as_written = names_.of(path.string());
    if (fs::exists(as_written, ignored)) return as_written;
    for (const char* extension : {".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".exr", ".webp", ".tif"}) {
      const std::string longer = names_.of(path.string() + extension);
      if (fs::exists(longer, ignored)) return longer;
    }
    return as_written;
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
    const std::optional<LensKind> kind = values_.model(item, lens.kind, frame.place);
    if (!kind || !sound || !keys_are_read) return frame;
    frame.lens = values_.lens(item, lens, frame.place);
    frame.lens.kind = *kind;
    frame.files.color = file_of(folder_ / frame.file_path);
    std::string depth = path_of("depth_path");
    if (depth.empty()) depth = path_of("depth_file_path");  // nerfstudio's name for it
    if (!depth.empty()) frame.files.depth = file_of(folder_ / depth);
    if (const std::string label = label_key_.empty() ? "" : path_of(label_key_.c_str()); !label.empty())
      frame.files.label = file_of(folder_ / label);
    if (const std::string instance = path_of("instance_path"); !instance.empty())
      frame.files.instance = file_of(folder_ / instance);
    if (const std::string mask = path_of("mask_path"); !mask.empty()) frame.files.mask = file_of(folder_ / mask);
    for (const std::string& name : channels_)
      if (const std::string file = path_of((name + "_path").c_str()); !file.empty())
        frame.channels[name] = names_.of((folder_ / file).string());
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

  // 3 or 4 rows of 4 numbers; empty where they are not.
  static bool read_rows(const json& rows, std::vector<double>& out) {
    bool valid = rows.is_array() && (rows.size() == 4 || rows.size() == 3);
    for (std::size_t r = 0; valid && r < rows.size(); ++r) {
      valid = rows[r].is_array() && rows[r].size() == 4;
      for (std::size_t c = 0; valid && c < 4; ++c) {
        const json& v = rows[r][c];
        // Exporters write a lost pose as null; it is skipped and counted like NaN.
        if (v.is_null())
          out.push_back(std::nan(""));
        else if (v.is_number())
          out.push_back(v.get<double>());
        else
          valid = false;
      }
    }
    if (!valid) out.clear();
    return valid;
  }

  void read_matrix(const json& item, TransformsFrame& frame) {
    const json* rows = item.contains("transform_matrix") ? &item["transform_matrix"] : nullptr;
    if (rows != nullptr && read_rows(*rows, frame.matrix)) return;
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
  TransformsValues<json> values_;
  FileNames names_;
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
