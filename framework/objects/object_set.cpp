#include "objects/object_set.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "core/error.h"
#include "formats/safetensors.h"
#include "objects/object_table.h"
#include "system/checksum.h"

namespace semfield {

namespace {

[[noreturn]] void refuse(const std::string& path, const std::string& what) {
  throw Error(ErrorKind::data, "objects.found.unreadable", path + ": " + what,
              "find the objects again: semfield objects");
}

std::vector<double> doubles(const TensorFile& file, const std::string& name, std::size_t count) {
  const TensorRef* const tensor = file.find(name);
  if (tensor == nullptr || tensor->type != TensorType::f64 || tensor->bytes.size() != count * sizeof(double))
    refuse(file.name(), fmt::format("'{}' has no {} numbers", name, count));
  std::vector<double> out(count);
  std::memcpy(out.data(), tensor->bytes.data(), tensor->bytes.size());
  return out;
}

}  // namespace

std::int32_t ObjectSet::at(Vec3d place) const {
  if (const std::int32_t cell = cells.near(place); cell >= 0) return id[static_cast<std::size_t>(cell)];
  std::int32_t object = 0;
  double nearest = kReach * cells.edge_m();
  for (int k = 0; k < 27; ++k) {  // a mesh need not lie where the points are
    const Vec3d way{k % 3 - 1.0, k / 3 % 3 - 1.0, k / 9 - 1.0};
    const std::int32_t cell = cells.near(place + way * (kReach / 2 * cells.edge_m()));
    if (cell < 0) continue;
    const double distance = length(position[static_cast<std::size_t>(cell)] - place);
    if (distance >= nearest) continue;
    nearest = distance;
    object = id[static_cast<std::size_t>(cell)];
  }
  return object;
}

std::string ObjectSet::digest() const {
  return fmt::format("{:016x}", fnv1a64({reinterpret_cast<const char*>(id.data()), id.size() * sizeof(id[0])}));
}

ObjectSet object_set(const FoundObjects& found, std::string about) {
  ObjectSet set{found.surface.pool.cells, {}, {}, found.id, found.class_of, found.rows, std::move(about)};
  for (const PoolPoint& point : found.surface.pool.points) {
    set.position.push_back(point.position);
    std::array<std::uint8_t, 3>& color = set.color.emplace_back();
    for (int k = 0; k < 3; ++k)
      color[static_cast<std::size_t>(k)] =
          static_cast<std::uint8_t>(std::lround(255 * std::clamp(point.color[k], 0.0, 1.0)));
  }
  return set;
}

void write_object_set(const std::string& path, const ObjectSet& set) {
  const auto points = std::ssize(set.position), rows = std::ssize(set.rows);
  std::vector<double> position, agreement, probability;
  std::vector<std::int64_t> id(set.id.begin(), set.id.end()), class_of(set.class_of.begin(), set.class_of.end());
  std::vector<std::int64_t> views, row_class;
  std::vector<std::uint8_t> color;
  for (const Vec3d& p : set.position) position.insert(position.end(), {p.x, p.y, p.z});
  for (const auto& c : set.color) color.insert(color.end(), c.begin(), c.end());
  for (const ObjectRow& row : set.rows) {
    agreement.push_back(row.agreement);
    probability.push_back(row.class_probability);
    views.push_back(row.views);
    row_class.push_back(row.class_index);
  }
  const std::vector<double> cell{set.cells.edge_m()};
  std::vector<std::int64_t> place;  // not of the positions: the mean of a cell may be rounded onto its border
  for (std::int32_t c = 0; c < set.cells.count(); ++c)
    place.insert(place.end(), set.cells.place(c).begin(), set.cells.place(c).end());
  write_safetensors(
      path,
      {tensor_ref("cell", {1}, cell), tensor_ref("place", {points, 3}, place),
       tensor_ref("position", {points, 3}, position), tensor_ref("color", {points, 3}, color),
       tensor_ref("id", {points}, id), tensor_ref("class", {points}, class_of), tensor_ref("row.views", {rows}, views),
       tensor_ref("row.class", {rows}, row_class), tensor_ref("row.agreement", {rows}, agreement),
       tensor_ref("row.class_probability", {rows}, probability)},
      {{"about", set.about}});
}

ObjectSet read_object_set(const std::string& path) {
  const TensorFile file = TensorFile::read(path);
  const TensorRef *const ids = file.find("id"), *const classes = file.find("row.class"),
                         *const color = file.find("color");
  if (ids == nullptr || classes == nullptr || color == nullptr || ids->shape.size() != 1 || classes->shape.size() != 1)
    refuse(path, "it holds no objects");
  const auto points = static_cast<std::size_t>(ids->shape[0]), rows = static_cast<std::size_t>(classes->shape[0]);
  const double cell = doubles(file, "cell", 1)[0];
  if (!(cell > 0)) refuse(path, "the cells have no size");
  if (color->type != TensorType::u8 || color->bytes.size() != 3 * points)
    refuse(path, "'color' does not fit the points");
  ObjectSet set;
  set.cells = SurfaceCells(cell);
  const std::vector<double> position = doubles(file, "position", 3 * points);
  const std::vector<std::int64_t> place = file.integers("place", 3 * ids->shape[0]),
                                  id = file.integers("id", ids->shape[0]),
                                  class_of = file.integers("class", ids->shape[0]);
  set.color.resize(points);
  if (points > 0) std::memcpy(set.color.data(), color->bytes.data(), color->bytes.size());
  for (std::size_t i = 0; i < points; ++i) {
    set.position.push_back({position[3 * i], position[3 * i + 1], position[3 * i + 2]});
    const auto at = [&](std::size_t k) { return static_cast<std::int32_t>(place[3 * i + k]); };
    if (set.cells.add(SurfaceCell{at(0), at(1), at(2)}) != static_cast<std::int32_t>(i))
      refuse(path, "two points lie in one cell");
    if (id[i] < 0 || id[i] > static_cast<std::int64_t>(rows)) refuse(path, fmt::format("object {} has no row", id[i]));
    set.id.push_back(static_cast<std::int32_t>(id[i]));
    set.class_of.push_back(static_cast<std::int16_t>(class_of[i]));
  }
  const std::vector<double> agreement = doubles(file, "row.agreement", rows);
  const std::vector<double> probability = doubles(file, "row.class_probability", rows);
  const std::vector<std::int64_t> views = file.integers("row.views", classes->shape[0]);
  const std::vector<std::int64_t> row_class = file.integers("row.class", classes->shape[0]);
  set.rows.resize(rows);
  for (std::size_t o = 0; o < rows; ++o) {
    ObjectRow& row = set.rows[o];
    row.id = static_cast<std::int32_t>(o) + 1;
    row.class_index = static_cast<std::int16_t>(row_class[o]);
    row.class_probability = probability[o];
    row.agreement = agreement[o];
    row.views = static_cast<std::int32_t>(views[o]);
  }
  measure_objects(set.rows, set.position, set.id, cell);
  const auto about = file.metadata().find("about");
  if (about != file.metadata().end()) set.about = about->second;
  return set;
}

}  // namespace semfield
