// Pose and camera checks.
#include "scene/scene_checks.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <map>
#include <set>

#include "core/check.h"
#include "scene/camera.h"

namespace semfield {

namespace {

std::string number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3g", value);
  return text;
}

bool finite(const Pose& pose) {
  for (const auto& row : pose.r) {
    for (const double v : row) {
      if (!std::isfinite(v)) return false;
    }
  }
  return std::isfinite(pose.t.x) && std::isfinite(pose.t.y) && std::isfinite(pose.t.z);
}

bool finite(const Camera& camera) {
  const double all[] = {camera.fx, camera.fy, camera.cx, camera.cy, camera.k1,
                        camera.k2, camera.k3, camera.k4, camera.p1, camera.p2};
  return std::all_of(std::begin(all), std::end(all), [](double v) { return std::isfinite(v); });
}

bool finite(const Box& box) {
  for (int a = 0; a < 3; ++a) {
    if (!std::isfinite(box.lo[a]) || !std::isfinite(box.hi[a])) return false;
  }
  return true;
}

// A perspective lens sees less than 180 degrees: at a thousandth of the image it is 179.9.
bool is_focal(double focal_px, int size_px) { return focal_px >= 1e-3 * size_px && focal_px <= 1e6 * size_px; }

void check_focal(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const bool positive = camera.fx > 0 && camera.fy > 0;
  if (is_focal(camera.fx, camera.width_px) && is_focal(camera.fy, camera.height_px)) return;
  diagnostics.error(
      "scene.camera.focal", place,
      "focal length is " + number(camera.fx) + " x " + number(camera.fy) + " pixels; it must be " +
          (positive ? "between a thousandth and a million times the image, which has " +
                          std::to_string(camera.width_px) + " x " + std::to_string(camera.height_px) + " pixels"
                    : std::string("positive")),
      positive ? "check that the intrinsics are in pixels" : "check the intrinsics and the axes convention");
}

// What no fisheye and no panorama has.
void check_wide_lens(const Camera& c, const std::string& place, Diagnostics& diagnostics) {
  if (!c.is_wide()) return;
  const bool is_panorama = c.lens == LensKind::equirectangular;
  if (c.p1 != 0 || c.p2 != 0 || (is_panorama && (c.k1 != 0 || c.k2 != 0 || c.k3 != 0 || c.k4 != 0)))
    diagnostics.error("scene.camera.model", place,
                      std::string(is_panorama ? "a panorama has no distortion" : "a fisheye has k1 to k4 alone") +
                          ", and others of its coefficients are not 0",
                      "set them to 0, or name the camera's own model");
  const double turns = c.width_px / (2 * M_PI * c.fx);
  if (is_panorama && c.fx > 0 && turns > 1 + 1e-6)
    diagnostics.error("scene.camera.focal", place,
                      "the panorama goes " + number(turns) + " times around: its focal length is too short",
                      "leave fl_x and fl_y out where the image shows the whole sphere");
}

// The angle of a pixel's ray to the axis against that which a lens without distortion gives it; 1 near the axis, 0
// where the lens has no ray.
double bend_at(const Camera& c, double u, double v) {
  const double x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy, away = std::hypot(x, y);
  const double plain = c.is_wide() ? away : std::atan(away);
  const Vec3d ray = c.direction(u, v);
  if (ray == Vec3d{0, 0, 0}) return 0;
  return plain < 1e-3 * (c.width_px / c.fx) ? 1 : std::atan2(std::hypot(ray.x, ray.y), ray.z) / plain;
}

// A lens whose polynomial has no inverse in the image, or bends rays as none does.
void check_distortion(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  if (!camera.has_distortion() || camera.lens == LensKind::equirectangular) return;
  constexpr double kFar = 10, kUnusual = 2;
  int lost = 0, lost_inside = 0;  // of 9 points up to the border; of 8 around the middle, half as far out
  double least = 1, most = 1;
  const auto look_at = [&](double u, double v, int& count) {
    const double bend = bend_at(camera, u, v);
    count += bend == 0 ? 1 : 0;
    if (bend == 0) return;
    least = std::min(least, bend);
    most = std::max(most, bend);
  };
  for (int i = 0; i <= 2; ++i) {
    for (int j = 0; j <= 2; ++j) {
      look_at(camera.width_px * i / 2.0, camera.height_px * j / 2.0, lost);
      if (i != 1 || j != 1) look_at(camera.width_px * (i + 1) / 4.0, camera.height_px * (j + 1) / 4.0, lost_inside);
    }
  }
  const double bend = 1 / least > most ? least : most;
  const std::string bent = "lens distortion bends rays to " + number(bend) + " times their angle to the axis";
  if (lost == 9 || lost_inside == 8) {
    diagnostics.error("scene.camera.distortion", place,
                      lost == 9 ? "lens distortion has no inverse anywhere in the image"
                                : "lens distortion has no inverse but in the very middle of the image",
                      "calibrate again");
  } else if (bend > kFar || bend < 1 / kFar) {
    diagnostics.error("scene.camera.distortion", place, bent + ", which no lens does",
                      "check that the coefficients are those of this camera model, in its order");
  } else if (bend > kUnusual || bend < 1 / kUnusual) {
    diagnostics.warning("scene.camera.bent", place, bent,
                        "check that the coefficients are those of this camera model, in its order");
  } else if (lost > 0 && !camera.is_wide()) {  // a fisheye's corners lie beyond its circle, as they should
    diagnostics.warning("scene.camera.masked", place,
                        "lens distortion has no inverse at " + std::to_string(lost) +
                            " of 9 points of the image; such pixels are masked",
                        "calibrate with points up to the image corners");
  }
}

// max |R^T R - I|
double orthonormal_error(const Pose& pose) {
  double worst = 0;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b)
      worst = std::max(worst, std::abs(dot(pose.axis(a), pose.axis(b)) - (a == b ? 1.0 : 0.0)));
  }
  return worst;
}

