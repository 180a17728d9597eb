#include "surface/surface_graph.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <queue>
#include <tuple>

namespace semfield {

namespace {

float step_cost(const PoolPoint& a, const PoolPoint& b, double cell_m, const SurfaceGraphRules& rules) {
  const PointDifference apart = difference(a, b, rules.color_sigma, rules.normal_sigma);
  return static_cast<float>(rules.way * length(a.position - b.position) / cell_m + std::min(rules.most, apart.color) +
                            std::min(rules.most, apart.normal));
}

}  // namespace

SurfaceGraph::SurfaceGraph(const SurfacePool& pool, const SurfaceGraphRules& rules) {
  const std::vector<CellPair> pairs = pool.cells.neighbours();
  first_.assign(pool.points.size() + 1, 0);
  for (const CellPair& pair : pairs)
    for (const std::int32_t point : {pair.a, pair.b}) ++first_[static_cast<std::size_t>(point) + 1];
  for (std::size_t i = 1; i < first_.size(); ++i) first_[i] += first_[i - 1];
  std::vector<std::int32_t> next = first_;
  edges_.resize(2 * pairs.size());
  for (const CellPair& pair : pairs) {
    const auto a = static_cast<std::size_t>(pair.a), b = static_cast<std::size_t>(pair.b);
    const float cost = step_cost(pool.points[a], pool.points[b], pool.cell_m(), rules);
    edges_[static_cast<std::size_t>(next[a]++)] = {pair.b, cost};
    edges_[static_cast<std::size_t>(next[b]++)] = {pair.a, cost};
  }
  settle({});
}

void SurfaceGraph::settle(std::span<const GraphSeed> seeds) {
  settled_.assign(first_.empty() ? 0 : first_.size() - 1, {{kUnreached, kUnreached}, {kVoid, kVoid}});
  spread(seeds);
}

void SurfaceGraph::add(const GraphSeed& seed) { spread({&seed, 1}); }

void SurfaceGraph::spread(std::span<const GraphSeed> seeds) {
  // An entry that is dearer than what the point has is passed over.
  struct Entry {
    float cost;
    std::int32_t point;
    std::int16_t class_index;
    bool operator>(const Entry& other) const {
      return std::tie(cost, point, class_index) > std::tie(other.cost, other.point, other.class_index);
    }
  };
  std::priority_queue<Entry, std::vector<Entry>, std::greater<>> queue;
  // True when a way to the point is the cheapest of its class and among the two cheapest classes.
  const auto take = [&](std::int32_t point, std::int16_t cls, float cost) {
    Settled& s = settled_[static_cast<std::size_t>(point)];
    if (s.class_index[0] == cls) {
      if (cost >= s.cost[0]) return false;
      s.cost[0] = cost;
      return true;
    }
    if (s.class_index[1] == cls) {
      if (cost >= s.cost[1]) return false;
      s.cost[1] = cost;
    } else {
      if (cost >= s.cost[1]) return false;
      s.cost[1] = cost;
      s.class_index[1] = cls;
    }
    if (s.cost[1] < s.cost[0]) {
      std::swap(s.cost[0], s.cost[1]);
      std::swap(s.class_index[0], s.class_index[1]);
    }
    return true;
  };
  for (const GraphSeed& seed : seeds)
    if (seed.point >= 0 && take(seed.point, seed.class_index, 0)) queue.push({0, seed.point, seed.class_index});
  while (!queue.empty()) {
    const auto [cost, point, cls] = queue.top();
    queue.pop();
    const Settled& s = settled_[static_cast<std::size_t>(point)];
    const int slot = s.class_index[0] == cls ? 0 : 1;
    if (s.class_index[slot] != cls || cost > s.cost[slot]) continue;
    for (auto e = static_cast<std::size_t>(first_[static_cast<std::size_t>(point)]);
         e < static_cast<std::size_t>(first_[static_cast<std::size_t>(point) + 1]); ++e) {
      const float next = cost + edges_[e].cost;
      if (take(edges_[e].to, cls, next)) queue.push({next, edges_[e].to, cls});
    }
  }
}

void SurfaceGraph::around(std::int32_t point, float reach, std::size_t most, Scratch& scratch,
                          std::vector<Near>& out) const {
  using Entry = std::pair<float, std::int32_t>;
  scratch.best.resize(settled_.size(), kUnreached);
  std::priority_queue<Entry, std::vector<Entry>, std::greater<>> queue;
  const auto take = [&](std::int32_t at, float cost) {
    float& best = scratch.best[static_cast<std::size_t>(at)];
    if (cost >= best) return;
    if (best == kUnreached) scratch.touched.push_back(at);
    best = cost;
    queue.emplace(cost, at);
  };
  out.clear();
  take(point, 0);
  while (!queue.empty() && out.size() < most) {
    const auto [cost, at] = queue.top();
    queue.pop();
    if (cost > scratch.best[static_cast<std::size_t>(at)]) continue;
    out.push_back({at, cost});
    for (auto e = static_cast<std::size_t>(first_[static_cast<std::size_t>(at)]);
         e < static_cast<std::size_t>(first_[static_cast<std::size_t>(at) + 1]); ++e)
      if (const float next = cost + edges_[e].cost; next <= reach) take(edges_[e].to, next);
  }
  for (const std::int32_t at : scratch.touched) scratch.best[static_cast<std::size_t>(at)] = kUnreached;
  scratch.touched.clear();
}

}  // namespace semfield
