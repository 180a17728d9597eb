#include "app/objects/object_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>

#include "formats/image_io.h"
#include "scene/output_names.h"
#include "surface/mesh/mesh_files.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

constexpr std::int32_t kMostObjects = 1024;  // as classes of a PLY file

std::string text(const Json& json, int indent = -1) {
  return json.dump(indent, ' ', false, Json::error_handler_t::replace);
}
Json numbers(Vec3d v) { return {v.x, v.y, v.z}; }

}  // namespace

std::string object_class_name(const ObjectRow& row, const ClassTable& classes) {
  return row.class_index == kVoid || row.class_index >= classes.valid_count() ? "object"
                                                                              : classes.valid(row.class_index).name;
}

ObjectFiles::ObjectFiles(std::string folder, const FoundObjects& found, const SceneInfo& info)
    : folder_(std::move(folder)), found_(found), info_(info) {
  if (std::ssize(found.rows) > kMostObjects)
    throw Error(ErrorKind::data, "objects.count.large",
                fmt::format("{} objects, and files hold {}", found.rows.size(), kMostObjects),
                "raise objects.least_points");
  create_folders(path("instance"));
  create_folders(path("panoptic"));
}

std::string ObjectFiles::path(const std::string& name) const { return (fs::path(folder_) / name).string(); }

std::int32_t ObjectFiles::panoptic_id(std::int32_t object, std::int16_t label) const {
  if (object > 0) return object;
  const bool is_stuff = label != kVoid && found_.stuff[static_cast<std::size_t>(label)];
  return is_stuff ? static_cast<std::int32_t>(found_.rows.size()) + 1 + label : 0;
}

void ObjectFiles::add(const ObjectView& view) {
  const Camera& camera = view.frame.camera;
  const std::string name = output_name(view.frame.name) + ".png";
  std::vector<std::uint16_t> ids(view.id.begin(), view.id.end());
  write_png_gray16(path("instance/" + name), camera.width_px, camera.height_px, ids);
  struct Segment {
    std::int32_t area = 0, x0 = 1 << 30, y0 = 1 << 30, x1 = 0, y1 = 0;
    std::int16_t class_index = kVoid;
  };
  std::map<std::int32_t, Segment> segments;
  std::vector<std::uint8_t> rgb(3 * view.id.size());
  for (std::size_t i = 0; i < view.id.size(); ++i) {
    const std::int16_t label = view.label.empty() ? kVoid : view.label[i];
    const std::int32_t id = panoptic_id(view.id[i], label);
    for (int k = 0; k < 3; ++k) rgb[3 * i + static_cast<std::size_t>(k)] = static_cast<std::uint8_t>(id >> (8 * k));
    if (id == 0) continue;
    Segment& s = segments[id];
    const auto x = static_cast<std::int32_t>(i) % camera.width_px, y = static_cast<std::int32_t>(i) / camera.width_px;
    ++s.area;
    s.x0 = std::min(s.x0, x);
    s.y0 = std::min(s.y0, y);
    s.x1 = std::max(s.x1, x + 1);
    s.y1 = std::max(s.y1, y + 1);
    s.class_index = view.id[i] > 0 ? found_.rows[static_cast<std::size_t>(view.id[i]) - 1].class_index : label;
  }
  write_png_rgb(path("panoptic/" + name), camera.width_px, camera.height_px, rgb);
  const std::size_t number = images_.size() + 1;
  Json infos = Json::array();
  for (const auto& [id, s] : segments) {
    infos.push_back({{"id", id},
                     {"category_id", s.class_index == kVoid ? 0 : info_.classes.id_of(s.class_index)},
                     {"area", s.area},
                     {"bbox", {s.x0, s.y0, s.x1 - s.x0, s.y1 - s.y0}},
                     {"iscrowd", 0}});
  }
  images_.push_back(
      text({{"id", number}, {"file_name", name}, {"width", camera.width_px}, {"height", camera.height_px}}));
  annotations_.push_back(text({{"image_id", number}, {"file_name", name}, {"segments_info", infos}}));
}

