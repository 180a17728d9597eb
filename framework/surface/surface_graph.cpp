#include "surface/surface_graph.h"

#define EIGEN_DONT_PARALLELIZE

#include <Eigen/IterativeLinearSolvers>
#include <Eigen/SparseCore>
#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <mutex>
#include <queue>
#include <tuple>
#include <utility>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "core/joined_sets.h"
#include "labels/segments.h"

namespace semfield {

namespace {

constexpr std::int32_t kFarthest = 1 << 20;     // cells from the first along an axis; 21 bits of a key
constexpr std::int32_t kFarthestOf0 = 1 << 30;  // cells from 0
constexpr std::size_t kFirstEntries = 1024;
constexpr std::int64_t kBlock = 4096;  // cells of a unit of work

constexpr double kDepthStep = 0.05;  // of the distance: neighbours that differ more lie on two surfaces
// Cosine between the ray through an image point and the one that should fall there: equal but for rounding.
constexpr double kSameRay = 1 - 1e-9;

// The neighbour at `index` +- `step` that is a place and nearer to the one at `index`; the way to it, towards growing
// indices. Zero without such a neighbour.
Vec3d way_along(std::span<const Vec3d> places, std::size_t index, std::size_t step, bool has_before, bool has_after) {
  Vec3d best;
  double least = std::numeric_limits<double>::infinity();
  const auto consider = [&](std::size_t other, double sign) {
    const Vec3d way = (places[other] - places[index]) * sign;
    if (!is_place(places[other]) || !(length(way) < least)) return;
    least = length(way);
    best = way;
  };
  if (has_before) consider(index - step, -1);
  if (has_after) consider(index + step, 1);
  return best;
}

}  // namespace

std::optional<Vec3d> surface_point(const PosedDepth& view, std::int32_t column, std::int32_t row) {
  const float z = view.depth_m[view.pixel(column, row)];
  if (!(z > 0 && std::isfinite(z))) return std::nullopt;
  const Vec3d direction = view.camera.direction(column + 0.5, row + 0.5);
  const double share = view.camera.depth_of(direction);
  if (!(share > 0)) return std::nullopt;
  return view.world_from_camera.apply(direction * (static_cast<double>(z) / share));
}

std::optional<PixelHit> project_point(const Camera& camera, const Pose& world_from_camera, Vec3d point) {
  const Vec3d local = world_from_camera.apply_inverse(point);
  if (!camera.sees(local)) return std::nullopt;
  double u = 0, v = 0;
  camera.project(local, u, v);
  // Written so that NaN is outside; whole numbers are taken only of what fits.
  if (!(u >= 0 && u < camera.width_px && v >= 0 && v < camera.height_px)) return std::nullopt;
  if (camera.has_distortion() && !(dot(camera.direction(u, v), normalized(local)) > kSameRay)) return std::nullopt;
  return PixelHit{static_cast<std::int32_t>(u), static_cast<std::int32_t>(v), camera.depth_of(local), u, v};
}

bool is_place(Vec3d point) { return std::isfinite(point.x) && std::isfinite(point.y) && std::isfinite(point.z); }

std::vector<Vec3d> surface_points(const PosedDepth& view) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  std::vector<Vec3d> points(view.depth_m.size(), Vec3d{kNone, kNone, kNone});
  parallel_for(view.camera.height_px, [&](std::int64_t row) {
    for (std::int32_t column = 0; column < view.camera.width_px; ++column) {
      const auto point = surface_point(view, column, static_cast<std::int32_t>(row));
      if (point) points[view.pixel(column, static_cast<std::int32_t>(row))] = *point;
    }
  });
  return points;
}

