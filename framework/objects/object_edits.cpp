#include "objects/object_edits.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <span>

#include "core/error.h"
#include "core/text.h"
#include "objects/object_table.h"
#include "system/files.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

constexpr double kLeastPiece = 0.02;  // of an object's points
constexpr std::size_t kMostName = 80;

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
  return {value[0].get<double>(), value[1].get<double>(), value[2].get<double>()};
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

// Points of one object, and which of them touch.
struct Body {
  std::vector<std::size_t> points;
  std::map<std::int32_t, std::vector<std::int32_t>> touching;  // by cell
};

Body body_of(const ObjectSet& set, std::int32_t object) {
  Body body;
  for (std::size_t i = 0; i < set.id.size(); ++i)
    if (set.id[i] == object) body.points.push_back(i);
  for (const CellPair& pair : set.cells.neighbours()) {
    if (set.id[static_cast<std::size_t>(pair.a)] != object || set.id[static_cast<std::size_t>(pair.b)] != object)
      continue;
    body.touching[pair.a].push_back(pair.b);
    body.touching[pair.b].push_back(pair.a);
  }
  return body;
}

// Spreads parts from cell to cell, in the order of the steps from where they begin; `part_of` by cell.
void spread(const Body& body, std::vector<std::int32_t> begun, std::map<std::int32_t, int>& part_of) {
  for (std::size_t next = 0; next < begun.size(); ++next) {
    const auto near = body.touching.find(begun[next]);
    if (near == body.touching.end()) continue;
    for (const std::int32_t other : near->second)
      if (part_of.emplace(other, part_of.at(begun[next])).second) begun.push_back(other);
  }
}

// Pieces that do not touch, the largest as part 0.
std::map<std::int32_t, int> pieces_of(const Body& body) {
  std::map<std::int32_t, int> part_of;
  std::vector<std::size_t> sizes;
  for (const std::size_t point : body.points) {
    const auto cell = static_cast<std::int32_t>(point);
    const std::size_t before = part_of.size();
    if (!part_of.emplace(cell, static_cast<int>(sizes.size())).second) continue;
    spread(body, {cell}, part_of);
    sizes.push_back(part_of.size() - before);
  }
  std::vector<int> order;
  for (int k = 0; k < static_cast<int>(sizes.size()); ++k) order.push_back(k);
  const auto size = [&](int k) { return sizes[static_cast<std::size_t>(k)]; };
  std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return size(a) > size(b); });
  std::vector<int> rank(sizes.size(), 0);
  for (std::size_t k = 0; k < order.size(); ++k) {
    const bool stands_alone =
        static_cast<double>(size(order[k])) >= kLeastPiece * static_cast<double>(body.points.size());
    rank[static_cast<std::size_t>(order[k])] = stands_alone ? static_cast<int>(k) : 0;
  }
  for (auto& [cell, part] : part_of) part = rank[static_cast<std::size_t>(part)];
  return part_of;
}

// The larger of two parts keeps the id.
void larger_first(std::map<std::int32_t, int>& part_of) {
  const auto ones = std::count_if(part_of.begin(), part_of.end(), [](const auto& one) { return one.second == 1; });
  if (2 * ones <= std::ssize(part_of)) return;
  for (auto& [cell, part] : part_of) part = 1 - part;
}

// Two parts by a place of each; what is reached from neither is of the part whose place is nearer.
std::map<std::int32_t, int> halves_of(const ObjectSet& set, const Body& body, std::int32_t object,
                                      const std::array<Vec3d, 2>& at) {
  std::map<std::int32_t, int> part_of;
  std::vector<std::int32_t> begun;
  for (int k = 0; k < 2; ++k) {
    const std::int32_t cell = set.cells.near(at[static_cast<std::size_t>(k)]);
    if (cell < 0 || set.id[static_cast<std::size_t>(cell)] != object || !part_of.emplace(cell, k).second)
      refuse(fmt::format("object {}: the two places do not lie on it, each on a part of its own", object),
             "click two places of the object");
    begun.push_back(cell);
  }
  spread(body, begun, part_of);
  for (const std::size_t point : body.points) {
    const auto way = [&](int k) { return length(set.position[point] - at[static_cast<std::size_t>(k)]); };
    part_of.emplace(static_cast<std::int32_t>(point), way(1) < way(0) ? 1 : 0);
  }
  larger_first(part_of);
  return part_of;
}

// The two sides of a plane.
std::map<std::int32_t, int> sides_of(const ObjectSet& set, const Body& body, std::int32_t object,
                                     const std::array<Vec3d, 3>& plane) {
  const Vec3d a = plane[1] - plane[0], b = plane[2] - plane[0], normal = cross(a, b);
  if (!(length(normal) > 1e-6 * length(a) * length(b)))
    refuse(fmt::format("object {}: the three places lie on a line, so many planes hold them", object),
           "click two points that you see apart");
  std::map<std::int32_t, int> part_of;
  for (const std::size_t point : body.points)
    part_of[static_cast<std::int32_t>(point)] = dot(set.position[point] - plane[0], normal) < 0 ? 1 : 0;
  larger_first(part_of);
  return part_of;
}

