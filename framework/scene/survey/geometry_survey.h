// Whether poses, lens and depth of a scene fit its pixels: small pictures of a few frames, taken while they are read,
// are compared.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "scene/camera_rig.h"
#include "scene/scene.h"
#include "scene/survey/bundle.h"

namespace semfield {

/// World points of a sparse grid of pixels and their distances along the rays, metres; only where depth is valid.
struct SurveyPoints {
  std::vector<float> x, y, z, distance;
  std::int64_t looked_at = 0;  ///< pixels of the grid

  void add(Vec3d point, double along) {
    x.push_back(static_cast<float>(point.x));
    y.push_back(static_cast<float>(point.y));
    z.push_back(static_cast<float>(point.z));
    distance.push_back(static_cast<float>(along));
  }
  void append(const SurveyPoints& more) {
    for (const auto& member : {&SurveyPoints::x, &SurveyPoints::y, &SurveyPoints::z, &SurveyPoints::distance})
      (this->*member).insert((this->*member).end(), (more.*member).begin(), (more.*member).end());
    looked_at += more.looked_at;
  }
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

/// Whether cameras fit the photographs, in pixels; and if not, what fits.
struct CameraCheck {
  int corners = 0;   ///< found again in another frame; 0: too few to say anything
  double given = 0;  ///< share of them that lie where the cameras put them
  bool off = false;  ///< other cameras fit clearly more
  /// What fits more, and what share of the corners: "another lens (focal length 532 for 585 pixels)". Of corners that
  /// took no part in finding it.
  std::vector<std::pair<std::string, double>> fits;
};

inline constexpr int kEdgeReach = 8;  ///< pixels of the small picture, each way
/// How strong the photograph's edges are where depth has its edges, [2 kEdgeReach + 1][2 kEdgeReach + 1] by shift down
/// and right, their mean 1; empty where a frame has few edges.
using EdgeScores = std::vector<float>;
EdgeScores edge_scores(const Camera& camera, const FrameBuffer& frame);

/// What the pixels say of the cameras.
struct GeometryVerdict {
  std::string text;  ///< one sentence
  /// Corners of photographs that were found again in others, where the poses put them; empty with depth, and where the
  /// photographs do not agree with the poses.
  SurveyPoints corners;
  CameraCheck cameras;
  bool depth_beside = false;  ///< edges of depth lie beside those of the photographs
  /// By what factor brightness differs between overlapping frames: e to the median over pairs of the magnitude of the
  /// pair's median logarithm, 1 or more. Nothing where too few pairs say so, or nobody asked for it.
  std::optional<double> exposure;
};

class GeometrySurvey {
 public:
  /// `as_opened` is the manifest before `given` was applied and outlives this; `cameras` are at the loaded size, with
  /// width 0 where a frame cannot be read. `exposure`: brightness is compared too.
  GeometrySurvey(const SceneInfo& as_opened, const std::vector<Camera>& cameras, const PoseConvention& given,
                 bool exposure = false);
  ~GeometrySurvey();

  /// Keeps what the check needs of a frame, its depth converted; at most a hundred kilobytes of some hundred frames.
  /// For different frames from any thread.
  void look_at(std::size_t frame, const Camera& camera, const FrameBuffer& pixels);

  /// The same for any number of threads. Adds an error where another convention or image size fits and the given one
  /// does not, or where many corners contradict the poses, a warning where nothing fits.
  GeometryVerdict conclude(Diagnostics& diagnostics) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace semfield
