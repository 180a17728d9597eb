// A field as 3D Gaussians [Kerbl23], without a training of their own.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "eval/evaluator.h"
#include "handover/voxel_map.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

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
