#include "handover/object_lookup.h"

#include <bit>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>
#include <sstream>
#include <unordered_map>

#include "compute/parallel.h"
#include "core/error.h"
#include "system/files.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

[[noreturn]] void refuse_objects(const std::string& path, const std::string& cause) {
  throw Error(ErrorKind::data, "objects.files.format", "'" + path + "': " + cause, "run `semfield objects` again");
}

std::size_t bytes_of(const std::string& type, const std::string& path) {
  if (type == "double") return 8;
  if (type == "float" || type == "int" || type == "uint") return 4;
  if (type == "uchar") return 1;
  refuse_objects(path, "a property of type '" + type + "'");
}

// Where x, y, z and label of a vertex lie in a binary PLY that this program wrote.
struct VertexLayout {
  std::size_t count = 0, stride = 0, data_at = 0;
  std::map<std::string, std::size_t> at;
};

VertexLayout layout_of(const std::string& bytes, const std::string& path) {
  constexpr std::string_view kEnd = "end_header\n";
  const std::size_t end = bytes.find(kEnd);
  if (bytes.rfind("ply\nformat binary_little_endian 1.0\n", 0) != 0 || end == std::string::npos)
    refuse_objects(path, "not a binary PLY");
  VertexLayout layout;
  layout.data_at = end + kEnd.size();
  std::istringstream lines(bytes.substr(0, end));
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string word, type, name;
    words >> word >> type >> name;
    if (word == "element" && type != "vertex") refuse_objects(path, "an element '" + type + "'");
    if (word == "element") layout.count = std::strtoull(name.c_str(), nullptr, 10);
    if (word != "property") continue;
    layout.at[name] = layout.stride;
    layout.stride += bytes_of(type, path);
  }
  for (const char* name : {"x", "y", "z", "label"})
    if (layout.at.count(name) == 0) refuse_objects(path, std::string("no property '") + name + "'");
  if (layout.count > (bytes.size() - layout.data_at) / layout.stride ||
      layout.count * layout.stride != bytes.size() - layout.data_at)
    refuse_objects(path, "its points do not fill the file");
  return layout;
}

template <class T>
T value_at(const std::string& bytes, std::size_t at) {
  static_assert(std::endian::native == std::endian::little);
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

using CellKey = std::uint64_t;
// 21 bits an axis: neighbours of one another never share a key within a million cells.
CellKey key_at(std::int64_t x, std::int64_t y, std::int64_t z) {
  constexpr std::uint64_t kMask = (std::uint64_t{1} << 21) - 1;
  return (static_cast<std::uint64_t>(x) & kMask) << 42 | (static_cast<std::uint64_t>(y) & kMask) << 21 |
         (static_cast<std::uint64_t>(z) & kMask);
}

}  // namespace

std::optional<ObjectLookup> ObjectLookup::read(const std::string& folder) {
  const std::string table = (fs::path(folder) / "objects.json").string(),
                    points = (fs::path(folder) / "objects.ply").string();
  std::error_code unknown;
  if (!fs::exists(table, unknown) && !fs::exists(points, unknown)) return std::nullopt;
  ObjectLookup out;
  double cell = 0;
  try {
    const auto json = nlohmann::json::parse(read_text_file(table));
    out.step_ = json.at("step").get<std::int64_t>();
    cell = json.at("cell").get<double>();
    for (const auto& row : json.at("objects"))
      out.names_[row.at("id").get<std::int32_t>()] = row.at("class").get<std::string>();
  } catch (const nlohmann::json::exception& e) {
    refuse_objects(table, e.what());
  }
  if (!(cell > 0) || !std::isfinite(cell)) refuse_objects(table, "'cell' is no length");
  out.reach_ = kReach * cell;
  const std::string bytes = read_text_file(points, std::size_t{4} << 30);
  const VertexLayout layout = layout_of(bytes, points);
  for (std::size_t i = 0; i < layout.count; ++i) {
    const std::size_t at = layout.data_at + i * layout.stride;
    Vec3d place;
    int axis = 0;
    for (const char* name : {"x", "y", "z"}) {
      place[axis] = value_at<double>(bytes, at + layout.at.at(name));
      if (!std::isfinite(place[axis++])) refuse_objects(points, "point " + std::to_string(i) + " is not finite");
    }
    const auto id = value_at<std::int32_t>(bytes, at + layout.at.at("label"));
    if (id != 0 && out.names_.count(id) == 0)
      refuse_objects(points, "object " + std::to_string(id) + " is not in objects.json");
    out.places_.push_back(place);
    out.ids_.push_back(id);
  }
  return out;
}

std::vector<std::int32_t> ObjectLookup::ids_of(std::span<const Vec3d> points) const {
  std::unordered_map<CellKey, std::vector<std::uint32_t>> cells;
  const auto cell_of = [&](double x) { return static_cast<std::int64_t>(std::floor(x / reach_)); };
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Vec3d& p = places_[i];
    cells[key_at(cell_of(p.x), cell_of(p.y), cell_of(p.z))].push_back(static_cast<std::uint32_t>(i));
  }
  std::vector<std::int32_t> ids(points.size(), 0);
  parallel_for(static_cast<std::int64_t>(points.size()), [&](std::int64_t n) {
    const Vec3d& p = points[static_cast<std::size_t>(n)];
    double nearest = reach_;
    for (std::int64_t dx = -1; dx <= 1; ++dx)
      for (std::int64_t dy = -1; dy <= 1; ++dy)
        for (std::int64_t dz = -1; dz <= 1; ++dz) {
          const auto found = cells.find(key_at(cell_of(p.x) + dx, cell_of(p.y) + dy, cell_of(p.z) + dz));
          if (found == cells.end()) continue;
          for (const std::uint32_t i : found->second) {
            const double distance = length(places_[i] - p);
            if (distance >= nearest) continue;
            nearest = distance;
            ids[static_cast<std::size_t>(n)] = ids_[i];
          }
        }
  });
  return ids;
}

}  // namespace semfield
