#include "surface/mesh/shape/simplify.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <queue>
#include <span>
#include <tuple>
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

namespace {

constexpr double kBorder = 100;        // a border's planes, in areas of its triangles
constexpr double kLeastTurn = 0.2;     // cosine between a triangle's normals before and after
constexpr double kLeastVolume = 1e-9;  // of a quadric's matrix, relative to its size: below it there is no one place

// Sum of weighted squared distances to planes: p A p + 2 b p + c.
struct Quadric {
  double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0, c = 0;
  Vec3d b;

  void add_plane(Vec3d unit_normal, Vec3d on_it, double weight) {
    const Vec3d& n = unit_normal;
    const double d = -dot(n, on_it);
    xx += weight * n.x * n.x, xy += weight * n.x * n.y, xz += weight * n.x * n.z;
    yy += weight * n.y * n.y, yz += weight * n.y * n.z, zz += weight * n.z * n.z;
    b = b + n * (weight * d);
    c += weight * d * d;
  }
  friend Quadric operator+(Quadric p, const Quadric& q) {
    p.xx += q.xx, p.xy += q.xy, p.xz += q.xz, p.yy += q.yy, p.yz += q.yz, p.zz += q.zz, p.c += q.c;
    p.b = p.b + q.b;
    return p;
  }
  double at(Vec3d p) const {
    const Vec3d a{xx * p.x + xy * p.y + xz * p.z, xy * p.x + yy * p.y + yz * p.z, xz * p.x + yz * p.y + zz * p.z};
    return std::max(0.0, dot(p, a) + 2 * dot(b, p) + c);
  }
  // Where the gradient is 0, by Cramer's rule; none on a plane or along a crease.
  std::optional<Vec3d> least() const {
    const Vec3d r0{xx, xy, xz}, r1{xy, yy, yz}, r2{xz, yz, zz};
    const double volume = dot(r0, cross(r1, r2)), size = xx + yy + zz;
    if (!(std::abs(volume) > kLeastVolume * size * size * size)) return std::nullopt;
    return (cross(r1, r2) * b.x + cross(r2, r0) * b.y + cross(r0, r1) * b.z) * (-1 / volume);
  }
};

struct Collapse {
  double cost = 0;
  std::uint32_t keep = 0, drop = 0;          // ends; keep < drop
  std::uint32_t keep_age = 0, drop_age = 0;  // a collapse at an end makes the others there stale
  Vec3d place;
  bool operator<(const Collapse& other) const {  // the least is on top of the queue
    return std::tie(cost, keep, drop) > std::tie(other.cost, other.keep, other.drop);
  }
};

class Simplifier {
 public:
  explicit Simplifier(Surface& surface)
      : surface_(surface),
        quadric_(surface.positions.size()),
        around_(surface.positions.size()),
        age_(surface.positions.size()),
        alive_(surface.triangles.size(), 1),
        left_(surface.triangles.size()) {
    for (std::uint32_t i = 0; i < surface.triangles.size(); ++i)
      for (const std::uint32_t v : surface.triangles[i]) around_[v].push_back(i);
    for (const Triangle& t : surface.triangles) add_planes(t);
    for (std::uint32_t v = 0; v < around_.size(); ++v)
      for (const std::uint32_t w : neighbours(v))
        if (v < w) offer(v, w);
  }

  std::vector<char> run(std::size_t faces) {
    while (left_ > faces && !queue_.empty()) {
      const Collapse next = queue_.top();
      queue_.pop();
      if (age_[next.keep] != next.keep_age || age_[next.drop] != next.drop_age || !is_allowed(next)) continue;
      collapse(next);
    }
    return std::move(alive_);
  }

 private:
  const Vec3d& at(std::uint32_t v) const { return surface_.positions[v]; }
  static bool has(const Triangle& t, std::uint32_t v) { return t[0] == v || t[1] == v || t[2] == v; }

  std::vector<std::uint32_t> neighbours(std::uint32_t v) const {
    std::vector<std::uint32_t> out;
    for (const std::uint32_t i : around_[v])
      for (const std::uint32_t w : surface_.triangles[i])
        if (w != v) out.push_back(w);
    std::sort(out.begin(), out.end());
    out.erase(std::unique(out.begin(), out.end()), out.end());
    return out;
  }
  int triangles_at(std::uint32_t v, std::uint32_t w) const {
    return static_cast<int>(std::count_if(around_[v].begin(), around_[v].end(),
                                          [&](std::uint32_t i) { return has(surface_.triangles[i], w); }));
  }
  bool is_on_border(std::uint32_t v) const {
    const std::vector<std::uint32_t> others = neighbours(v);
    return std::any_of(others.begin(), others.end(), [&](std::uint32_t w) { return triangles_at(v, w) != 2; });
  }

  bool differ(std::uint32_t v, std::uint32_t w) const {
    const PointAttributes& known = surface_.attributes;
    return known.has_labels() && known.label[v] != known.label[w];
  }

