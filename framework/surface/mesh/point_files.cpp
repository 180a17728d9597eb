#include "surface/mesh/point_files.h"

#include <fmt/format.h>

#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>

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
  file.values(id, bytes);
  text_of(file, describes, 32);
}

void write_header(BufferedFile& file, const LasLayout& layout, std::size_t count, std::uint32_t records,
                  std::uint32_t data_at) {
  constexpr std::uint16_t kWellKnownText = 16;  // asked of formats from 6 on, whether there is a text or not
  constexpr std::uint16_t kNoDay = 0;           // equal points give equal files
  constexpr std::array<std::uint32_t, 6> kEarlierCounts{};
  constexpr std::array<std::uint64_t, 14> kLaterReturns{};
  constexpr std::uint64_t kNoWaveforms = 0, kNoRecordsBehind = 0;
  file.text("LASF");
  file.values(std::uint16_t{0}, kWellKnownText);
  file.text(std::string(16, '\0'));
  file.values(std::uint8_t{1}, std::uint8_t{4});
  text_of(file, "OTHER", 32);
  text_of(file, "Semfield", 32);
  file.values(kNoDay, kNoDay, kHeaderBytes, data_at, records, std::uint8_t{7}, layout.point_bytes, kEarlierCounts);
  file.values(layout.step, layout.step, layout.step, layout.offset.x, layout.offset.y, layout.offset.z);
  for (int axis = 0; axis < 3; ++axis) file.values(layout.box.hi[axis], layout.box.lo[axis]);
  file.values(kNoWaveforms, kNoRecordsBehind, std::uint32_t{0}, std::uint64_t{count}, std::uint64_t{count},
              kLaterReturns);
}

void write_extra_bytes(BufferedFile& file, const LasLayout& layout) {
  write_record(file, 4, static_cast<std::uint16_t>(kExtraBytesEntry * layout.extra.size()), "extra bytes");
  for (const auto& [name, type] : layout.extra) {
    file.values(std::uint16_t{0}, type, std::uint8_t{0});
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
    const std::int32_t id = known.has_labels() ? classes.id_of(known.label[i]) : 0;
    constexpr std::uint16_t kNoIntensity = 0, kNoSource = 0;
    constexpr std::uint8_t kFirstOfOne = 0x11, kNoFlags = 0, kNoUserData = 0;
    constexpr std::int16_t kNoAngle = 0;
    file.values(kNoIntensity, kFirstOfOne, kNoFlags, classification(id), kNoUserData, kNoAngle, kNoSource, 0.0);
    for (const std::uint8_t c : known.color[i]) file.value(static_cast<std::uint16_t>(257 * c));
    if (known.has_labels()) file.values(static_cast<std::uint16_t>(id), known.entropy[i]);
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
  return layout.offset;
}

// PCD, the format of the Point Cloud Library.

void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset) {
  const PointAttributes& known = points.attributes;
  const bool normals = !points.normals.empty();
  std::vector<std::pair<const char*, const char*>> columns{{"x", "F"}, {"y", "F"}, {"z", "F"}};
  if (normals) columns.insert(columns.end(), {{"normal_x", "F"}, {"normal_y", "F"}, {"normal_z", "F"}});
  columns.emplace_back("rgb", "U");
  if (known.has_labels()) columns.insert(columns.end(), {{"label", "U"}, {"entropy", "F"}});
  if (known.has_instances()) columns.emplace_back("instance", "U");
  std::string names, sizes, kinds, counts;
  for (const auto& [name, kind] : columns) {
    names += std::string(" ") + name;
    sizes += " 4";
    kinds += std::string(" ") + kind;
    counts += " 1";
  }
  const std::size_t count = points.positions.size();
  BufferedFile file(path);
  file.text(
      fmt::format("# .PCD v0.7 - world frame of the input less {:.17g} {:.17g} {:.17g}\n"
                  "VERSION 0.7\nFIELDS{}\nSIZE{}\nTYPE{}\nCOUNT{}\nWIDTH {}\nHEIGHT 1\n"
                  "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA binary\n",
                  offset.x, offset.y, offset.z, names, sizes, kinds, counts, count, count));
  for (std::size_t i = 0; i < count; ++i) {
    file.floats(points.positions[i] - offset);
    if (normals) file.floats(points.normals[i]);
    const auto& c = known.color[i];
    file.value(std::uint32_t{c[0]} << 16 | std::uint32_t{c[1]} << 8 | std::uint32_t{c[2]});
    if (known.has_labels()) file.values(static_cast<std::uint32_t>(classes.id_of(known.label[i])), known.entropy[i]);
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
}

std::string sidecar_json(const Sidecar& sidecar) {
  using OrderedJson = nlohmann::ordered_json;
  OrderedJson world{{"unit", sidecar.metric ? "m" : "scene"},
                    {"axes", "those of the input"},
                    {"pose_scale", sidecar.convention.pose_scale},
                    {"poses_inverted", sidecar.convention.invert_poses},
                    {"camera_axes_flipped", sidecar.convention.flip_camera_axes}};
  if (sidecar.up) world["up"] = {sidecar.up->x, sidecar.up->y, sidecar.up->z};
  OrderedJson out{{"format", "semfield-handover-1"},
                  {"run", sidecar.run},
                  {"scene", sidecar.scene},
                  {"step", sidecar.step},
                  {"world", world},
                  {"files", OrderedJson::array()}};
  for (const HandedFile& file : sidecar.files) {
    OrderedJson& row = out["files"].emplace_back();
    row = {{"file", std::filesystem::path(file.path).filename().string()},
           {"holds", file.holds},
           {"offset", {file.offset.x, file.offset.y, file.offset.z}}};
    if (file.edge) row["edge"] = *file.edge;
  }
  if (sidecar.classes != nullptr) {
    out["classes"] = OrderedJson::array();
    for (const ClassEntry& entry : sidecar.classes->entries())
      out["classes"].push_back(
          {{"id", entry.id}, {"name", entry.name}, {"color", entry.color}, {"ignore", entry.ignore}});
  }
  for (const auto& [id, name] : sidecar.objects) out["objects"].push_back({{"id", id}, {"name", name}});
  return out.dump(1, ' ', false, OrderedJson::error_handler_t::replace) + "\n";
}

}  // namespace semfield