// What the principal point says of the image that the intrinsics belong to: it lies near the middle of all but cropped
// ones. "" where that may be this image.
std::string other_image(const Camera& c) {
  const double x = 2 * c.cx / c.width_px, y = 2 * c.cy / c.height_px;
  const auto near_one = [](double ratio) { return std::abs(ratio - 1) < 0.1; };
  const double shape = static_cast<double>(c.width_px) / c.height_px;
  if (near_one(x * shape) && near_one(y / shape) && (shape > 1.2 || shape < 1 / 1.2)) return "turned by a quarter";
  const double factor = 0.5 * (x + y);
  if (!(x > 0 && y > 0) || !near_one(x / y) || (factor < 1.8 && factor > 0.55)) return "";
  return factor > 1 ? number(factor) + " times as large" : number(1 / factor) + " times as small";
}

}  // namespace

std::string frame_place(const FrameInfo& frame) {
  std::string place = "frame '";
  place += frame.name;
  place += "'";
  if (!frame.source.empty()) place += " (" + frame.source + ")";
  return place;
}

Pose pose_from_rows(std::span<const double> numbers) {
  SEMFIELD_CHECK(numbers.size() == 12 || numbers.size() == 16, "a pose has 12 or 16 numbers");
  Pose pose;
  for (std::size_t row = 0; row < 3; ++row) {
    for (std::size_t col = 0; col < 3; ++col) pose.r[row][col] = numbers[row * 4 + col];
  }
  pose.t = {numbers[3], numbers[7], numbers[11]};
  return pose;
}

Pose opencv_from_opengl(Pose pose) {
  for (auto& row : pose.r) {
    row[1] = -row[1];
    row[2] = -row[2];
  }
  return pose;
}

bool check_last_row(std::span<const double> numbers, const std::string& place, Diagnostics& diagnostics) {
  if (numbers.size() != 16) return true;
  const std::span<const double> row = numbers.subspan(12);
  bool finite = true, good = true;
  for (std::size_t i = 0; i < 4; ++i) {
    finite = finite && std::isfinite(row[i]);
    good = good && std::abs(row[i] - (i == 3 ? 1.0 : 0.0)) < 1e-6;
  }
  if (good || !finite) return true;
  diagnostics.error("scene.pose.last_row", place, "the last row of the pose is not 0 0 0 1",
                    "write camera-to-world matrices row by row; a transposed one has its centre there");
  return false;
}

PoseState check_pose(Pose& pose, const std::string& place, Diagnostics& diagnostics) {
  if (!finite(pose)) return PoseState::not_finite;
  const double error = orthonormal_error(pose);
  const double determinant = dot(cross(pose.axis(0), pose.axis(1)), pose.axis(2));
  if (error > 1e-3) {
    diagnostics.error("scene.pose.rotation", place,
                      "pose is not a rotation: its axes are " + number(error) + " off orthonormal (1e-3 is allowed)",
                      "check that the matrix is camera-to-world, row by row, without a scale");
    return PoseState::refused;
  }
  if (determinant < 0) {
    diagnostics.error("scene.pose.mirrored", place, "pose mirrors the scene (determinant -1)",
                      "flip one camera axis in the export");
    return PoseState::refused;
  }
  if (error > 1e-5) {
    diagnostics.warning("scene.pose.rounded", place,
                        "pose is " + number(error) + " off orthonormal and was made orthonormal",
                        "export poses with more digits");
  }
  if (error > 1e-9) make_rotation(pose);
  return PoseState::good;
}

void report_skipped(const std::vector<std::string>& skipped, std::size_t kept, const std::string& source,
                    Diagnostics& diagnostics) {
  if (kept == 0) {
    diagnostics.error(
        "scene.frames.none", source,
        skipped.empty() ? "no frames in it" : "all " + std::to_string(skipped.size()) + " poses are not finite",
        skipped.empty() ? "check the path" : "track the cameras again");
  }
  if (skipped.empty() || kept == 0) return;
  std::vector<std::string> shown(
      skipped.begin(), skipped.begin() + static_cast<std::ptrdiff_t>(std::min<std::size_t>(8, skipped.size())));
  if (shown.size() < skipped.size()) shown.push_back("...");
  diagnostics.warning("scene.pose.skipped", source,
                      std::to_string(skipped.size()) + " of " + std::to_string(skipped.size() + kept) +
                          " frames skipped: their poses are not finite (" + join(shown) + ")",
                      {});
}

