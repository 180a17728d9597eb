#include "objects/object_edits.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <span>

#include "core/error.h"
#include "core/text.h"
#include "objects/object_set.h"
#include "system/files.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

constexpr double kLeastPiece = 0.02;  // of an object's points
constexpr std::size_t kMostName = 80;
constexpr double kFarthest = 1e12;  // of a place from the origin, along an axis

[[noreturn]] void refuse(const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::data, "objects.edit.invalid", message, remedy);
}

std::int32_t id_of(const Json& value, const std::string& where) {
  if (!value.is_number_integer() || value.get<std::int64_t>() < 1 || value.get<std::int64_t>() > 65535)
    refuse(where + ": an object is a number from 1 on", "take the ids of objects.json");
  return value.get<std::int32_t>();
}

Vec3d place_of(const Json& value, const std::string& where) {
  if (!value.is_array() || value.size() != 3 ||
      !std::all_of(value.begin(), value.end(), [](const Json& v) { return v.is_number(); }))
    refuse(where + ": a place is three numbers", "give [x, y, z] in the world of the input");
  const Vec3d place{value[0].get<double>(), value[1].get<double>(), value[2].get<double>()};
  if (!(std::abs(place.x) <= kFarthest && std::abs(place.y) <= kFarthest && std::abs(place.z) <= kFarthest))
    refuse(where + ": a place lies farther away than any scene", "give [x, y, z] in the world of the input");
  return place;
}

template <std::size_t N>
std::array<Vec3d, N> places_of(const Json& value, const std::string& what, const std::string& remedy) {
  if (!value.is_array() || value.size() != N) refuse(what, remedy);
  std::array<Vec3d, N> places;
  for (std::size_t k = 0; k < N; ++k) places[k] = place_of(value[k], what);
  return places;
}

Json json_of_places(std::span<const Vec3d> places) {
  Json out = Json::array();
  for (const Vec3d& p : places) out.push_back({p.x, p.y, p.z});
  return out;
}

ObjectEdit edit_of(const Json& json, const std::string& where) {
  if (!json.is_object() || !json.contains("do") || !json["do"].is_string())
    refuse(where + ": it does not say what to do", "give a map with 'do': rename, merge or split");
  const auto of = [&](const char* key) -> const Json& {
    if (!json.contains(key)) refuse(fmt::format("{}: '{}' is missing", where, key), "give it");
    return json[key];
  };
  ObjectEdit edit;
  const std::string what = json["do"].get<std::string>();
  if (what == "merge") {
    edit.kind = ObjectEdit::Kind::merge;
    const Json& objects = of("objects");
    if (!objects.is_array() || objects.size() < 2) refuse(where + ": 'objects' are two or more", "name them");
    for (const Json& one : objects) edit.objects.push_back(id_of(one, where));
    return edit;
  }
  if (what != "rename" && what != "split")
    refuse(fmt::format("{}: '{}' is nothing to do", where, what), "rename, merge or split");
  edit.objects = {id_of(of("object"), where)};
  if (what == "rename") {
    const Json& name = of("name");
    if (!name.is_string() || name.get<std::string>().size() > kMostName)
      refuse(fmt::format("{}: a name is text of at most {} bytes", where, kMostName), "shorten it");
    edit.name = name.get<std::string>();
    if (!is_line_of_text(edit.name))
      refuse(where + ": a name has no tabs, line breaks or other control characters", "write it as one line of text");
    return edit;
  }
  edit.kind = ObjectEdit::Kind::split;
  if (json.contains("at")) edit.at = places_of<2>(json["at"], where + ": 'at' is two places", "give one of each part");
  if (json.contains("plane"))
    edit.plane = places_of<3>(json["plane"], where + ": 'plane' is three places", "give three that lie on it");
  if (edit.at && edit.plane) refuse(where + ": 'at' and 'plane' part an object in two ways", "give one of them");
  return edit;
}

Json json_of(const ObjectEdit& edit) {
  if (edit.kind == ObjectEdit::Kind::merge) return {{"do", "merge"}, {"objects", edit.objects}};
  if (edit.kind == ObjectEdit::Kind::rename)
    return {{"do", "rename"}, {"object", edit.objects[0]}, {"name", edit.name}};
  Json out{{"do", "split"}, {"object", edit.objects[0]}};
  if (edit.at) out["at"] = json_of_places(*edit.at);
  if (edit.plane) out["plane"] = json_of_places(*edit.plane);
  return out;
}

