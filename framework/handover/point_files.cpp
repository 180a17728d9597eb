// LAS 1.4 [ASPRS19]: a header, three variable length records, and points of format 7 with extra bytes.
#include "handover/point_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "surface/mesh/mesh_files.h"

namespace semfield {

namespace {

constexpr std::uint16_t kHeaderBytes = 375, kRecordHeaderBytes = 54, kExtraBytesEntry = 192;
constexpr std::uint16_t kPointBytes = 36;                       // of format 7
constexpr std::uint8_t kUint16 = 3, kUint32 = 5, kFloat32 = 9;  // data types of extra bytes
constexpr std::uint16_t kClassNames = 256 * 16;

struct LasLayout {
  std::vector<std::pair<const char*, std::uint8_t>> extra;
  std::uint16_t point_bytes = kPointBytes;
  double step = 1e-6;
  Vec3d offset;
  Box box;
};

LasLayout las_layout(const PointSet& points) {
  LasLayout layout;
  layout.extra.reserve(3);
  if (points.attributes.has_labels()) layout.extra = {{"label", kUint16}, {"entropy", kFloat32}};
  if (points.attributes.has_instances()) layout.extra.emplace_back("instance", kUint32);
  for (const auto& [name, type] : layout.extra)
    layout.point_bytes = static_cast<std::uint16_t>(layout.point_bytes + (type == kUint16 ? 2 : 4));
  layout.box = box_around(points.positions);
  if (layout.box.empty()) layout.box = {{}, {}};
  // At most ten million steps a side, which 32 bits hold many times over.
  const double whole = decade(layout.box);
  layout.step = 1e-6 * whole;
  for (int axis = 0; axis < 3; ++axis)
    layout.offset[axis] = whole * std::round(layout.box.center()[axis] / whole) + 0.0;
  return layout;
}

void text_of(BufferedFile& file, std::string_view words, std::size_t bytes) {
  std::string field(words.substr(0, bytes));
  field.resize(bytes, '\0');
  file.text(field);
}

void write_record(BufferedFile& file, std::uint16_t id, std::uint16_t bytes, const char* describes) {
  file.value(std::uint16_t{0});
  text_of(file, "LASF_Spec", 16);
  file.value(id);
  file.value(bytes);
  text_of(file, describes, 32);
}

void write_header(BufferedFile& file, const LasLayout& layout, std::size_t count, std::uint32_t records,
                  std::uint32_t data_at) {
  constexpr std::uint16_t kWellKnownText = 16;  // asked of formats from 6 on, whether there is a text or not
  file.text("LASF");
  file.value(std::uint16_t{0});
  file.value(kWellKnownText);
  file.text(std::string(16, '\0'));
  file.value(std::uint8_t{1});
  file.value(std::uint8_t{4});
  text_of(file, "OTHER", 32);
  text_of(file, "Semfield", 32);
  file.value(std::uint16_t{0});  // no day: equal points give equal files
  file.value(std::uint16_t{0});
  file.value(kHeaderBytes);
  file.value(data_at);
  file.value(records);
  file.value(std::uint8_t{7});
  file.value(layout.point_bytes);
  for (int k = 0; k < 6; ++k) file.value(std::uint32_t{0});  // counts of earlier versions
  for (int k = 0; k < 3; ++k) file.value(layout.step);
  for (int axis = 0; axis < 3; ++axis) file.value(layout.offset[axis]);
  for (int axis = 0; axis < 3; ++axis) {
    file.value(layout.box.hi[axis]);
    file.value(layout.box.lo[axis]);
  }
  file.value(std::uint64_t{0});  // no waveforms
  file.value(std::uint64_t{0});  // no records behind the points
  file.value(std::uint32_t{0});
  file.value(static_cast<std::uint64_t>(count));
  file.value(static_cast<std::uint64_t>(count));  // all of them first returns
  for (int k = 1; k < 15; ++k) file.value(std::uint64_t{0});
}

void write_extra_bytes(BufferedFile& file, const LasLayout& layout) {
  write_record(file, 4, static_cast<std::uint16_t>(kExtraBytesEntry * layout.extra.size()), "extra bytes");
  for (const auto& [name, type] : layout.extra) {
    file.value(std::uint16_t{0});
    file.value(type);
    file.value(std::uint8_t{0});
    text_of(file, name, 32);
    file.text(std::string(kExtraBytesEntry - 36 - 32, '\0'));
    text_of(file, std::string(name) == "entropy" ? "nats" : "id; 0 = none", 32);
  }
}

std::uint8_t classification(std::int32_t id) { return static_cast<std::uint8_t>(std::min(id, 255)); }

void write_class_names(BufferedFile& file, const ClassTable& classes) {
  write_record(file, 0, kClassNames, "classification lookup");
  std::array<std::string, 256> names;
  for (const ClassEntry& entry : classes.entries())
    if (entry.id < 255) names[static_cast<std::size_t>(entry.id)] = entry.name;
  for (std::size_t id = 0; id < names.size(); ++id) {
    file.value(static_cast<std::uint8_t>(id));
    text_of(file, names[id], 15);
  }
}

}  // namespace

Vec3d write_las(const std::string& path, const PointSet& points, const ClassTable& classes) {
  const LasLayout layout = las_layout(points);
  const PointAttributes& known = points.attributes;
  const std::uint32_t records = known.has_labels() ? 2 : layout.extra.empty() ? 0 : 1;
  std::size_t data_at = kHeaderBytes;
  if (!layout.extra.empty()) data_at += kRecordHeaderBytes + kExtraBytesEntry * layout.extra.size();
  if (known.has_labels()) data_at += kRecordHeaderBytes + std::size_t{kClassNames};
  BufferedFile file(path);
  write_header(file, layout, points.positions.size(), records, static_cast<std::uint32_t>(data_at));
  if (!layout.extra.empty()) write_extra_bytes(file, layout);
  if (known.has_labels()) write_class_names(file, classes);
  for (std::size_t i = 0; i < points.positions.size(); ++i) {
    for (int axis = 0; axis < 3; ++axis)
      file.value(
          static_cast<std::int32_t>(std::llround((points.positions[i][axis] - layout.offset[axis]) / layout.step)));
    file.value(std::uint16_t{0});    // intensity
    file.value(std::uint8_t{0x11});  // the first of one return
    file.value(std::uint8_t{0});     // flags
    const std::int32_t id = known.has_labels() ? classes.id_of(known.label[i]) : 0;
    file.value(classification(id));
    file.value(std::uint8_t{0});   // user data
    file.value(std::int16_t{0});   // scan angle
    file.value(std::uint16_t{0});  // point source
    file.value(0.0);               // time
    for (const std::uint8_t c : known.color[i]) file.value(static_cast<std::uint16_t>(257 * c));
    if (known.has_labels()) {
      file.value(static_cast<std::uint16_t>(id));
      file.value(known.entropy[i]);
    }
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
  return layout.offset;
}

// PCD, the format of the Point Cloud Library.

void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset) {
  const PointAttributes& known = points.attributes;
  std::string names = "x y z", kinds = "F F F";
  const auto add = [&](const char* name, const char* kind) {
    names += std::string(" ") + name;
    kinds += std::string(" ") + kind;
  };
  const bool normals = !points.normals.empty();
  if (normals)
    for (const char* name : {"normal_x", "normal_y", "normal_z"}) add(name, "F");
  add("rgb", "U");
  if (known.has_labels()) {
    add("label", "U");
    add("entropy", "F");
  }
  if (known.has_instances()) add("instance", "U");
  std::string sizes, counts;
  for (const char c : kinds)
    if (c == ' ') {
      sizes += "4 ";
      counts += "1 ";
    }
  const std::size_t count = points.positions.size();
  BufferedFile file(path);
  file.text(
      fmt::format("# .PCD v0.7 - world frame of the input less {:.17g} {:.17g} {:.17g}\n"
                  "VERSION 0.7\nFIELDS {}\nSIZE {}4\nTYPE {}\nCOUNT {}1\nWIDTH {}\nHEIGHT 1\n"
                  "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA binary\n",
                  offset.x, offset.y, offset.z, names, sizes, kinds, counts, count, count));
  for (std::size_t i = 0; i < count; ++i) {
    for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(points.positions[i][axis] - offset[axis]));
    for (int axis = 0; axis < 3 && normals; ++axis) file.value(static_cast<float>(points.normals[i][axis]));
    const auto& c = known.color[i];
    file.value(std::uint32_t{c[0]} << 16 | std::uint32_t{c[1]} << 8 | std::uint32_t{c[2]});
    if (known.has_labels()) {
      file.value(static_cast<std::uint32_t>(classes.id_of(known.label[i])));
      file.value(known.entropy[i]);
    }
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
}

std::string sidecar_json(const Sidecar& sidecar) {
  using Json = nlohmann::ordered_json;
  Json world{{"unit", sidecar.metric ? "m" : "scene"},
             {"axes", "those of the input"},
             {"pose_scale", sidecar.convention.pose_scale},
             {"poses_inverted", sidecar.convention.invert_poses},
             {"camera_axes_flipped", sidecar.convention.flip_camera_axes}};
  if (sidecar.up) world["up"] = {sidecar.up->x, sidecar.up->y, sidecar.up->z};
  Json out{{"format", "semfield-handover-1"},
           {"run", sidecar.run},
           {"scene", sidecar.scene},
           {"step", sidecar.step},
           {"world", world},
           {"files", Json::array()}};
  for (const HandedFile& file : sidecar.files) {
    Json& row = out["files"].emplace_back();
    row = {{"file", std::filesystem::path(file.path).filename().string()},
           {"holds", file.holds},
           {"offset", {file.offset.x, file.offset.y, file.offset.z}}};
    if (file.edge) row["edge"] = *file.edge;
  }
  if (sidecar.classes != nullptr) {
    out["classes"] = Json::array();
    for (const ClassEntry& entry : sidecar.classes->entries())
      out["classes"].push_back(
          {{"id", entry.id}, {"name", entry.name}, {"color", entry.color}, {"ignore", entry.ignore}});
  }
  for (const auto& [id, name] : sidecar.objects) out["objects"].push_back({{"id", id}, {"name", name}});
  return out.dump(1, ' ', false, Json::error_handler_t::replace) + "\n";
}

}  // namespace semfield
