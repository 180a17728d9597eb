#include "app/objects/object_tables.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>

#include "app/json_output.h"
#include "core/error.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "surface/mesh/mesh_files.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield::app {

namespace {

Json numbers(Vec3d v) { return {v.x, v.y, v.z}; }

Json row_json(const ObjectRow& row, const ClassTable& classes) {
  return {{"id", row.id},
          {"name", object_name(row, classes)},
          {"class", object_class_name(row, classes)},
          {"class_probability", row.class_probability},
          {"agreement", row.agreement},
          {"views", row.views},
          {"points", row.points},
          {"area", row.area},
          {"centroid", numbers(row.centroid)},
          {"box",
           {{"center", numbers(row.box.center)},
            {"axes", {numbers(row.box.axis[0]), numbers(row.box.axis[1]), numbers(row.box.axis[2])}},
            {"size", numbers(row.box.size)}}}};
}

std::string table_json(const EditedObjects& objects, const SceneInfo& info) {
  Json out = Json::parse(objects.set.about);
  out["unit"] = info.metric ? "m" : "scene";
  out["edits"] = objects.edits.edits.size();
  out["state"] = objects_state(objects.edits);
  Json& rows = out["objects"] = Json::array();
  for (const ObjectRow& row : objects.set.rows)
    if (row.points > 0) rows.push_back(row_json(row, info.classes));
  return json_text(out, 1) + "\n";
}

std::string table_csv(const ObjectSet& set, const ClassTable& classes) {
  std::string out =
      "id,name,class,class_probability,agreement,views,points,area,centroid_x,centroid_y,centroid_z,size_0,size_1,"
      "size_2\n";
  for (const ObjectRow& row : set.rows) {
    if (row.points == 0) continue;
    out += fmt::format("{},{},{},{:.4f},{:.4f},{},{},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g}\n", row.id,
                       csv_field(object_name(row, classes)), csv_field(object_class_name(row, classes)),
                       row.class_probability, row.agreement, row.views, row.points, row.area, row.centroid.x,
                       row.centroid.y, row.centroid.z, row.box.size.x, row.box.size.y, row.box.size.z);
  }
  return out;
}

void write_points(const std::string& path, const ObjectSet& set, const ClassTable& classes) {
  PointSet points;
  std::vector<ClassEntry> names{{0, "none", {}, true}};
  for (const ObjectRow& row : set.rows) names.push_back({row.id, object_name(row, classes), {}, false});
  for (std::size_t i = 0; i < set.position.size(); ++i) {
    points.positions.push_back(set.position[i]);
    std::array<std::uint8_t, 3> color = ClassTable::default_color(set.id[i]);
    if (set.id[i] == 0)  // its own colour, paler
      for (std::size_t k = 0; k < 3; ++k)
        color[k] = static_cast<std::uint8_t>(std::min(255.0, 128 + 100.0 / 255 * set.color[i][k]));
    points.attributes.color.push_back(color);
    points.attributes.label.push_back(static_cast<std::int16_t>(set.id[i] == 0 ? kVoid : set.id[i] - 1));
    points.attributes.entropy.push_back(0);
  }
  write_ply(path, points, ClassTable(std::move(names)));
}

}  // namespace

std::string object_class_name(const ObjectRow& row, const ClassTable& classes) {
  return row.class_index == kVoid || row.class_index >= classes.valid_count() ? "object"
                                                                              : classes.valid(row.class_index).name;
}

std::string object_name(const ObjectRow& row, const ClassTable& classes) {
  return row.name.empty() ? fmt::format("{} {}", object_class_name(row, classes), row.id) : row.name;
}

std::string object_row_json(const ObjectRow& row, const ClassTable& classes) {
  return json_text(row_json(row, classes));
}

void check_object_count(const std::vector<ObjectRow>& rows) {
  if (std::ssize(rows) > kMostObjects)
    throw Error(ErrorKind::data, "objects.count.large",
                fmt::format("{} objects, and files hold {}", rows.size(), kMostObjects), "raise objects.least_points");
}

std::string objects_state(const ObjectEdits& edits) {
  return fmt::format("{:016x}", fnv1a64(object_edits_text(edits)));
}

