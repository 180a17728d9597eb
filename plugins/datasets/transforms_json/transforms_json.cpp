// transforms.json scenes of nerfstudio, instant-ngp and Blender.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

using nlohmann::json;

/// Intrinsics as written; a frame's own values override the file's. Image size 0 where only the image can tell.
struct TransformsLens {
  double w = 0, h = 0, camera_angle_x = 0, camera_angle_y = 0;
  std::optional<double> cx, cy;
  Camera told;  ///< focal lengths (fl_x, fl_y), kind and distortion
};

/// What the index says of a photograph. Its split comes from Blender's file names or nerfstudio's *_filenames; its
/// matrix is empty where the file's cannot be used, which was reported; its name is the path as written.
struct TransformsFrame : PosedPhotograph {
  std::string entry;  ///< "transforms.json: frame 3 (images/0003.jpg)"
  TransformsLens lens;
};

struct TransformsIndex {
  std::vector<TransformsFrame> frames;
  bool metric = false;            ///< its poses are in metres
  std::string unclear_depth_key;  ///< a key that tells a unit of depth in a way that is not known; "" = none
  /// Of the camera that took the depth images, where it is another: its lens, and depth_from_color [4][4] by rows.
  std::optional<TransformsLens> depth_lens;
  std::vector<double> depth_from_color;
  std::string classes;                 ///< path of a class table; "" = not told
  std::vector<ClassEntry> class_list;  ///< classes written in the file itself
};

/// Its keys are those of PhotographParams but `every`, `least_confidence` and `label_dir`.
struct TransformsJsonParams : PhotographParams {
  std::string label_key = "label_path";
  double depth_unit_m = 0;
  std::int32_t alpha_background = 255;
  bool alpha_masks = false;
  bool metric = false;
  std::vector<std::string> channels;
};

namespace {

// Coefficients of distortion in the order of nerfstudio's list.
constexpr std::pair<const char*, double Camera::*> kDistortion[] = {{"k1", &Camera::k1}, {"k2", &Camera::k2},
                                                                    {"k3", &Camera::k3}, {"k4", &Camera::k4},
                                                                    {"p1", &Camera::p1}, {"p2", &Camera::p2}};

constexpr const char* kUndistort =
    "undistort the images to a pinhole camera, for example with colmap image_undistorter";

/// The value of a key; nullptr where there is none or it is null.
const json* given(const json& node, const char* key) {
  const auto found = node.find(key);
  return found == node.end() || found->is_null() ? nullptr : &*found;
}

bool are_numbers(const json& list) {
  return list.is_array() && std::all_of(list.begin(), list.end(), [](const json& v) { return v.is_number(); });
}

/// Reads values of a file or of one of its frames; what is wrong goes into the diagnostics under `place`.
class TransformsValues {
 public:
  explicit TransformsValues(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}

  /// Reports a value that cannot be read. Always nothing, for callers that return what they read.
  std::nullopt_t refuse(const std::string& place, const std::string& message, const char* remedy) {
    diagnostics_.error("scene.index.value", place, message, remedy);
    return std::nullopt;
  }

  std::optional<double> number(const json& node, const char* key, const std::string& place) {
    const json* value = given(node, key);
    if (value == nullptr) return std::nullopt;
    if (!value->is_number()) return refuse(place, fmt::format("'{}' is not a number", key), "write a number");
    return value->get<double>();
  }

  // nerfstudio writes a flag, instant-ngp 0 or 1, and hand-made files "true". Nothing when reported.
  std::optional<bool> flag(const json& node, const char* key, const std::string& place) {
    if (given(node, key) == nullptr) return false;
    const json& value = node[key];
    if (value.is_boolean()) return value.get<bool>();
    for (const auto& [means, as_written] :
         {std::pair{true, json{1, "true", "True", "1"}}, std::pair{false, json{0, "false", "False", "0", ""}}})
      if (std::find(as_written.begin(), as_written.end(), value) != as_written.end()) return means;
    return refuse(place, fmt::format("'{}' is {}, neither true nor false", key, value.dump()), "write true or false");
  }