// One object that is split.
struct Body {
  const ObjectSet& set;
  const TouchingCells& touching;
  std::int32_t object;
  std::vector<std::int32_t> points;
};

// Of every point of the set the part of the object, from 0 on; kNoPart: of none.
using Parts = std::vector<std::int32_t>;
constexpr std::int32_t kNoPart = -1;

// Spreads parts from cell to cell, in the order of the steps from where they begin. The number of points reached.
std::size_t spread(const Body& body, std::vector<std::int32_t> begun, Parts& part_of) {
  for (std::size_t next = 0; next < begun.size(); ++next) {
    const auto cell = static_cast<std::size_t>(begun[next]);
    for (std::int32_t n = body.touching.first[cell]; n < body.touching.first[cell + 1]; ++n) {
      const std::int32_t other = body.touching.of[static_cast<std::size_t>(n)];
      std::int32_t& part = part_of[static_cast<std::size_t>(other)];
      if (part != kNoPart || body.set.id[static_cast<std::size_t>(other)] != body.object) continue;
      part = part_of[cell];
      begun.push_back(other);
    }
  }
  return begun.size();
}

// Pieces that do not touch, the largest as part 0.
Parts pieces_of(const Body& body) {
  Parts part_of(body.set.id.size(), kNoPart);
  std::vector<std::size_t> sizes;
  for (const std::int32_t point : body.points) {
    std::int32_t& part = part_of[static_cast<std::size_t>(point)];
    if (part != kNoPart) continue;
    part = static_cast<std::int32_t>(sizes.size());
    sizes.push_back(spread(body, {point}, part_of));
  }
  std::vector<std::int32_t> order;
  for (std::int32_t k = 0; k < std::ssize(sizes); ++k) order.push_back(k);
  const auto size = [&](std::int32_t k) { return sizes[static_cast<std::size_t>(k)]; };
  std::stable_sort(order.begin(), order.end(), [&](std::int32_t a, std::int32_t b) { return size(a) > size(b); });
  std::vector<std::int32_t> rank(sizes.size(), 0);
  for (std::size_t k = 0; k < order.size(); ++k) {
    const bool stands_alone =
        static_cast<double>(size(order[k])) >= kLeastPiece * static_cast<double>(body.points.size());
    rank[static_cast<std::size_t>(order[k])] = stands_alone ? static_cast<std::int32_t>(k) : 0;
  }
  for (std::int32_t& part : part_of)
    if (part != kNoPart) part = rank[static_cast<std::size_t>(part)];
  return part_of;
}

// The larger of two parts keeps the id.
Parts larger_first(const Body& body, Parts part_of) {
  if (2 * std::count(part_of.begin(), part_of.end(), 1) <= std::ssize(body.points)) return part_of;
  for (std::int32_t& part : part_of)
    if (part != kNoPart) part = 1 - part;
  return part_of;
}

// Two parts by a place of each; what is reached from neither is of the part whose place is nearer.
Parts halves_of(const Body& body, const std::array<Vec3d, 2>& at) {
  Parts part_of(body.set.id.size(), kNoPart);
  std::vector<std::int32_t> begun;
  for (std::int32_t k = 0; k < 2; ++k) {
    const std::int32_t cell = body.set.cells.near(at[static_cast<std::size_t>(k)]);
    if (cell < 0 || body.set.id[static_cast<std::size_t>(cell)] != body.object ||
        part_of[static_cast<std::size_t>(cell)] != kNoPart)
      refuse(fmt::format("object {}: the two places do not lie on it, each on a part of its own", body.object),
             "click two places of the object");
    part_of[static_cast<std::size_t>(cell)] = k;
    begun.push_back(cell);
  }
  spread(body, begun, part_of);
  for (const std::int32_t point : body.points) {
    const auto i = static_cast<std::size_t>(point);
    const auto way = [&](std::size_t k) { return length(body.set.position[i] - at[k]); };
    if (part_of[i] == kNoPart) part_of[i] = way(1) < way(0) ? 1 : 0;
  }
  return larger_first(body, std::move(part_of));
}

// The two sides of a plane.
Parts sides_of(const Body& body, const std::array<Vec3d, 3>& plane) {
  const Vec3d a = plane[1] - plane[0], b = plane[2] - plane[0], normal = cross(a, b);
  if (!(length(normal) > 1e-6 * length(a) * length(b)))
    refuse(fmt::format("object {}: the three places lie on a line, so many planes hold them", body.object),
           "click two points that you see apart");
  Parts part_of(body.set.id.size(), kNoPart);
  for (const std::int32_t point : body.points) {
    const auto i = static_cast<std::size_t>(point);
    part_of[i] = dot(body.set.position[i] - plane[0], normal) < 0 ? 1 : 0;
  }
  return larger_first(body, std::move(part_of));
}