bool SeenSurface::is_interior(std::int64_t pixel) const {
  const std::int64_t x = pixel % width_px, y = pixel / width_px;
  if (x == 0 || y == 0 || x + 1 == width_px || y + 1 == height_px) return false;
  const auto at = [&](std::int64_t p) { return distance_m[static_cast<std::size_t>(p)]; };
  const double here = at(pixel), left = at(pixel - 1), right = at(pixel + 1), above = at(pixel - width_px),
               below = at(pixel + width_px);
  if (!(here > 0 && left > 0 && right > 0 && above > 0 && below > 0)) return false;
  // A plane seen at a slant has steps that are alike on both sides; a border has one on one side.
  return std::max(std::abs(left + right - 2 * here), std::abs(above + below - 2 * here)) < kDepthStep * here;
}

SeenSurface seen_surface(std::vector<Vec3d> place, std::int32_t width_px, Vec3d eye) {
  SeenSurface seen;
  seen.width_px = width_px;
  seen.height_px = static_cast<std::int32_t>(std::ssize(place) / width_px);
  seen.place = std::move(place);
  seen.normal.resize(seen.place.size());
  seen.distance_m.resize(seen.place.size());
  const auto width = static_cast<std::size_t>(width_px), height = static_cast<std::size_t>(seen.height_px);
  parallel_for(seen.height_px, [&](std::int64_t y) {
    const auto row = static_cast<std::size_t>(y);
    for (std::size_t column = 0; column < width; ++column) {
      const std::size_t pixel = row * width + column;
      const Vec3d own = seen.place[pixel];
      if (!is_place(own)) continue;
      seen.distance_m[pixel] = length(own - eye);
      const Vec3d along = way_along(seen.place, pixel, 1, column > 0, column + 1 < width);
      const Vec3d down = way_along(seen.place, pixel, width, row > 0, row + 1 < height);
      const Vec3d normal = cross(along, down);
      const double size = length(normal);
      if (!(size > 0)) continue;
      seen.normal[pixel] = normal * (1 / size);
      if (dot(seen.normal[pixel], eye - own) < 0) seen.normal[pixel] = seen.normal[pixel] * -1.0;
    }
  });
  return seen;
}

// Its entry, or the free one where it belongs. The upper bits of a product with an odd number depend on all bits of the
// key.
std::size_t CellIndex::place_of(std::uint64_t key) const {
  const int bits = std::countr_zero(entries_.size());
  std::size_t place = (key * 0x9E3779B97F4A7C15U) >> (64 - bits);
  while (entries_[place].number >= 0 && entries_[place].key != key) place = (place + 1) & (entries_.size() - 1);
  return place;
}

std::int32_t CellIndex::add(std::uint64_t key, std::int32_t fresh) {
  if (2 * used_ >= entries_.size()) grow();
  Entry& entry = entries_[place_of(key)];
  if (entry.number < 0) {
    entry = {key, fresh};
    ++used_;
  }
  return entry.number;
}

void CellIndex::grow() {
  const std::vector<Entry> before = std::exchange(entries_, {});
  entries_.resize(std::max(kFirstEntries, 4 * before.size()));
  for (const Entry& entry : before)
    if (entry.number >= 0) entries_[place_of(entry.key)] = entry;
}

SurfaceCells::SurfaceCells(double edge_m) : edge_m_(edge_m) {
  SEMFIELD_CHECK(edge_m > 0 && std::isfinite(edge_m), "a cell's edge is a positive length");
}

// Counted from the first cell: scenes may lie far from 0.
std::uint64_t SurfaceCells::key_of(const SurfaceCell& place) const {
  std::uint64_t key = 0;
  for (std::size_t k = 0; k < 3; ++k)
    key = key << 21 | static_cast<std::uint64_t>(place[k] - (places_.empty() ? place[k] : places_[0][k]) + kFarthest);
  return key;
}

bool SurfaceCells::fits(const SurfaceCell& place) const {
  for (std::size_t k = 0; k < 3; ++k) {
    if (std::abs(std::int64_t{place[k]}) >= kFarthestOf0) return false;
    if (!places_.empty() && std::abs(place[k] - places_[0][k]) >= kFarthest - 1) return false;
  }
  return true;
}