  // The lens of a file or of one of its frames, which may leave it to the file; nothing when reported.
  std::optional<LensKind> model(const json& node, LensKind otherwise, const std::string& place) {
    std::string model;
    if (const json* name = given(node, "camera_model")) {
      if (!name->is_string())
        return refuse(place, "'camera_model' is " + name->dump() + ", which is not a name",
                      "write \"camera_model\": \"OPENCV\", or leave the key out");
      model = name->get<std::string>();
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
    diagnostics_.error("scene.camera.model", place,
                       "camera model '" + model +
                           "' is not supported (only OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, "
                           "OPENCV_FISHEYE, EQUIRECTANGULAR)",
                       kUndistort);
    return std::nullopt;
  }

  /// What a file or a frame leaves out, `base` has; nothing for a lens that is not read, which is reported.
  std::optional<TransformsLens> lens(const json& node, const TransformsLens& base, const std::string& place) {
    const std::optional<LensKind> kind = model(node, base.told.lens, place);
    if (!kind) return std::nullopt;
    TransformsLens out = base;
    out.told.lens = *kind;
    const auto take = [&](const char* key, auto& into) {
      if (const std::optional<double> value = number(node, key, place)) into = *value;
    };
    take("w", out.w);
    take("h", out.h);
    take("fl_x", out.told.fx);
    take("fl_y", out.told.fy);
    take("camera_angle_x", out.camera_angle_x);
    take("camera_angle_y", out.camera_angle_y);
    for (const auto& [key, field] : kDistortion) take(key, out.told.*field);
    take("cx", out.cx);
    take("cy", out.cy);
    read_distortion(node, out, place);
    read_camera_matrix(node, out, place);
    return out;
  }

  /// Metres of one step of a depth image: `otherwise` where no key says; 0 = not told.
  double depth_unit(const json& node, double otherwise, const std::string& place) {
    // Ours, instant-ngp's and nerfstudio's. What other names mean is not clear: steps per metre, or metres per step.
    constexpr std::array kKeys{"depth_unit_m", "integer_depth_scale", "depth_unit_scale_factor"};
    for (const char* key : {"depth_scale", "depth_scale_factor", "depth_factor", "depth_unit", "png_depth_scale"})
      if (node.contains(key) && unclear_depth_key_.empty()) unclear_depth_key_ = key;
    const char* from = nullptr;
    double unit = otherwise;
    for (const char* key : kKeys) {
      const std::optional<double> value = number(node, key, place);
      if (!value || *value == 0) continue;
      if (!(*value >= 1e-9 && *value <= 1e6)) {
        refuse(place, fmt::format("{} must be positive, from 1e-9 to 1e6", key),
               "write the metres of one step, such as 0.001");
      } else if (from != nullptr && *value != unit) {
        refuse(place, fmt::format("'{}' is not what '{}' says of the unit of depth", key, from), "keep one of the two");
      } else {
        from = key;
        unit = *value;
      }
    }
    return unit;
  }
  /// A key met that seems to tell the unit of depth, of which it is not clear how; "" for none.
  const std::string& unclear_depth_key() const { return unclear_depth_key_; }

 private:
  // Whether a single key is left out or says what `whole`, which has its value too, says; reports it otherwise.
  bool agrees(const json& node, const char* key, double value, const char* whole, const std::string& place) {
    if (!node.contains(key) || !node[key].is_number() || node[key].get<double>() == value) return true;
    refuse(place, fmt::format("'{}' is not what '{}' has in its place", key, whole), "keep one of the two");
    return false;
  }

  // nerfstudio's list of all coefficients, which takes the place of the single keys there.
  void read_distortion(const json& node, TransformsLens& lens, const std::string& place) {
    const json* list = given(node, "distortion_params");
    if (list == nullptr) return;
    if (!are_numbers(*list) || list->size() != std::size(kDistortion)) {
      refuse(place, "'distortion_params' is not a list of six numbers", "write [k1, k2, k3, k4, p1, p2]");
      return;
    }
    for (std::size_t i = 0; i < std::size(kDistortion); ++i) {
      const auto& [key, field] = kDistortion[i];
      const double value = (*list)[i].get<double>();
      if (!agrees(node, key, value, "distortion_params", place)) return;
      lens.told.*field = value;
    }
  }

  // The numbers of a 3 x 3, 3 x 4 or 4 x 4 matrix, of its rows or all in one list; the first three of its first three
  // rows.
  static std::optional<std::array<double, 9>> matrix_of(const json& value) {
    std::vector<double> all;
    std::size_t rows = 0;
    if (!value.is_array()) return std::nullopt;
    for (const json& row : value) {
      rows += row.is_array() ? 1 : 0;
      for (const json& one : row.is_array() ? row : json::array({row})) {
        if (!one.is_number()) return std::nullopt;
        all.push_back(one.get<double>());
      }
    }
    const std::size_t columns = all.size() == 9 ? 3 : all.size() == 12 || all.size() == 16 ? 4 : 0;
    if (columns == 0 || (rows != 0 && rows != all.size() / columns)) return std::nullopt;
    std::array<double, 9> out{};
    for (std::size_t i = 0; i < 9; ++i) out[i] = all[i / 3 * columns + i % 3];
    return out;
  }

  // A lens as the matrix of a pinhole camera, row by row or transposed.
  void read_camera_matrix(const json& node, TransformsLens& lens, const std::string& place) {
    for (const char* key : {"K", "intrinsics", "intrinsic_matrix", "camera_matrix", "cam_K"}) {
      const json* matrix = given(node, key);
      if (matrix == nullptr) continue;
      const std::optional<std::array<double, 9>> found = matrix_of(*matrix);
      std::array<double, 9> k = found.value_or(std::array<double, 9>{});
      if (k[2] == 0 && k[5] == 0) {
        std::swap(k[1], k[3]);
        std::swap(k[2], k[6]);
        std::swap(k[5], k[7]);
      }
      if (!found || k[1] != 0 || k[3] != 0 || k[6] != 0 || k[7] != 0 || k[8] != 1) {
        if (lens.told.fx != 0 || lens.camera_angle_x != 0) continue;  // something else of that name
        diagnostics_.error("scene.camera.format", place,
                           fmt::format("'{}' is not the matrix of a pinhole camera without skew", key),
                           "write 'fl_x', 'fl_y', 'cx' and 'cy', or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]");
        return;
      }
      const std::pair<const char*, double> same[] = {{"fl_x", k[0]}, {"fl_y", k[4]}, {"cx", k[2]}, {"cy", k[5]}};
      for (const auto& [name, value] : same)
        if (!agrees(node, name, value, key, place)) return;
      lens.told.fx = k[0];
      lens.told.fy = k[4];
      lens.cx = k[2];
      lens.cy = k[5];
      return;
    }
  }

  Diagnostics& diagnostics_;
  std::string unclear_depth_key_;
};

// Keys of transforms.json: those that are read, and what others look like.

bool is_in(const std::vector<std::string>& list, const std::string& key) {
  return std::find(list.begin(), list.end(), key) != list.end();
}

const std::vector<std::string> kLensKeys = word_list(
    "w h fl_x fl_y cx cy camera_angle_x camera_angle_y k1 k2 k3 k4 p1 p2 camera_model is_fisheye distortion_params K "
    "intrinsics intrinsic_matrix camera_matrix cam_K");
const std::vector<std::string> kFileKeys = word_list(
    "frames classes depth_unit_m train_filenames test_filenames val_filenames aabb_scale scale offset "
    "integer_depth_scale depth_unit_scale_factor depth_camera metric");
const std::vector<std::string> kFrameKeys = word_list(
    "file_path depth_path label_path instance_path depth_file_path mask_path transform_matrix depth_unit_m "
    "integer_depth_scale depth_unit_scale_factor");
// Keys of nerfstudio, instant-ngp and Blender that are near one of ours.
const std::vector<std::string> kStrangers = word_list("frame_id filenames depth_unit");

// Our keys, and what other programs and people call them.
const std::map<std::string, std::vector<std::string>> kOtherNames{
    {"fl_x", word_list("fx focal focal_length")},
    {"fl_y", word_list("fy")},
    {"w", word_list("width")},
    {"h", word_list("height")},
    {"cx", word_list("c_x")},
    {"cy", word_list("c_y")},
    {"file_path", word_list("image image_path filename file_name")},
    {"transform_matrix", word_list("pose matrix c2w transform camera_to_world")}};

// The key that is read, of a file or with `of_frame` of one of its frames, that `key` is near; "" for one that is read
// itself, is known from other programs, or is near none. `named` are keys of frames that the configuration names.
std::string meant_key(const std::string& key, bool of_frame, const std::vector<std::string>& named) {
  std::vector<std::string> known = kLensKeys;
  const std::vector<std::string>& own = of_frame ? kFrameKeys : kFileKeys;
  known.insert(known.end(), own.begin(), own.end());
  if (of_frame) known.insert(known.end(), named.begin(), named.end());
  if (is_in(known, key) || is_in(kStrangers, key)) return "";
  for (const auto& [ours, others] : kOtherNames)
    if (is_in(others, key)) return is_in(known, ours) ? ours : "";
  for (const char* end : {"_path", "_file_path", "_matrix"})
    if (is_in(own, key + end)) return key + end;
  return key.size() < 4 ? "" : closest_spelling(key, known);
}

// Reading transforms.json.

class FileReader {
 public:
  FileReader(std::string path, std::optional<Split> split, const TransformsJsonParams& params, TransformsIndex& out,
             Diagnostics& diagnostics)
      : path_(std::move(path)),
        folder_(fs::path(path_).parent_path()),
        split_(split),
        params_(params),
        named_{params.label_key},
        values_(diagnostics),
        out_(out),
        diagnostics_(diagnostics) {
    for (const std::string& name : params.channels) named_.push_back(name + "_path");
  }

