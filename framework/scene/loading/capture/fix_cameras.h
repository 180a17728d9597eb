// Cameras of a scene that has poses, fixed by its photographs: lens, poses, and where the depth camera stands.
#pragma once

#include <cstddef>
#include <functional>
#include <string>
#include <vector>

#include "scene/loading/capture/prepare.h"
#include "scene/scene.h"
#include "scene/survey/bundle.h"

namespace semfield {

struct PosedScene {
  SceneInfo info;                               ///< in house conventions
  std::function<void(int, FrameBuffer&)> read;  ///< pixels of a frame, depth in the unit of the poses; thread-safe
};

struct FixedCameras {
  std::vector<Camera> cameras;  ///< by frame
  std::vector<Pose> poses;
  bool kept = false;  ///< the photographs ask for no change: cameras and poses are those given
  /// Of each frame with depth: the camera that took it, of any size of the same view; and where it stands.
  std::vector<Camera> depth_cameras;
  Pose depth_from_color;
  bool depth_apart = false;                         ///< depth is of another camera than colour
  std::size_t points = 0, judges = 0;               ///< that took part in fixing, and that did not
  double given_px = 0, fixed_px = 0;                ///< median errors of points that took no part in fixing
  double given_on_depth = -1, fixed_on_depth = -1;  ///< shares of points on the depth shown; -1: not known
  std::vector<std::string> changes;                 ///< sentences: what was changed, and by how much
};

/// Photographs are matched by COLMAP along pairs that the given poses propose; then bundle adjustment moves poses, the
/// lens and the depth camera. What a tenth of the points says, held out of it, decides whether the result is taken.
/// `out`/prepare/ holds the steps that are done, by which a call that was ended goes on; the scene's own files are for
/// the caller to write. Throws Error for a scene that cannot be fixed, a folder of others, a program that is missing
/// or fails.
FixedCameras fix_cameras(const PosedScene& scene, const std::string& out, int threads, const Programs& programs,
                         const CaptureProgress& progress);

/// Whether the frame's source is a photograph that COLMAP and browsers read as it is: JPEG or PNG.
bool is_photograph_file(const FrameInfo& frame);

/// Pairs of frames that may see the same: each with its nearest by distance and angle, and with those behind it.
std::vector<Pair> pairs_by_pose(const std::vector<Pose>& poses);

// What COLMAP found of the same point in several photographs, as tracks.

/// Reads features and the matches that two views confirm from a database of COLMAP, and joins matches to tracks: of two
/// that would bring two features of one image into a track, the later is dropped. `names` are those of the images;
/// Sighting::frame is a place among them. Deterministic. Points are not set.
std::vector<Track> feature_tracks(const std::string& database, const std::vector<std::string>& names);

}  // namespace semfield