bool SurfaceCells::find_place(Vec3d point, SurfaceCell& place) const {
  for (int axis = 0; axis < 3; ++axis) {
    const double at = std::floor(point[axis] / edge_m_);
    if (!(std::abs(at) < kFarthestOf0)) return false;  // NaN too
    place[static_cast<std::size_t>(axis)] = static_cast<std::int32_t>(at);
  }
  return fits(place);
}

std::int32_t SurfaceCells::add(Vec3d point) {
  SurfaceCell place{};
  return find_place(point, place) ? add(place) : -1;
}

std::int32_t SurfaceCells::add(const SurfaceCell& place) {
  if (!fits(place)) return -1;
  const std::int32_t number = index_.add(key_of(place), count());
  if (number == count()) places_.push_back(place);
  return number;
}

std::int32_t SurfaceCells::near(Vec3d point) const {
  SurfaceCell own{};
  if (places_.empty() || !find_place(point, own)) return -1;
  if (const std::int32_t found = index_.find(key_of(own)); found >= 0) return found;
  std::int32_t nearest = -1;
  double least = INFINITY;
  for (std::int32_t k = 0; k < 27; ++k) {
    const SurfaceCell other{own[0] + k % 3 - 1, own[1] + k / 3 % 3 - 1, own[2] + k / 9 - 1};
    const std::int32_t found = index_.find(key_of(other));
    if (found < 0) continue;
    const Vec3d center{(other[0] + 0.5) * edge_m_, (other[1] + 0.5) * edge_m_, (other[2] + 0.5) * edge_m_};
    const double distance = length(center - point);
    if (distance >= least) continue;
    least = distance;
    nearest = found;
  }
  return nearest;
}

std::vector<CellPair> SurfaceCells::neighbours() const {
  std::vector<std::vector<CellPair>> of_block(static_cast<std::size_t>((count() + kBlock - 1) / kBlock));
  parallel_for(std::ssize(of_block), [&](std::int64_t block) {
    for (std::int64_t cell = block * kBlock; cell < std::min<std::int64_t>(count(), (block + 1) * kBlock); ++cell) {
      const SurfaceCell& own = place(static_cast<std::int32_t>(cell));
      for (int offset = 14; offset < 27; ++offset) {  // the half of the 27 behind the cell itself
        const SurfaceCell other{own[0] + offset / 9 - 1, own[1] + offset / 3 % 3 - 1, own[2] + offset % 3 - 1};
        if (const std::int32_t found = index_.find(key_of(other)); found >= 0)
          of_block[static_cast<std::size_t>(block)].push_back({static_cast<std::int32_t>(cell), found});
      }
    }
  });
  std::vector<CellPair> pairs;
  for (const std::vector<CellPair>& some : of_block) pairs.insert(pairs.end(), some.begin(), some.end());
  return pairs;
}

namespace {

std::uint64_t key_of_points(std::int32_t a, std::int32_t b) {
  return static_cast<std::uint64_t>(std::min(a, b)) << 32 | static_cast<std::uint32_t>(std::max(a, b));
}

float step_cost(const SurfacePool& pool, const CellPair& pair, const SurfaceGraphRules& rules) {
  const PoolPoint& a = pool.points[static_cast<std::size_t>(pair.a)];
  const PoolPoint& b = pool.points[static_cast<std::size_t>(pair.b)];
  const PointDifference apart = difference(a, b, rules.color_sigma, rules.normal_sigma);
  double seen = std::min(rules.most, apart.color) + std::min(rules.most, apart.normal);
  if (const auto said = pool.segment_steps.find(key_of_points(pair.a, pair.b)); said != pool.segment_steps.end()) {
    const auto [within, across] = said->second;
    const double share = static_cast<double>(across) / (within + across);
    seen = seen * (share + (1 - share) * rules.within_segment) + share * rules.segment_border;
  }
  return static_cast<float>(rules.way * length(a.position - b.position) / pool.cell_m() + seen);
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
    const float cost = step_cost(pool, pair, rules);
    edges_[static_cast<std::size_t>(next[a]++)] = {pair.b, cost};
    edges_[static_cast<std::size_t>(next[b]++)] = {pair.a, cost};
  }
  settle({});
}

