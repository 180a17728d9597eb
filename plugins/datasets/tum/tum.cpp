// Recordings in the layout of the TUM RGB-D benchmark [Sturm12]: rgb.txt, depth.txt and groundtruth.txt with times, and
// the images that they name.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <map>
#include <optional>

#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/frame_files.h"
#include "scene/loading/posed_photographs.h"

namespace semfield {

struct TumParams : PhotographParams {
  std::vector<double> lens;  ///< fx fy cx cy, or these and k1 k2 p1 p2 k3; empty: by the name of the folder
  double within_s = 0.02;
  double depth_steps = 5000;  ///< of a depth image, per metre
};

namespace {

[[noreturn]] void refuse_tum(Code code, const std::string& what, const char* remedy = "export the recording again") {
  throw Error(ErrorKind::data, code, what, remedy);
}

// A line of a list: its time, and what follows.
struct TimedRow {
  double time_s = 0;
  std::string place;
  std::vector<std::string> words;
};

// In the order of time.
std::vector<TimedRow> read_list(const std::string& path, std::size_t words) {
  std::vector<TimedRow> rows;
  for (const TextRow& row : read_text_rows(path, ' ')) {
    TimedRow timed{0, row.place, {}};
    for (const std::string& field : row.fields)
      if (!field.empty()) timed.words.push_back(field);
    if (timed.words.size() != words + 1)
      refuse_tum("scene.index.format",
                 fmt::format("{}: {} words; a line has a time and {}", row.place, timed.words.size(), words));
    if (!parse_real(timed.words[0], timed.time_s))
      refuse_tum("scene.index.value", row.place + ": '" + timed.words[0] + "' is not a time");
    timed.words.erase(timed.words.begin());
    rows.push_back(std::move(timed));
  }
  if (rows.empty()) refuse_tum("scene.index.format", "'" + path + "' has no lines");
  std::stable_sort(rows.begin(), rows.end(), [](const auto& a, const auto& b) { return a.time_s < b.time_s; });
  const auto twice =
      std::adjacent_find(rows.begin(), rows.end(), [](const auto& a, const auto& b) { return a.time_s == b.time_s; });
  if (twice != rows.end())
    refuse_tum("scene.index.twice", std::next(twice)->place + ": has the time of " + twice->place,
               "keep one of the two lines");
  return rows;
}

// The first row that is not before a time.
std::size_t row_from(const std::vector<TimedRow>& rows, double time_s) {
  return static_cast<std::size_t>(
      std::lower_bound(rows.begin(), rows.end(), time_s, [](const TimedRow& r, double t) { return r.time_s < t; }) -
      rows.begin());
}

struct TimedPose {
  Vec3d center;
  Quaternion turn{};
};

TimedPose pose_in(const TimedRow& row) {
  std::array<double, 7> n{};
  for (std::size_t i = 0; i < n.size(); ++i)
    if (!parse_number(row.words[i], n[i]))
      refuse_tum("scene.index.value", row.place + ": '" + row.words[i] + "' is not a number");
  return {{n[0], n[1], n[2]}, {n[6], n[3], n[4], n[5]}};
}

// Between the poses before and after a time, which both lie within a distance of it; of one alone that one. Nothing
// where there is none. Turns a hundredth of a second apart are so near that the way between them is straight.
std::optional<Pose> pose_at(const std::vector<TimedRow>& rows, double time_s, double within_s) {
  const std::size_t after = row_from(rows, time_s);
  const bool has_after = after < rows.size() && rows[after].time_s - time_s <= within_s;
  const bool has_before = after > 0 && time_s - rows[after - 1].time_s <= within_s;
  if (!has_after && !has_before) return std::nullopt;
  const TimedPose a = pose_in(rows[has_before ? after - 1 : after]), b = pose_in(rows[has_after ? after : after - 1]);
  double share = 0;
  if (has_before && has_after && rows[after].time_s > rows[after - 1].time_s)
    share = (time_s - rows[after - 1].time_s) / (rows[after].time_s - rows[after - 1].time_s);
  double same_side = 0;  // a quaternion and its negative are one turn
  for (std::size_t k = 0; k < 4; ++k) same_side += a.turn[k] * b.turn[k];
  Quaternion turn;
  for (std::size_t k = 0; k < 4; ++k) turn[k] = (1 - share) * a.turn[k] + share * (same_side < 0 ? -1 : 1) * b.turn[k];
  Pose pose;
  set_rotation(pose, turn);
  pose.t = (1 - share) * a.center + share * b.center;
  return pose;
}

// Lenses of the benchmark's cameras: fx fy cx cy, k1 k2 p1 p2 k3.
std::vector<double> lens_of_folder(const std::string& folder) {
  if (folder.find("freiburg1") != std::string::npos)
    return {517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633};
  if (folder.find("freiburg2") != std::string::npos)
    return {520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172};
  if (folder.find("freiburg3") != std::string::npos) return {535.4, 539.2, 320.1, 247.6};
  return {525.0, 525.0, 319.5, 239.5};  // what drivers of such cameras say without a calibration
}

}  // namespace

void describe(ParamVisitor& visit, TumParams& p) {
  describe(visit, static_cast<PhotographParams&>(p));
  SEMFIELD_PARAM(visit, p, lens,
                 "[fx, fy, cx, cy] in pixels of the stored images, centres of pixels whole numbers, or these and "
                 "[k1, k2, p1, p2, k3]; empty = those of the benchmark's camera that the folder's name says",
                 {-1e6, 1e6});
  SEMFIELD_PARAM(visit, p, within_s, "how far a depth image or a pose may be from an image, seconds", {0, 1e6});
  SEMFIELD_PARAM(visit, p, depth_steps, "steps of a depth image per metre", {1e-6, 1e9});
}

void validate(const TumParams& p, Diagnostics& diagnostics) {
  validate(static_cast<const PhotographParams&>(p), diagnostics);
  if (!p.lens.empty() && p.lens.size() != 4 && p.lens.size() != 9)
    diagnostics.error("scene.camera.format", "lens", std::to_string(p.lens.size()) + " numbers",
                      "give four, fx fy cx cy, or nine, with k1 k2 p1 p2 k3");
}

std::string recognise(const std::string& path, TumParams& p) {
  for (const char* name : {"rgb.txt", "groundtruth.txt"})
    if (!is_file(fs::path(path) / name)) return "";
  p.root = path;
  return "a recording in the layout of the TUM RGB-D benchmark";
}

SceneInfo find_photographs(const TumParams& params, PosedPhotographs& files, Diagnostics& diagnostics) {
  files.require({"", "rgb.txt", "groundtruth.txt"}, "a recording of the TUM RGB-D benchmark");
  const fs::path root(files.root());
  const std::vector<TimedRow> images = read_list((root / "rgb.txt").string(), 1);
  const std::vector<TimedRow> poses = read_list((root / "groundtruth.txt").string(), 7);
  std::vector<TimedRow> depths;
  if (fs::exists(root / "depth.txt")) depths = read_list((root / "depth.txt").string(), 1);
  const std::vector<double> lens =
      params.lens.empty() ? lens_of_folder(fs::weakly_canonical(root).filename().string()) : params.lens;
  std::vector<PosedPhotograph> photos;
  std::size_t without_pose = 0;
  FileNames names;
  std::map<std::string, std::string> lines;  // by image
  for (const TimedRow& image : images) {
    const std::optional<Pose> pose = pose_at(poses, image.time_s, params.within_s);
    if (!pose) {
      ++without_pose;
      continue;
    }
    PosedPhotograph photo;
    photo.color = names.of((root / image.words[0]).string());
    const auto [other, fresh] = lines.emplace(fs::path(photo.color).lexically_normal().string(), image.place);
    if (!fresh) {
      diagnostics.error("scene.frame.twice", image.place, "is the image of " + other->second,
                        "keep one of the two lines");
      continue;
    }
    photo.world_from_camera = *pose;
    photo.depth_unit_m = 1 / params.depth_steps;
    ImageSize size{640, 480};  // what the benchmark's lenses are of
    if (!params.lens.empty() && is_there(photo.color)) size = image_size(photo.color);
    photo.camera = {size.width_px, size.height_px, lens[0], lens[1], lens[2] + 0.5, lens[3] + 0.5};
    constexpr double Camera::*kBend[] = {&Camera::k1, &Camera::k2, &Camera::p1, &Camera::p2, &Camera::k3};
    for (std::size_t i = 4; i < lens.size(); ++i) photo.camera.*kBend[i - 4] = lens[i];
    // The nearest in time, and of two the earlier.
    const std::size_t after = row_from(depths, image.time_s);
    const auto gap = [&](std::size_t i) { return std::abs(depths[i].time_s - image.time_s); };
    std::size_t nearest = depths.size();
    for (const std::size_t i : {after - 1, after})
      if (i < depths.size() && gap(i) <= params.within_s && (nearest == depths.size() || gap(i) < gap(nearest)))
        nearest = i;
    if (nearest < depths.size()) photo.depth = names.of((root / depths[nearest].words[0]).string());
    photos.push_back(std::move(photo));
  }
  const long within_ms = std::lround(1000 * params.within_s);
  if (photos.empty())
    refuse_tum("scene.pose.count", fmt::format("'{}': no image has a pose within {} ms", root.string(), within_ms),
               "check that rgb.txt and groundtruth.txt are of one recording, or raise scene.within_s");
  if (without_pose > 0)
    diagnostics.note("scene.pose.count", "'" + (root / "groundtruth.txt").string() + "'",
                     fmt::format("{} of {} images have no pose within {} ms and are left out", without_pose,
                                 images.size(), within_ms));
  return files.open(std::move(photos), {}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(tum, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<TumParams>, TumParams>(
      "tum", "Recordings in the layout of the TUM RGB-D benchmark, as exporters of ROS bags write them.");
})

}  // namespace semfield