// Edits one after another. Sizes are measured at the end, everything else at once.
class Editing {
 public:
  explicit Editing(ObjectSet& set) : set_(set) {}

  void apply(const ObjectEdit& edit) {
    check_ids(edit.objects);
    switch (edit.kind) {
      case ObjectEdit::Kind::rename:
        row(edit.objects[0]).name = edit.name;
        return;
      case ObjectEdit::Kind::merge:
        return merge(edit.objects);
      case ObjectEdit::Kind::split:
        return split(edit);
    }
  }

  void finish() {
    std::vector<ObjectRow> rows;
    for (const std::int32_t object : changed_) rows.push_back(row(object));
    measure_objects(rows, set_.position, places_of(changed_), set_.cells.edge_m());
    for (const ObjectRow& one : rows) row(one.id) = one;
    changed_.clear();
  }

 private:
  // Of every point the place of its object among `objects`, from 1 on; 0: it is of none of them.
  std::vector<std::int32_t> places_of(const std::set<std::int32_t>& objects) const {
    std::vector<std::int32_t> place(set_.rows.size() + 1, 0), of(set_.id.size());
    std::int32_t last = 0;
    for (const std::int32_t object : objects) place[static_cast<std::size_t>(object)] = ++last;
    for (std::size_t i = 0; i < of.size(); ++i) of[i] = place[static_cast<std::size_t>(set_.id[i])];
    return of;
  }

  // The class of objects is that of most of their points; where no point has one, it stays.
  void vote(const std::set<std::int32_t>& objects) {
    const std::vector<std::int32_t> place = places_of(objects);
    std::vector<std::map<std::int16_t, std::int64_t>> votes(objects.size());
    for (std::size_t i = 0; i < place.size(); ++i)
      if (place[i] > 0 && set_.class_of[i] != kVoid) ++votes[static_cast<std::size_t>(place[i]) - 1][set_.class_of[i]];
    auto of_object = votes.begin();
    for (const std::int32_t object : objects) {
      const std::map<std::int16_t, std::int64_t>& counts = *of_object++;
      if (counts.empty()) continue;
      std::int64_t all = 0;
      for (const auto& [class_index, count] : counts) all += count;
      const auto best = std::max_element(counts.begin(), counts.end(),
                                         [](const auto& a, const auto& b) { return a.second < b.second; });
      row(object).class_index = best->first;
      row(object).class_probability = static_cast<double>(best->second) / static_cast<double>(all);
    }
    changed_.insert(objects.begin(), objects.end());
  }

  ObjectRow& row(std::int32_t id) { return set_.rows[static_cast<std::size_t>(id) - 1]; }

  void check_ids(const std::vector<std::int32_t>& objects) {
    for (auto id = objects.begin(); id != objects.end(); ++id) {
      if (*id < 1 || *id > std::ssize(set_.rows) || row(*id).points == 0)
        refuse(fmt::format("there is no object {}", *id), "take an id of objects.json");
      if (std::find(objects.begin(), id, *id) != id)
        refuse(fmt::format("object {} is named twice", *id), "name it once");
    }
  }

  void merge(const std::vector<std::int32_t>& objects) {
    ObjectRow& kept = row(objects[0]);
    std::int64_t points = 0;
    double agreement = 0;
    for (const std::int32_t id : objects) {
      ObjectRow& one = row(id);
      points += one.points;
      agreement += static_cast<double>(one.points) * one.agreement;
      kept.views = std::max(kept.views, one.views);
      one.points = 0;
    }
    kept.points = points;
    kept.agreement = agreement / static_cast<double>(points);
    for (std::int32_t& id : set_.id)
      if (std::find(objects.begin(), objects.end(), id) != objects.end()) id = objects[0];
    vote({objects.begin(), objects.end()});
  }

