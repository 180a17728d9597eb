#include "surface/objects/find_objects.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <map>
#include <numeric>
#include <set>

#include "compute/parallel.h"
#include "core/joined_sets.h"
#include "execution/lane_executor.h"
#include "labels/clicks.h"
#include "labels/label_files.h"
#include "scene/camera_rig.h"
#include "scene/classes/class_table.h"
#include "surface/objects/object_set.h"
#include "surface/surface_graph.h"

namespace semfield {

namespace {

constexpr std::int64_t kLeastSights = 4;   // of a segment in the map of a view
constexpr std::int64_t kLeastClicked = 6;  // points of a thing that somebody clicked: a cell and some around it

class Clock {
 public:
  explicit Clock(FoundObjects& to) : to_(to) {}
  void part(const char* name) {
    const auto now = std::chrono::steady_clock::now();
    to_.seconds.emplace_back(name, std::chrono::duration<double>(now - since_).count());
    since_ = now;
  }

 private:
  FoundObjects& to_;
  std::chrono::steady_clock::time_point since_ = std::chrono::steady_clock::now();
};

// Those with the names, and, where segments say their classes, those of no segment.
std::vector<bool> stuff_classes(const ClassTable& classes, const std::vector<std::string>& names,
                                const SegmentSet& segments) {
  std::vector<bool> stuff(static_cast<std::size_t>(classes.valid_count()), segments.classes);
  for (const FrameSegments& frame : segments.frames)
    for (const auto& [id, index] : frame.class_of) stuff[static_cast<std::size_t>(index)] = false;
  for (int c = 0; c < classes.valid_count(); ++c)
    if (std::find(names.begin(), names.end(), classes.valid(c).name) != names.end())
      stuff[static_cast<std::size_t>(c)] = true;
  return stuff;
}

}  // namespace

TouchingCells touching_cells(const SurfaceCells& cells) {
  const std::vector<CellPair> pairs = cells.neighbours();
  TouchingCells out;
  out.first.assign(static_cast<std::size_t>(cells.count()) + 1, 1);
  out.first[0] = 0;
  for (const CellPair& pair : pairs) {
    ++out.first[static_cast<std::size_t>(pair.a) + 1];
    ++out.first[static_cast<std::size_t>(pair.b) + 1];
  }
  for (std::size_t c = 1; c < out.first.size(); ++c) out.first[c] += out.first[c - 1];
  out.of.resize(static_cast<std::size_t>(out.first.back()));
  std::vector<std::int32_t> next(out.first.begin(), out.first.end() - 1);
  for (std::int32_t c = 0; c < cells.count(); ++c)
    out.of[static_cast<std::size_t>(next[static_cast<std::size_t>(c)]++)] = c;
  for (const CellPair& pair : pairs) {
    out.of[static_cast<std::size_t>(next[static_cast<std::size_t>(pair.a)]++)] = pair.b;
    out.of[static_cast<std::size_t>(next[static_cast<std::size_t>(pair.b)]++)] = pair.a;
  }
  return out;
}

FoundObjects find_objects(Session& session, const SegmentSet& segments, std::unique_ptr<Grouping> grouping,
                          const KernelTables& kernels, const ObjectStages& progress) {
  const ObjectsParams& params = session.config.objects;
  const bool clicked = !segments.clicks.empty();
  if (clicked && !session.pipeline->has_semantics())
    throw Error(ErrorKind::data, "objects.clicks.no_classes",
                segments.from + ": a click says where a thing is, and the run has no classes that say where it ends",
                "train the run with classes, or give masks with --segments");
  FoundObjects found;
  Clock clock(found);
  const auto say = [&](const char* stage) {
    return [&progress, stage](double done, double of) {
      if (progress) progress(stage, done, of);
    };
  };
  found.grouping = std::move(grouping);
  found.stuff = stuff_classes(session.scene.info.classes, params.stuff, segments);
  std::vector<PoolView> views = object_views(session, params.rays, say("seen"));
  clock.part("rendering");
  found.surface = object_surface(std::move(views), session.limits, params.points);
  const SurfacePool& pool = found.surface.pool;
  found.touching = touching_cells(pool.cells);
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : pool.points) positions.push_back(point.position);
  std::vector<Pose> poses;
  for (const PoolView& view : found.surface.views) poses.push_back(view.camera.world_from_camera);
  found.up = up_of_cameras(poses);
  clock.part("surface");
  std::vector<SegmentSights> sights = segment_sights(found.surface, segments, kLeastSights);
  for (const SegmentSights& view : sights) found.shown += view.segments();
  const PointClasses classes = classes_of_points(session, positions, sights);
  found.class_of = classes.most_probable();
  ClickedObjects told;
  if (clicked) {
    told = clicked_objects(found.surface, found.touching, found.class_of, found.stuff, segments.clicks, kLeastClicked);
    found.id = told.id;
    found.unclaimed = told.unclaimed;
    if (std::all_of(found.id.begin(), found.id.end(), [](std::int32_t id) { return id == 0; }))
      throw Error(ErrorKind::data, "objects.segments.none",
                  fmt::format("none of {} clicks is on a thing that has surface around it", segments.clicks.size()),
                  "click on things, whose classes are not in objects.stuff, or raise objects.points and objects.rays");
    sights = point_sights(found.surface, found.id);
  }
  clock.part("classes");
  const ObjectNetworkShape shape{params.frequencies, params.hidden_width, params.hidden_layers};
  found.network = std::make_unique<ObjectNetwork<float>>(kernels, *found.grouping, shape, session.scene.bounds,
                                                         params.seed, params.views);
  const ObjectLearning learning{params.steps, params.views, params.view_points, params.learning_rate, params.seed};
  const DeviceId device = session.pipeline->executor().device();
  const ObjectProgress learned = say("learned");
  if (device.kind != Device::cuda || !found.network->learn_on_gpu(device.ordinal, positions, sights, learning, learned))
    found.network->learn(positions, sights, learning, learned);
  clock.part("learning");
  found.place = found.network->outputs(positions);
  const View<float> place(found.place.data(), std::ssize(positions), found.grouping->width());
  found.grouping->place(place);
  const ClusterRules rules{params.reach, params.neighbours, params.agree, static_cast<double>(params.least_views),
                           params.least_points};
  if (!clicked) {
    found.id = cluster_points(pool, {place, found.class_of, found.stuff}, sights, rules);
    for (std::int32_t& id : found.id) ++id;
  }
  found.rows = object_table(found.surface, found.id, sights, classes, found.stuff, found.up);
  for (std::size_t k = 0; k < told.class_of.size(); ++k) found.rows[k].class_index = told.class_of[k];
  clock.part("groups");
  return found;
}

