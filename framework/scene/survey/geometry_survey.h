// Whether the poses of a scene fit its pixels: small pictures of a few frames, taken while they are read, are compared
// under every convention that poses may have been written in.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "scene/survey/camera_check.h"
#include "scene/survey/depth_edges.h"
#include "scene/survey/photo_votes.h"

namespace semfield {

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
struct DepthRange {
  double median = 0;
  int values = 0;  ///< different ones; few when metres were rounded to whole steps
};

/// What is to be said of tallies of vote_by_depth: one sentence, and the error or the warning. `wide`: of wide_pairs,
/// where depth that disagrees may be of other sides of things; a convention that fits speaks all the same.
std::string judge_depth(const DepthTallies& tallies, const SceneInfo& as_opened, const DepthRange& range, bool wide,
                        Diagnostics& diagnostics);

/// The same of vote_by_photos.
std::string judge_photos(const PhotoTallies& tallies, const SceneInfo& as_opened, Diagnostics& diagnostics);

}  // namespace semfield
