#include "surface/mesh/shape/close_holes.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <unordered_map>
#include <unordered_set>
#include <vector>

namespace semfield {

namespace {

using Loop = std::vector<std::uint32_t>;

std::uint64_t directed(std::uint32_t from, std::uint32_t to) { return std::uint64_t{from} << 32 | to; }

// Sides of triangles, with their direction.
std::unordered_set<std::uint64_t> sides_of(const Surface& surface) {
  std::unordered_set<std::uint64_t> sides;
  sides.reserve(3 * surface.triangles.size());
  for (const Triangle& t : surface.triangles)
    for (std::size_t k = 0; k < 3; ++k) sides.insert(directed(t[k], t[(k + 1) % 3]));
  return sides;
}

// Cycles of the sides that are missing, each in the direction that a triangle in the hole would have. A walk that comes
// to a vertex of its own has closed a cycle, which is taken off.
std::vector<Loop> loops_of(const Surface& surface, const std::unordered_set<std::uint64_t>& sides) {
  std::unordered_map<std::uint32_t, std::vector<std::uint32_t>> missing;
  Loop starts;
  for (const Triangle& t : surface.triangles) {
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint32_t from = t[(k + 1) % 3], to = t[k];
      if (sides.contains(directed(from, to))) continue;
      missing[from].push_back(to);
      starts.push_back(from);
    }
  }
  std::vector<Loop> loops;
  std::unordered_map<std::uint32_t, std::size_t> place;  // on the way
  for (const std::uint32_t start : starts) {
    Loop way{start};
    place = {{start, 0}};
    while (!way.empty()) {
      std::vector<std::uint32_t>& next = missing[way.back()];
      if (next.empty()) break;
      const std::uint32_t to = next.back();
      next.pop_back();
      const auto met = place.find(to);
      if (met == place.end()) {
        place[to] = way.size();
        way.push_back(to);
        continue;
      }
      loops.emplace_back(way.begin() + static_cast<std::ptrdiff_t>(met->second), way.end());
      for (std::size_t i = met->second + 1; i < way.size(); ++i) place.erase(way[i]);
      way.resize(met->second + 1);
    }
  }
  return loops;
}

// Triangles of least area that fill a loop: best[i][j] is that of the part between corner i and corner j.
class Filling {
 public:
  Filling(const Surface& surface, std::span<const std::uint32_t> loop, const std::unordered_set<std::uint64_t>& sides)
      : surface_(surface), loop_(loop), sides_(sides), best_(loop.size() * loop.size(), 0), middle_(best_.size(), 0) {
    const std::size_t n = loop.size();
    for (std::size_t wide = 2; wide < n; ++wide)
      for (std::size_t i = 0; i + wide < n; ++i) choose(i, i + wide);
  }
  bool exists() const { return std::isfinite(best_[loop_.size() - 1]); }
  void add_to(std::vector<Triangle>& triangles) const { add(0, loop_.size() - 1, triangles); }

 private:
  void choose(std::size_t i, std::size_t j) {
    const std::size_t n = loop_.size(), at = i * n + j;
    best_[at] = std::numeric_limits<double>::infinity();
    // A side that the surface has already would get a third triangle.
    const bool inner = !(i == 0 && j == n - 1);
    if (inner && (sides_.contains(directed(loop_[i], loop_[j])) || sides_.contains(directed(loop_[j], loop_[i]))))
      return;
    for (std::size_t k = i + 1; k < j; ++k) {
      const double area = best_[i * n + k] + best_[k * n + j] + area_of(surface_, {loop_[i], loop_[k], loop_[j]});
      if (!(area < best_[at])) continue;
      best_[at] = area;
      middle_[at] = k;
    }
  }
  void add(std::size_t i, std::size_t j, std::vector<Triangle>& triangles) const {
    if (j - i < 2) return;
    const std::size_t k = middle_[i * loop_.size() + j];
    add(i, k, triangles);
    add(k, j, triangles);
    triangles.push_back({loop_[i], loop_[k], loop_[j]});
  }

  const Surface& surface_;
  std::span<const std::uint32_t> loop_;
  const std::unordered_set<std::uint64_t>& sides_;
  std::vector<double> best_;
  std::vector<std::size_t> middle_;
};

double length_of(const Surface& surface, const Loop& loop) {
  double sum = 0;
  for (std::size_t i = 0; i < loop.size(); ++i)
    sum += length(surface.positions[loop[(i + 1) % loop.size()]] - surface.positions[loop[i]]);
  return sum;
}

}  // namespace

std::size_t close_holes(Surface& surface, double longest) {
  std::unordered_set<std::uint64_t> sides = sides_of(surface);
  std::size_t closed = 0;
  for (const Loop& loop : loops_of(surface, sides)) {
    if (loop.size() < 3 || loop.size() > kMostHoleEdges || length_of(surface, loop) > longest) continue;
    const Filling filling(surface, loop, sides);
    if (!filling.exists()) continue;
    const std::size_t before = surface.triangles.size();
    filling.add_to(surface.triangles);
    for (std::size_t i = before; i < surface.triangles.size(); ++i) {
      const Triangle& t = surface.triangles[i];
      for (std::size_t k = 0; k < 3; ++k) sides.insert(directed(t[k], t[(k + 1) % 3]));
    }
    ++closed;
  }
  if (closed > 0) set_vertex_normals(surface);
  return closed;
}

}  // namespace semfield