void SurfaceGraph::settle(std::span<const GraphSeed> seeds) {
  settled_.assign(first_.empty() ? 0 : first_.size() - 1, {{kUnreached, kUnreached}, {kVoid, kVoid}});
  spread(seeds);
}

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

namespace {
constexpr std::int64_t kChunkRays = std::int64_t{1} << 16;
}

float SurfaceMap::at(std::int32_t column, std::int32_t row) const {
  const std::int32_t x = std::clamp(column / stride, 0, width_px - 1), y = std::clamp(row / stride, 0, height_px - 1);
  return distance_m[static_cast<std::size_t>(std::int64_t{y} * width_px + x)];
}

std::vector<float> surface_distances(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                                     std::span<const PixelPlace> pixels) {
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  const auto total = static_cast<std::int64_t>(pixels.size());
  const std::int64_t most = std::min(total, kChunkRays);
  std::vector<double> origin(3 * static_cast<std::size_t>(most)), direction(origin.size()),
      near_far(2 * static_cast<std::size_t>(most));
  std::vector<float> opacity(static_cast<std::size_t>(most)), distance(pixels.size());
  for (std::int64_t begin = 0; begin < total; begin += most) {
    const std::int64_t count = std::min(most, total - begin);
    parallel_for((count + 255) / 256, [&](std::int64_t block) {
      for (std::int64_t i = block * 256; i < std::min(count, (block + 1) * 256); ++i) {
        const auto k = static_cast<std::size_t>(i);
        const PixelPlace& pixel = pixels[static_cast<std::size_t>(begin) + k];
        cast_ray(camera, limits, pixel.column, pixel.row, &origin[3 * k], &direction[3 * k], &near_far[2 * k]);
      }
    });
    RenderJob<float> job;
    job.origin = {origin.data(), count, 3};
    job.direction = {direction.data(), count, 3};
    job.near_far = {near_far.data(), count, 2};
    job.depth = {distance.data() + begin, count, 1};
    job.opacity = {opacity.data(), count, 1};
    pipeline.executor().render(job);
    for (std::int64_t i = 0; i < count; ++i) {
      const float met = opacity[static_cast<std::size_t>(i)];
      float& value = distance[static_cast<std::size_t>(begin + i)];
      value = met < kSurfaceOpacity ? 0.0F : value / met;
    }
  }
  return distance;
}

SurfaceMap make_surface_map(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                            std::int32_t stride, std::int64_t step) {
  SurfaceMap map;
  map.stride = std::clamp(stride, 1, std::min(camera.camera.width_px, camera.camera.height_px));
  map.width_px = strided_px(camera.camera.width_px, map.stride);
  map.height_px = strided_px(camera.camera.height_px, map.stride);
  map.step = step;
  std::vector<PixelPlace> pixels(static_cast<std::size_t>(std::int64_t{map.width_px} * map.height_px));
  for (std::size_t i = 0; i < pixels.size(); ++i)
    pixels[i] = strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride);
  map.distance_m = surface_distances(pipeline, camera, limits, pixels);
  return map;
}

Vec3d point_at(const RayCamera& camera, const RayLimits& limits, const PixelPlace& pixel, double distance_m) {
  double origin[3], direction[3], near_far[2];
  cast_ray(camera, limits, pixel.column, pixel.row, origin, direction, near_far);
  return {origin[0] + direction[0] * distance_m, origin[1] + direction[1] * distance_m,
          origin[2] + direction[2] * distance_m};
}

SeenSurface surface_seen_by(const PoolView& view, const RayLimits& limits) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  const SurfaceMap& map = view.map;
  std::vector<Vec3d> places(map.distance_m.size(), Vec3d{kNone, kNone, kNone});
  for (std::size_t i = 0; i < places.size(); ++i) {
    const auto distance = static_cast<double>(map.distance_m[i]);
    if (!(distance > 0)) continue;
    places[i] =
        point_at(view.camera, limits, strided_place(static_cast<std::int64_t>(i), map.width_px, map.stride), distance);
  }
  return seen_surface(std::move(places), map.width_px, view.camera.world_from_camera.t);
}

