// Pre-rendered Replica sequences: traj_w_c.txt, rgb/, depth/, semantic_class/, semantic_instance/; or as NICE-SLAM
// renders them: traj.txt, results/frame*.jpg and depth*.png.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <numeric>
#include <string>
#include <tuple>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

using nlohmann::json;

enum class ReplicaSplit { by_steps, paper };
SEMFIELD_CHOICES(ReplicaSplit, "auto", "paper");

/// Its keys are those of PhotographParams but `every`, `least_confidence` and `masks`.
struct ReplicaParams : PhotographParams {
  ReplicaParams() { label_dir = "semantic_class"; }
  std::string sequence;
  double hfov_deg = 90;
  std::string test_label_dir;
  ReplicaSplit split = ReplicaSplit::by_steps;
  std::int32_t train_step = 0;
  std::int32_t train_offset = 0;
  std::int32_t test_step = 0;
  std::int32_t test_offset = 0;
};

namespace {

/// Whether a folder holds traj.txt and results/.
bool is_slam_sequence(const fs::path& folder) { return is_file(folder / "traj.txt") && is_folder(folder / "results"); }

/// What cam_params.json says, which lies beside the trajectory or in the folder above: {"camera": {"w": 1200, "h": 680,
/// "fx": 600, "fy": 600, "cx": 599.5, "cy": 339.5, "scale": 6553.5}}
struct SlamCamera {
  Camera camera;                     ///< width 0 where there is no such file, or one that was reported
  double depth_unit_m = 1 / 6553.5;  ///< of one step of a depth image
};
SlamCamera read_slam_camera(const fs::path& folder, Diagnostics& diagnostics) {
  constexpr const char* kFile = "cam_params.json";
  const fs::path beside = folder / kFile, above = fs::weakly_canonical(folder).parent_path() / kFile;
  const std::string path = (is_there(beside) ? beside : above).string();
  if (!is_there(path)) return {};
  const json root = read_pose_json<json>(path, "download the scene again");
  bool sound = true;
  const auto number = [&](const char* key) {
    const json camera = root.is_object() ? root.value("camera", json()) : json();
    if (camera.is_object() && camera.contains(key) && camera[key].is_number()) return camera[key].get<double>();
    if (sound)
      diagnostics.error("scene.index.value", path, std::string("has no number '") + key + "' in 'camera'",
                        "download the scene again");
    sound = false;
    return 0.0;
  };
  const double width = number("w"), height = number("h"), steps = number("scale");
  // Centres of pixels are whole numbers there.
  Camera camera{0, 0, number("fx"), number("fy"), number("cx") + 0.5, number("cy") + 0.5};
  if (!sound || !set_image_size(camera, width, height, path, diagnostics)) return {};
  if (steps >= 1e-6 && steps <= 1e9) return {camera, 1 / steps};
  diagnostics.error("scene.index.value", path, "'scale' is not a number of steps per metre",
                    "write the steps of a depth image per metre, such as 6553.5");
  return {};
}

}  // namespace

void describe(ParamVisitor& visit, ReplicaParams& p) {
  SEMFIELD_PARAM(visit, p, root,
                 "folder of the scene: it holds traj_w_c.txt, or Sequence_1 and so on, or traj.txt and results/");
  SEMFIELD_PARAM(visit, p, sequence, "folder of the sequence inside root; empty = root itself, else Sequence_1");
  SEMFIELD_PARAM(visit, p, hfov_deg, "horizontal field of view of the renders, degrees", {1, 179});
  SEMFIELD_PARAM(
      visit, p, label_dir,
      "folder of the label images semantic_class_<i>.png or <i>.png, with or without zeros before <i>; empty = "
      "no labels");
  SEMFIELD_PARAM(visit, p, test_label_dir,
                 "label folder of the test frames; empty = label_dir, and semantic_class where it has no file");
  SEMFIELD_PARAM(visit, p, classes, "class table (.yaml, .csv, .json); empty = the one found next to the sequence");
  SEMFIELD_PARAM(visit, p, unknown_labels, "how a label id outside the class table is read: as an error, or as void");
  SEMFIELD_PARAM(visit, p, missing, kMissingSentence);
  SEMFIELD_PARAM(
      visit, p, split,
      "auto: by the steps where one is given, else every frame is in a split, by test_every; paper: frames 0, "
      "5, 10, ... train and 2, 7, 12, ... are held out [Zhi21]");
  SEMFIELD_PARAM(visit, p, test_every,
                 "every N-th frame is held out for tests, the others train; 0 = none; without steps only", {0, 1e6});
  SEMFIELD_PARAM(visit, p, train_step, "every N-th frame trains; 0 = all that are not held out", {0, 1e6});
  SEMFIELD_PARAM(visit, p, train_offset, "number of the first training frame, with train_step", {0, 1e6});
  SEMFIELD_PARAM(visit, p, test_step,
                 "every N-th frame is held out for tests; 0 = none, and without train_step by test_every", {0, 1e6});
  SEMFIELD_PARAM(visit, p, test_offset, "number of the first test frame, with test_step", {0, 1e6});
}