  // Of a triangle, its own plane, and one across it through each side that a border runs along: that of the surface, or
  // of two classes, which runs beside the two corners of one class.
  void add_planes(const Triangle& t) {
    const Vec3d area = cross(at(t[1]) - at(t[0]), at(t[2]) - at(t[0]));
    const double size = length(area);
    if (!(size > 0)) return;
    const Vec3d normal = area * (1 / size);
    for (const std::uint32_t v : t) quadric_[v].add_plane(normal, at(v), size / 2);
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint32_t v = t[k], w = t[(k + 1) % 3], third = t[(k + 2) % 3];
      const bool between_classes = !differ(v, w) && differ(v, third), ends = triangles_at(v, w) == 1;
      if (!between_classes && !ends) continue;
      const Vec3d aside = normalized(cross(at(w) - at(v), normal));
      for (const std::uint32_t corner : {v, w})
        quadric_[corner].add_plane(aside, at(v), (ends ? kBorder : 1) * size / 2);
      if (between_classes) quadric_[third].add_plane(aside, at(third), size / 2);
    }
  }

  void offer(std::uint32_t v, std::uint32_t w) {
    Collapse way{0, std::min(v, w), std::max(v, w), 0, 0, {}};
    way.keep_age = age_[way.keep];
    way.drop_age = age_[way.drop];
    const Quadric both = quadric_[v] + quadric_[w];
    const Vec3d a = at(way.keep), b = at(way.drop), middle = (a + b) * 0.5;
    const double edge = length(b - a);
    way.place = middle;
    for (const Vec3d& other : {a, b})
      if (both.at(other) < both.at(way.place)) way.place = other;
    const std::optional<Vec3d> least = both.least();
    if (least && length(*least - middle) <= edge && both.at(*least) < both.at(way.place)) way.place = *least;
    way.cost = both.at(way.place);
    queue_.push(way);
  }

  // Of the triangles around `v` that stay: none turns over, or shrinks to a line, when v moves.
  bool keeps_facing(std::uint32_t v, std::uint32_t other, Vec3d place) const {
    for (const std::uint32_t i : around_[v]) {
      const Triangle& t = surface_.triangles[i];
      if (has(t, other)) continue;
      std::array<Vec3d, 3> now{at(t[0]), at(t[1]), at(t[2])};
      const Vec3d before = cross(now[1] - now[0], now[2] - now[0]);
      for (std::size_t k = 0; k < 3; ++k)
        if (t[k] == v) now[k] = place;
      const Vec3d after = cross(now[1] - now[0], now[2] - now[0]);
      if (!(dot(before, after) > kLeastTurn * length(before) * length(after))) return false;
    }
    return true;
  }

  // The ends have no neighbours in common but the third corners of their triangles, and an edge between two borders is
  // a border: else sheets would touch, or a hole close.
  bool is_allowed(const Collapse& way) const {
    const std::vector<std::uint32_t> a = neighbours(way.keep), b = neighbours(way.drop);
    std::vector<std::uint32_t> common;
    std::set_intersection(a.begin(), a.end(), b.begin(), b.end(), std::back_inserter(common));
    const int triangles = triangles_at(way.keep, way.drop);
    if (triangles < 1 || triangles > 2 || std::ssize(common) != triangles) return false;
    if (a.size() + b.size() - 2 - common.size() < 3) return false;  // of a tetrahedron nothing would be left
    if (triangles == 2 && is_on_border(way.keep) && is_on_border(way.drop)) return false;
    return keeps_facing(way.keep, way.drop, way.place) && keeps_facing(way.drop, way.keep, way.place);
  }

  void collapse(const Collapse& way) {
    if (length(way.place - at(way.drop)) < length(way.place - at(way.keep))) take_attributes(way.keep, way.drop);
    surface_.positions[way.keep] = way.place;
    quadric_[way.keep] = quadric_[way.keep] + quadric_[way.drop];
    for (const std::uint32_t i : around_[way.drop]) {
      Triangle& t = surface_.triangles[i];
      if (has(t, way.keep)) {
        alive_[i] = 0;
        --left_;
        for (const std::uint32_t v : t)
          if (v != way.drop) std::erase(around_[v], i);
        continue;
      }
      std::replace(t.begin(), t.end(), way.drop, way.keep);
      around_[way.keep].push_back(i);
    }
    around_[way.drop].clear();
    ++age_[way.drop];
    ++age_[way.keep];
    for (const std::uint32_t v : neighbours(way.keep)) offer(way.keep, v);
  }

  void take_attributes(std::uint32_t to, std::uint32_t from) {
    PointAttributes& known = surface_.attributes;
    if (!known.color.empty()) known.color[to] = known.color[from];
    if (!known.has_labels()) return;
    known.label[to] = known.label[from];
    known.entropy[to] = known.entropy[from];
  }

  Surface& surface_;
  std::vector<Quadric> quadric_;
  std::vector<std::vector<std::uint32_t>> around_;  // triangles of each vertex
  std::vector<std::uint32_t> age_;
  std::vector<char> alive_;
  std::size_t left_;
  std::priority_queue<Collapse> queue_;
};

}  // namespace

void simplify(Surface& surface, std::size_t faces) {
  if (surface.triangles.size() <= faces) return;
  keep_triangles(surface, Simplifier(surface).run(faces));
  set_vertex_normals(surface);
}

}  // namespace semfield