namespace {

double extent_of(std::span<const SeenSurface> seen) {
  Vec3d low{INFINITY, INFINITY, INFINITY}, high{-INFINITY, -INFINITY, -INFINITY};
  for (const SeenSurface& view : seen) {
    for (const Vec3d& place : view.place) {
      if (!is_place(place)) continue;
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], place[axis]);
        high[axis] = std::max(high[axis], place[axis]);
      }
    }
  }
  return low.x > high.x ? 0 : length(high - low);
}

}  // namespace

PointDifference difference(const PoolPoint& a, const PoolPoint& b, double color_sigma, double normal_sigma) {
  const Vec3d dc = a.color - b.color, dn = a.normal - b.normal;
  return {dot(dc, dc) * (1 / (2 * color_sigma * color_sigma)), dot(dn, dn) * (1 / (2 * normal_sigma * normal_sigma))};
}

void SurfacePool::number(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
  std::vector<std::int32_t>& of_pixel = point_of_pixel[view];
  of_pixel.assign(seen.place.size(), -1);
  for (std::size_t i = 0; i < of_pixel.size(); ++i) {
    const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), seen.width_px, stride);
    const auto at = static_cast<std::size_t>(std::int64_t{pixel.row} * photo.width_px + pixel.column);
    if (photo.mask.uses(at)) of_pixel[i] = cells.add(seen.place[i]);
  }
}

void SurfacePool::gather(std::size_t view, const SeenSurface& seen, const StoredFrame& photo, std::int32_t stride) {
  points.resize(static_cast<std::size_t>(cells.count()));
  const std::vector<std::int32_t>& of_pixel = point_of_pixel[view];
  for (std::size_t i = 0; i < of_pixel.size(); ++i) {
    if (of_pixel[i] < 0) continue;
    const PixelPlace pixel = strided_place(static_cast<std::int64_t>(i), seen.width_px, stride);
    const auto at = static_cast<std::size_t>(std::int64_t{pixel.row} * photo.width_px + pixel.column);
    PoolPoint& point = points[static_cast<std::size_t>(of_pixel[i])];
    const std::uint8_t* const rgb = &photo.rgb[3 * at];
    point.color = point.color + Vec3d{double(rgb[0]), double(rgb[1]), double(rgb[2])};
    point.position = point.position + seen.place[i];
    point.normal = point.normal + seen.normal[i];
    point.pixels += 1;
    const bool interior = seen.is_interior(static_cast<std::int64_t>(i)), first = point.pixels == 1;
    if (!first && (interior != point.interior ? !interior : seen.distance_m[i] >= point.distance_m)) continue;
    point.distance_m = seen.distance_m[i];
    point.interior = interior;
    point.view = static_cast<int>(view);
    point.pixel = pixel;
  }
}

void SurfacePool::finish() {
  for (PoolPoint& point : points) {
    point.position = point.position * (1 / point.pixels);
    point.color = point.color * (1 / (255 * point.pixels));
    const double size = length(point.normal);
    point.normal = size > 0 ? point.normal * (1 / size) : Vec3d{};
  }
}

void SurfacePool::count_segments(std::size_t number, const PoolView& view) {
  if (view.segments == nullptr) return;
  const std::vector<std::int32_t>& of_pixel = point_of_pixel[number];
  const auto segment_at = [&](std::size_t i) {
    const PixelPlace at = strided_place(static_cast<std::int64_t>(i), view.map.width_px, view.map.stride);
    return view.segments->at(at.column, at.row, view.photo->width_px, view.photo->height_px);
  };
  const auto width = static_cast<std::size_t>(view.map.width_px);
  for (std::size_t i = 0; i < of_pixel.size(); ++i) {
    for (const std::size_t next : {i + 1, i + width}) {
      if (next >= of_pixel.size() || (next == i + 1 && next % width == 0)) continue;
      if (of_pixel[i] < 0 || of_pixel[next] < 0 || of_pixel[i] == of_pixel[next]) continue;
      const std::int32_t here = segment_at(i), there = segment_at(next);
      if (here == 0 && there == 0) continue;
      SegmentSteps& steps = segment_steps[key_of_points(of_pixel[i], of_pixel[next])];
      ++(here == there ? steps.within : steps.across);
    }
  }
}