  void read() {
    const int before = diagnostics_.error_count();
    const json root = read_pose_json<json>(path_, "export the poses again");
    if (!root.is_object() || !root.contains("frames") || !root["frames"].is_array()) {
      throw Error(ErrorKind::data, "scene.index.format", "'" + path_ + "' has no list 'frames'",
                  "give a transforms.json of nerfstudio, instant-ngp or Blender");
    }
    const std::optional<TransformsLens> lens = values_.lens(root, {}, path_);
    if (!lens) return;
    const double depth_unit_m = values_.depth_unit(root, 0, path_);
    read_depth_camera(root);
    out_.metric = values_.flag(root, "metric", path_).value_or(false) || out_.metric;
    read_classes(root);
    // What is missing in every frame for a key that the file misspells would be said of every frame.
    const bool sound = check_keys(root, false, path_);
    SplitLists lists = read_split_lists(root);
    for (std::size_t i = 0; i < root["frames"].size(); ++i) {
      TransformsFrame frame = read_frame(root["frames"][i], i, *lens, sound);
      if (frame.color.empty()) {
        frame.split = split_;
      } else {
        frame.split = split_in(lists, frame);
        frame.depth_unit_m = values_.depth_unit(root["frames"][i], depth_unit_m, frame.entry);
      }
      out_.frames.push_back(std::move(frame));
    }
    if (diagnostics_.error_count() == before) report_unmatched(lists);
    if (out_.unclear_depth_key.empty()) out_.unclear_depth_key = values_.unclear_depth_key();
    for (const std::string& name : unread_maps_)
      diagnostics_.note("scene.channel.unread", path_,
                        fmt::format("frames name maps of '{}', which nothing reads; scene.channels: [{}] offers "
                                    "them to heads and losses",
                                    name, name));
  }

