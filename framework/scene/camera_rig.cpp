#include "scene/camera_rig.h"

#include <fmt/format.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr std::size_t kMostCameras = 128;  // looked at for each voxel
constexpr double kSeenBy = 0.9;            // of the cameras
constexpr double kMostOneSided = 0.75;     // length of the mean direction to the cameras: 0.64 for half a circle
constexpr int kRounds = 8;                 // of reweighting
constexpr double kLeastAlike = 0.93;       // length of the mean view axis: that of axes spread over 30 degrees about it

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

// Such a lens looks nowhere in particular.
bool any_panorama(const Cameras& cameras) {
  return std::any_of(cameras.begin(), cameras.end(),
                     [](const FrameInfo* frame) { return frame->camera.lens == LensKind::equirectangular; });
}

// At most `most` of them, evenly taken.
Cameras some_of(const Cameras& cameras, std::size_t most) {
  if (cameras.size() <= most) return cameras;
  Cameras out;
  for (std::size_t i = 0; i < most; ++i) out.push_back(cameras[i * cameras.size() / most]);
  return out;
}

// Where a world point falls in the frame's image, pixels; false when it is behind the camera or beside the image.
bool project_into(const FrameInfo& frame, Vec3d point, double& u, double& v) {
  const Vec3d p = frame.world_from_camera.apply_inverse(point);
  if (!frame.camera.sees(p)) return false;
  frame.camera.project(p, u, v);
  return u >= 0 && v >= 0 && u < frame.camera.width_px && v < frame.camera.height_px;
}

// Box of the voxels of `region`, 48 an axis, whose centres `keeps` accepts (called from any thread); empty when there
// is none.
template <class Keeps>
Box box_of_voxels(const Box& region, const Keeps& keeps) {
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

}  // namespace

double angle_deg(const Pose& a, const Pose& b) {
  double trace = 0;
  for (int c = 0; c < 3; ++c) trace += dot(a.axis(c), b.axis(c));
  return std::acos(std::clamp(0.5 * (trace - 1), -1.0, 1.0)) * 180 / M_PI;
}

bool look_one_way(const Cameras& cameras) {
  if (cameras.size() < 3 || any_panorama(cameras)) return false;
  Vec3d sum;
  for (const FrameInfo* camera : cameras) sum = sum + camera->world_from_camera.axis(2);
  if (length(sum) < kLeastAlike * static_cast<double>(cameras.size())) return false;
  const Vec3d ahead = normalized(sum);
  // A walk ahead passes by what it shows.
  double first = 1e300, last = -1e300;
  Box beside;
  for (const FrameInfo* camera : cameras) {
    const Vec3d at = camera->world_from_camera.t - cameras.front()->world_from_camera.t;
    const double along = dot(at, ahead);
    first = std::min(first, along);
    last = std::max(last, along);
    beside.include(at - ahead * along);
  }
  return last - first <= length(beside.size());
}

