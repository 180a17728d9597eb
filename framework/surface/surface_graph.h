// What a view sees of the surface in each of its pixels - places in the world, normals, borders of depth -, its cells,
// and the cheapest ways over its points from those that somebody has named: steps of colour and bends cost more.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>
#include <unordered_map>
#include <vector>

#include "core/small_math.h"
#include "eval/evaluator.h"
#include "execution/pipeline.h"
#include "scene/scene.h"

namespace semfield {

struct FrameSegments;

/// Camera, pose and z-depth of a view.
struct PosedDepth {
  Camera camera;
  Pose world_from_camera;
  std::span<const float> depth_m;  ///< [H * W] z-depth, 0 = none

  std::size_t pixel(std::int32_t column, std::int32_t row) const {
    return static_cast<std::size_t>(row) * static_cast<std::size_t>(camera.width_px) + static_cast<std::size_t>(column);
  }
};

/// World point that the centre of a pixel sees; none where it has no depth (0, negative, not finite), or where the lens
/// has no inverse.
std::optional<Vec3d> surface_point(const PosedDepth& view, std::int32_t column, std::int32_t row);

/// Where a world point falls in an image.
struct PixelHit {
  std::int32_t column = 0, row = 0;
  double z_m = 0;       ///< z-depth of the point in that view
  double u = 0, v = 0;  ///< image point in pixels
};

/// None for a point behind the camera or outside the image, or outside the field of view of a distorting lens (whose
/// polynomial folds such points back into the image).
std::optional<PixelHit> project_point(const Camera& camera, const Pose& world_from_camera, Vec3d point);

/// Pixels of a view, or every so many of them, row by row.
struct SeenSurface {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<Vec3d> place;        ///< NaN where the view sees nothing
  std::vector<Vec3d> normal;       ///< towards the camera; 0 where there is none
  std::vector<double> distance_m;  ///< from the camera, 0 for nothing
  /// No border of depth beside the pixel, whose four neighbours see something too.
  bool is_interior(std::int64_t pixel) const;
};

bool is_place(Vec3d point);

/// World points of a view's pixels [H * W], NaN for none.
std::vector<Vec3d> surface_points(const PosedDepth& view);

/// `place` [height * width] as seen from `eye`. A normal is the cross product of the ways to the nearer of the two
/// neighbours along the row and along the column, so that edges of depth do not turn it.
SeenSurface seen_surface(std::vector<Vec3d> place, std::int32_t width_px, Vec3d eye);

// The cells of a surface.

/// Place of a cell in the grid, in cells from the origin.
using SurfaceCell = std::array<std::int32_t, 3>;

/// Two cells that touch in a face, an edge or a corner.
struct CellPair {
  std::int32_t a = 0, b = 0;
};

/// Numbers by key, in one table that is at most half full: a key lies at the first free place from its hash on.
class CellIndex {
 public:
  /// The number of `key`, or -1.
  std::int32_t find(std::uint64_t key) const { return entries_.empty() ? -1 : entries_[place_of(key)].number; }
  /// The number of `key`, which is `fresh` where it had none.
  std::int32_t add(std::uint64_t key, std::int32_t fresh);

 private:
  struct Entry {
    std::uint64_t key = 0;
    std::int32_t number = -1;  // -1: free
  };
  std::size_t place_of(std::uint64_t key) const;
  void grow();
  std::vector<Entry> entries_;  // a power of two of them, or none
  std::size_t used_ = 0;
};

/// Cells get numbers from 0 on as they are met.
class SurfaceCells {
 public:
  SurfaceCells() = default;
  /// `edge_m`: of a cell. Throws Error(internal) where it is not positive.
  explicit SurfaceCells(double edge_m);

  double edge_m() const { return edge_m_; }
  /// The cell that holds `point`, a new one when it is the first in it; -1 for a point that is not finite, more than a
  /// million cells from the first one, or more than a billion from 0.
  std::int32_t add(Vec3d point);
  std::int32_t add(const SurfaceCell& place);  ///< likewise
  std::int32_t count() const { return static_cast<std::int32_t>(places_.size()); }
  const SurfaceCell& place(std::int32_t cell) const { return places_[static_cast<std::size_t>(cell)]; }
  /// The cell that holds `point`, else the one with the nearest centre of those that touch its place; -1: none.
  std::int32_t near(Vec3d point) const;
  /// Every two cells of which each is one of the other's 26 neighbours, once; in the order of the first one's number.
  std::vector<CellPair> neighbours() const;