void validate(const ReplicaParams& p, Diagnostics& diagnostics) {
  check_root_and_test_every(p.root, p.test_every, diagnostics);
  if (p.split == ReplicaSplit::paper && (p.train_step > 0 || p.test_step > 0))
    diagnostics.error("config.value.conflict", "split", "paper has steps of its own",
                      "drop scene.train_step and scene.test_step, or set scene.split: auto");
  if (p.train_step == 0 && p.test_step == 1)
    diagnostics.error("scene.split.empty", "test_step", "1 leaves no frame to train on",
                      "take 2 or more, or 0 for test_every");
  // Two arithmetic sequences meet when their offsets agree modulo the greatest common divisor of their steps.
  if (p.train_step > 0 && p.test_step > 0 &&
      (p.train_offset - p.test_offset) % std::gcd(p.train_step, p.test_step) == 0)
    diagnostics.error("scene.split.overlap", "test_offset",
                      fmt::format("test frames {} + n * {} meet training frames {} + n * {}", p.test_offset,
                                  p.test_step, p.train_offset, p.train_step),
                      "choose offsets that never meet, or test_step: 0");
}

std::string recognise(const std::string& path, ReplicaParams& p) {
  p.root = path;
  for (const char* folder : {".", "Sequence_1"}) {
    if (is_file(fs::path(path) / folder / "traj_w_c.txt")) return "Replica's traj_w_c.txt";
  }
  return is_slam_sequence(path) ? "Replica's traj.txt and results/, as NICE-SLAM has them" : "";
}

namespace {

class Replica {
 public:
  Replica(const ReplicaParams& params, PosedPhotographs& files) : params_(params), files_(files), root_(files.root()) {
    if (params_.split == ReplicaSplit::paper) {
      params_.train_step = params_.test_step = 5;
      params_.train_offset = 0;
      params_.test_offset = 2;
    }
  }

  SceneInfo open(Diagnostics& diagnostics) {
    folder_ = sequence_folder();
    const std::string trajectory = (folder_ / (slam_ ? "traj.txt" : "traj_w_c.txt")).string();
    for (const std::string& labels : {params_.label_dir, params_.test_label_dir}) {
      // The default folder may be absent (a scene without labels); one that was asked for may not.
      const bool asked = !labels.empty() && labels != ReplicaParams{}.label_dir;
      if (asked && !fs::is_directory(folder_ / labels))
        diagnostics.error("labels.folder.missing", (folder_ / labels).string(), "label folder is missing",
                          "check scene.label_dir and scene.test_label_dir");
    }
    index_labels(diagnostics);
    std::size_t rows = 0;
    std::vector<PosedPhotograph> photos = read_trajectory(trajectory, diagnostics, rows);
    check_poses_for_images(trajectory, rows, diagnostics);
    set_cameras(photos, diagnostics);
    SceneInfo info = files_.open(std::move(photos),
                                 {.read = {},
                                  .place = folder_.string(),
                                  .poses = trajectory,
                                  .with_masks = false,
                                  .labels_by_name = false,
                                  .class_folders = {folder_.string(), root_.string(), (root_ / "habitat").string()}},
                                 diagnostics);
    info.near_hint_m = 0.1;  // the rooms' range [Zhi21, section 4.1]
    info.far_hint_m = 10;
    std::size_t unused = 0;
    for (std::size_t number = 0; number < rows; ++number)
      unused += split_of(static_cast<int>(number)) == Split::unused ? 1 : 0;
    if (unused > 0)
      diagnostics.note(
          "scene.frames.unused", root_,
          fmt::format("{} of {} frames are in neither split (scene.split, or train_step and test_step)", unused, rows));
    report_unlabelled(info, diagnostics);
    return info;
  }

 private:
  // Sets slam_ too.
  fs::path sequence_folder() {
    const auto has_poses = [](const fs::path& folder) { return fs::exists(folder / "traj_w_c.txt"); };
    require_folder(root_, "check scene.root");
    if (!params_.sequence.empty()) {
      const fs::path folder = root_ / params_.sequence;
      require_folder(folder, "check scene.sequence");
      slam_ = !has_poses(folder) && is_slam_sequence(folder);
      return folder;
    }
    for (const fs::path& folder : {root_, root_ / "Sequence_1"})
      if (has_poses(folder)) return folder;
    slam_ = is_slam_sequence(root_);
    if (slam_) return root_;
    throw Error(ErrorKind::no_input, "scene.poses.missing",
                "no traj_w_c.txt in '" + root_.string() + "' or its Sequence_1",
                "check scene.root; it names the folder of one scene");
  }