 private:
  // A list of names: each by its path, and whether a frame has it.
  struct SplitList {
    const char* key;
    std::unordered_map<std::string, std::pair<std::string, bool>> names;
    bool holds(const TransformsFrame& frame, const std::string& as_written) {
      bool found = false;
      for (const std::string& path : {as_written, decomposed(fs::absolute(frame.color).lexically_normal().string())}) {
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
      const json* names = given(root, list->key);
      if (names == nullptr) continue;
      if (!names->is_array() ||
          !std::all_of(names->begin(), names->end(), [](const json& n) { return n.is_string(); })) {
        values_.refuse(path_, fmt::format("'{}' is not a list of names", list->key),
                       "write the 'file_path' of each frame");
        continue;
      }
      for (const json& name : *names) {
        const auto text = name.get<std::string>();
        list->names.try_emplace(path_of_name(text), text, false);
      }
    }
    return lists;
  }

  // Where no list of training frames is given, all that no other list names train.
  std::optional<Split> split_in(SplitLists& lists, const TransformsFrame& frame) {
    if (!lists.any()) return split_;
    const std::string path = path_of_name(frame.name);
    const bool in_train = lists.train.holds(frame, path), in_test = lists.test.holds(frame, path),
               in_val = lists.val.holds(frame, path);
    const bool tests = lists.test.names.empty() ? in_val : in_test;
    if (in_train && tests)
      diagnostics_.error("scene.split.overlap", frame.entry, "is both in train_filenames and among the frames held out",
                         "keep it in one of the two lists");
    if (tests) return Split::test;
    return in_train || (lists.train.names.empty() && !in_val) ? Split::train : Split::unused;
  }

  void report_unmatched(const SplitLists& lists) {
    for (const SplitList* list : {&lists.train, &lists.test, &lists.val}) {
      std::vector<std::string> unmatched;
      for (const auto& [path, name] : list->names)
        if (!name.second) unmatched.push_back(name.first);
      if (unmatched.empty()) continue;
      diagnostics_.error("scene.split.unknown", path_,
                         fmt::format("{} of {} names in '{}' fit no frame, such as '{}'", unmatched.size(),
                                     list->names.size(), list->key, *std::ranges::min_element(unmatched)),
                         "write each as the 'file_path' of its frame");
    }
  }