CameraRig find_rig(const Cameras& all) {
  CameraRig rig;
  rig.forward = look_one_way(all);
  const Cameras cameras = some_of(all, kMostCameras);
  if (cameras.size() < 3 || any_panorama(cameras) || !find_focus(cameras, rig.focus)) return rig;
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
  for (std::size_t row = 0; row < 3; ++row)
    for (std::size_t col = 0; col < 3; ++col) out.r[row][col] = pose.r[col][row];
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
    info.bounds = Box{};
    info.near_hint_m = info.far_hint_m = 0;
  } else if (convention.pose_scale != 1) {
    if (!info.bounds.empty()) {
      info.bounds.lo = info.bounds.lo * convention.pose_scale;
      info.bounds.hi = info.bounds.hi * convention.pose_scale;
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

namespace {

constexpr int kTolerance = 6;                  // of 255: what compression leaves of one colour
constexpr double kLeastBorder = 0.75;          // of the border's pixels show the background
constexpr double kLeastShare = 0.25;           // of all pixels; less is the rim of images that were undistorted
constexpr double kMostBackgroundViews = 0.05;  // of the frames that see a voxel of the object: highlights, bad poses
constexpr double kLeastViews = 0.4;     // of all frames must tell of a voxel: few look past the object at what it hides
constexpr double kCleanBorder = 0.005;  // foreground on the border of a frame that shows the object whole, at most
constexpr std::size_t kMostFrames = 128;

using Color = std::array<std::uint8_t, 3>;

bool near_color(const std::uint8_t* pixel, const Color& color) {
  return std::equal(color.begin(), color.end(), pixel, [](int a, int b) { return std::abs(a - b) <= kTolerance; });
}

template <class Look>
void each_border_pixel(const StoredFrame& frame, const Look& look) {
  const auto look_at = [&](std::int64_t x, std::int64_t y) {
    const auto pixel = static_cast<std::size_t>(y * frame.width_px + x);
    if (frame.mask.uses(pixel)) look(&frame.rgb[3 * pixel]);
  };
  for (std::int64_t x = 0; x < frame.width_px; ++x) {
    look_at(x, 0);
    look_at(x, frame.height_px - 1);
  }
  for (std::int64_t y = 1; y + 1 < frame.height_px; ++y) {
    look_at(0, y);
    look_at(frame.width_px - 1, y);
  }
}

// The median of each channel over all borders.
Color border_color(const std::vector<const StoredFrame*>& frames) {
  std::array<std::array<std::int64_t, 256>, 3> histogram{};
  std::int64_t count = 0;
  for (const StoredFrame* frame : frames) {
    each_border_pixel(*frame, [&](const std::uint8_t* pixel) {
      for (std::size_t c = 0; c < 3; ++c) ++histogram[c][pixel[c]];
      ++count;
    });
  }
  Color color{};
  for (std::size_t c = 0; c < 3; ++c) {
    std::int64_t below = 0;
    std::size_t value = 0;
    while (value < 255 && (below += histogram[c][value]) * 2 < count) ++value;
    color[c] = static_cast<std::uint8_t>(value);
  }
  return color;
}

// Sums of foreground pixels over rectangles from the top left corner.
class ForegroundSums {
 public:
  ForegroundSums(const StoredFrame& frame, const Color& background)
      : columns_(static_cast<std::size_t>(frame.width_px) + 1),
        rows_(static_cast<std::size_t>(frame.height_px) + 1),
        sums_(columns_ * rows_) {
    for (std::size_t y = 1; y < rows_; ++y) {
      std::uint32_t row = 0;
      for (std::size_t x = 1; x < columns_; ++x) {
        // What a mask hides may be the object.
        const std::size_t pixel = (y - 1) * (columns_ - 1) + x - 1;
        row += frame.mask.uses(pixel) && near_color(&frame.rgb[3 * pixel], background) ? 0 : 1;
        sums_[y * columns_ + x] = sums_[(y - 1) * columns_ + x] + row;
      }
    }
  }
  /// Any foreground within `radius` pixels of (u, v), as a square.
  bool any(double u, double v, double radius) const {
    const auto clamped = [](double at, std::size_t count) {
      return static_cast<std::size_t>(std::clamp(at, 0.0, static_cast<double>(count - 1)));
    };
    const std::size_t x0 = clamped(std::floor(u - radius), columns_), x1 = clamped(std::ceil(u + radius), columns_);
    const std::size_t y0 = clamped(std::floor(v - radius), rows_), y1 = clamped(std::ceil(v + radius), rows_);
    return sums_[y1 * columns_ + x1] + sums_[y0 * columns_ + x0] !=
           sums_[y0 * columns_ + x1] + sums_[y1 * columns_ + x0];
  }
  std::int64_t total() const { return sums_.back(); }

 private:
  std::size_t columns_, rows_;
  std::vector<std::uint32_t> sums_;
};

struct Silhouettes {
  Cameras cameras;
  std::vector<ForegroundSums> sums;
  std::vector<bool> whole;  ///< by frame: its border is background

  // Box of the voxels of `region` that the frames take for the object.
  Box hull(const Box& region) const {
    const double radius_m = 0.5 * length(region.size()) / 48;  // of a voxel
    return box_of_voxels(region, [&](Vec3d center) {
      double seen = 0, background = 0;
      for (std::size_t i = 0; i < cameras.size(); ++i) {
        double u = 0, v = 0;
        const bool in_image = project_into(*cameras[i], center, u, v);
        if (!in_image && !whole[i]) continue;
        seen += 1;
        const double depth = cameras[i]->camera.depth_of(cameras[i]->world_from_camera.apply_inverse(center));
        // A frame that shows the object whole tells of what is beside it too.
        background += in_image && sums[i].any(u, v, radius_m * cameras[i]->camera.fx / depth) ? 0 : 1;
        if (background > kMostBackgroundViews * static_cast<double>(cameras.size())) return false;
      }
      return seen >= kLeastViews * static_cast<double>(cameras.size()) && background <= kMostBackgroundViews * seen;
    });
  }
};

}  // namespace

std::optional<PlainBackground> find_plain_background(const Cameras& cameras,
                                                     const std::vector<const StoredFrame*>& pixels,
                                                     const CameraRig& rig) {
  if (!rig.inward) return std::nullopt;
  std::vector<const StoredFrame*> frames;
  Silhouettes silhouettes;
  const std::size_t count = std::min(cameras.size(), kMostFrames);
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t at = i * cameras.size() / count;
    if (pixels[at]->rgb.empty()) continue;
    frames.push_back(pixels[at]);
    silhouettes.cameras.push_back(cameras[at]);
  }
  if (frames.empty()) return std::nullopt;
  PlainBackground out;
  out.color = border_color(frames);
  std::int64_t border = 0, plain = 0;
  for (const StoredFrame* frame : frames) {
    std::int64_t around = 0, alike = 0;
    each_border_pixel(*frame, [&](const std::uint8_t* pixel) {
      ++around;
      alike += near_color(pixel, out.color) ? 1 : 0;
    });
    border += around;
    plain += alike;
    silhouettes.whole.push_back(static_cast<double>(around - alike) <= kCleanBorder * static_cast<double>(around));
  }
  if (border == 0 || static_cast<double>(plain) < kLeastBorder * static_cast<double>(border)) return std::nullopt;
  std::int64_t all = 0, foreground = 0;
  for (const StoredFrame* frame : frames) {
    silhouettes.sums.emplace_back(*frame, out.color);
    all += std::int64_t{frame->width_px} * frame->height_px;
    foreground += silhouettes.sums.back().total();
  }
  if (static_cast<double>(foreground) > (1 - kLeastShare) * static_cast<double>(all)) return std::nullopt;
  const Vec3d half{rig.distance_m, rig.distance_m, rig.distance_m};
  const Box coarse = silhouettes.hull({rig.focus - half, rig.focus + half});
  if (coarse.empty()) return std::nullopt;
  out.object = silhouettes.hull(coarse);  // the same number of voxels over less space
  return out.object.empty() ? std::nullopt : std::optional(out);
}

namespace {

constexpr double kNearAxis = 0.9397;  // cosine of 20 degrees
constexpr double kCancelled = 0.1;    // length of a mean of unit vectors that say nothing together

// x, -x, y, -y, z, -z.
Vec3d axis(int number) {
  Vec3d out;
  out[number / 2] = number % 2 == 0 ? 1 : -1;
  return out;
}

}  // namespace

std::optional<Vec3d> up_of_cameras(std::span<const Pose> world_from_camera) {
  Vec3d sum;
  for (const Pose& pose : world_from_camera) sum = sum - pose.axis(1);
  if (!(length(sum) > kCancelled * static_cast<double>(world_from_camera.size()))) return std::nullopt;
  const Vec3d mean = normalized(sum);
  for (int i = 0; i < 6; ++i) {
    if (dot(axis(i), mean) > kNearAxis) return axis(i);
  }
  return mean;
}

std::optional<Vec3d> axis_named(const std::string& name) {
  for (int i = 0; i < 6; ++i) {
    const std::string text = axis_text(axis(i));
    if (name == text || (i % 2 == 0 && name == text.substr(1))) return axis(i);
  }
  return std::nullopt;
}

std::string axis_text(Vec3d up) {
  for (int i = 0; i < 6; ++i) {
    if (up == axis(i)) return fmt::format("{}{}", i % 2 == 0 ? '+' : '-', "xyz"[i / 2]);
  }
  return fmt::format("({:.3f}, {:.3f}, {:.3f})", up.x, up.y, up.z);
}

}  // namespace semfield
