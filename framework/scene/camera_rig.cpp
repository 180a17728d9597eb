#include "scene/camera_rig.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "scene/scene.h"

namespace semfield {

namespace {

constexpr std::size_t kMostCameras = 128;  // looked at for each voxel
constexpr double kSeenBy = 0.9;            // of the cameras
constexpr double kMostOneSided = 0.75;     // length of the mean direction to the cameras: 0.64 for half a circle
constexpr int kRounds = 8;                 // of reweighting

// The point whose distances to the view axes have the least sum (not of squares: a stray camera must not pull it).
bool find_focus(const Cameras& cameras, Vec3d& focus) {
  std::vector<double> weight(cameras.size(), 1.0);
  for (int round = 0; round < kRounds; ++round) {
    Eigen::Matrix3d across = Eigen::Matrix3d::Zero();  // sum w (I - d d^T)
    Eigen::Vector3d right = Eigen::Vector3d::Zero();   // sum w (I - d d^T) c
    double total = 0;
    for (std::size_t i = 0; i < cameras.size(); ++i) {
      const Pose& pose = cameras[i]->world_from_camera;
      const Vec3d d = pose.axis(2);
      const Eigen::Vector3d axis(d.x, d.y, d.z), center(pose.t.x, pose.t.y, pose.t.z);
      const Eigen::Matrix3d one = weight[i] * (Eigen::Matrix3d::Identity() - axis * axis.transpose());
      across += one;
      right += one * center;
      total += weight[i];
    }
    if (!(across.determinant() > 1e-6 * total * total * total)) return false;  // all axes are parallel
    const Eigen::Vector3d solution = across.ldlt().solve(right);
    focus = {solution[0], solution[1], solution[2]};
    for (std::size_t i = 0; i < cameras.size(); ++i) {
      const Vec3d from = focus - cameras[i]->world_from_camera.t, d = cameras[i]->world_from_camera.axis(2);
      const double off = std::max(length(from - d * dot(d, from)), 1e-3 * length(from));
      weight[i] = off > 0 ? 1 / off : 0;  // a camera at the focus has its view axis through it anyway
    }
  }
  return true;
}

// At most `most` of them, evenly taken.
Cameras some_of(const Cameras& cameras, std::size_t most) {
  if (cameras.size() <= most) return cameras;
  Cameras out;
  for (std::size_t i = 0; i < most; ++i) out.push_back(cameras[i * cameras.size() / most]);
  return out;
}

}  // namespace

double angle_deg(const Pose& a, const Pose& b) {
  double trace = 0;
  for (int c = 0; c < 3; ++c) trace += dot(a.axis(c), b.axis(c));
  return std::acos(std::clamp(0.5 * (trace - 1), -1.0, 1.0)) * 180 / M_PI;
}

bool project_into(const FrameInfo& frame, Vec3d point, double& u, double& v) {
  const Vec3d p = frame.world_from_camera.apply_inverse(point);
  if (!frame.camera.sees(p)) return false;
  frame.camera.project(p, u, v);
  return u >= 0 && v >= 0 && u < frame.camera.width_px && v < frame.camera.height_px;
}

Box box_of_voxels(const Box& region, const std::function<bool(Vec3d center)>& keeps) {
  constexpr std::int64_t kSide = 48;
  const Vec3d cell = region.size() * (1.0 / kSide);
  std::vector<Box> layers(kSide);
  parallel_for(kSide, [&](std::int64_t z) {
    for (std::int64_t y = 0; y < kSide; ++y) {
      for (std::int64_t x = 0; x < kSide; ++x) {
        const Vec3d lo = region.lo + Vec3d{static_cast<double>(x) * cell.x, static_cast<double>(y) * cell.y,
                                           static_cast<double>(z) * cell.z};
        if (!keeps(lo + cell * 0.5)) continue;
        layers[static_cast<std::size_t>(z)].include(lo);
        layers[static_cast<std::size_t>(z)].include(lo + cell);
      }
    }
  });
  Box box;
  for (const Box& layer : layers) {
    if (layer.empty()) continue;
    box.include(layer.lo);
    box.include(layer.hi);
  }
  return box;
}

CameraRig find_rig(const Cameras& all) {
  CameraRig rig;
  const Cameras cameras = some_of(all, kMostCameras);
  // A panorama looks nowhere in particular.
  const auto is_panorama = [](const FrameInfo* frame) { return frame->camera.lens == LensKind::equirectangular; };
  if (std::any_of(cameras.begin(), cameras.end(), is_panorama)) return rig;
  if (cameras.size() < 3 || !find_focus(cameras, rig.focus)) return rig;
  std::vector<double> distances;
  Vec3d mean;
  std::size_t see_it = 0;
  const double count = static_cast<double>(cameras.size());
  for (const FrameInfo* camera : cameras) {
    const Vec3d to_camera = camera->world_from_camera.t - rig.focus;
    distances.push_back(length(to_camera));
    if (distances.back() > 0) mean = mean + normalized(to_camera) * (1 / count);
    double u = 0, v = 0;
    see_it += project_into(*camera, rig.focus, u, v) ? 1 : 0;
  }
  rig.distance_m = median_of(std::move(distances));
  if (static_cast<double>(see_it) < kSeenBy * count || length(mean) > kMostOneSided) return rig;
  const Vec3d half{rig.distance_m, rig.distance_m, rig.distance_m};
  rig.seen = box_of_voxels({rig.focus - half, rig.focus + half}, [&](Vec3d center) {
    double seen = 0, u = 0, v = 0;
    for (const FrameInfo* camera : cameras) seen += project_into(*camera, center, u, v) ? 1 : 0;
    return seen >= kSeenBy * count;
  });
  rig.inward = !rig.seen.empty();
  return rig;
}

// Poses and depth of files that keep another convention than their dataset expects.

namespace {

Pose inverse(const Pose& pose) {
  Pose out;
  for (std::size_t row = 0; row < 3; ++row) {
    for (std::size_t col = 0; col < 3; ++col) out.r[row][col] = pose.r[col][row];
  }
  out.t = pose.unrotate(pose.t) * -1.0;
  return out;
}

}  // namespace

Pose converted_pose(const Pose& pose, const PoseConvention& convention, bool opengl_files) {
  Pose out = pose;
  if (convention.invert_poses) out = inverse(opengl_files ? opencv_from_opengl(pose) : pose);  // the file's own matrix
  // The axes of the file are turned unless they are OpenCV's; without an inversion open() has already done so.
  const bool turn = convention.invert_poses ? opengl_files != convention.flip_camera_axes : convention.flip_camera_axes;
  if (turn) out = opencv_from_opengl(out);
  out.t = out.t * convention.pose_scale;
  return out;
}

void convert_info(SceneInfo& info, const PoseConvention& convention) {
  if (convention == PoseConvention{}) return;
  for (FrameInfo& frame : info.frames)
    frame.world_from_camera = converted_pose(frame.world_from_camera, convention, info.opengl_files);
  info.opengl_files = false;
  if (convention.invert_poses) {
    info.bounds = info.limit = Box{};
    info.near_hint_m = info.far_hint_m = 0;
  } else if (convention.pose_scale != 1) {
    for (Box* box : {&info.bounds, &info.limit}) {
      if (box->empty()) continue;
      box->lo = box->lo * convention.pose_scale;
      box->hi = box->hi * convention.pose_scale;
    }
    // Where poses and depth were in two units, it is not known in which of them the hints were; depth tells.
    const bool depth =
        convention.depth_scale != convention.pose_scale &&
        std::any_of(info.frames.begin(), info.frames.end(), [](const FrameInfo& f) { return f.has_depth; });
    info.near_hint_m = depth ? 0 : info.near_hint_m * convention.pose_scale;
    info.far_hint_m = depth ? 0 : info.far_hint_m * convention.pose_scale;
  }
}

void convert_depth(FrameBuffer& frame, const PoseConvention& convention) {
  if (convention.depth_scale == 1) return;
  for (float& depth : frame.depth_m) depth = static_cast<float>(depth * convention.depth_scale);
}

}  // namespace semfield