// Class and size of objects, from their points.
void count_anew(ObjectSet& set, const std::vector<std::int32_t>& objects) {
  measure_objects(set.rows, set.position, set.id, set.cells.edge_m());
  for (const std::int32_t object : objects) {
    std::map<std::int16_t, std::int64_t> votes;
    std::int64_t all = 0;
    for (std::size_t i = 0; i < set.id.size(); ++i) {
      if (set.id[i] != object || set.class_of[i] == kVoid) continue;
      ++votes[set.class_of[i]];
      ++all;
    }
    if (all == 0) continue;
    const auto best =
        std::max_element(votes.begin(), votes.end(), [](const auto& a, const auto& b) { return a.second < b.second; });
    ObjectRow& row = set.rows[static_cast<std::size_t>(object) - 1];
    row.class_index = best->first;
    row.class_probability = static_cast<double>(best->second) / static_cast<double>(all);
  }
}

void merge(ObjectSet& set, const std::vector<std::int32_t>& objects) {
  ObjectRow& kept = set.rows[static_cast<std::size_t>(objects[0]) - 1];
  double points = 0, agreement = 0;
  for (const std::int32_t id : objects) {
    ObjectRow& row = set.rows[static_cast<std::size_t>(id) - 1];
    points += static_cast<double>(row.points);
    agreement += static_cast<double>(row.points) * row.agreement;
    kept.views = std::max(kept.views, row.views);
  }
  kept.agreement = agreement / points;
  for (std::int32_t& id : set.id)
    if (std::find(objects.begin(), objects.end(), id) != objects.end()) id = objects[0];
  count_anew(set, {objects[0]});
}

void split(ObjectSet& set, const ObjectEdit& edit) {
  const std::int32_t object = edit.objects[0];
  const Body body = body_of(set, object);
  const std::map<std::int32_t, int> part_of = edit.at      ? halves_of(set, body, object, *edit.at)
                                              : edit.plane ? sides_of(set, body, object, *edit.plane)
                                                           : pieces_of(body);
  int most = 0;
  for (const auto& [cell, part] : part_of) most = std::max(most, part);
  if (most == 0)
    refuse(edit.plane ? fmt::format("object {}: all of it lies on one side of the plane", object)
                      : fmt::format("object {}: it has no second piece of a fiftieth of its points", object),
           edit.plane ? "click two points between the parts" : "click a point of each part and split at the points");
  const auto first = static_cast<std::int32_t>(set.rows.size());
  std::vector<std::int32_t> changed{object};
  for (int part = 1; part <= most; ++part) {
    ObjectRow row = set.rows[static_cast<std::size_t>(object) - 1];
    row.id = first + part;
    row.name.clear();
    changed.push_back(row.id);
    set.rows.push_back(row);
  }
  for (const auto& [cell, part] : part_of)
    if (part > 0) set.id[static_cast<std::size_t>(cell)] = first + part;
  count_anew(set, changed);
}

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

void write_object_edits(const std::string& path, const ObjectEdits& edits) {
  std::string lines;
  for (const ObjectEdit& edit : edits.edits)
    lines += (lines.empty() ? "\n  " : ",\n  ") + json_of(edit).dump(-1, ' ', false, Json::error_handler_t::replace);
  write_file_atomic(path, fmt::format("{{\"objects\": \"{}\",\n \"edits\": [{}]}}\n", edits.digest, lines));
}

void apply_edit(ObjectSet& set, const ObjectEdit& edit) {
  for (std::size_t k = 0; k < edit.objects.size(); ++k) {
    const std::int32_t id = edit.objects[k];
    const bool is_there =
        id >= 1 && id <= std::ssize(set.rows) && set.rows[static_cast<std::size_t>(id) - 1].points > 0;
    if (!is_there) refuse(fmt::format("there is no object {}", id), "take an id of objects.json");
    if (std::find(edit.objects.begin(), edit.objects.begin() + static_cast<std::ptrdiff_t>(k), id) !=
        edit.objects.begin() + static_cast<std::ptrdiff_t>(k))
      refuse(fmt::format("object {} is named twice", id), "name it once");
  }
  switch (edit.kind) {
    case ObjectEdit::Kind::rename:
      set.rows[static_cast<std::size_t>(edit.objects[0]) - 1].name = edit.name;
      return;
    case ObjectEdit::Kind::merge:
      return merge(set, edit.objects);
    case ObjectEdit::Kind::split:
      return split(set, edit);
  }
}

void apply_edits(ObjectSet& set, const ObjectEdits& edits, const std::string& file) {
  if (edits.edits.empty()) return;
  if (edits.digest != set.digest())
    throw Error(ErrorKind::data, "objects.edits.foreign",
                fmt::format("{}: its {} edits are of other objects than these", file, edits.edits.size()),
                "rename or remove the file, or find the objects again with the same run, segments and settings");
  for (const ObjectEdit& edit : edits.edits) apply_edit(set, edit);
}

EditedObjects read_edited_objects(const std::string& folder) {
  const std::filesystem::path in(folder);
  const std::string file = (in / "edits.json").string();
  EditedObjects out{read_object_set((in / "found.safetensors").string()), read_object_edits(file)};
  const std::string digest = out.set.digest();
  apply_edits(out.set, out.edits, file);
  out.edits.digest = digest;
  return out;
}

}  // namespace semfield