void check_manifest_numbers(const SceneInfo& info, Diagnostics& diagnostics) {
  std::set<std::string> named;
  for (const Diagnostic& d : diagnostics.all()) named.insert(d.where);
  const Camera* sound = nullptr;  // that of the frame before
  for (const FrameInfo& frame : info.frames) {
    const std::string place = frame_place(frame);
    if (named.count(place) > 0) continue;
    if (!finite(frame.world_from_camera)) {
      diagnostics.error("scene.pose.not_finite", place, "pose has a number that is not finite",
                        "the dataset must leave such frames out");
    } else if (sound == nullptr || !(frame.camera == *sound)) {
      sound = check_camera(frame.camera, place, diagnostics) ? &frame.camera : nullptr;
    }
  }
  if (!std::isfinite(info.near_hint_m) || !std::isfinite(info.far_hint_m)) {
    diagnostics.error("scene.bounds.not_finite", info.name,
                      "near and far distance of the dataset are " + number(info.near_hint_m) + " and " +
                          number(info.far_hint_m) + " m; they must be finite",
                      "set scene.load.near_m and scene.load.far_m");
  }
  if (!finite(info.bounds) || !finite(info.limit))
    diagnostics.error("scene.bounds.not_finite", info.name, "the dataset's bounds are not finite",
                      "set scene.load.bounds");
}

bool check_camera(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const int before = diagnostics.error_count();
  if (camera.width_px <= 0 || camera.height_px <= 0) {
    diagnostics.error("scene.image.size", place,
                      "image size is " + std::to_string(camera.width_px) + " x " + std::to_string(camera.height_px),
                      "state the size in pixels");
    return false;
  }
  if (!finite(camera)) {
    diagnostics.error("scene.camera.not_finite", place, "camera has an intrinsic that is not finite",
                      "calibrate again");
    return false;
  }
  check_focal(camera, place, diagnostics);
  const auto outside = [](double c, int size) { return c < -size || c > 2.0 * size; };
  if (outside(camera.cx, camera.width_px) || outside(camera.cy, camera.height_px)) {
    diagnostics.error("scene.camera.center", place,
                      "principal point (" + number(camera.cx) + ", " + number(camera.cy) +
                          ") lies far outside the image of " + std::to_string(camera.width_px) + " x " +
                          std::to_string(camera.height_px) + " pixels",
                      "check that the intrinsics belong to images of this size");
  }
  check_wide_lens(camera, place, diagnostics);
  if (diagnostics.error_count() == before) check_distortion(camera, place, diagnostics);
  return diagnostics.error_count() == before;
}

void check_poses_differ(const SceneInfo& info, Diagnostics& diagnostics) {
  std::map<std::array<double, 12>, std::vector<const FrameInfo*>> frames_at;
  for (const FrameInfo& frame : info.frames) {
    const Pose& pose = frame.world_from_camera;
    if (!finite(pose)) continue;
    std::array<double, 12> key{pose.t.x, pose.t.y, pose.t.z};
    for (std::size_t i = 0; i < 9; ++i) key[3 + i] = pose.r[i / 3][i % 3];
    frames_at[key].push_back(&frame);
  }
  std::size_t alike = 0;
  const std::vector<const FrameInfo*>* most = nullptr;
  for (const auto& [pose, frames] : frames_at) {
    if (frames.size() < 2) continue;
    alike += frames.size();
    if (most == nullptr || frames.size() > most->size()) most = &frames;
  }
  if (most == nullptr) return;
  const std::string all = std::to_string(info.frames.size());
  const std::string remedy = "check the export: a tracker that is lost may repeat its last pose";
  if (most->size() == info.frames.size()) {
    diagnostics.warning("scene.pose.repeated", info.name, "all " + all + " frames have one pose: nothing shows shape",
                        remedy);
  } else {
    diagnostics.warning("scene.pose.repeated", info.name,
                        std::to_string(alike) + " of " + all + " frames have the pose of another frame, " +
                            std::to_string(most->size()) + " that of '" + most->front()->name + "'",
                        remedy);
  }
}

bool check_principal_point(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const std::string other = other_image(camera);
  if (other.empty()) return true;
  diagnostics.error("scene.camera.size", place,
                    "principal point (" + number(camera.cx) + ", " + number(camera.cy) +
                        ") is the middle of an image " + other + " as this one of " + std::to_string(camera.width_px) +
                        " x " + std::to_string(camera.height_px) + " pixels: the intrinsics are that image's",
                    "state the size that they belong to, or give those of the images as they are stored");
  return false;
}

}  // namespace semfield