std::vector<std::int32_t> object_ids(Session& session, FoundObjects& objects, const RayCamera& camera,
                                     std::span<const std::int16_t> label) {
  constexpr double kWayWeight = 0.25;  // of a cell's distance, beside that of places
  const SurfacePool& pool = objects.surface.pool;
  const SurfaceMap map = make_surface_map(*session.pipeline, camera, session.limits, 1, 0);
  const auto pixels = static_cast<std::size_t>(std::int64_t{map.width_px} * map.height_px);
  const TouchingCells& touching = objects.touching;
  std::vector<std::int32_t> cell(pixels, -1), ids(pixels, 0);
  std::vector<Vec3d> position(pixels);
  parallel_for(map.height_px, [&](std::int64_t y) {
    for (std::int32_t x = 0; x < map.width_px; ++x) {
      const auto i = static_cast<std::size_t>(y * map.width_px + x);
      const auto distance = static_cast<double>(map.distance_m[i]);
      if (!(distance > 0)) continue;
      position[i] = point_at(camera, session.limits, {x, static_cast<std::int32_t>(y)}, distance);
      cell[i] = pool.cells.near(position[i]);
    }
  });
  // Where cells that touch are of several objects, the network says whose the very place is.
  std::vector<std::size_t> asked;
  std::vector<Vec3d> places;
  for (std::size_t i = 0; i < pixels; ++i) {
    if (cell[i] < 0) continue;
    const auto c = static_cast<std::size_t>(cell[i]);
    ids[i] = objects.id[c];
    const auto begin = touching.of.begin() + touching.first[c], end = touching.of.begin() + touching.first[c + 1];
    const bool differs = !label.empty() && label[i] != kVoid && objects.class_of[c] != label[i];
    if (!differs &&
        std::all_of(begin, end, [&](std::int32_t n) { return objects.id[static_cast<std::size_t>(n)] == ids[i]; }))
      continue;
    asked.push_back(i);
    places.push_back(position[i]);
  }
  std::vector<float> rows = objects.network->outputs(places);
  const std::int32_t width = objects.grouping->width();
  objects.grouping->place({rows.data(), std::ssize(places), width});
  parallel_for((std::ssize(asked) + 255) / 256, [&](std::int64_t block) {
    for (auto k = static_cast<std::size_t>(block * 256);
         k < std::min(asked.size(), static_cast<std::size_t>(block + 1) * 256); ++k) {
      const std::size_t i = asked[k];
      const auto c = static_cast<std::size_t>(cell[i]);
      const std::int16_t own = label.empty() ? kVoid : label[i];
      double best = INFINITY;
      for (std::int32_t n = touching.first[c]; n < touching.first[c + 1]; ++n) {
        const auto other = static_cast<std::size_t>(touching.of[static_cast<std::size_t>(n)]);
        double cost = 0;
        for (std::int32_t d = 0; d < width; ++d) {
          const auto way =
              static_cast<double>(rows[k * static_cast<std::size_t>(width) + static_cast<std::size_t>(d)] -
                                  objects.place[other * static_cast<std::size_t>(width) + static_cast<std::size_t>(d)]);
          cost += way * way;
        }
        const Vec3d way = (position[i] - pool.points[other].position) * (1 / pool.cell_m());
        cost += kWayWeight * dot(way, way);
        if (own != kVoid) {
          const std::int32_t id = objects.id[other];
          const std::int16_t its =
              id > 0 ? objects.rows[static_cast<std::size_t>(id) - 1].class_index : objects.class_of[other];
          if (its != own) cost += 1e6;
        }
        if (cost >= best) continue;
        best = cost;
        ids[i] = objects.id[other];
      }
    }
  });
  return ids;
}

namespace {

// What views say of two groups.
struct Evidence {
  double weight = 0, same = 0, views = 0;
  double share() const { return weight > 0 ? same / weight : 0; }
};

class Clustering {
 public:
  Clustering(const SurfacePool& pool, const PlacedPoints& points, std::span<const SegmentSights> sights,
             const ClusterRules& rules)
      : points_(points),
        sights_(sights),
        rules_(rules),
        near_(pool.cells.neighbours()),
        group_(pool.points.size(), -1),
        is_stuff_(pool.points.size(), false) {}

  std::vector<std::int32_t> run() {
    grow();
    part();
    take_in(1);
    join_by_views();
    drop_small();
    drop_rims();
    take_in(INFINITY);
    number();
    return std::move(group_);
  }