std::string ObjectFiles::panoptic_json() const {
  Json categories = Json::array();
  for (int c = 0; c < info_.classes.valid_count(); ++c) {
    const ClassEntry& entry = info_.classes.valid(c);
    categories.push_back({{"id", entry.id},
                          {"name", entry.name},
                          {"isthing", found_.stuff[static_cast<std::size_t>(c)] ? 0 : 1},
                          {"color", entry.color}});
  }
  Json out{{"images", Json::array()}, {"annotations", Json::array()}, {"categories", categories}};
  for (const std::string& one : images_) out["images"].push_back(Json::parse(one));
  for (const std::string& one : annotations_) out["annotations"].push_back(Json::parse(one));
  return text(out, 1) + "\n";
}

std::string ObjectFiles::table_json(const std::string& about) const {
  Json out = Json::parse(about);
  out["unit"] = info_.metric ? "m" : "scene";
  Json& rows = out["objects"] = Json::array();
  for (const ObjectRow& row : found_.rows) {
    rows.push_back({{"id", row.id},
                    {"class", object_class_name(row, info_.classes)},
                    {"class_probability", row.class_probability},
                    {"agreement", row.agreement},
                    {"views", row.views},
                    {"points", row.points},
                    {"area", row.area},
                    {"centroid", numbers(row.centroid)},
                    {"box",
                     {{"center", numbers(row.box.center)},
                      {"axes", {numbers(row.box.axis[0]), numbers(row.box.axis[1]), numbers(row.box.axis[2])}},
                      {"size", numbers(row.box.size)}}}});
  }
  return text(out, 1) + "\n";
}

std::string ObjectFiles::table_csv() const {
  std::string out =
      "id,class,class_probability,agreement,views,points,area,centroid_x,centroid_y,centroid_z,size_0,size_1,size_2\n";
  for (const ObjectRow& row : found_.rows) {
    std::string name = object_class_name(row, info_.classes);
    for (std::size_t at = name.find('"'); at != std::string::npos; at = name.find('"', at + 2)) name.insert(at, 1, '"');
    if (name.find_first_of(",\"\n") != std::string::npos) name = '"' + name + '"';
    out += fmt::format("{},{},{:.4f},{:.4f},{},{},{:.6g},{:.6g},{:.6g},{:.6g},{:.6g},{:.6g},{:.6g}\n", row.id, name,
                       row.class_probability, row.agreement, row.views, row.points, row.area, row.centroid.x,
                       row.centroid.y, row.centroid.z, row.box.size.x, row.box.size.y, row.box.size.z);
  }
  return out;
}

void ObjectFiles::write_points() const {
  PointSet points;
  std::vector<ClassEntry> names{{0, "none", {}, true}};
  for (const ObjectRow& row : found_.rows)
    names.push_back({row.id, fmt::format("{} {}", object_class_name(row, info_.classes), row.id), {}, false});
  const SurfacePool& pool = found_.surface.pool;
  for (std::size_t i = 0; i < pool.points.size(); ++i) {
    const PoolPoint& point = pool.points[i];
    points.positions.push_back(point.position);
    std::array<std::uint8_t, 3> color = ClassTable::default_color(found_.id[i]);
    if (found_.id[i] == 0)  // its own colour, paler
      for (int k = 0; k < 3; ++k)
        color[static_cast<std::size_t>(k)] =
            static_cast<std::uint8_t>(std::clamp(128 + 100 * point.color[k], 0.0, 255.0));
    points.attributes.color.push_back(color);
    points.attributes.label.push_back(static_cast<std::int16_t>(found_.id[i] == 0 ? kVoid : found_.id[i] - 1));
    points.attributes.entropy.push_back(0);
  }
  write_ply(path("objects.ply"), points, ClassTable(std::move(names)));
}

void ObjectFiles::finish(const std::string& about) {
  write_file_atomic(path("panoptic.json"), panoptic_json());
  write_file_atomic(path("objects.csv"), table_csv());
  write_points();
  write_file_atomic(path("objects.json"), table_json(about));
}

}  // namespace semfield::app