  void read_depth_camera(const json& root) {
    if (given(root, "depth_camera") == nullptr) return;
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
    out_.depth_lens = values_.lens(node, {}, place);
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
      values_.refuse(path_, "'classes' is neither a path nor a list of {id, name, ignore}",
                     "write \"classes\": \"classes.yaml\"");
      return;
    }
    for (const json& c : classes) {
      const auto number = c["id"].get<std::int64_t>();
      // Out of range stays out of range: the table refuses it.
      const auto id = static_cast<std::int32_t>(number < -1 || number > 70000 ? -1 : number);
      out_.class_list.push_back(
          {id, c["name"].get<std::string>(), ClassTable::default_color(std::max(id, 0)), c.value("ignore", false)});
    }
  }

  // Blender leaves the extension out.
  std::string file_of(const fs::path& path) {
    std::string as_written = names_.of(path.string());
    if (is_there(as_written)) return as_written;
    for (const char* extension : {".png", ".jpg", ".jpeg", ".JPG", ".PNG", ".exr", ".webp", ".tif"}) {
      const std::string longer = names_.of(path.string() + extension);
      if (is_there(longer)) return longer;
    }
    return as_written;
  }

  TransformsFrame read_frame(const json& item, std::size_t index, const TransformsLens& lens, bool sound) {
    TransformsFrame frame;
    frame.entry = path_ + ": frame " + std::to_string(index);
    if (!item.is_object()) {
      diagnostics_.error("scene.index.format", frame.entry, "is not a map",
                         "write {\"file_path\": ..., \"transform_matrix\": ...}");
      return frame;
    }
    const auto path_of = [&](const char* key) {
      return item.contains(key) && item[key].is_string() ? item[key].get<std::string>() : std::string();
    };
    frame.name = path_of("file_path");
    const bool keys_are_read = check_keys(item, true, frame.entry + " (" + frame.name + ")");
    if (frame.name.empty()) {
      if (keys_are_read)
        diagnostics_.error("scene.index.format", frame.entry, "has no 'file_path'", "name the image of the frame");
      return frame;
    }
    frame.entry += " (" + frame.name + ")";
    if (!sound || !keys_are_read) {
      values_.model(item, lens.told.lens, frame.entry);  // which is said all the same
      return frame;
    }
    const std::optional<TransformsLens> own = values_.lens(item, lens, frame.entry);
    if (!own) return frame;
    frame.lens = *own;
    frame.color = file_of(folder_ / frame.name);
    const char* const depth_key = path_of("depth_path").empty() ? "depth_file_path" : "depth_path";  // nerfstudio's
    for (const auto& [key, file] : {std::pair{depth_key, &FrameFiles::depth},
                                    {params_.label_key.c_str(), &FrameFiles::label},
                                    {"instance_path", &FrameFiles::instance},
                                    {"mask_path", &FrameFiles::mask}})
      if (const std::string path = *key == '\0' ? "" : path_of(key); !path.empty())
        frame.*file = file_of(folder_ / path);
    for (const std::string& name : params_.channels)
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
      if (of_frame && value.is_string()) look_for_map(key, value.get<std::string>());
      const auto [found, fresh] = meant_.try_emplace({of_frame, key});
      if (fresh) found->second = meant_key(key, of_frame, named_);
      const std::string& meant = found->second;
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
      diagnostics_.error("scene.camera.model", place, fmt::format("'{}' is not 0: such cameras are not read", key),
                         kUndistort);
    }
    return diagnostics_.error_count() == before;
  }

  // A key NAME_path of a frame that names a .npy and that nothing reads is remembered by its name.
  void look_for_map(const std::string& key, const std::string& file) {
    constexpr std::string_view kEnd = "_path";
    if (!is_in(kFrameKeys, key) && !is_in(named_, key) && key.ends_with(kEnd) && file.ends_with(".npy"))
      unread_maps_.insert(key.substr(0, key.size() - kEnd.size()));
  }

  // Poses as exporters of trackers write them.
  static std::string quaternion_in(const json& item) {
    for (const auto& [key, value] : item.items())
      if (are_numbers(value) && (value.size() == 4 || value.size() == 7 || value.size() == 8))
        return "; '" + key + "' looks like a quaternion, which is not read";
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
        "scene.pose.format", frame.entry,
        (rows == nullptr ? "has no 'transform_matrix'" : "'transform_matrix' is not 4 rows of 4 numbers") +
            quaternion_in(item),
        "write the camera-to-world matrix row by row");
  }