  // One camera for all frames, of the size of the first image that can be read; headers tell those of another size. One
  // that cam_params.json names follows the size of each image.
  void set_cameras(std::vector<PosedPhotograph>& photos, Diagnostics& diagnostics) const {
    Camera camera;
    set_first_size(camera, photos, &FrameFiles::color);
    // hfov: tan(hfov / 2) = (W / 2) / fx. The renders put cx = (W - 1) / 2 with integer pixel centres: W / 2 here.
    camera.fx = camera.fy = 0.5 * camera.width_px / std::tan(params_.hfov_deg * (M_PI / 360));
    camera.cx = 0.5 * camera.width_px;
    camera.cy = 0.5 * camera.height_px;
    const SlamCamera told = slam_ ? read_slam_camera(folder_, diagnostics) : SlamCamera{{}, 0.001};
    const bool is_told =
        told.camera.width_px > 0 && camera.width_px > 0 && params_.hfov_deg == ReplicaParams{}.hfov_deg;
    for (PosedPhotograph& photo : photos) {
      photo.camera = is_told ? told.camera : camera;
      photo.intrinsics = is_told ? Intrinsics::stated : Intrinsics::exact;
      photo.depth_unit_m = told.depth_unit_m;
    }
  }

  // A photograph for each pose of a split.
  std::vector<PosedPhotograph> read_trajectory(const std::string& path, Diagnostics& diagnostics,
                                               std::size_t& rows) const {
    const std::string text = read_pose_file(path);
    std::vector<PosedPhotograph> out;
    std::string_view rest = text, row;
    rows = 0;
    for (int line = 1; next_line(rest, row); ++line) {
      std::vector<double> numbers;
      const std::string_view bad = parse_numbers(row, numbers);
      if (numbers.empty() && bad.empty()) continue;
      const std::string place = path + ":" + std::to_string(line);
      const auto number = static_cast<int>(rows++);
      if (numbers.size() != 16 || !bad.empty()) {
        const bool quaternion = bad.empty() && (numbers.size() == 7 || numbers.size() == 8);  // 8: a time stands first
        const std::string more = quaternion    ? ", as of a position and a quaternion"
                                 : bad.empty() ? ""
                                 : bad.find('\0') != std::string_view::npos
                                     ? " and a NUL byte"
                                     : fmt::format(" and the text '{}'", bad.substr(0, 40));
        diagnostics.error("scene.pose.format", place,
                          fmt::format("expected 16 numbers, got {}{}", numbers.size(), more),
                          "write one camera-to-world matrix per line, row by row");
        continue;
      }
      const Split split = split_of(number);
      if (split == Split::unused) continue;
      PosedPhotograph photo;
      static_cast<FrameFiles&>(photo) = files_of(number, split);
      photo.place = place;
      photo.matrix = std::move(numbers);
      photo.split = split;
      out.push_back(std::move(photo));
    }
    return out;
  }

  Split split_of(int number) const {
    const auto in = [number](std::int32_t step, std::int32_t offset) {
      return step > 0 && number >= offset && (number - offset) % step == 0;
    };
    if (params_.train_step == 0 && params_.test_step == 0)
      return HoldOut{params_.test_every}.split_of(static_cast<std::size_t>(number),
                                                  std::numeric_limits<std::size_t>::max());
    if (in(params_.train_step, params_.train_offset)) return Split::train;
    if (in(params_.test_step, params_.test_offset)) return Split::test;
    return params_.train_step == 0 ? Split::train : Split::unused;
  }

  // More poses than images are missing images; more images than poses have no place in the scene, or all poses are off.
  void check_poses_for_images(const std::string& trajectory, std::size_t rows, Diagnostics& diagnostics) const {
    const std::string_view prefix = slam_ ? "frame" : "rgb_";
    std::vector<std::int64_t> without;
    std::size_t images = 0;
    const fs::path colors = folder_ / (slam_ ? "results" : "rgb");
    if (!fs::is_directory(colors)) return;
    for (const fs::directory_entry& entry : sorted_folder(colors.string())) {
      const std::string stem = entry.path().stem().string();
      std::int64_t number = 0;
      if (!stem.starts_with(prefix) || !parse_whole(stem.substr(prefix.size()), number)) continue;
      ++images;
      if (number >= static_cast<std::int64_t>(rows)) without.push_back(number);
    }
    if (without.empty()) return;
    std::sort(without.begin(), without.end());
    const std::string sentence = fmt::format("{} poses for {} images: from {}{} on {} have none", rows, images, prefix,
                                             without.front(), without.size());
    if (params_.missing == MissingFiles::skip)
      return diagnostics.note("scene.pose.count", trajectory, sentence + "; they are left out");
    diagnostics.error(
        "scene.pose.count", trajectory, sentence,
        "write one pose per line for every image, or leave out what has none with --set scene.missing=skip");
  }

