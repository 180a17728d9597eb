// The pool's points as a graph on which clicks spread: a way costs more across steps of colour and bends of the
// surface.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "serve/surface_pool.h"

namespace semfield {

struct SurfaceGraphRules {
  double way = 0.08;           ///< cost of a way of one cell
  double color_sigma = 0.05;   ///< a step of this much colour (0 to 1) costs 1/2, four times as much 8
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

  /// Of every point; Dijkstra's algorithm with two labels a point [Dijkstra59; Falcao04].
  const std::vector<Settled>& settled() const { return settled_; }
  void settle(std::span<const GraphSeed> seeds);
  /// One more seed, at the cost of what changes.
  void add(const GraphSeed& seed);

  /// Cost of the cheapest way from `point` to each point that can be reached for at most `reach`: pairs in the order of
  /// cost.
  struct Near {
    std::int32_t point;
    float cost;
  };
  std::vector<Near> around(std::int32_t point, float reach) const;

 private:
  struct Edge {
    std::int32_t to;
    float cost;
  };
  std::vector<std::int32_t> first_;  // [points + 1]
  std::vector<Edge> edges_;
  std::vector<Settled> settled_;
};

}  // namespace semfield
