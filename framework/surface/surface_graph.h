// Find the cheapest ways over the points of a surface from those that somebody has named: steps of colour and bends
// cost more.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "surface/surface_pool.h"

namespace semfield {

struct SurfaceGraphRules {
  double way = 0.08;           ///< cost of a way of one cell
  double color_sigma = 0.1;    ///< a step of this much colour (0 to 1) costs 1/2, four times as much 8
  double normal_sigma = 0.35;  ///< likewise of the difference of unit normals
  double most = 6;             ///< of each of the two
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
  void add(const GraphSeed& seed);

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

}  // namespace semfield
