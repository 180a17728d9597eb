// Bundle adjustment [Triggs00]: poses, lenses and points are moved together to where photographs show the points, while
// poses are held to those given as far as photographs do not say more.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "scene/camera.h"
#include "scene/camera_rig.h"

namespace semfield {

/// Where a photograph shows a point, pixels.
struct Sighting {
  std::int32_t frame = 0;
  double u = 0, v = 0;
};

/// A point of the world and where it is seen.
struct Track {
  Vec3d point;
  std::vector<Sighting> seen;
};

/// What a lens is off by from the one stated; shared by all frames of one camera.
struct LensChange {
  /// Logarithms of the factors of fx and fy; the shift of the centre, shares of the image's width and height; what is
  /// added to k1, k2, p1 and p2.
  std::array<double, 8> by{};
  Camera applied_to(const Camera& stated) const;
};

/// Depth of one frame on a coarse grid.
struct BundleDepth {
  Camera camera;               ///< at the size of the grid
  std::vector<float> depth_m;  ///< [H * W], Camera::depth_of; 0 = none
};

struct Bundle {
  std::vector<Camera> stated;  ///< by frame
  std::vector<Pose> given;     ///< world_from_camera
  std::vector<Pose> poses;     ///< the same number; begins as `given`
  std::vector<int> lens_of;    ///< of each frame: its place in `lenses`
  std::vector<LensChange> lenses;
  std::vector<Track> tracks;
  std::vector<BundleDepth> depth;  ///< by frame, or none at all
  Pose depth_from_color;           ///< of every frame; the identity where both are one camera
  /// The middle distance from a camera to its points: the length by which shifts are judged.
  double middle = 1;

  Camera camera(std::size_t frame) const {
    return lenses[static_cast<std::size_t>(lens_of[frame])].applied_to(stated[frame]);
  }
  /// Sets `middle` from the tracks.
  void measure();
};

struct BundleOptions {
  double outlier_px = 2;   ///< errors far beyond count for little (Cauchy)
  double turn_rad = 0.02;  ///< by which given poses are off, one sigma
  double shift = 0.015;    ///< the same, in Bundle::middle
  double depth_share =
      0.04;  ///< by which depth is off, one sigma: errors of neighbours are alike, so each counts little
  bool move_poses = true, move_focal = true, move_lens = true, move_depth_camera = false;
  bool use_depth = false;  ///< points lie on the depth that frames show
  int iterations = 15;
};

/// Distance in pixels between where the frame shows the point and where its camera sees it; infinite behind it.
double error_px(const Bundle& bundle, const Track& track, const Sighting& sighting);
/// Moves a track's point to where it is seen, its cameras fixed. False where no point is seen from two places.
bool settle_point(const Bundle& bundle, Track& track);
/// Levenberg-Marquardt with the points eliminated. Deterministic.
void adjust(Bundle& bundle, const BundleOptions& options);
/// The share of points that lie within 2 % of the depth shown, of those where depth is shown without an edge; -1 where
/// there are fewer than 50.
double share_on_depth(const Bundle& bundle);
/// Moves depth_from_color alone, to where most points lie on the depth shown.
void align_depth(Bundle& bundle);

/// exp(turn) * the rotation, then the shift: of camera_from_world, in the axes of the camera.
Pose moved(const Pose& world_from_camera, const std::array<double, 6>& by);

}  // namespace semfield
