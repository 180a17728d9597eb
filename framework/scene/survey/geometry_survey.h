// Whether the poses of a scene fit its pixels: small pictures of a few frames, taken while they are read, are compared
// under every convention that poses may have been written in.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "scene/camera_rig.h"
#include "scene/scene.h"
#include "scene/survey/bundle.h"
#include "scene/survey/camera_check.h"

namespace semfield {

/// World points of a sparse grid of pixels and their distances along the rays, metres; only where depth is valid.
struct SurveyPoints {
  std::vector<float> x, y, z, distance;
  std::int64_t looked_at = 0;  ///< pixels of the grid
};

/// Where the points of frames are, as far as bounds may believe them.
struct SurveyedExtent {
  Box bounds;
  double near_m = 0, far_m = 0;
  std::int64_t points = 0;
};

/// Of points whose depth is estimated: the outermost half per cent each way is dropped, and the box then grown by
/// `margin` of its size each way. Nothing without points.
std::optional<SurveyedExtent> extent_of_points(std::vector<SurveyPoints> parts, double margin = 0.05);

/// Pixels between two that are looked at, each way: 4, or the power of two beyond that keeps `pixels` in all (of the
/// frames surveyed) below 2^20 points.
std::int32_t survey_step(std::int64_t pixels);

/// Points of one frame. Pose and camera belong to the buffer's size.
SurveyPoints survey_frame(const Camera& camera, const Pose& world_from_camera, const FrameBuffer& frame,
                          std::int32_t step);

// What the pixels of neighbouring frames say of each convention that poses may have been written in.

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

// What photographs without depth say of the convention of poses: corners found again in neighbouring ones, and the
// epipolar lines where the poses put them. Unit and scale do not show in them.

/// A corner and what it looks like: 8 x 8 means of grey around it, mean 0 and length 1.
struct PhotoCorner {
  Vec3d ray;            ///< in camera axes, z = 1
  double u = 0, v = 0;  ///< in the photograph as loaded, pixels
  float grey = 0;       ///< mean around it, 0 to 255
  std::array<float, 64> patch;
};

/// What the check keeps of a photograph.
struct PhotoFrame {
  Camera camera;  ///< its focal lengths are those of the small picture
  std::vector<PhotoCorner> corners;
};

/// A small picture in grey, 0 to 255.
struct Grey {
  std::int32_t width = 0, height = 0;
  std::vector<float> value;
  float at(std::int32_t x, std::int32_t y) const {
    return value[static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)];
  }
};
/// Pixels of a photograph along a side of one of its small picture.
std::int32_t photo_step(const Camera& camera);
/// Means of blocks of `side` x `side` pixels.
Grey grey_of(const FrameBuffer& frame, std::int32_t side);

/// The strongest corners of a frame of about 320 pixels width or height, spread over it.
PhotoFrame photo_frame(const Camera& camera, const FrameBuffer& frame);

/// Longer side of the small pictures in which corners are found, pixels, about.
inline constexpr std::int32_t kPhotoSide = 320;

struct PhotoTally {
  PoseConvention convention;
  int fits = 0;                           ///< matches that lie within 1.5 pixels of their epipolar half line
  int better_pairs = 0, worse_pairs = 0;  ///< pairs of frames where more or fewer fit than as given
};

/// As PhotoTally, under the convention given with all focal lengths divided by `factor`.
struct FocalTally {
  double factor = 1;
  int fits = 0;
  int better_pairs = 0, worse_pairs = 0;
};

struct PhotoTallies {
  std::vector<Track> tracks;        ///< of two frames each, all matches of such pairs; points are not set
  int matches = 0, pairs = 0;       ///< of pairs with enough matches to show that they overlap
  std::vector<PhotoTally> tallies;  ///< the convention given, the other axes, the inverse, both
  std::vector<FocalTally> focal;
  /// Where the matches that fit the convention given lie, of pairs of training frames: world points, and distances from
  /// the first camera of each pair. Only of matches whose rays meet at an angle that shows how far.
  SurveyPoints corners;
  /// By what factor brightness differs between the frames of a pair: e to the median over pairs of the magnitude of the
  /// pair's median logarithm, 1 or more. Nothing where too few pairs say so.
  std::optional<double> exposure;
};

/// Matches between the frames of each pair, held against each convention. `frames` as `as_opened.frames`.
PhotoTallies vote_by_photos(const SceneInfo& as_opened, const std::vector<PhotoFrame>& frames, const FramePairs& pairs,
                            const PoseConvention& given);

/// What the pixels say of the poses.
struct GeometryVerdict {
  std::string text;  ///< one sentence
  /// Corners of photographs that were found again in others, where the poses put them; empty with depth, and where the
  /// photographs do not agree with the poses.
  SurveyPoints corners;
  CameraCheck cameras;
  bool depth_beside = false;       ///< edges of depth lie beside those of the photographs
  std::optional<double> exposure;  ///< as PhotoTallies; nothing where nobody asked for it
};

class GeometrySurvey {
 public:
  /// `as_opened` is the manifest before `given` was applied and outlives this; `cameras` are at the loaded size, with
  /// width 0 where a frame cannot be read. `exposure`: brightness is compared too, also of frames with depth.
  GeometrySurvey(const SceneInfo& as_opened, const std::vector<Camera>& cameras, const PoseConvention& given,
                 bool exposure = false);

  /// Keeps what the check needs of a frame, its depth converted; at most a hundred kilobytes of some hundred frames.
  /// For different frames from any thread.
  void look_at(std::size_t frame, const Camera& camera, const FrameBuffer& pixels);

  /// The same for any number of threads. Adds an error where another convention fits and the given one does not, or
  /// where many corners contradict the poses, a warning where nothing fits.
  GeometryVerdict conclude(Diagnostics& diagnostics) const;

 private:
  Bundle bundle_of(const PhotoTallies& found) const;
  std::vector<Pose> delayed_poses(const PhotoTallies& found, double frames) const;
  /// Adds to the text, and warnings, what the photographs say of the cameras in pixels.
  void judge_cameras(GeometryVerdict& verdict, bool with_depth, Diagnostics& diagnostics) const;

  const SceneInfo& as_opened_;
  std::vector<Camera> cameras_;
  PoseConvention given_;
  bool exposure_;
  FramePairs pairs_;
  FramePairs wide_;  // of frames with depth, where there are hardly any others
  std::vector<bool> wanted_;
  std::vector<SmallFrame> frames_;
  std::vector<EdgeScores> edges_;
  std::vector<PhotoFrame> photos_;  // of frames without depth, or where brightness is compared
};

/// Depth over all frames looked at.
struct DepthSpread {
  double median = 0;
  int values = 0;  ///< different ones; few when metres were rounded to whole steps
};

/// What is to be said of tallies of vote_by_depth: one sentence, and the error or the warning. `wide`: of wide_pairs,
/// where depth that disagrees may be of other sides of things; a convention that fits speaks all the same.
std::string judge_depth(const DepthTallies& tallies, const SceneInfo& as_opened, const DepthSpread& range, bool wide,
                        Diagnostics& diagnostics);

/// The same of vote_by_photos.
std::string judge_photos(const PhotoTallies& tallies, const SceneInfo& as_opened, Diagnostics& diagnostics);

}  // namespace semfield