SurfacePool make_surface_pool(std::span<const PoolView> views, const RayLimits& limits, std::int64_t wanted) {
  std::vector<SeenSurface> seen(views.size());
  parallel_for(std::ssize(views), [&](std::int64_t v) {
    const PoolView& view = views[static_cast<std::size_t>(v)];
    if (!view.map.empty()) seen[static_cast<std::size_t>(v)] = surface_seen_by(view, limits);
  });
  const double extent = extent_of(seen);
  SurfacePool pool;
  pool.point_of_pixel.resize(views.size());
  for (std::size_t v = 0; v < views.size(); ++v) pool.point_of_pixel[v].assign(seen[v].place.size(), -1);
  if (!(extent > 0)) return pool;
  // A surface has as many cells as the square of their number per axis; the second turn corrects the first guess.
  double cell_m = extent / std::sqrt(static_cast<double>(wanted));
  for (int turn = 0; turn < 3; ++turn) {
    pool = SurfacePool(cell_m, views.size());
    for (std::size_t v = 0; v < views.size(); ++v)
      if (!views[v].map.empty()) pool.number(v, seen[v], *views[v].photo, views[v].map.stride);
    const double ratio = static_cast<double>(pool.cells.count()) / static_cast<double>(wanted);
    if (ratio > 0.8 && ratio < 1.25) break;
    cell_m *= std::clamp(std::sqrt(ratio), 0.2, 5.0);
  }
  for (std::size_t v = 0; v < views.size(); ++v)
    if (!views[v].map.empty()) pool.gather(v, seen[v], *views[v].photo, views[v].map.stride);
  for (std::size_t v = 0; v < views.size(); ++v) pool.count_segments(v, views[v]);
  pool.finish();
  return pool;
}

namespace {

using Matrix = Eigen::SparseMatrix<double>;
using Solver = Eigen::ConjugateGradient<Matrix, Eigen::Lower | Eigen::Upper, Eigen::IncompleteCholesky<double>>;

constexpr double kResidual = 1e-6;  // of the right side that votes of weight 1 give
constexpr int kMostIterations = 20000;

// The nodes of parts with votes, and the matrix L + D of them.
struct System {
  std::vector<std::int32_t> node_of_row;
  Matrix matrix;
};

System build_system(std::span<const GraphEdge> edges, std::span<const double> held, std::span<const char> reached) {
  System system;
  std::vector<std::int32_t> row_of_node(reached.size(), -1);
  for (std::size_t n = 0; n < reached.size(); ++n) {
    if (reached[n] == 0) continue;
    row_of_node[n] = static_cast<std::int32_t>(system.node_of_row.size());
    system.node_of_row.push_back(static_cast<std::int32_t>(n));
  }
  std::vector<Eigen::Triplet<double>> entries;
  std::vector<double> diagonal(system.node_of_row.size());
  for (std::size_t row = 0; row < diagonal.size(); ++row)
    diagonal[row] = held[static_cast<std::size_t>(system.node_of_row[row])];
  for (const GraphEdge& edge : edges) {
    const std::int32_t a = row_of_node[static_cast<std::size_t>(edge.a)],
                       b = row_of_node[static_cast<std::size_t>(edge.b)];
    if (a < 0) continue;  // both or none: they are of one part
    entries.emplace_back(a, b, -edge.weight);
    entries.emplace_back(b, a, -edge.weight);
    diagonal[static_cast<std::size_t>(a)] += edge.weight;
    diagonal[static_cast<std::size_t>(b)] += edge.weight;
  }
  const auto rows = static_cast<std::int32_t>(diagonal.size());
  for (std::int32_t row = 0; row < rows; ++row) entries.emplace_back(row, row, diagonal[static_cast<std::size_t>(row)]);
  system.matrix.resize(rows, rows);
  system.matrix.setFromTriplets(entries.begin(), entries.end());
  return system;
}

// Rows become distributions: rounding may leave sums beside 1 and values below 0.
void normalise(std::span<float> row) {
  float sum = 0;
  for (float& value : row) sum += value = std::max(value, 0.0F);
  for (float& value : row) value = sum > 0 ? value / sum : 0;
}

}  // namespace