  FrameFiles files_of(int number, Split split) const {
    const std::string n = std::to_string(number) + ".png";
    FrameFiles files;
    if (slam_) {
      const fs::path lossless = folder_ / "results" / fmt::format("frame{:06}.png", number);
      files.color = (fs::exists(lossless) ? lossless : fs::path(lossless).replace_extension(".jpg")).string();
      files.depth = (folder_ / "results" / fmt::format("depth{:06}.png", number)).string();
    } else {
      files.color = (folder_ / "rgb" / ("rgb_" + n)).string();
      files.depth = in_folder(folder_ / "depth", "depth_" + n);
    }
    files.label = label_of(number, split);
    files.instance = in_folder(folder_ / "semantic_instance", "semantic_instance_" + n);
    return files;
  }

  // Label images by number: "semantic_class_12.png", "semantic_class_00012.png", "12.png". Other files (previews) are
  // none.
  void index_labels(Diagnostics& diagnostics) {
    constexpr std::string_view kPrefix = "semantic_class_";
    for (const std::string& labels : {params_.label_dir, params_.test_label_dir, ReplicaParams{}.label_dir}) {
      const fs::path where = folder_ / labels;
      if (params_.label_dir.empty() && params_.test_label_dir.empty()) return;
      if (labels.empty() || !fs::is_directory(where) || label_files_.count(labels) > 0) continue;
      std::map<int, std::string>& files = label_files_[labels];
      for (const fs::directory_entry& entry : sorted_folder(where.string())) {
        std::string digits = entry.path().stem().string();
        if (digits.rfind(kPrefix, 0) == 0) digits.erase(0, kPrefix.size());
        if (entry.path().extension() != ".png" || digits.empty() || digits.size() > 9 ||
            digits.find_first_not_of("0123456789") != std::string::npos) {
          continue;
        }
        if (const auto [other, fresh] = files.emplace(std::stoi(digits), entry.path().string()); !fresh)
          diagnostics.error("labels.frame.twice", where.string(),
                            fmt::format("'{}' and '{}' are labels of the same frame",
                                        fs::path(other->second).filename().string(), entry.path().filename().string()),
                            "keep one of the two");
      }
    }
  }

  std::string label_of(int number, Split split) const {
    const auto find = [&](const std::string& labels) {
      const auto files = label_files_.find(labels);
      if (files == label_files_.end()) return std::string();
      const auto file = files->second.find(number);
      return file == files->second.end() ? std::string() : file->second;
    };
    if (split != Split::test) return find(params_.label_dir);
    if (!params_.test_label_dir.empty()) return find(params_.test_label_dir);
    const std::string own = find(params_.label_dir);
    return own.empty() && label_files_.count(params_.label_dir) > 0 ? find(ReplicaParams{}.label_dir) : own;
  }

  void report_unlabelled(const SceneInfo& info, Diagnostics& diagnostics) const {
    for (const auto& [split, what, labels] :
         {std::tuple{Split::train, "training", params_.label_dir},
          std::tuple{Split::test, "test",
                     params_.test_label_dir.empty() ? params_.label_dir : params_.test_label_dir}}) {
      if (label_files_.count(labels) == 0) continue;
      const auto in_split = [&, wanted = split](const FrameInfo& f) { return f.split == wanted; };
      const auto all = std::count_if(info.frames.begin(), info.frames.end(), in_split);
      const auto missing = std::count_if(info.frames.begin(), info.frames.end(),
                                         [&](const FrameInfo& f) { return in_split(f) && !f.has_labels; });
      const std::string place = (folder_ / labels).string();
      if (all > 0 && missing == all)
        diagnostics.error("labels.frames.missing", place, fmt::format("no label image of any {} frame in it", what),
                          "name them semantic_class_<i>.png or <i>.png, <i> as in rgb_<i>.png");
      else if (missing > 0)
        diagnostics.note("labels.frames.missing", place,
                         fmt::format("{} of {} {} frames have no label image", missing, all, what));
    }
  }

  ReplicaParams params_;
  PosedPhotographs& files_;
  fs::path root_, folder_;                                         ///< of the scene, of its sequence
  bool slam_ = false;                                              ///< in the layout of NICE-SLAM
  std::map<std::string, std::map<int, std::string>> label_files_;  ///< folder as in the parameters -> <i> -> path
};

}  // namespace

SceneInfo find_photographs(const ReplicaParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  return Replica(params, files).open(diagnostics);
}

SEMFIELD_PLUGIN_MODULE(replica, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<ReplicaParams>, ReplicaParams>(
      "replica", "Pre-rendered Replica sequences: poses, colour, depth, class and instance images.");
})

}  // namespace semfield
