// Whether cameras fit the photographs, in pixels; and if not, what fits.
#pragma once

#include <array>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "scene/scene.h"
#include "scene/survey/bundle.h"

namespace semfield {

struct CameraCheck {
  int corners = 0;   ///< found again in another frame; 0: too few to say anything
  double given = 0;  ///< share of them that lie where the cameras put them
  bool off = false;  ///< other cameras fit clearly more
  /// What fits more, and what share of the corners: "another lens (focal length 532 for 585 pixels)". Of corners that
  /// took no part in finding it.
  std::vector<std::pair<std::string, double>> fits;
};

/// Poses of the bundle's frames as they were so many frames later; empty where frames are not in order.
using DelayedPoses = std::function<std::vector<Pose>(double frames)>;

/// `bundle` holds the frames as given and tracks of two frames each, whose points do not matter, in pixels of
/// `stated`; `side_px` is the longer side of the pictures in which they were found.
CameraCheck check_cameras(Bundle bundle, double side_px, const DelayedPoses& delayed);

// Whether depth lies on the colours: edges of depth are held against edges of the photograph, shifted each way.

inline constexpr int kEdgeReach = 8;  ///< pixels of the small picture, each way
/// How strong the photograph's edges are where depth has its edges, [2 kEdgeReach + 1][2 kEdgeReach + 1] by shift down
/// and right, their mean 1; empty where a frame has few edges.
using EdgeScores = std::vector<float>;
EdgeScores edge_scores(const Camera& camera, const FrameBuffer& frame);

/// Where depth lies best.
struct DepthShift {
  double right_px = 0, down_px = 0;  ///< by which edges of colour lie beside those of depth, pixels of the photograph
  double steps = 0;                  ///< how far that is, pixels of the small picture
  double gain = 1;                   ///< how much stronger edges are there than where they should be
};
/// Nothing where too few frames say the same.
std::optional<DepthShift> depth_shift(const std::vector<EdgeScores>& frames, const std::vector<Camera>& cameras);

}  // namespace semfield
