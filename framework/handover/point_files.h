// Labelled points and splats in formats of other programs.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "eval/evaluator.h"
#include "handover/voxel_map.h"
#include "scene/camera_rig.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

/// PCD 0.7, binary: x y z (float, less `offset`), normal_x normal_y normal_z, rgb (as PCL packs it); with semantics
/// label (uint: the id) and entropy (float, nats); with objects instance (uint, 0 = none).
void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset);

/// LAS 1.4, point format 7: whole steps of a millionth of the box's decade(), a thousandth of a millimetre in a room,
/// from the middle of the box in whole decades (both in the header); colours with 16 bits; classification: the class's
/// id, 255 for one above 254. Extra bytes, which the header describes: label (uint16: the id), entropy (float) and,
/// with objects, instance (uint32). A table of classification names, of 15 bytes each. No coordinate system of the
/// earth is named. Returns the offset of the header, which readers add by themselves.
Vec3d write_las(const std::string& path, const PointSet& points, const ClassTable& classes);

// What files for other programs cannot say themselves: where their coordinates come from and what their numbers mean.

/// A file, and what was taken from its coordinates: those of the input are the file's plus `offset`.
struct HandedFile {
  std::string path;
  std::string holds;             ///< "surface", "points", "splats", "voxels", "costmap"
  Vec3d offset;                  ///< world units
  std::optional<double> edge{};  ///< of a voxel or a pixel of a map, world units
};

struct Sidecar {
  std::string run, scene;
  std::int64_t step = 0;
  bool metric = true;                   ///< the unit is the metre; else it is the scene's own
  std::optional<Vec3d> up;              ///< unit vector of the world, where it is known
  PoseConvention convention;            ///< what the configuration did to the poses of the input when they were read
  const ClassTable* classes = nullptr;  ///< null: no semantics
  std::map<std::int32_t, std::string> objects;  ///< names by id; empty: none
  std::vector<HandedFile> files;
};

/// JSON of `semfield-handover-1`, with its last line's end: run, scene, step, world {unit, axes, up, pose_scale,
/// poses_inverted, axes_flipped}, files [{file, holds, offset, edge}], classes [{id, name, color, ignore}], objects
/// [{id, name}]. Files are named without their folders.
std::string sidecar_json(const Sidecar& sidecar);

/// Gaussians of one size: points with their colours and classes, and how opaque the middle of each is.
struct Splats {
  PointSet points;
  std::vector<float> opacity;  ///< [N] in (0, 1)
  double deviation = 0;        ///< standard deviation, the same along all axes, world units
};

/// Opacity of the middle of Gaussians that stand on a grid of distance `spacing` and deviation `width` spacings, so
/// that light that passes them dies as in a medium of this optical depth per spacing. A plane of the grid takes the
/// logarithm of 1 - a g out of the light, whose integral over a Gaussian g is -2 pi width^2 Li2(a), Li2 the dilogarithm
/// [Lewin81]; at most kMostOpacity.
double splat_opacity(double optical_depth, double width);
inline constexpr double kMostOpacity = 0.99, kSplatWidth = 0.5;

/// The cubes of a grid in which light of training views ends. The field's density says how much of it does; colours and
/// classes are those that the views show, of the pixels whose light ends there, near ones before far ones.
class SplatVolume {
 public:
  /// Asks the field in every cube. `opaque`: what lies outside of the box is solid, as rendering draws a background
  /// there.
  SplatVolume(const Pipeline<float>& pipeline, const VoxelGridPlace& place, const Box& bounds, bool opaque);

  /// A rendered view. The same views in the same order give the same splats, for any number of threads.
  void add(const RayCamera& camera, const RenderedFrame& frame, const RayLimits& limits);
  Splats splats() const;

 private:
  struct Share {
    std::uint32_t cell, pixel;
    float light, weight;  // of the pixel's light; and that as pixels per area
  };
  void follow(const RayCamera& camera, const RayLimits& limits, std::int32_t width, std::int32_t row,
              std::vector<Share>& into) const;
  void add_share(const Share& share, const RenderedFrame& frame);

  VoxelGridPlace place_;
  std::vector<float> density_;        ///< of each cube, per world unit
  std::vector<std::int32_t> number_;  ///< of each cube among those below, -1: none
  struct Seen {
    std::uint32_t cell = 0;
    float light = 0, weight = 0, lead = 0;
    std::array<float, 3> color{};  // sum of weighted ones
    std::int16_t label = kVoid;
  };
  std::vector<Seen> seen_;
  bool labels_ = false;
};

/// The PLY of [Kerbl23], binary little-endian: x y z (less `offset`), nx ny nz (0), f_dc_0..2 (colour as the harmonic
/// of degree 0), opacity (its logit), scale_0..2 (logarithms), rot_0..3 (w x y z), all float; with semantics class_id
/// and with objects instance_id (int), behind them.
void write_splat_ply(const std::string& path, const Splats& splats, const ClassTable& classes, Vec3d offset);
/// .splat: 32 bytes each, x y z and three deviations (float), red green blue and opacity (8 bits), w x y z (8 bits,
/// 128 = 0). Ids have no place in it.
void write_splat(const std::string& path, const Splats& splats, Vec3d offset);

// Colours of splats, so that they look drawn as the field looks rendered.

/// What the field shows from a place.
struct SplatView {
  RayCamera camera;
  std::vector<std::uint8_t> rgb;  ///< [height_px, width_px, 3]
};

/// Draws the splats as viewers do, by weighted averages from front to back [Zwicker01] [Kerbl23], over `background`.
/// The picture, [height_px, width_px, 3] in 0 to 1; empty for a wide lens, whose footprints are no ellipses.
std::vector<float> draw_splats(const Splats& splats, const RayCamera& camera, const std::array<double, 3>& background);

/// Changes colours so that pictures of the splats come near the views: a viewer widens every footprint by a part of a
/// pixel and blurs what the field shows sharp. Simultaneous iterations [Gilbert72]: a splat's colour moves by the mean
/// of what its pixels miss, weighted by its share in them. Views of a wide lens say nothing. The same bits for any
/// number of threads.
void fit_colors(Splats& splats, std::span<const SplatView> views, const std::array<double, 3>& background);

}  // namespace semfield
