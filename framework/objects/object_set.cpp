#include "objects/object_set.h"

#include <fmt/format.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <map>
#include <nlohmann/json.hpp>
#include <type_traits>

#include "compute/parallel.h"
#include "core/error.h"
#include "execution/point_network.h"
#include "formats/safetensors.h"
#include "system/checksum.h"

namespace semfield {

namespace {

[[noreturn]] void refuse(const std::string& path, const std::string& what) {
  throw Error(ErrorKind::data, "objects.found.unreadable", path + ": " + what,
              "find the objects again: semfield objects");
}

const TensorRef& tensor_of(const TensorFile& file, const std::string& name, TensorType type, std::size_t count) {
  const TensorRef* const tensor = file.find(name);
  if (tensor == nullptr || tensor->type != type || tensor->bytes.size() != count * tensor_type_bytes(type))
    refuse(file.name(), fmt::format("'{}' has no {} numbers of {}", name, count, tensor_type_name(type)));
  return *tensor;
}

// Numbers of a tensor from `low` to `high`, in the type that holds them.
template <class T, class Stored>
std::vector<T> numbers_of(const TensorFile& file, const std::string& name, std::size_t count, Stored low, Stored high) {
  const TensorType type = std::is_same_v<Stored, double> ? TensorType::f64 : TensorType::i64;
  const TensorRef& tensor = tensor_of(file, name, type, count);
  std::vector<T> out(count);
  for (std::size_t i = 0; i < count; ++i) {
    Stored value = 0;
    std::memcpy(&value, tensor.bytes.data() + i * sizeof value, sizeof value);
    if (!(value >= low && value <= high))
      refuse(file.name(), fmt::format("number {} of '{}' is {}, not from {} to {}", i + 1, name, value, low, high));
    out[i] = static_cast<T>(value);
  }
  return out;
}

std::size_t length_of(const TensorFile& file, const std::string& name, std::int64_t most) {
  const TensorRef* const tensor = file.find(name);
  if (tensor == nullptr || tensor->shape.size() != 1) refuse(file.name(), "it holds no objects");
  if (tensor->shape[0] > most)
    refuse(file.name(), fmt::format("'{}' has {} numbers, more than {}", name, tensor->shape[0], most));
  return static_cast<std::size_t>(tensor->shape[0]);
}

TensorFile open_set(const std::string& path) {
  try {
    return TensorFile::read(path);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data) throw;
    refuse(path, e.message());
  }
}

// What the program reads of it is of the kinds that it wrote.
std::string about_of(const TensorFile& file) {
  const auto found = file.metadata().find("about");
  const nlohmann::json about =
      found == file.metadata().end() ? nlohmann::json() : nlohmann::json::parse(found->second, nullptr, false);
  if (!about.is_object() || (about.contains("step") && !about["step"].is_number_unsigned()))
    refuse(file.name(), "'about' does not tell how the objects were found");
  return found->second;
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

ObjectSet read_object_set(const std::string& path, int classes) {
  constexpr std::int64_t kMostPoints = 1 << 28, kMostCells = 1 << 20;
  const TensorFile file = open_set(path);
  const std::size_t points = length_of(file, "id", kMostPoints), rows = length_of(file, "row.class", kMostObjects);
  const auto most_class = static_cast<std::int64_t>(classes) - 1;
  const double cell = numbers_of<double>(file, "cell", 1, 1e-30, 1e30)[0];
  const auto position = numbers_of<double>(file, "position", 3 * points, -1e30, 1e30);
  const auto place = numbers_of<std::int32_t, std::int64_t>(file, "place", 3 * points, -kMostCells, kMostCells);
  ObjectSet set;
  set.about = about_of(file);
  set.cells = SurfaceCells(cell);
  set.id = numbers_of<std::int32_t, std::int64_t>(file, "id", points, 0, static_cast<std::int64_t>(rows));
  set.class_of = numbers_of<std::int16_t, std::int64_t>(file, "class", points, kVoid, most_class);
  set.color.resize(points);
  const TensorRef color = tensor_of(file, "color", TensorType::u8, 3 * points);
  if (points > 0) std::memcpy(set.color.data(), color.bytes.data(), color.bytes.size());
  for (std::size_t i = 0; i < points; ++i) {
    const Vec3d at{position[3 * i], position[3 * i + 1], position[3 * i + 2]};
    const SurfaceCell in{place[3 * i], place[3 * i + 1], place[3 * i + 2]};
    for (int axis = 0; axis < 3; ++axis)  // a mean may be rounded onto the border
      if (!(std::abs(at[axis] / cell - in[static_cast<std::size_t>(axis)] - 0.5) <= 0.75))
        refuse(path, fmt::format("point {} lies outside its cell", i + 1));
    if (set.cells.add(in) != static_cast<std::int32_t>(i))
      refuse(path, fmt::format("point {} has no cell of its own", i + 1));
    set.position.push_back(at);
  }
  const auto agreement = numbers_of<double>(file, "row.agreement", rows, 0.0, 1 + 1e-6);
  const auto probability = numbers_of<double>(file, "row.class_probability", rows, 0.0, 1 + 1e-6);
  const auto views = numbers_of<std::int32_t, std::int64_t>(file, "row.views", rows, 0, INT32_MAX);
  const auto row_class = numbers_of<std::int16_t, std::int64_t>(file, "row.class", rows, kVoid, most_class);
  set.rows.resize(rows);
  for (std::size_t o = 0; o < rows; ++o) {
    ObjectRow& row = set.rows[o];
    row.id = static_cast<std::int32_t>(o) + 1;
    row.class_index = row_class[o];
    row.class_probability = probability[o];
    row.agreement = agreement[o];
    row.views = views[o];
  }
  measure_objects(set.rows, set.position, set.id, cell);
  return set;
}

std::vector<std::int16_t> PointClasses::most_probable() const {
  const auto width = static_cast<std::size_t>(classes);
  std::vector<std::int16_t> out(width == 0 ? 0 : probability.size() / width, kVoid);
  for (std::size_t i = 0; i < out.size(); ++i) {
    const auto row = probability.begin() + static_cast<std::ptrdiff_t>(i * width);
    const auto best = std::max_element(row, row + static_cast<std::ptrdiff_t>(width));
    if (*best > 0) out[i] = static_cast<std::int16_t>(best - row);
  }
  return out;
}

PointClasses classes_of_points(Session& session, std::span<const Vec3d> positions,
                               std::span<const SegmentSights> sights) {
  PointClasses out;
  out.classes = std::max(1, session.classes());
  const auto width = static_cast<std::size_t>(out.classes);
  out.probability.assign(positions.size() * width, 0);
  if (!session.pipeline->has_semantics()) {
    for (const SegmentSights& view : sights) {
      for (std::size_t i = 0; i < view.point.size(); ++i) {
        const std::int16_t told = view.class_of[static_cast<std::size_t>(view.segment[i])];
        if (told >= 0 && told < out.classes)
          out.probability[static_cast<std::size_t>(view.point[i]) * width + static_cast<std::size_t>(told)] += 1;
      }
    }
    return out;
  }
  const auto logits = static_cast<std::int32_t>(session.plan.class_of_logit.size());
  std::vector<double> at;
  for (const Vec3d& p : positions) at.insert(at.end(), {p.x, p.y, p.z});
  std::vector<float> found(positions.size() * static_cast<std::size_t>(logits));
  PointQuery<float> query;
  query.position = {at.data(), std::ssize(positions), 3};
  query.logits = {found.data(), std::ssize(positions), logits};
  query_points(*session.pipeline, query);
  parallel_for(std::ssize(positions), [&](std::int64_t n) {
    const auto i = static_cast<std::size_t>(n);
    const float* const row = &found[i * static_cast<std::size_t>(logits)];
    const float most = *std::max_element(row, row + logits);
    double sum = 0;
    for (std::int32_t c = 0; c < logits; ++c) sum += std::exp(static_cast<double>(row[c] - most));
    for (std::int32_t c = 0; c < logits; ++c)
      out.probability[i * width + static_cast<std::size_t>(session.plan.class_of_logit[static_cast<std::size_t>(c)])] =
          static_cast<float>(std::exp(static_cast<double>(row[c] - most)) / sum);
  });
  return out;
}

namespace {

constexpr double kTrim = 0.01;  // of an object's points on each side of its box, which depth throws about

// The box along the principal axes of the points.
TurnedBox box_of(const std::vector<Vec3d>& points, Vec3d mean) {
  Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
  for (const Vec3d& p : points) {
    const Eigen::Vector3d way(p.x - mean.x, p.y - mean.y, p.z - mean.z);
    spread += way * way.transpose();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solved(spread);
  TurnedBox box;
  for (int k = 0; k < 2; ++k) {
    const Eigen::Vector3d v = solved.eigenvectors().col(2 - k);
    Eigen::Index largest = 0;
    v.cwiseAbs().maxCoeff(&largest);
    const double sign = v(largest) < 0 ? -1 : 1;  // a solver may turn an axis about
    box.axis[static_cast<std::size_t>(k)] = {sign * v(0), sign * v(1), sign * v(2)};
  }
  box.axis[2] = cross(box.axis[0], box.axis[1]);
  box.center = mean;
  for (int k = 0; k < 3; ++k) {
    const Vec3d axis = box.axis[static_cast<std::size_t>(k)];
    std::vector<double> along;
    for (const Vec3d& p : points) along.push_back(dot(p - mean, axis));
    std::sort(along.begin(), along.end());
    const auto cut = static_cast<std::size_t>(kTrim * static_cast<double>(along.size()));
    const double low = along[cut], high = along[along.size() - 1 - cut];
    box.size[k] = high - low;
    box.center = box.center + axis * ((low + high) / 2);
  }
  return box;
}

}  // namespace

void measure_objects(std::span<ObjectRow> rows, std::span<const Vec3d> position, std::span<const std::int32_t> id,
                     double cell_m) {
  std::vector<std::vector<Vec3d>> points(rows.size());
  for (std::size_t i = 0; i < id.size(); ++i)
    if (id[i] > 0) points[static_cast<std::size_t>(id[i]) - 1].push_back(position[i]);
  for (std::size_t o = 0; o < rows.size(); ++o) {
    ObjectRow& row = rows[o];
    row.points = std::ssize(points[o]);
    row.area = static_cast<double>(row.points) * cell_m * cell_m;
    row.centroid = {};
    row.box = {{}, {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}}, {}};
    if (points[o].empty()) continue;
    Vec3d sum;
    for (const Vec3d& p : points[o]) sum = sum + p;
    row.centroid = sum * (1 / static_cast<double>(row.points));
    row.box = box_of(points[o], row.centroid);
  }
}

std::vector<ObjectRow> object_table(const ObjectSurface& surface, std::span<const std::int32_t> id,
                                    std::span<const SegmentSights> sights, const PointClasses& classes) {
  const std::int32_t most = id.empty() ? 0 : *std::max_element(id.begin(), id.end());
  std::vector<ObjectRow> rows(static_cast<std::size_t>(most));
  std::vector<std::vector<double>> votes(rows.size(), std::vector<double>(static_cast<std::size_t>(classes.classes)));
  for (std::size_t i = 0; i < id.size(); ++i) {
    if (id[i] == 0) continue;
    const auto o = static_cast<std::size_t>(id[i]) - 1;
    for (std::size_t c = 0; c < votes[o].size(); ++c)
      votes[o][c] += static_cast<double>(classes.probability[i * votes[o].size() + c]);
  }
  for (const SegmentSights& view : sights) {
    std::map<std::int32_t, std::map<std::int32_t, double>> in_segment;  // by object
    for (std::size_t i = 0; i < view.point.size(); ++i)
      if (const std::int32_t o = id[static_cast<std::size_t>(view.point[i])]; o > 0) ++in_segment[o][view.segment[i]];
    for (const auto& [o, of] : in_segment) {
      double all = 0, best = 0;
      for (const auto& [s, n] : of) {
        all += n;
        best = std::max(best, n);
      }
      ObjectRow& row = rows[static_cast<std::size_t>(o) - 1];
      ++row.views;
      row.agreement += best / all;
    }
  }
  for (std::size_t o = 0; o < rows.size(); ++o) {
    ObjectRow& row = rows[o];
    row.id = static_cast<std::int32_t>(o) + 1;
    if (row.views > 0) row.agreement /= row.views;
    double all = 0;
    for (const double v : votes[o]) all += v;
    if (!(all > 0)) continue;
    const auto best = std::max_element(votes[o].begin(), votes[o].end());
    row.class_index = static_cast<std::int16_t>(best - votes[o].begin());
    row.class_probability = *best / all;
  }
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : surface.pool.points) positions.push_back(point.position);
  measure_objects(rows, positions, id, surface.pool.cell_m());
  return rows;
}

}  // namespace semfield