Diffusion diffuse_votes(std::span<const GraphEdge> edges, std::span<const double> votes, int classes,
                        double vote_weight, const std::function<void(int done, int of)>& done) {
  SEMFIELD_CHECK(classes > 0 && votes.size() % static_cast<std::size_t>(classes) == 0, "a row of votes a node");
  const auto width = static_cast<std::size_t>(classes);
  const std::size_t nodes = votes.size() / width;
  std::vector<double> held(nodes);
  std::vector<char> voted_class(width), reached(nodes), voted_part(nodes);
  JoinedSets parts(nodes);
  for (const GraphEdge& edge : edges) parts.join(edge.a, edge.b);
  for (std::size_t n = 0; n < nodes; ++n) {
    for (std::size_t c = 0; c < width; ++c) {
      const double vote = votes[n * width + c];
      held[n] += vote_weight * vote;
      voted_class[c] |= vote > 0 ? 1 : 0;
    }
    if (held[n] > 0) voted_part[parts.of(n)] = 1;
  }
  Diffusion out;
  out.probability.resize(votes.size());
  for (std::size_t n = 0; n < nodes; ++n) {
    const std::size_t root = parts.of(n);
    reached[n] = voted_part[root];
    if (root != n) continue;
    ++out.parts;
    out.parts_without_vote += voted_part[n] == 0 ? 1 : 0;
  }
  const System system = build_system(edges, held, reached);
  if (system.node_of_row.empty()) return out;
  std::vector<std::size_t> asked;
  for (std::size_t c = 0; c < width; ++c) {
    if (voted_class[c] != 0) asked.push_back(c);
  }
  std::mutex told;
  int solved = 0;
  // A solver keeps the state of its last solution, so every worker has one; each class is solved alone.
  const std::int64_t workers = std::min<std::int64_t>(thread_count(), std::ssize(asked));
  parallel_for(workers, [&](std::int64_t worker) {
    Solver solver;
    solver.setTolerance(kResidual / std::max(1.0, vote_weight));
    solver.setMaxIterations(kMostIterations);
    solver.compute(system.matrix);
    SEMFIELD_CHECK(solver.info() == Eigen::Success, "a Laplacian with votes is positive definite");
    for (auto k = static_cast<std::size_t>(worker); k < asked.size(); k += static_cast<std::size_t>(workers)) {
      const auto place = [&](Eigen::Index row) {
        return static_cast<std::size_t>(system.node_of_row[static_cast<std::size_t>(row)]) * width + asked[k];
      };
      Eigen::VectorXd right(std::ssize(system.node_of_row));
      for (Eigen::Index row = 0; row < right.size(); ++row) right[row] = vote_weight * votes[place(row)];
      const Eigen::VectorXd solution = solver.solve(right);
      if (solver.info() != Eigen::Success) {
        throw Error(ErrorKind::failure, "fuse.diffusion.diverged", "the diffusion of a class's votes does not converge",
                    "raise propagate.vote_weight, propagate.color_sigma or propagate.normal_sigma");
      }
      for (Eigen::Index row = 0; row < right.size(); ++row)
        out.probability[place(row)] = static_cast<float>(solution[row]);
      const std::lock_guard lock(told);
      if (done) done(++solved, static_cast<int>(asked.size()));
    }
  });
  for (std::size_t n = 0; n < nodes; ++n) normalise(std::span(out.probability).subspan(n * width, width));
  return out;
}

}  // namespace semfield