 private:
  bool is_stuff(std::int32_t i) const { return is_stuff_[static_cast<std::size_t>(i)] != 0; }
  // What the field says there.
  std::int16_t class_of(std::int32_t i) const {
    return points_.class_of.empty() ? kVoid : points_.class_of[static_cast<std::size_t>(i)];
  }
  bool is_of_stuff(std::int16_t class_index) const {
    return class_index != kVoid && points_.stuff[static_cast<std::size_t>(class_index)];
  }
  static float squared(const float* a, const float* b, std::int32_t width) {
    float sum = 0;
    for (std::int32_t d = 0; d < width; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
    return sum;
  }

  // Mean places of the segments of all views: a segment's middle lies where its object does, also where its border is
  // blurred. Segments of stuff have none: those whose class is such, or most of whose points are.
  void take_means() {
    const std::int32_t width = points_.place.cols;
    for (const SegmentSights& view : sights_) {
      first_segment_.push_back(static_cast<std::int32_t>(is_thing_.size()));
      for (std::int32_t s = 0; s < view.segments(); ++s) {
        const std::int16_t told = view.class_of[static_cast<std::size_t>(s)];
        std::vector<double> sum(static_cast<std::size_t>(width), 0);
        double count = 0, all = 0;
        for (std::int32_t i = view.first[static_cast<std::size_t>(s)]; i < view.first[static_cast<std::size_t>(s) + 1];
             ++i) {
          const std::int32_t point = view.point[static_cast<std::size_t>(i)];
          ++all;
          if (told == kVoid && is_of_stuff(class_of(point))) continue;
          ++count;
          for (std::int32_t d = 0; d < width; ++d)
            sum[static_cast<std::size_t>(d)] += static_cast<double>(points_.place(point, d));
        }
        is_thing_.push_back(2 * count > all && !is_of_stuff(told));
        for (const double value : sum) segment_mean_.push_back(static_cast<float>(value / std::max(count, 1.0)));
      }
    }
    first_segment_.push_back(static_cast<std::int32_t>(is_thing_.size()));
  }

  // Clusters of the segments of all views [Ester96]; kStuff: segments of stuff, -1: of no cluster.
  std::vector<std::int32_t> cluster_segments() const {
    const auto count = std::ssize(is_thing_);
    const std::int32_t width = points_.place.cols;
    const auto reach = static_cast<float>(rules_.reach * rules_.reach);
    std::vector<std::vector<std::int32_t>> near(static_cast<std::size_t>(count));
    parallel_for(count, [&](std::int64_t i) {
      if (!is_thing_[static_cast<std::size_t>(i)]) return;
      for (std::int64_t j = 0; j < count; ++j)
        if (j != i && is_thing_[static_cast<std::size_t>(j)] &&
            squared(&segment_mean_[static_cast<std::size_t>(i * width)],
                    &segment_mean_[static_cast<std::size_t>(j * width)], width) < reach)
          near[static_cast<std::size_t>(i)].push_back(static_cast<std::int32_t>(j));
    });
    const auto inside = [&](std::int64_t i) {
      return std::ssize(near[static_cast<std::size_t>(i)]) >= rules_.neighbours;
    };
    JoinedSets joined(static_cast<std::size_t>(count));
    std::vector<std::int32_t> cluster(static_cast<std::size_t>(count), -1);
    for (std::int64_t i = 0; i < count; ++i)
      for (const std::int32_t j : near[static_cast<std::size_t>(i)])
        if (j > i && inside(i) && inside(j)) joined.join(static_cast<std::int32_t>(i), j);
    for (std::int64_t i = 0; i < count; ++i) {
      if (!is_thing_[static_cast<std::size_t>(i)]) cluster[static_cast<std::size_t>(i)] = kStuff;
      if (inside(i)) cluster[static_cast<std::size_t>(i)] = joined.of(static_cast<std::int32_t>(i));
    }
    return cluster;
  }

  // Of each point the cluster that most of its segments are of, the first of equals; -1: none. Sets what is stuff: by
  // the segments that a point lies in, among which what the field says counts as kFieldVotes.
  std::vector<std::int32_t> votes_of(const std::vector<std::int32_t>& cluster) {
    std::vector<std::int32_t> first(group_.size() + 1, 0);
    const auto for_votes = [&](const auto& body) {
      for (std::size_t v = 0; v < sights_.size(); ++v)
        for (std::size_t i = 0; i < sights_[v].point.size(); ++i)
          if (const auto c = cluster[static_cast<std::size_t>(first_segment_[v] + sights_[v].segment[i])]; c != -1)
            body(static_cast<std::size_t>(sights_[v].point[i]), c);
    };
    for_votes([&](std::size_t point, std::int32_t) { ++first[point + 1]; });
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<std::int32_t> vote(static_cast<std::size_t>(first.back())), next(first.begin(), first.end() - 1);
    for_votes([&](std::size_t point, std::int32_t c) { vote[static_cast<std::size_t>(next[point]++)] = c; });
    std::vector<std::int32_t> of_point(group_.size(), -1);
    parallel_for((std::ssize(of_point) + kBlock - 1) / kBlock, [&](std::int64_t block) {
      for (std::int64_t i = block * kBlock; i < std::min(std::ssize(of_point), (block + 1) * kBlock); ++i) {
        const auto n = static_cast<std::size_t>(i);
        const auto end = vote.begin() + first[n + 1];
        std::sort(vote.begin() + first[n], end);
        const auto things = std::upper_bound(vote.begin() + first[n], end, kStuff);
        const std::int16_t said = class_of(static_cast<std::int32_t>(i));
        std::ptrdiff_t stuff = things - (vote.begin() + first[n]), thing = end - things, most = 0;
        if (said != kVoid) (is_of_stuff(said) ? stuff : thing) += kFieldVotes;
        is_stuff_[n] = stuff > thing;
        if (is_stuff_[n]) continue;
        for (auto of = things; of != end;) {
          const auto behind = std::upper_bound(of, end, *of);
          if (behind - of > most) {
            most = behind - of;
            of_point[n] = *of;
          }
          of = behind;
        }
      }
    });
    return of_point;
  }

  // A point is of the cluster that most of its segments are of, and a group is what touches of one cluster.
  void grow() {
    take_means();
    const std::vector<std::int32_t> of_point = votes_of(cluster_segments());
    JoinedSets joined(group_.size());
    for (const auto& [a, b] : near_)
      if (of_point[static_cast<std::size_t>(a)] >= 0 &&
          of_point[static_cast<std::size_t>(a)] == of_point[static_cast<std::size_t>(b)])
        joined.join(a, b);
    std::vector<std::int32_t> size(group_.size(), 0);
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (of_point[static_cast<std::size_t>(i)] >= 0) ++size[static_cast<std::size_t>(joined.of(i))];
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (of_point[static_cast<std::size_t>(i)] >= 0 && size[static_cast<std::size_t>(joined.of(i))] >= kLeastPiece)
        group_[static_cast<std::size_t>(i)] = joined.of(i);
    number();
  }

  // Sights of every point: the numbers of their segments among those of all views, ascending.
  void take_sights() {
    sight_first_.assign(group_.size() + 1, 0);
    for (const SegmentSights& view : sights_)
      for (const std::int32_t point : view.point) ++sight_first_[static_cast<std::size_t>(point) + 1];
    std::partial_sum(sight_first_.begin(), sight_first_.end(), sight_first_.begin());
    sight_.resize(static_cast<std::size_t>(sight_first_.back()));
    std::vector<std::int32_t> next(sight_first_.begin(), sight_first_.end() - 1);
    for (std::size_t v = 0; v < sights_.size(); ++v) {
      for (std::size_t i = 0; i < sights_[v].point.size(); ++i)
        sight_[static_cast<std::size_t>(next[static_cast<std::size_t>(sights_[v].point[i])]++)] =
            first_segment_[v] + sights_[v].segment[i];
      for (std::int32_t s = first_segment_[v]; s < first_segment_[v + 1]; ++s)
        view_of_.push_back(static_cast<std::int32_t>(v));
    }
  }

  // What views say of two touching regions, over the pairs of their points that touch.
  using Rank = std::pair<double, std::uint64_t>;  // the surest first
  struct Link {
    std::int32_t a = 0, b = 0;
    double same = 0, common = 0;
    // Among equals in no order of space, or else a plain surface would grow from one end, a point in a round.
    Rank rank() const {
      const auto number = static_cast<std::uint64_t>(a) << 32 | static_cast<std::uint64_t>(b);
      const std::uint64_t mixed = number * 0x9E3779B97F4A7C15u;
      return {-same / (common + kDoubt), (mixed ^ mixed >> 29) * 0xBF58476D1CE4E5B9u};
    }
  };
  Link link_of(const CellPair& pair) const {
    Link link{pair.a, pair.b};
    auto a = sight_first_[static_cast<std::size_t>(pair.a)], b = sight_first_[static_cast<std::size_t>(pair.b)];
    const auto a_end = sight_first_[static_cast<std::size_t>(pair.a) + 1],
               b_end = sight_first_[static_cast<std::size_t>(pair.b) + 1];
    const auto view = [&](std::int32_t i) {
      return view_of_[static_cast<std::size_t>(sight_[static_cast<std::size_t>(i)])];
    };
    while (a < a_end && b < b_end) {
      if (view(a) != view(b)) {
        ++(view(a) < view(b) ? a : b);
        continue;
      }
      const std::int32_t v = view(a), a0 = a, b0 = b;
      while (a < a_end && view(a) == v) ++a;
      while (b < b_end && view(b) == v) ++b;
      double same = 0;
      for (auto i = a0; i < a; ++i)
        for (auto j = b0; j < b; ++j)
          same += sight_[static_cast<std::size_t>(i)] == sight_[static_cast<std::size_t>(j)];
      link.common += 1;
      link.same += same / ((a - a0) * (b - b0));
    }
    return link;
  }

  // Links between the same two regions become one.
  static void add_up(std::vector<Link>& links) {
    std::sort(links.begin(), links.end(),
              [](const Link& x, const Link& y) { return std::tie(x.a, x.b) < std::tie(y.a, y.b); });
    std::size_t last = 0;
    for (std::size_t i = 1; i < links.size(); ++i) {
      if (links[i].a == links[last].a && links[i].b == links[last].b) {
        links[last].same += links[i].same;
        links[last].common += links[i].common;
      } else {
        links[++last] = links[i];
      }
    }
    if (!links.empty()) links.resize(last + 1);
  }

  // Groups whose sights views put into several segments come apart along the surface, where the network could not tell
  // things from each other: from single points on, regions join that are each other's surest neighbour, as far as views
  // say that they are one. Parts of one thing are joined again afterwards.
  void part() {
    std::vector<double> same(static_cast<std::size_t>(groups_), 0), all(static_cast<std::size_t>(groups_), 0);
    for (const Counts& view : counts()) {
      for (const auto& [g, seen] : view) {
        all[static_cast<std::size_t>(g)] += seen.total;
        for (const auto& [segment, n] : seen.in) same[static_cast<std::size_t>(g)] += n * n / seen.total;
      }
    }
    const auto is_many = [&](std::int32_t g) {
      return g >= 0 && same[static_cast<std::size_t>(g)] < kOne * all[static_cast<std::size_t>(g)];
    };
    take_sights();
    std::vector<Link> links;
    for (const CellPair& pair : near_) {
      const std::int32_t g = group_[static_cast<std::size_t>(pair.a)];
      if (g == group_[static_cast<std::size_t>(pair.b)] && is_many(g)) links.push_back(link_of(pair));
    }
    JoinedSets joined(group_.size());
    for (bool some = true; some;) {
      std::vector<Rank> best(group_.size(), {-rules_.agree, 0});
      for (const Link& link : links)
        for (const std::int32_t end : {link.a, link.b})
          best[static_cast<std::size_t>(end)] = std::min(best[static_cast<std::size_t>(end)], link.rank());
      some = false;
      for (const Link& link : links) {
        if (best[static_cast<std::size_t>(link.a)] != link.rank() ||
            best[static_cast<std::size_t>(link.b)] != link.rank())
          continue;
        joined.join(link.a, link.b);
        some = true;
      }
      for (Link& link : links) std::tie(link.a, link.b) = std::minmax({joined.of(link.a), joined.of(link.b)});
      std::erase_if(links, [](const Link& link) { return link.a == link.b; });
      add_up(links);
    }
    std::vector<std::int32_t> size(group_.size(), 0);
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (is_many(group_[static_cast<std::size_t>(i)])) ++size[static_cast<std::size_t>(joined.of(i))];
    for (std::int32_t i = 0; i < std::ssize(group_); ++i) {
      std::int32_t& g = group_[static_cast<std::size_t>(i)];
      if (is_many(g)) g = size[static_cast<std::size_t>(joined.of(i))] >= kLeastPiece ? groups_ + joined.of(i) : -1;
    }
    number();
  }

  // Groups are numbered anew, the largest first.
  void number() {
    // A group's number is below that of the points, or behind the groups and then of a point (part()).
    std::vector<std::int32_t> size(static_cast<std::size_t>(groups_) + group_.size(), 0), to(size.size(), -1);
    for (const std::int32_t g : group_)
      if (g >= 0) ++size[static_cast<std::size_t>(g)];
    std::vector<std::pair<std::int32_t, std::int32_t>> order;
    for (std::size_t g = 0; g < size.size(); ++g)
      if (size[g] > 0) order.emplace_back(-size[g], static_cast<std::int32_t>(g));
    std::sort(order.begin(), order.end());
    for (std::size_t n = 0; n < order.size(); ++n)
      to[static_cast<std::size_t>(order[n].second)] = static_cast<std::int32_t>(n);
    for (std::int32_t& g : group_)
      if (g >= 0) g = to[static_cast<std::size_t>(g)];
    groups_ = static_cast<std::int32_t>(order.size());
  }

  std::vector<float> means() const {
    const auto width = static_cast<std::size_t>(points_.place.cols);
    std::vector<double> sum(static_cast<std::size_t>(groups_) * width, 0), count(static_cast<std::size_t>(groups_), 0);
    for (std::size_t i = 0; i < group_.size(); ++i) {
      if (group_[i] < 0) continue;
      const auto g = static_cast<std::size_t>(group_[i]);
      count[g] += 1;
      for (std::size_t d = 0; d < width; ++d)
        sum[g * width + d] += static_cast<double>(points_.place(static_cast<std::int64_t>(i), static_cast<int>(d)));
    }
    std::vector<float> mean(sum.size());
    for (std::size_t g = 0; g < count.size(); ++g)
      for (std::size_t d = 0; d < width; ++d)
        mean[g * width + d] = static_cast<float>(sum[g * width + d] / std::max(count[g], 1.0));
    return mean;
  }

  // Of every group the class that most of its points have.
  std::vector<std::int16_t> classes() const {
    std::vector<std::map<std::int16_t, std::int32_t>> votes(static_cast<std::size_t>(groups_));
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (const std::int32_t g = group_[static_cast<std::size_t>(i)]; g >= 0 && class_of(i) != kVoid)
        ++votes[static_cast<std::size_t>(g)][class_of(i)];
    std::vector<std::int16_t> out;
    for (const auto& of : votes)
      out.push_back(of.empty() ? kVoid : std::max_element(of.begin(), of.end(), [](const auto& a, const auto& b) {
                                           return a.second < b.second;
                                         })->first);
    return out;
  }

  // Points without a group join that of a neighbour whose mean is nearest and within `reach` times the reach, in rings.
  void take_in(double reach) {
    const auto width = points_.place.cols;
    const std::vector<float> mean = means();
    const std::vector<std::int16_t> class_of_group = classes();
    const auto most = static_cast<float>(reach * reach * rules_.reach * rules_.reach);
    const auto waits = [&](std::int32_t point) {
      return group_[static_cast<std::size_t>(point)] < 0 && !is_stuff(point);
    };
    std::vector<CellPair> asks;  // a waits, b is its neighbour
    for (const CellPair& pair : near_) {
      if (waits(pair.a)) asks.push_back(pair);
      if (waits(pair.b)) asks.push_back({pair.b, pair.a});
    }
    std::vector<std::int32_t> next = group_;
    std::vector<float> best(group_.size(), INFINITY);
    for (int ring = 0; ring < 64 && !asks.empty(); ++ring) {
      for (const CellPair& pair : asks) {
        const auto i = static_cast<std::size_t>(pair.a);
        const std::int32_t g = group_[static_cast<std::size_t>(pair.b)];
        if (g < 0) continue;
        const std::int16_t its = class_of(pair.a), of_group = class_of_group[static_cast<std::size_t>(g)];
        if (its != of_group && its != kVoid && of_group != kVoid && !is_of_stuff(its)) continue;
        const float way = squared(points_.place.row(pair.a), &mean[static_cast<std::size_t>(g * width)], width);
        if (way > most || way > best[i] || (way == best[i] && g >= next[i])) continue;
        best[i] = way;
        next[i] = g;
      }
      bool some = false;
      for (const CellPair& pair : asks) {
        const auto i = static_cast<std::size_t>(pair.a);
        some |= group_[i] != next[i];
        group_[i] = next[i];
      }
      if (!some) break;
      std::erase_if(asks, [&](const CellPair& pair) { return !waits(pair.a); });
    }
  }

  // Sights of a group in a view, and by its segments.
  struct Seen {
    double total = 0;
    std::map<std::int32_t, double> in;
  };
  using Counts = std::map<std::int32_t, Seen>;  // by group
  std::vector<Counts> counts() const {
    std::vector<Counts> all(sights_.size());
    parallel_for(std::ssize(sights_), [&](std::int64_t v) {
      const SegmentSights& view = sights_[static_cast<std::size_t>(v)];
      for (std::size_t i = 0; i < view.point.size(); ++i) {
        const std::int32_t g = group_[static_cast<std::size_t>(view.point[i])];
        if (g < 0) continue;
        Seen& of = all[static_cast<std::size_t>(v)][g];
        of.total += 1;
        of.in[view.segment[i]] += 1;
      }
    });
    return all;
  }

  using Pair = std::pair<std::int32_t, std::int32_t>;
  // A view that sees n_a and n_b of two groups says same = sum_s n_as n_bs / (n_a n_b) with the weight of the smaller.
  static Evidence evidence_of(std::span<const Counts> views, const Pair& pair) {
    Evidence out;
    for (const Counts& view : views) {
      const auto a = view.find(pair.first), b = view.find(pair.second);
      if (a == view.end() || b == view.end()) continue;
      const double weight = std::min(a->second.total, b->second.total);
      if (weight < kLeastSights) continue;
      double same = 0;
      for (const auto& [segment, n] : a->second.in)
        if (const auto also = b->second.in.find(segment); also != b->second.in.end()) same += n * also->second;
      out.weight += weight;
      out.views += 1;
      out.same += weight * same / (a->second.total * b->second.total);
    }
    return out;
  }

  // Of the pairs that touch, or that a view has in one segment.
  std::map<Pair, Evidence> evidence_of_all(std::span<const Counts> views) const {
    std::map<Pair, Evidence> evidence;
    for (const auto& [a, b] : near_) {
      const std::int32_t g = group_[static_cast<std::size_t>(a)], h = group_[static_cast<std::size_t>(b)];
      if (g >= 0 && h >= 0 && g != h) evidence[std::minmax({g, h})];
    }
    for (const Counts& view : views) {
      std::map<std::int32_t, std::vector<std::int32_t>> groups;  // of each segment
      for (const auto& [g, seen] : view) {
        for (const auto& [segment, n] : seen.in) {
          for (const std::int32_t other : groups[segment]) evidence[{other, g}];
          groups[segment].push_back(g);
        }
      }
    }
    std::vector<std::pair<const Pair, Evidence>*> all;
    for (auto& one : evidence) all.push_back(&one);
    parallel_for(std::ssize(all), [&](std::int64_t i) {
      auto& [pair, its] = *all[static_cast<std::size_t>(i)];
      its = evidence_of(views, pair);
    });
    return evidence;
  }

  void join_by_views() {
    std::vector<Counts> views = counts();
    std::map<Pair, Evidence> evidence = evidence_of_all(views);
    touch_by_mean(evidence);
    JoinedSets joined(static_cast<std::size_t>(groups_));
    for (;;) {
      std::erase_if(evidence, [](const auto& e) { return e.second.same == 0; });  // nothing joins those
      const auto best = std::max_element(evidence.begin(), evidence.end(), [&](const auto& a, const auto& b) {
        return score(a.second) < score(b.second);
      });
      if (best == evidence.end() || score(best->second) <= rules_.agree) break;
      const auto [keep, gone] = best->first;
      joined.join(keep, gone);
      for (Counts& view : views) {
        const auto from = view.find(gone);
        if (from == view.end()) continue;
        Seen& to = view[keep];
        to.total += from->second.total;
        for (const auto& [segment, n] : from->second.in) to.in[segment] += n;
        view.erase(from);
      }
      std::set<std::int32_t> others;
      std::erase_if(evidence, [&](const auto& e) {
        const auto [a, b] = e.first;
        const bool of_both = a == keep || a == gone || b == keep || b == gone;
        if (of_both) others.insert(a == keep || a == gone ? b : a);
        return of_both;
      });
      others.erase(keep);
      others.erase(gone);
      for (const std::int32_t other : others) {
        const Pair pair = std::minmax({keep, other});
        evidence[pair] = evidence_of(views, pair);
      }
    }
    for (std::int32_t& g : group_)
      if (g >= 0) g = joined.of(g);
    number();
  }

  double score(const Evidence& e) const { return e.views >= rules_.least_views ? e.share() : 0; }

  // Pairs that no view tells apart, which touch and have one mean, are one for certain.
  void touch_by_mean(std::map<Pair, Evidence>& evidence) const {
    const std::vector<float> mean = means();
    const std::int32_t width = points_.place.cols;
    for (const auto& [a, b] : near_) {
      const std::int32_t g = group_[static_cast<std::size_t>(a)], h = group_[static_cast<std::size_t>(b)];
      if (g < 0 || h < 0 || g == h) continue;
      const Pair pair{std::min(g, h), std::max(g, h)};
      if (const auto found = evidence.find(pair); found != evidence.end() && found->second.views >= rules_.least_views)
        continue;
      const float way =
          squared(&mean[static_cast<std::size_t>(g * width)], &mean[static_cast<std::size_t>(h * width)], width);
      if (static_cast<double>(way) < rules_.reach * rules_.reach)
        evidence[pair] = {1, 1 - 1e-3 * static_cast<double>(way), rules_.least_views};
    }
  }

  void drop_small() {
    std::vector<std::int64_t> size(static_cast<std::size_t>(groups_), 0);
    for (const std::int32_t g : group_)
      if (g >= 0) ++size[static_cast<std::size_t>(g)];
    for (std::int32_t& g : group_)
      if (g >= 0 && size[static_cast<std::size_t>(g)] < rules_.least_points) g = -1;
    number();
  }

  // Groups that lie for the most part in segments that are more of another group are rims of other things.
  void drop_rims() {
    std::vector<double> all(static_cast<std::size_t>(groups_), 0), held(static_cast<std::size_t>(groups_), 0);
    for (const Counts& view : counts()) {
      std::map<std::int32_t, std::pair<double, std::int32_t>> most;  // of a segment: sights, group
      for (const auto& [g, seen] : view) {
        all[static_cast<std::size_t>(g)] += seen.total;
        for (const auto& [segment, n] : seen.in)
          if (auto& of = most[segment]; n > of.first) of = {n, g};
      }
      for (const auto& [segment, of] : most) held[static_cast<std::size_t>(of.second)] += of.first;
    }
    for (std::int32_t& g : group_)
      if (g >= 0 && held[static_cast<std::size_t>(g)] < kHeld * all[static_cast<std::size_t>(g)]) g = -1;
    number();
  }

  static constexpr std::int64_t kBlock = 4096;  // points of a unit of work
  static constexpr std::int32_t kStuff = -2;    // among numbers of clusters
  static constexpr double kDoubt = 0.5;         // views that say nothing, beside those that see a pair
  static constexpr double kOne = 0.8;           // share of a group's sights in one segment, from which it is one thing
  static constexpr double kHeld = 0.4;          // share of its sights in segments that are mostly its own, at least
  static constexpr int kFieldVotes = 1;         // of the views' votes
  static constexpr double kLeastSights = 3;
  static constexpr std::int32_t kLeastPiece = 4;  // points of a group before groups are joined

  PlacedPoints points_;
  std::span<const SegmentSights> sights_;
  ClusterRules rules_;
  std::vector<CellPair> near_;
  std::vector<std::int32_t> group_;
  std::vector<char> is_stuff_;
  std::int32_t groups_ = 0;
  // Of the segments of all views, one behind another.
  std::vector<std::int32_t> first_segment_;  // of a view
  std::vector<char> is_thing_;
  std::vector<std::int32_t> sight_first_, sight_, view_of_;
  std::vector<float> segment_mean_;
};

}  // namespace

std::vector<std::int32_t> cluster_points(const SurfacePool& pool, const PlacedPoints& points,
                                         std::span<const SegmentSights> sights, const ClusterRules& rules) {
  return Clustering(pool, points, sights, rules).run();
}

namespace {

using Mark = Annotations::Mark;

constexpr float kAround = 2;  // cost of ways (SurfaceGraph) that stay on a surface of one colour

// The table without the classes that the events add: a run that has learned from them has those already.
ClassTable classes_before(const ClassTable& classes, const std::vector<LabelEvent>& events) {
  std::set<std::string> added;
  for (const LabelEvent& event : events) {
    if (event.kind == LabelEventKind::add_class) added.insert(event.class_name);
    if (event.kind == LabelEventKind::change_class && event.new_name != event.class_name) added.insert(event.new_name);
  }
  std::vector<ClassEntry> entries = classes.entries();
  std::erase_if(entries, [&](const ClassEntry& entry) { return added.contains(entry.name); });
  return ClassTable(std::move(entries));
}

// Points of the surface under a mark, in every view of its frame.
std::vector<std::int32_t> points_under(const ObjectSurface& surface, const Mark& mark) {
  std::vector<std::int32_t> points;
  for (std::size_t v = 0; v < surface.views.size(); ++v) {
    const PoolView& view = surface.views[v];
    if (view.frame != mark.frame) continue;
    const std::int32_t width = view.map.width_px, stride = view.map.stride;
    for (const PixelRun& run : runs_of(mark, view.camera.camera.width_px, view.camera.camera.height_px)) {
      const std::int32_t row = std::min(run.y / stride, view.map.height_px - 1);
      for (std::int32_t x = run.x0; x < run.x1; ++x) {
        const std::int64_t at = std::int64_t{row} * width + std::min(x / stride, width - 1);
        const std::int32_t point = surface.pool.point_of_pixel[v][static_cast<std::size_t>(at)];
        if (point >= 0 && (points.empty() || points.back() != point)) points.push_back(point);
      }
    }
  }
  return points;
}

// Objects of at least so many points, numbered anew.
void drop_small(ClickedObjects& objects, std::int64_t least) {
  std::vector<std::int64_t> points(objects.class_of.size(), 0);
  for (const std::int32_t id : objects.id)
    if (id > 0) ++points[static_cast<std::size_t>(id) - 1];
  std::vector<std::int32_t> number{0};
  std::vector<std::int16_t> class_of;
  for (std::size_t o = 0; o < points.size(); ++o) {
    if (points[o] >= least) class_of.push_back(objects.class_of[o]);
    number.push_back(points[o] >= least ? static_cast<std::int32_t>(std::ssize(class_of)) : 0);
  }
  for (std::int32_t& id : objects.id) id = number[static_cast<std::size_t>(id)];
  objects.class_of = std::move(class_of);
}

}  // namespace

SegmentSet segments_of_clicks(const std::string& file, const SceneInfo& info, Diagnostics& diagnostics) {
  const std::vector<LabelEvent> events = read_click_log(file, diagnostics);
  SceneInfo before;
  before.frames = info.frames;
  before.classes = classes_before(info.classes, events);
  const Annotations sum = replay(before, 0, events, file);
  SegmentSet set;
  set.from = file;
  set.frames.resize(info.frames.size());
  set.clicks = sum.marks();
  const ClassNames names(info.classes);
  for (Mark& mark : set.clicks)
    if (mark.class_index != kVoid) mark.class_index = names.index_of(sum.classes().valid(mark.class_index).name, file);
  if (set.clicks.empty())
    refuse_labels("labels.clicks.empty", file, "no clicks in it", "click things with `semfield serve`");
  return set;
}

ClickedObjects clicked_objects(const ObjectSurface& surface, const TouchingCells& touching,
                               std::span<const std::int16_t> class_of, const std::vector<bool>& stuff,
                               std::span<const Mark> clicks, std::int64_t least) {
  // Numbers of (class, object) in the graph; 0 is no object's.
  std::map<std::pair<int, std::int32_t>, std::int16_t> number_of;
  std::vector<std::int16_t> numbers;
  std::vector<std::vector<std::int32_t>> under;
  for (const Mark& mark : clicks) {
    under.push_back(points_under(surface, mark));
    const bool is_thing = mark.class_index != kVoid && !stuff[static_cast<std::size_t>(mark.class_index)];
    const auto next = static_cast<std::int16_t>(number_of.size() + 1);
    numbers.push_back(is_thing ? number_of.try_emplace({mark.class_index, mark.object}, next).first->second
                               : std::int16_t{0});
  }
  std::map<std::int32_t, std::int16_t> number_at;  // of clicks at one place the last counts
  for (std::size_t k = 0; k < clicks.size(); ++k)
    for (const std::int32_t point : under[k]) number_at[point] = numbers[k];
  std::vector<GraphSeed> seeds;
  for (const auto& [point, number] : number_at) seeds.push_back({point, number});
  SurfaceGraph graph(surface.pool, {});
  graph.settle(seeds);

  ClickedObjects out;
  out.id.assign(surface.pool.points.size(), 0);
  const auto settled_on = [&](std::int32_t point) {
    return graph.settled()[static_cast<std::size_t>(point)].class_index[0];
  };
  SurfaceGraph::Scratch scratch;
  std::map<std::int16_t, std::int32_t> id_of;  // of numbers whose clicks say which object they mean
  for (std::size_t k = 0; k < clicks.size(); ++k) {
    const std::int16_t number = numbers[k];
    if (number == 0) continue;
    std::set<std::int32_t> named;  // under this click, whatever the field says there
    for (const std::int32_t seed : under[k])
      if (settled_on(seed) == number) named.insert(seed);
    const auto agrees = [&](std::int32_t point) {
      return class_of[static_cast<std::size_t>(point)] == clicks[k].class_index;
    };
    std::set<std::int32_t> met;
    std::vector<SurfaceGraph::Near> near;
    for (const std::int32_t seed : under[k]) {
      if (!named.contains(seed) || out.id[static_cast<std::size_t>(seed)] != 0 || !met.insert(seed).second) continue;
      std::vector<std::int32_t> piece{seed};
      for (std::size_t next = 0; next < piece.size(); ++next) {
        const auto cell = static_cast<std::size_t>(piece[next]);
        for (std::int32_t n = touching.first[cell]; n < touching.first[cell + 1]; ++n) {
          const std::int32_t other = touching.of[static_cast<std::size_t>(n)];
          const bool its = out.id[static_cast<std::size_t>(other)] == 0 && settled_on(other) == number &&
                           (agrees(other) || named.contains(other));
          if (its && met.insert(other).second) piece.push_back(other);
        }
      }
      const bool seen = std::any_of(piece.begin(), piece.end(), agrees);
      const bool is_all =
          std::all_of(under[k].begin(), under[k].end(), [&](std::int32_t p) { return met.contains(p); });
      if (std::ssize(piece) < least && (seen || is_all)) {  // the surface around the click, whatever the field says
        graph.around(seed, kAround, static_cast<std::size_t>(4 * least), scratch, near);
        for (const SurfaceGraph::Near& at : near) {
          const bool its = out.id[static_cast<std::size_t>(at.point)] == 0 && settled_on(at.point) == number;
          if (std::ssize(piece) < least && its && met.insert(at.point).second) piece.push_back(at.point);
        }
      }
      if (std::ssize(piece) < least && !seen) continue;
      const bool known = clicks[k].object != 0 && id_of.contains(number);
      if (!known) out.class_of.push_back(static_cast<std::int16_t>(clicks[k].class_index));
      const std::int32_t object = known ? id_of[number] : static_cast<std::int32_t>(std::ssize(out.class_of));
      id_of[number] = object;
      for (const std::int32_t point : piece) out.id[static_cast<std::size_t>(point)] = object;
    }
  }
  drop_small(out, least);
  for (std::size_t k = 0; k < clicks.size(); ++k) {
    const auto claimed = [&](std::int32_t point) { return out.id[static_cast<std::size_t>(point)] != 0; };
    if (numbers[k] != 0 && std::none_of(under[k].begin(), under[k].end(), claimed)) out.unclaimed.push_back(k);
  }
  return out;
}

}  // namespace semfield
