#include "serve/surface/surface_graph.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <queue>
#include <tuple>
#include <unordered_map>

#include "compute/parallel.h"

namespace semfield {

namespace {

float step_cost(const PoolPoint& a, const PoolPoint& b, double cell, const SurfaceGraphRules& rules) {
  double color = 0;
  for (int c = 0; c < 3; ++c) {
    const double d = static_cast<double>(a.color[c]) - static_cast<double>(b.color[c]);
    color += d * d;
  }
  const Vec3d bend = a.normal - b.normal;
  return static_cast<float>(rules.way * length(a.position - b.position) / cell +
                            std::min(rules.most, color / (2 * rules.color_sigma * rules.color_sigma)) +
                            std::min(rules.most, dot(bend, bend) / (2 * rules.normal_sigma * rules.normal_sigma)));
}

}  // namespace

SurfaceGraph::SurfaceGraph(const SurfacePool& pool, const SurfaceGraphRules& rules) : cell_m_(pool.cell_m) {
  const auto count = static_cast<std::int64_t>(pool.points.size());
  std::unordered_map<std::uint64_t, std::int32_t>& at = point_of_cell_;
  at.reserve(static_cast<std::size_t>(2 * count));
  for (std::int64_t i = 0; i < count; ++i)
    at.emplace(surface_cell_key(pool.points[static_cast<std::size_t>(i)].cell), static_cast<std::int32_t>(i));
  std::vector<std::vector<Edge>> of(pool.points.size());
  parallel_for((count + 511) / 512, [&](std::int64_t block) {
    for (std::int64_t i = block * 512; i < std::min(count, (block + 1) * 512); ++i) {
      const PoolPoint& own = pool.points[static_cast<std::size_t>(i)];
      for (std::int32_t k = 0; k < 27; ++k) {
        const SurfaceCell other{own.cell[0] + k % 3 - 1, own.cell[1] + k / 3 % 3 - 1, own.cell[2] + k / 9 - 1};
        const auto found = at.find(surface_cell_key(other));
        if (found == at.end() || found->second == i) continue;
        const PoolPoint& point = pool.points[static_cast<std::size_t>(found->second)];
        of[static_cast<std::size_t>(i)].push_back({found->second, step_cost(own, point, pool.cell_m, rules)});
      }
    }
  });
  first_.assign(1, 0);
  for (const std::vector<Edge>& edges : of) {
    edges_.insert(edges_.end(), edges.begin(), edges.end());
    first_.push_back(static_cast<std::int32_t>(edges_.size()));
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

std::int32_t SurfaceGraph::point_at(Vec3d place) const {
  if (point_of_cell_.empty()) return -1;
  const SurfaceCell own = surface_cell(place, cell_m_);
  if (const auto found = point_of_cell_.find(surface_cell_key(own)); found != point_of_cell_.end())
    return found->second;
  std::int32_t nearest = -1;
  double least = INFINITY;
  for (std::int32_t k = 0; k < 27; ++k) {
    const SurfaceCell other{own[0] + k % 3 - 1, own[1] + k / 3 % 3 - 1, own[2] + k / 9 - 1};
    const auto found = point_of_cell_.find(surface_cell_key(other));
    if (found == point_of_cell_.end()) continue;
    const Vec3d center{(other[0] + 0.5) * cell_m_, (other[1] + 0.5) * cell_m_, (other[2] + 0.5) * cell_m_};
    const double distance = length(center - place);
    if (distance >= least) continue;
    least = distance;
    nearest = found->second;
  }
  return nearest;
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