  std::string path_;
  fs::path folder_;
  std::optional<Split> split_;
  const TransformsJsonParams& params_;
  std::vector<std::string> named_;                             // keys of frames that the configuration names
  std::map<std::pair<bool, std::string>, std::string> meant_;  // of frames or not, keys met -> what they look like
  std::set<std::string> unread_maps_;
  TransformsValues values_;
  FileNames names_;
  TransformsIndex& out_;
  Diagnostics& diagnostics_;
};

// Reads `root`/transforms.json, or transforms_train/val/test.json, or `root` itself when it is a file; without a test
// file the validation frames are held out. Throws Error when no index is there or it is not JSON.
TransformsIndex read_transforms(const std::string& root, const TransformsJsonParams& params, Diagnostics& diagnostics) {
  TransformsIndex out;
  const auto read = [&](const std::string& path, std::optional<Split> split) {
    FileReader(path, split, params, out, diagnostics).read();
  };
  const fs::path folder(root);
  const bool is_index = is_there(root) && !is_folder(root);
  if (!is_index) require_folder(root, "check scene.root");
  const fs::path whole = is_index ? folder : folder / "transforms.json";
  if (is_there(whole)) {
    read(whole.string(), std::nullopt);
    return out;
  }
  const bool has_test = is_there(folder / "transforms_test.json");
  bool any = false;
  for (const auto& [name, split] : {std::pair{"transforms_train.json", Split::train},
                                    {"transforms_test.json", Split::test},
                                    {"transforms_val.json", has_test ? Split::unused : Split::test}}) {
    if (!is_there(folder / name)) continue;
    any = true;
    read((folder / name).string(), split);
  }
  if (!any)
    throw Error(ErrorKind::no_input, "scene.poses.missing",
                "no transforms.json or transforms_train.json in '" + root + "'",
                "check scene.root; it names the folder of one scene");
  return out;
}

}  // namespace

void describe(ParamVisitor& visit, TransformsJsonParams& p) {
  SEMFIELD_PARAM(
      visit, p, root,
      "folder with transforms.json (or Blender's transforms_train.json and transforms_test.json), or the file itself");
  SEMFIELD_PARAM(visit, p, test_every,
                 "every N-th frame, by name, is held out for tests where the index names no test frame; 0 = none",
                 {0, 1e6});
  SEMFIELD_PARAM(visit, p, label_key, "key of a frame that names its label image; empty = no labels");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the file's own, or the one next to it");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
  SEMFIELD_PARAM(visit, p, depth_unit_m, "metres of one step of a depth image; 0 = what the file says, else 0.001",
                 {0, 1000});
  SEMFIELD_PARAM(visit, p, alpha_background, "grey that shows through transparent pixels, 0 to 255; -1 = drop alpha",
                 {-1, 255});
  SEMFIELD_PARAM(visit, p, alpha_masks,
                 "transparent pixels are missing data and are masked; else they show alpha_background, as empty space");
  SEMFIELD_PARAM(visit, p, masks, kMasksSentence);
  SEMFIELD_PARAM(visit, p, metric, "poses are in metres (they are taken to be when the scene has depth)");
  SEMFIELD_PARAM(
      visit, p, channels,
      "further channels by name, which losses may read: the key NAME_path of a frame names a .npy of [h, w, k] "
      "numbers, whose grid covers the image");
}

std::string recognise(const std::string& path, TransformsJsonParams& p) {
  const fs::path file(path);
  p.root = path;
  if (is_file(file) && file.extension() == ".json" && file.filename().string().starts_with("transforms")) {
    // The usual names stand for the whole folder, whose other file may hold the tests.
    const std::string name = file.filename().string();
    if (name == "transforms.json" || name == "transforms_train.json") p.root = file.parent_path().string();
    return name;
  }
  for (const char* name : {"transforms.json", "transforms_train.json"})
    if (is_file(file / name)) return name;
  return "";
}