 private:
  std::uint64_t key_of(const SurfaceCell& place) const;  // unique where fits()
  bool fits(const SurfaceCell& place) const;
  bool find_place(Vec3d point, SurfaceCell& place) const;
  double edge_m_ = 0;
  CellIndex index_;
  std::vector<SurfaceCell> places_;
};

// Where the rays of a camera's pixels meet the field: the surface that labels lie on.

/// Distances along the rays of every `stride`-th pixel (eval/evaluator.h), row-major.
struct SurfaceMap {
  std::int32_t stride = 0;  ///< 0: not made yet
  std::int32_t width_px = 0, height_px = 0;
  std::vector<float> distance_m;  ///< [height * width] along the ray; 0: the ray meets nothing
  std::int64_t step = 0;          ///< of training, when it was made

  bool empty() const { return stride == 0; }
  /// The map's value at a pixel of the frame.
  float at(std::int32_t column, std::int32_t row) const;
};

/// Whether training has moved so far since the map was made that it is made anew. `step` is that of training.
inline bool is_stale(const SurfaceMap& map, std::int64_t step) {
  return static_cast<double>(step) > 1.6 * static_cast<double>(map.step) + 50;
}

/// A ray that keeps less opacity than this meets nothing.
inline constexpr float kSurfaceOpacity = 0.5F;

/// Expected distance divided by opacity, at these pixels; 0 where opacity is below kSurfaceOpacity. Colours and labels
/// are not computed. Throws as Executor::render.
std::vector<float> surface_distances(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                                     std::span<const PixelPlace> pixels);

SurfaceMap make_surface_map(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                            std::int32_t stride, std::int64_t step);

/// World position on the pixel's ray.
Vec3d point_at(const RayCamera& camera, const RayLimits& limits, const PixelPlace& pixel, double distance_m);

// Thin the surface that several views show to one point per cell, with the mean colour and normal of what lies there.

/// A view of the pool: its camera and the surface that it sees.
struct PoolView {
  int frame = 0;  ///< in SceneInfo::frames
  RayCamera camera;
  const StoredFrame* photo = nullptr;       ///< borrowed
  SurfaceMap map;                           ///< empty: not seen yet
  const FrameSegments* segments = nullptr;  ///< borrowed; null: nobody has segmented its image
};

/// What the view's map shows.
SeenSurface surface_seen_by(const PoolView& view, const RayLimits& limits);

/// A cell of the surface, and where it is seen best: in a view's middle rather than at a border of depth, and from
/// near.
struct PoolPoint {
  Vec3d position;  ///< mean of what lies in the cell
  Vec3d normal;    ///< unit mean of what is seen of it, towards the cameras; 0 where there is none
  Vec3d color;     ///< mean of the photographs there, 0 to 1
  double pixels = 0;
  int view = 0;
  PixelPlace pixel;
  double distance_m = 0;  ///< from which `view` sees it
  bool interior = false;  ///< no border of depth beside `pixel`
};

/// What |difference|^2 / (2 sigma^2) of colours and of normals counts between two points.
struct PointDifference {
  double color = 0, normal = 0;
};
PointDifference difference(const PoolPoint& a, const PoolPoint& b, double color_sigma, double normal_sigma);

/// Views are added one by one, in an order that gives the cells their numbers; finish() then makes means of sums.
struct SurfacePool {
  SurfacePool() = default;
  SurfacePool(double cell_m, std::size_t views) : cells(cell_m), point_of_pixel(views) {}

  SurfaceCells cells;
  std::vector<PoolPoint> points;  ///< one per cell
  /// Of each view: the point that stands for each pixel of its map, -1 where it sees nothing.
  std::vector<std::vector<std::int32_t>> point_of_pixel;

  /// What segments of views say of two points, the lower number in the upper half of the key: how often neighbouring
  /// pixels of theirs are of one segment, and of two.
  struct SegmentSteps {
    std::int32_t within = 0, across = 0;
  };
  std::unordered_map<std::uint64_t, SegmentSteps> segment_steps;

