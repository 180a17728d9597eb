// What the pixels of neighbouring frames say of each convention that poses may have been written in.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "scene/pose_convention.h"

namespace semfield {

/// A frame as the check keeps it; vectors are empty where it keeps none.
struct SmallFrame {
  Camera camera;                    ///< at the small size
  std::vector<float> depth_m;       ///< [H * W], 0 = invalid
  std::vector<Vec3d> points;        ///< some of its pixels as points in camera axes, divided by their z
  std::vector<float> point_depths;  ///< their z
};

/// The depth of a frame, at most 96 pixels wide or high, by the nearest pixel.
SmallFrame small_depth_frame(const Camera& camera, const FrameBuffer& frame);

/// Frames that may see the same things, by index; the first is the lower.
using FramePairs = std::vector<std::pair<int, int>>;

/// One convention and how well it fits.
struct Tally {
  PoseConvention convention;
  std::size_t axes = 0;  ///< its axes and direction, of conventions()
  int pairs = 0;         ///< pairs of frames that overlap under it
  double error = 1;      ///< median over them of the median relative difference of depths, 0..1
};

struct DepthTallies {
  std::vector<Tally> read;  ///< the convention given first
  /// Each of conventions() with camera centres that count for nothing: a unit that fits no better has not been seen.
  std::vector<Tally> still;
};

/// At most 24 frames, evenly spaced, each with its neighbours in order and by pose, however the poses are read: the
/// angle between two cameras is the same under every convention. Frames with width 0 in `cameras` are left out.
FramePairs choose_pairs(const SceneInfo& as_opened, const std::vector<Camera>& cameras);
/// All pairs of a few frames whose directions differ by less than a right angle: those of a wide ring overlap too, but
/// hide much from each other. None of over 24 frames.
FramePairs wide_pairs(const SceneInfo& as_opened, const std::vector<Camera>& cameras);

/// The convention given (first), the other axes, the inverse, and both.
std::vector<PoseConvention> conventions(const PoseConvention& given);

/// to_from, from the poses of two frames as opened.
Pose relative_pose(const SceneInfo& as_opened, const PoseConvention& convention, std::size_t to, std::size_t from);

/// Depth of each frame warped into the other of its pair under each of conventions(), with depth as it is and times
/// 1000 and 1/1000; and under the first with depth in the other units of common sensors and exports. `frames` as
/// `as_opened.frames`, empty where not looked at.
DepthTallies vote_by_depth(const SceneInfo& as_opened, const std::vector<SmallFrame>& frames, const FramePairs& pairs,
                           const PoseConvention& given);

}  // namespace semfield
