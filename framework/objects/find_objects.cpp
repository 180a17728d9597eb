#include "objects/find_objects.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <map>

#include "compute/parallel.h"
#include "execution/point_network.h"
#include "objects/click_objects.h"
#include "objects/clusters.h"
#include "objects/object_table.h"

namespace semfield {

namespace {

constexpr std::int64_t kLeastSights = 4;  // of a segment in the map of a view

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

std::vector<bool> stuff_classes(const ClassTable& classes, const std::vector<std::string>& names) {
  std::vector<bool> stuff(static_cast<std::size_t>(classes.valid_count()), false);
  for (int c = 0; c < classes.valid_count(); ++c)
    stuff[static_cast<std::size_t>(c)] = std::find(names.begin(), names.end(), classes.valid(c).name) != names.end();
  return stuff;
}

}  // namespace

TouchingCells touching_cells(const SurfaceCells& cells) {
  const std::vector<CellPair> pairs = cells.neighbours();
  TouchingCells out;
  out.first.assign(static_cast<std::size_t>(cells.count()) + 1, 0);
  for (std::int32_t c = 0; c < cells.count(); ++c) ++out.first[static_cast<std::size_t>(c) + 1];
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
  found.stuff = stuff_classes(session.scene.info.classes, params.stuff);
  std::vector<PoolView> views = object_views(session, params.rays, say("seen"));
  clock.part("rendering");
  found.surface = object_surface(std::move(views), session.limits, params.points);
  const SurfacePool& pool = found.surface.pool;
  found.touching = touching_cells(pool.cells);
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : pool.points) positions.push_back(point.position);
  clock.part("surface");
  std::vector<SegmentSights> sights = segment_sights(found.surface, segments, kLeastSights);
  const PointClasses classes = classes_of_points(session, positions, sights);
  found.class_of = classes.most_probable();
  ClickedObjects told;
  if (clicked) {
    told = clicked_objects(found.surface, found.touching, found.class_of, found.stuff, segments.clicks, kLeastClicked);
    found.id = told.id;
    found.unclaimed = told.unclaimed;
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
  std::unique_ptr<bool[]> stuff(new bool[positions.size()]);
  for (std::size_t i = 0; i < positions.size(); ++i)
    stuff[i] = found.class_of[i] != kVoid && found.stuff[static_cast<std::size_t>(found.class_of[i])];
  const ClusterRules rules{params.reach, params.neighbours, params.agree, static_cast<double>(params.least_views),
                           params.least_points};
  if (!clicked) {
    found.id = cluster_points(pool, {place, {stuff.get(), positions.size()}}, sights, rules);
    for (std::int32_t& id : found.id) ++id;
  }
  found.rows = object_table(found.surface, found.id, sights, classes);
  for (std::size_t k = 0; k < told.class_of.size(); ++k) found.rows[k].class_index = told.class_of[k];
  clock.part("groups");
  return found;
}

namespace {

constexpr double kWayWeight = 0.25;  // of a cell's distance, beside that of places

}  // namespace

std::vector<std::int32_t> object_ids(Session& session, FoundObjects& objects, const RayCamera& camera,
                                     std::span<const std::int16_t> label) {
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

}  // namespace semfield
