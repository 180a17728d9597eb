#include "objects/click_objects.h"

#include <algorithm>
#include <map>
#include <set>
#include <utility>

#include "labels/clicks/click_log.h"
#include "labels/label_steps.h"
#include "scene/classes/class_names.h"
#include "surface/surface_graph.h"

namespace semfield {

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