namespace {

// Pixel centres at +0.5 already; fx from fl_x or fx = (w / 2) / tan(angle / 2).
Camera camera_of(const TransformsLens& lens, std::int32_t width, std::int32_t height) {
  const auto from_angle = [](double size, double angle) {
    return angle > 0 && angle < M_PI ? 0.5 * size / std::tan(0.5 * angle) : 0.0;
  };
  Camera c;
  c.lens = lens.told.lens;
  if (c.lens == LensKind::equirectangular) {
    // Focal lengths of nerfstudio's panoramas are half the width and the height; ours are pixels per radian.
    c.fx = (lens.told.fx != 0 ? lens.told.fx : 0.5 * width) / M_PI;
    c.fy = (lens.told.fy != 0 ? lens.told.fy : height) / M_PI;
  } else {
    c = lens.told;
    if (c.fx == 0) c.fx = from_angle(width, lens.camera_angle_x);
    if (c.fy == 0)
      c.fy = lens.camera_angle_y != 0 && lens.told.fx == 0 ? from_angle(height, lens.camera_angle_y) : c.fx;
  }
  c.width_px = width;
  c.height_px = height;
  c.cx = lens.cx.value_or(0.5 * width);
  c.cy = lens.cy.value_or(0.5 * height);
  return c;
}

// How large an image may be is for `limits` to say; here it has to be a size at all.
bool whole_size(double value) { return value >= 1 && value <= 2147483647.0 && value == std::floor(value); }

// What cannot be read is reported with the headers.
bool is_real(const std::string& depth) {
  try {
    return has_real_depth(depth);
  } catch (const Error&) {
    return false;
  }
}

// The camera of a lens; the image's header tells the size where the file does not. False when reported.
bool frame_camera(const TransformsLens& l, const std::string& image, const std::string& place, Camera& out,
                  Diagnostics& diagnostics) {
  const bool told = l.w != 0 || l.h != 0;
  if (told && (!whole_size(l.w) || !whole_size(l.h))) {
    diagnostics.error("scene.image.size", place, "image size 'w' x 'h' is not a pair of whole numbers of pixels",
                      "write the size of the image, or leave both out");
    return false;
  }
  ImageSize size{static_cast<std::int32_t>(l.w), static_cast<std::int32_t>(l.h), 3, 8};
  try {
    if (told)
      check_input_limit(static_cast<std::int64_t>(std::max(l.w, l.h)), input_limits().image_axis_px,
                        "image size 'w' x 'h': ", "pixels along an axis", "image_axis_px");
    else
      size = image_size(image);
  } catch (const Error& e) {
    diagnostics.error(e.code(), place, (told ? "" : "colour image ") + e.message(), e.remedy());
    return false;
  }
  if (l.told.fx == 0 && l.told.fy == 0 && l.camera_angle_x == 0 && l.camera_angle_y == 0 &&
      l.told.lens != LensKind::equirectangular) {
    diagnostics.error("scene.camera.missing", place,
                      "no focal length: neither the file nor the frame has 'fl_x', 'camera_angle_x' or a matrix 'K'",
                      "write 'fl_x', 'fl_y', 'cx' and 'cy' in pixels");
    return false;
  }
  out = camera_of(l, size.width_px, size.height_px);
  return true;
}

// What the pixels of the depth camera show, where the index tells of one.
void read_depth_camera(const TransformsIndex& index, const std::string& root, FrameReadRules& rules,
                       Diagnostics& diagnostics) {
  if (!index.depth_lens) return;
  const std::string place = root + ": 'depth_camera'";
  const TransformsLens& lens = *index.depth_lens;
  if (!whole_size(lens.w) || !whole_size(lens.h) || lens.told.fx == 0) {
    diagnostics.error("scene.camera.missing", place, "has no size or no focal length",
                      "write 'w', 'h', 'fl_x', 'fl_y', 'cx' and 'cy' of the depth images, in pixels");
    return;
  }
  DepthCamera out{camera_of(lens, static_cast<std::int32_t>(lens.w), static_cast<std::int32_t>(lens.h)),
                  pose_from_rows(index.depth_from_color)};
  if (!check_camera(out.camera, place, diagnostics)) return;
  const PoseState state = check_pose(out.depth_from_color, place, diagnostics);
  if (state == PoseState::not_finite)
    diagnostics.error("scene.pose.format", place, "'depth_from_color' holds a value that is not finite",
                      "write 4 rows of 4 numbers");
  if (state != PoseState::good) return;
  rules.depth = DepthGrid::apart;
  rules.depth_camera = out;
}

// Frames that are in a split and have a pose, each image once.
std::vector<TransformsFrame*> used_frames(TransformsIndex& index, const std::string& root, Diagnostics& diagnostics) {
  std::vector<TransformsFrame*> used;
  std::map<std::string, const TransformsFrame*> seen;
  std::size_t unused = 0;
  for (TransformsFrame& in : index.frames) {
    unused += in.split == Split::unused ? 1 : 0;
    if (in.matrix.empty() || in.split == Split::unused) continue;
    const auto [other, fresh] = seen.emplace(fs::path(in.color).lexically_normal().string(), &in);
    if (fresh) {
      used.push_back(&in);
      continue;
    }
    const bool both = other->second->split != in.split;
    diagnostics.error("scene.frame.twice", in.entry,
                      both ? "image is listed for training and for tests" : "image is listed twice",
                      "keep one of the two frames");
  }
  if (unused > 0)
    diagnostics.note(
        "scene.frames.unused", root,
        fmt::format("{} of {} frames are in neither split, as the index says", unused, index.frames.size()));
  return used;
}

// Splits stay as the index tells them; where it names no test frame, every n-th of the sorted names is held out, so
// that the order of the export does not matter.
void choose_splits(const std::vector<TransformsFrame*>& frames, std::int32_t test_every, const std::string& root,
                   Diagnostics& diagnostics) {
  if (std::any_of(frames.begin(), frames.end(), [](const TransformsFrame* in) { return in->split == Split::test; })) {
    if (test_every != TransformsJsonParams{}.test_every)
      diagnostics.note("scene.split.given", root, "the index names the test frames; scene.test_every is not used");
    return;
  }
  const bool told = std::any_of(frames.begin(), frames.end(), [](const TransformsFrame* in) { return in->split; });
  std::vector<std::string> order;
  for (const TransformsFrame* in : frames) order.push_back(in->name);
  std::sort(order.begin(), order.end());
  std::size_t held_out = 0;
  for (TransformsFrame* in : frames) {
    const auto rank = std::lower_bound(order.begin(), order.end(), in->name) - order.begin();
    in->split = HoldOut{test_every}.split_of(static_cast<std::size_t>(rank), order.size());
    held_out += in->split == Split::test ? 1 : 0;
  }
  if (told && held_out > 0)
    diagnostics.note("scene.split.made", root,
                     fmt::format("the index names no test frame: {} of {} are held out, one in {} (scene.test_every; "
                                 "0 = none)",
                                 held_out, frames.size(), test_every));
}

}  // namespace