  double cell_m() const { return cells.edge_m(); }  ///< 0 without cells
  /// `stride`: of the pixels that `seen` has, in `photo`.
  void add(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
    number(view, seen, photo, stride);
    gather(view, seen, photo, stride);
  }
  /// add() in two parts: cells get their numbers, then points what lies in them.
  void number(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride);
  void gather(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride);
  void finish();
  /// Behind number(): what the segments of a view, if there are any, say of its points.
  void count_segments(std::size_t number, const PoolView& view);
};

/// Of some `wanted` points; the cells are sized for that. The same for the same maps.
SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted);

struct SurfaceGraphRules {
  double way = 0.08;            ///< cost of a way of one cell
  double color_sigma = 0.1;     ///< a step of this much colour (0 to 1) costs 1/2, four times as much 8
  double normal_sigma = 0.35;   ///< likewise of the difference of unit normals
  double most = 6;              ///< of each of the two
  double segment_border = 4;    ///< of a step that always leaves a segment
  double within_segment = 0.2;  ///< steps of colour and bends count so much in a segment
};

/// A point that somebody has named.
struct GraphSeed {
  std::int32_t point = -1;
  std::int16_t class_index = 0;
};

/// The cheapest ways from seeds to a point: to the nearest, and to the nearest of another class.
struct Settled {
  float cost[2];  ///< kUnreached: there is none
  std::int16_t class_index[2];
};
inline constexpr float kUnreached = 1e30F;

class SurfaceGraph {
 public:
  SurfaceGraph() = default;
  SurfaceGraph(const SurfacePool& pool, const SurfaceGraphRules& rules);

  /// Of every point; Dijkstra's algorithm with two labels a point [Dijkstra59], as in [Falcao04].
  const std::vector<Settled>& settled() const { return settled_; }
  void settle(std::span<const GraphSeed> seeds);
  /// One more seed, at the cost of what changes.
  void add(const GraphSeed& seed) { spread({&seed, 1}); }

  /// The points that can be reached from `point` for at most `reach`, and at most `most` of them, the cheapest first.
  struct Near {
    std::int32_t point;
    float cost;
  };
  /// Memory of around() for one thread.
  struct Scratch {
    std::vector<float> best;
    std::vector<std::int32_t> touched;
  };
  void around(std::int32_t point, float reach, std::size_t most, Scratch& scratch, std::vector<Near>& out) const;

 private:
  struct Edge {
    std::int32_t to;
    float cost;
  };
  // Ways from all seeds at once, so that a point is visited about as often as it has classes, however many seeds there
  // are.
  void spread(std::span<const GraphSeed> seeds);
  std::vector<std::int32_t> first_;  // [points + 1]
  std::vector<Edge> edges_;
  std::vector<Settled> settled_;
};

// Votes of some nodes of a weighted graph spread over all of it, by one linear system per class.

struct GraphEdge {
  std::int32_t a = 0, b = 0;
  double weight = 0;  ///< above 0
};

struct Diffusion {
  std::vector<float> probability;  ///< [nodes * classes]; a row sums to 1, or is 0 where no vote can be reached
  std::int64_t parts = 0;          ///< connected parts of the graph
  std::int64_t parts_without_vote = 0;
};

/// Solves (L + D) p_c = v_c for every class c, L the graph's Laplacian, v_c the votes for c times `vote_weight` and D
/// the diagonal of all votes times `vote_weight`: the chance that a walker from a node, who takes edges and votes by
/// their weights, ends at a vote for c [Zhu03, with votes on nodes of their own; Grady06, with seeds that hold softly].
/// `votes` [nodes * classes], not negative. Conjugate gradients with an incomplete factor, classes in parallel; the
/// bits do not depend on threads. `done` gets the number of classes solved, from any thread but one at a time; may be
/// null. Throws Error(failure) when the iteration does not converge.
Diffusion diffuse_votes(std::span<const GraphEdge> edges, std::span<const double> votes, int classes,
                        double vote_weight, const std::function<void(int done, int of)>& done);

}  // namespace semfield