void write_object_tables(const std::string& folder, const EditedObjects& objects, const SceneInfo& info) {
  check_object_count(objects.set.rows);
  const std::filesystem::path in(folder);
  write_file_atomic((in / "objects.json").string(), table_json(objects, info));
  write_file_atomic((in / "objects.csv").string(), table_csv(objects.set, info.classes));
  write_points((in / "objects.ply").string(), objects.set, info.classes);
}

std::string tables_state(const std::string& folder, const ObjectEdits& edits) {
  const std::filesystem::path in(folder);
  for (const char* name : {"objects.json", "objects.csv", "objects.ply"})
    if (!std::filesystem::is_regular_file(in / name)) return {};
  const Json root = Json::parse(read_text_file((in / "objects.json").string()), nullptr, false);
  if (!root.is_object()) return {};
  const auto state = root.find("state");
  if (state != root.end()) return state->is_string() ? state->get<std::string>() : std::string();
  return edits.edits.empty() ? objects_state(edits) : std::string();
}

std::optional<ObjectSet> objects_of_run(const std::string& run_dir, int classes) {
  const std::filesystem::path folder = std::filesystem::path(run_dir) / "objects";
  if (!std::filesystem::exists(folder / "found.safetensors")) return std::nullopt;
  ObjectSet found = read_edited_objects(folder.string(), classes).set;
  if (found.rows.empty()) return std::nullopt;
  return found;
}

namespace {

using Color = std::array<std::uint8_t, 3>;

constexpr Color kNothing{72, 72, 72};
constexpr std::int32_t kGap_px = 4;
constexpr std::int32_t kOwnColor = 65536;  // behind the numbers of true objects

// 0 is no object.
Color color_of(std::int32_t id) { return id == 0 ? kNothing : ClassTable::default_color(id); }

// The true object that shares most pixels with each found one; one that shares none keeps a number of its own.
std::map<std::int32_t, std::int32_t> true_objects(std::span<const std::int32_t> found,
                                                  std::span<const std::int32_t> truth) {
  std::map<std::int32_t, std::map<std::int32_t, std::int64_t>> shared;
  for (std::size_t i = 0; i < found.size(); ++i)
    if (found[i] != 0) shared[found[i]][truth[i]] += truth[i] != 0 ? 1 : 0;
  std::map<std::int32_t, std::int32_t> out{{0, 0}};
  for (const auto& [id, of_truth] : shared) {
    const auto best = std::max_element(of_truth.begin(), of_truth.end(),
                                       [](const auto& a, const auto& b) { return a.second < b.second; });
    out[id] = best->second > 0 ? best->first : kOwnColor + id;
  }
  return out;
}

}  // namespace

void write_object_strip(const std::string& path, const StoredFrame& frame, const FrameSegments& given,
                        std::span<const std::int32_t> id, const std::vector<bool>& stuff) {
  const std::int32_t width = frame.width_px, height = frame.height_px;
  const std::vector<std::int16_t> label = frame.label.expand();
  std::vector<std::int32_t> truth(label.size());
  for (std::size_t i = 0; i < label.size(); ++i)
    truth[i] = label[i] == kVoid || stuff[static_cast<std::size_t>(label[i])] ? 0 : frame.instance[i];
  const std::map<std::int32_t, std::int32_t> true_object = true_objects(id, truth);
  const std::int32_t panels = given.empty() ? 3 : 4, all = panels * width + (panels - 1) * kGap_px;
  std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * std::int64_t{all} * height), 255);
  for (std::int32_t y = 0; y < height; ++y) {
    for (std::int32_t x = 0; x < width; ++x) {
      const auto i = static_cast<std::size_t>(std::int64_t{y} * width + x);
      std::int32_t panel = 0;
      const auto put = [&](const Color& color) {
        const std::int64_t at = std::int64_t{y} * all + panel++ * (width + kGap_px) + x;
        std::copy(color.begin(), color.end(), rgb.begin() + 3 * at);
      };
      put({frame.rgb[3 * i], frame.rgb[3 * i + 1], frame.rgb[3 * i + 2]});
      if (!given.empty()) put(color_of(given.at(x, y, width, height)));
      put(color_of(true_object.at(id[i])));
      put(color_of(truth[i]));
    }
  }
  write_png_rgb(path, all, height, rgb);
}

}  // namespace semfield::app
