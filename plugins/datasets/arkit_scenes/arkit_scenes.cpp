// Scenes of Apple's ARKitScenes: lowres_wide/ with a trajectory, intrinsics, depth and confidence.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "core/files.h"
#include "core/text.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/posed_photographs.h"

namespace semfield {

struct ArkitScenesParams : PhotographParams {};

namespace {

constexpr double kSameTime_s = 0.005;  // between a photograph and a pose; poses come ten times a second
constexpr const char* kTrajectory = "lowres_wide.traj";

[[noreturn]] void refuse_arkit(Code code, const std::string& what, const char* remedy = "download the scene again") {
  throw Error(ErrorKind::data, code, what, remedy);
}

// The numbers of a line, which has to hold `count` of them.
std::vector<double> numbers_of(const TextRow& row, std::size_t count) {
  std::vector<double> out;
  if (parse_numbers(row.fields.front(), out).empty() && out.size() == count) return out;
  refuse_arkit("scene.index.value", fmt::format("{}: expected {} numbers", row.place, count));
}

// By time: a line is the time, the turn of camera from world as an axis times its angle, and the shift.
std::map<double, Pose> read_trajectory(const std::string& path) {
  std::map<double, Pose> out;
  std::map<double, std::string> lines;
  for (const TextRow& row : read_text_rows(path, '\n')) {
    const std::vector<double> v = numbers_of(row, 7);
    const double angle = std::hypot(v[1], v[2], v[3]), s = angle > 0 ? std::sin(angle / 2) / angle : 0.5;
    if (!std::isfinite(v[0])) refuse_arkit("scene.index.value", row.place + ": the time is not finite");
    if (const auto [other, fresh] = lines.emplace(v[0], row.place); !fresh)
      refuse_arkit("scene.index.twice", row.place + ": has the time of " + other->second, "keep one of the two lines");
    Pose& pose = out[v[0]];
    set_rotation(pose, {std::cos(angle / 2), -s * v[1], -s * v[2], -s * v[3]});  // turned back: world from camera
    pose.t = pose.rotate({v[4], v[5], v[6]}) * -1.0;
  }
  return out;
}

const Pose* pose_at(const std::map<double, Pose>& poses, double time) {
  auto next = poses.lower_bound(time);
  if (next != poses.begin() && (next == poses.end() || time - std::prev(next)->first < next->first - time)) --next;
  return next != poses.end() && std::abs(next->first - time) < kSameTime_s ? &next->second : nullptr;
}

// Times in names of photographs and of their intrinsics may differ by a millisecond.
std::string intrinsics_of(const fs::path& folder, const std::string& before, double time) {
  for (const double off : {0.0, -0.001, 0.001}) {
    const fs::path path = folder / fmt::format("{}{:.3f}.pincam", before, time + off);
    if (is_there(path)) return path.string();
  }
  return "";
}

}  // namespace

std::string recognise(const std::string& path, ArkitScenesParams& p) {
  const fs::path root(path);
  for (const fs::path& folder : {root, root / (root.filename().string() + "_frames")}) {
    if (!is_file(folder / kTrajectory) || !is_folder(folder / "lowres_wide")) continue;
    p.root = folder.string();
    return "a scene of ARKitScenes";
  }
  return "";
}

SceneInfo find_photographs(const ArkitScenesParams&, PosedPhotographs& files, Diagnostics& diagnostics) {
  files.require({"", "lowres_wide", kTrajectory, "lowres_wide_intrinsics"}, "the download of ARKitScenes");
  const fs::path root(files.root());
  const std::map<double, Pose> poses = read_trajectory((root / kTrajectory).string());
  std::vector<PosedPhotograph> photos;
  std::size_t without_pose = 0;
  std::map<double, std::string> by_time;
  const std::vector<std::string> images = files_with((root / "lowres_wide").string(), kPhotographs);
  for (const std::string& image : images) {
    const std::string stem = fs::path(image).stem().string();
    const std::size_t at = stem.rfind('_') + 1;
    double time = 0;
    if (at == 0 || !parse_number(std::string_view(stem).substr(at), time) || !std::isfinite(time)) {
      diagnostics.error("scene.frame.name", "'" + image + "'", "the name does not end with the time of the frame",
                        "keep the names of the download: <video>_<seconds>.png");
      continue;
    }
    if (const auto [other, fresh] = by_time.emplace(time, image); !fresh) {
      diagnostics.error("scene.frame.twice", "'" + image + "'", "is of the time of '" + other->second + "'",
                        "keep one of the two");
      continue;
    }
    const Pose* const pose = pose_at(poses, time);
    without_pose += pose == nullptr ? 1 : 0;
    if (pose == nullptr) continue;
    PosedPhotograph photo;
    photo.color = image;
    photo.world_from_camera = *pose;
    const std::string lens = intrinsics_of(root / "lowres_wide_intrinsics", stem.substr(0, at), time);
    const std::vector<TextRow> rows = lens.empty() ? std::vector<TextRow>() : read_text_rows(lens, '\n');
    if (rows.empty()) {
      diagnostics.error("scene.camera.missing", "'" + image + "'", "has no file in lowres_wide_intrinsics",
                        "download the scene again");
      continue;
    }
    const std::vector<double> v = numbers_of(rows.front(), 6);
    if (!set_image_size(photo.camera, v[0], v[1], lens, diagnostics)) continue;
    photo.camera.fx = v[2];
    photo.camera.fy = v[3];
    photo.camera.cx = v[4];
    photo.camera.cy = v[5];
    photo.depth = in_folder(root / "lowres_depth", stem + ".png");
    photo.confidence = (root / "confidence" / (stem + ".png")).string();
    photos.push_back(std::move(photo));
  }
  if (without_pose > 0)
    diagnostics.note("scene.pose.skipped", files.root(),
                     fmt::format("{} of {} photographs are left out: the trajectory has no pose within {:g} ms of them",
                                 without_pose, images.size(), 1000 * kSameTime_s));
  return files.open(std::move(photos), {.tracked = true}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(arkit_scenes, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<ArkitScenesParams>, ArkitScenesParams>(
      "arkit_scenes", "Scenes of Apple's ARKitScenes: photographs, poses and LiDAR depth of a tablet.");
})

}  // namespace semfield