  void split(const ObjectEdit& edit) {
    const std::int32_t object = edit.objects[0];
    if (touching_.first.empty()) touching_ = touching_cells(set_.cells);
    Body body{set_, touching_, object, {}};
    for (std::size_t i = 0; i < set_.id.size(); ++i)
      if (set_.id[i] == object) body.points.push_back(static_cast<std::int32_t>(i));
    const Parts part_of = edit.at      ? halves_of(body, *edit.at)
                          : edit.plane ? sides_of(body, *edit.plane)
                                       : pieces_of(body);
    const std::int32_t most = *std::max_element(part_of.begin(), part_of.end());
    if (most == 0)
      refuse(edit.plane ? fmt::format("object {}: all of it lies on one side of the plane", object)
                        : fmt::format("object {}: it has no second piece of a fiftieth of its points", object),
             edit.plane ? "click two points between the parts" : "click a point of each part and split at the points");
    const auto first = static_cast<std::int32_t>(set_.rows.size());
    if (first + most > kMostObjects)
      refuse(fmt::format("object {}: with its parts there are more than {} objects", object, kMostObjects),
             "find fewer objects: raise objects.least_points");
    std::set<std::int32_t> parts{object};
    for (std::int32_t part = 1; part <= most; ++part) {
      ObjectRow one = row(object);
      one.id = first + part;
      one.name.clear();
      one.points = 0;
      parts.insert(one.id);
      set_.rows.push_back(one);
    }
    for (const std::int32_t point : body.points) {
      const std::int32_t part = part_of[static_cast<std::size_t>(point)];
      if (part == 0) continue;
      set_.id[static_cast<std::size_t>(point)] = first + part;
      ++row(first + part).points;
      --row(object).points;
    }
    vote(parts);
  }

  ObjectSet& set_;
  TouchingCells touching_;  // made when an object is split
  std::set<std::int32_t> changed_;
};

}  // namespace

ObjectEdit parse_object_edit(std::string_view json, const std::string& where) {
  const Json root = Json::parse(json, nullptr, false);
  if (root.is_discarded()) refuse(where + ": it is no JSON", "give a map");
  return edit_of(root, where);
}

ObjectEdits read_object_edits(const std::string& path) {
  ObjectEdits out;
  if (!std::filesystem::exists(path)) return out;
  const Json root = Json::parse(read_text_file(path), nullptr, false);
  if (!root.is_object() || !root.contains("objects") || !root["objects"].is_string() || !root.contains("edits") ||
      !root["edits"].is_array())
    refuse(path + ": it is no file of edits", "put an earlier one in its place, or remove it");
  out.digest = root["objects"].get<std::string>();
  for (const Json& one : root["edits"])
    out.edits.push_back(edit_of(one, fmt::format("{}: edit {}", path, out.edits.size() + 1)));
  return out;
}

std::string object_edits_text(const ObjectEdits& edits) {
  std::string lines;
  for (const ObjectEdit& edit : edits.edits)
    lines += (lines.empty() ? "\n  " : ",\n  ") + json_of(edit).dump(-1, ' ', false, Json::error_handler_t::replace);
  return fmt::format("{{\"objects\": {},\n \"edits\": [{}]}}\n",
                     Json(edits.digest).dump(-1, ' ', false, Json::error_handler_t::replace), lines);
}

void write_object_edits(const std::string& path, const ObjectEdits& edits) {
  write_file_atomic(path, object_edits_text(edits));
}

void apply_edit(ObjectSet& set, const ObjectEdit& edit) {
  Editing editing(set);
  editing.apply(edit);
  editing.finish();
}

void apply_edits(ObjectSet& set, const ObjectEdits& edits, const std::string& file) {
  if (edits.edits.empty()) return;
  if (edits.digest != set.digest())
    throw Error(ErrorKind::data, "objects.edits.foreign",
                fmt::format("{}: its {} edits are of other objects than these", file, edits.edits.size()),
                "rename or remove the file, or find the objects again with the same run, segments and settings");
  Editing editing(set);
  for (std::size_t k = 0; k < edits.edits.size(); ++k) {
    try {
      editing.apply(edits.edits[k]);
    } catch (const Error& e) {
      throw Error(e.kind(), e.code(), fmt::format("{}: edit {}: {}", file, k + 1, e.message()),
                  "take this edit and those behind it out of the file");
    }
  }
  editing.finish();
}

EditedObjects read_edited_objects(const std::string& folder, int classes) {
  const std::filesystem::path in(folder);
  const std::string file = (in / "edits.json").string();
  EditedObjects out;
  out.set = read_object_set((in / "found.safetensors").string(), classes);
  out.edits = read_object_edits(file);
  const std::string digest = out.set.digest();
  apply_edits(out.set, out.edits, file);
  out.edits.digest = digest;
  return out;
}

}  // namespace semfield