SceneInfo find_photographs(const TransformsJsonParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  const std::string& root = files.root();
  TransformsIndex index = read_transforms(root, params, diagnostics);
  const std::vector<TransformsFrame*> used = used_frames(index, root, diagnostics);
  choose_splits(used, params.test_every, root, diagnostics);
  PhotographRules rules;
  rules.read.labels_key = "label_key";
  rules.read.depth = DepthGrid::image;
  rules.read.alpha_background = params.alpha_background;
  rules.read.alpha_masks = params.alpha_masks;
  rules.opengl_files = true;
  rules.depth_unit_m = params.depth_unit_m;
  rules.labels_by_name = false;
  rules.class_file = index.classes;
  rules.class_list = index.class_list;
  read_depth_camera(index, root, rules.read, diagnostics);
  std::vector<PosedPhotograph> photos;
  for (const TransformsFrame* in : used) {
    photos.push_back(*in);
    photos.back().find_camera = [in, &diagnostics](const std::string& place, Camera& camera) {
      return frame_camera(in->lens, in->color, place, camera, diagnostics);
    };
  }
  SceneInfo info = files.open(std::move(photos), std::move(rules), diagnostics);
  bool has_depth = false, unit_told = true;
  int real_depth = 0;
  for (const PosedPhotograph& photo : files.photographs()) {
    if (photo.depth.empty()) continue;
    has_depth = true;
    unit_told = unit_told && photo.depth_unit_m > 0;
    real_depth += photo.depth_unit_m > 0 && photo.depth_unit_m != 1 && is_real(photo.depth) ? 1 : 0;
  }
  if (params.depth_unit_m == 0 && !unit_told && !index.unclear_depth_key.empty())
    diagnostics.error("scene.depth.unit", root,
                      "'" + index.unclear_depth_key +
                          "' may be the steps of a depth image per metre or the metres of a step, and is not read",
                      "write \"depth_unit_m\" with the metres of a step, or set scene.depth_unit_m");
  if (real_depth > 0)
    diagnostics.note("scene.depth.real", root,
                     fmt::format("{} depth files hold real numbers, which are taken as they are: the unit that the "
                                 "index states is of integers",
                                 real_depth));
  info.metric = params.metric || index.metric || has_depth;
  return info;
}

SEMFIELD_PLUGIN_MODULE(transforms_json, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<TransformsJsonParams>, TransformsJsonParams>(
      "transforms_json", "Posed images with a transforms.json of nerfstudio, instant-ngp or Blender.");
})

}  // namespace semfield
