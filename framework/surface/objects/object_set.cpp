#include "surface/objects/object_set.h"

#include <fmt/format.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstring>
#include <nlohmann/json.hpp>
#include <numbers>
#include <set>
#include <type_traits>

#include "compute/parallel.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "execution/render_rays.h"
#include "formats/safetensors.h"

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

std::vector<std::int32_t> ObjectSet::at(std::span<const Vec3d> places) const {
  std::vector<std::int32_t> ids(places.size());
  parallel_for(std::ssize(places),
               [&](std::int64_t i) { ids[static_cast<std::size_t>(i)] = at(places[static_cast<std::size_t>(i)]); });
  return ids;
}

std::string ObjectSet::digest() const {
  return fmt::format("{:016x}", fnv1a64({reinterpret_cast<const char*>(id.data()), id.size() * sizeof(id[0])}));
}

ObjectSet object_set(const FoundObjects& found, std::string about) {
  ObjectSet set{found.surface.pool.cells, {}, {}, found.id, found.class_of, found.rows, found.up, std::move(about)};
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
  std::vector<TensorRef> tensors{tensor_ref("cell", {1}, cell),
                                 tensor_ref("place", {points, 3}, place),
                                 tensor_ref("position", {points, 3}, position),
                                 tensor_ref("color", {points, 3}, color),
                                 tensor_ref("id", {points}, id),
                                 tensor_ref("class", {points}, class_of),
                                 tensor_ref("row.views", {rows}, views),
                                 tensor_ref("row.class", {rows}, row_class),
                                 tensor_ref("row.agreement", {rows}, agreement),
                                 tensor_ref("row.class_probability", {rows}, probability)};
  std::vector<double> up;
  if (set.up) {
    up = {set.up->x, set.up->y, set.up->z};
    tensors.push_back(tensor_ref("up", {3}, up));
  }
  write_safetensors(path, tensors, {{"about", set.about}});
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
  if (file.find("up") != nullptr) {  // earlier versions wrote none
    const auto up = numbers_of<double>(file, "up", 3, -1.0, 1.0);
    set.up = Vec3d{up[0], up[1], up[2]};
    if (!(std::abs(length(*set.up) - 1) < 1e-6)) refuse(path, "'up' is not a unit vector");
  }
  measure_objects(set.rows, set.position, set.id, cell, set.up);
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

// The least and the greatest place of the points along an axis, without those that are trimmed. `along`: memory.
std::pair<double, double> extent_of(std::span<const Vec3d> points, Vec3d axis, std::vector<double>& along) {
  along.clear();
  for (const Vec3d& p : points) along.push_back(dot(p, axis));
  const auto cut = static_cast<std::ptrdiff_t>(kTrim * static_cast<double>(along.size()));
  const auto low = along.begin() + cut, high = along.end() - 1 - cut;
  std::nth_element(along.begin(), low, along.end());
  const double least = *low;
  if (low < high) std::nth_element(low + 1, high, along.end());
  return {least, *high};
}

using Axes = std::array<Vec3d, 3>;

// Axes of the rectangle of least area around the points as seen along `up`, the longer side first, and `up`.
Axes upright_axes(std::span<const Vec3d> all, Vec3d up) {
  constexpr std::size_t kMost = 2000;  // points that say how it is turned
  const std::size_t step = all.size() / kMost + 1;
  std::vector<Vec3d> points;
  for (std::size_t i = 0; i < all.size(); i += step) points.push_back(all[i]);
  int least = 0;
  for (int k = 1; k < 3; ++k) least = std::abs(up[k]) < std::abs(up[least]) ? k : least;
  Vec3d start{};
  start[least] = 1;
  start = normalized(start - up * dot(start, up));
  const Vec3d beside = cross(up, start);
  std::vector<double> along;
  const auto sides = [&](double degrees) {
    const double a = degrees * std::numbers::pi / 180;
    const Vec3d x = start * std::cos(a) + beside * std::sin(a), y = cross(up, x);
    const auto [x0, x1] = extent_of(points, x, along);
    const auto [y0, y1] = extent_of(points, y, along);
    return std::tuple{(x1 - x0) * (y1 - y0), x1 - x0 < y1 - y0 ? y : x};
  };
  double best = 0;
  for (const double by : {3.0, 0.25}) {  // degrees, first of all turns, then around the best
    const double middle = best, around = by == 3 ? 45 : 3;
    for (double degrees = middle - around; degrees <= middle + around; degrees += by)
      if (std::get<0>(sides(degrees)) < std::get<0>(sides(best))) best = degrees;
  }
  const Vec3d x = std::get<1>(sides(best));
  return {x, cross(up, x), up};
}

Axes principal_axes(std::span<const Vec3d> points, Vec3d mean) {
  Eigen::Matrix3d spread = Eigen::Matrix3d::Zero();
  for (const Vec3d& p : points) {
    const Eigen::Vector3d way(p.x - mean.x, p.y - mean.y, p.z - mean.z);
    spread += way * way.transpose();
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> solved(spread);
  Axes axes;
  for (int k = 0; k < 2; ++k) {
    const Eigen::Vector3d v = solved.eigenvectors().col(2 - k);
    axes[static_cast<std::size_t>(k)] = {v(0), v(1), v(2)};
  }
  return axes;
}

TurnedBox box_of(std::span<const Vec3d> points, Vec3d mean, const std::optional<Vec3d>& up) {
  TurnedBox box;
  box.axis = up ? upright_axes(points, *up) : principal_axes(points, mean);
  for (int k = 0; k < (up ? 1 : 2); ++k) {
    Vec3d& axis = box.axis[static_cast<std::size_t>(k)];
    int largest = 0;
    for (int d = 1; d < 3; ++d) largest = std::abs(axis[d]) > std::abs(axis[largest]) ? d : largest;
    if (axis[largest] < 0) axis = axis * -1.0;  // a box has two ways of each axis, and files always the same
  }
  if (up) box.axis[1] = cross(box.axis[2], box.axis[0]);
  box.axis[2] = cross(box.axis[0], box.axis[1]);
  box.center = {};
  std::vector<double> along;
  for (int k = 0; k < 3; ++k) {
    const Vec3d axis = box.axis[static_cast<std::size_t>(k)];
    const auto [low, high] = extent_of(points, axis, along);
    box.size[k] = high - low;
    box.center = box.center + axis * ((low + high) / 2);
  }
  return box;
}

}  // namespace

void measure_objects(std::span<ObjectRow> rows, std::span<const Vec3d> position, std::span<const std::int32_t> id,
                     double cell_m, const std::optional<Vec3d>& up) {
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
    row.box = box_of(points[o], row.centroid, up);
  }
}

std::vector<ObjectRow> object_table(const ObjectSurface& surface, std::span<const std::int32_t> id,
                                    std::span<const SegmentSights> sights, const PointClasses& classes,
                                    const std::vector<bool>& stuff, const std::optional<Vec3d>& up) {
  const std::int32_t most = id.empty() ? 0 : *std::max_element(id.begin(), id.end());
  std::vector<ObjectRow> rows(static_cast<std::size_t>(most));
  std::vector<std::vector<double>> votes(rows.size(), std::vector<double>(static_cast<std::size_t>(classes.classes)));
  for (std::size_t i = 0; i < id.size(); ++i) {
    if (id[i] == 0) continue;
    const auto o = static_cast<std::size_t>(id[i]) - 1;
    for (std::size_t c = 0; c < votes[o].size(); ++c)
      votes[o][c] += static_cast<double>(classes.probability[i * votes[o].size() + c]);
  }
  std::vector<std::map<std::int16_t, double>> told(rows.size());  // sights of each object in segments of a class
  for (const SegmentSights& view : sights) {
    std::map<std::int32_t, std::map<std::int32_t, double>> in_segment;  // by object
    for (std::size_t i = 0; i < view.point.size(); ++i)
      if (const std::int32_t o = id[static_cast<std::size_t>(view.point[i])]; o > 0) ++in_segment[o][view.segment[i]];
    for (const auto& [o, of] : in_segment) {
      double all = 0, best = 0;
      for (const auto& [s, n] : of) {
        all += n;
        best = std::max(best, n);
        if (const std::int16_t its = view.class_of[static_cast<std::size_t>(s)]; its != kVoid)
          told[static_cast<std::size_t>(o) - 1][its] += n;
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
    double all = 0, best = 0, told_all = 0;
    for (const double vote : votes[o]) all += vote;
    for (const auto& [c, n] : told[o]) told_all += n;
    for (const auto& [c, n] : told[o]) votes[o][static_cast<std::size_t>(c)] += n * std::max(all, 1.0) / told_all;
    all = 0;
    for (std::size_t c = 0; c < votes[o].size(); ++c) {
      all += votes[o][c];
      if (stuff[c] || !(votes[o][c] > best)) continue;
      best = votes[o][c];
      row.class_index = static_cast<std::int16_t>(c);
    }
    if (best > 0) row.class_probability = best / all;
  }
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : surface.pool.points) positions.push_back(point.position);
  measure_objects(rows, positions, id, surface.pool.cell_m(), up);
  return rows;
}

namespace {

using OrderedJson = nlohmann::ordered_json;

constexpr double kLeastPiece = 0.02;  // of an object's points
constexpr std::size_t kMostName = 80;
constexpr double kFarthest = 1e12;  // of a place from the origin, along an axis

[[noreturn]] void refuse_edit(const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::data, "objects.edit.invalid", message, remedy);
}

std::int32_t id_of(const OrderedJson& value, const std::string& where) {
  if (!value.is_number_integer() || value.get<std::int64_t>() < 1 || value.get<std::int64_t>() > 65535)
    refuse_edit(where + ": an object is a number from 1 on", "take the ids of objects.json");
  return value.get<std::int32_t>();
}

Vec3d place_of(const OrderedJson& value, const std::string& where) {
  if (!value.is_array() || value.size() != 3 ||
      !std::all_of(value.begin(), value.end(), [](const OrderedJson& v) { return v.is_number(); }))
    refuse_edit(where + ": a place is three numbers", "give [x, y, z] in the world of the input");
  const Vec3d place{value[0].get<double>(), value[1].get<double>(), value[2].get<double>()};
  if (!(std::abs(place.x) <= kFarthest && std::abs(place.y) <= kFarthest && std::abs(place.z) <= kFarthest))
    refuse_edit(where + ": a place lies farther away than any scene", "give [x, y, z] in the world of the input");
  return place;
}

template <std::size_t N>
std::array<Vec3d, N> places_of(const OrderedJson& value, const std::string& what, const std::string& remedy) {
  if (!value.is_array() || value.size() != N) refuse_edit(what, remedy);
  std::array<Vec3d, N> places;
  for (std::size_t k = 0; k < N; ++k) places[k] = place_of(value[k], what);
  return places;
}

OrderedJson json_of_places(std::span<const Vec3d> places) {
  OrderedJson out = OrderedJson::array();
  for (const Vec3d& p : places) out.push_back({p.x, p.y, p.z});
  return out;
}

ObjectEdit edit_of(const OrderedJson& json, const std::string& where) {
  if (!json.is_object() || !json.contains("do") || !json["do"].is_string())
    refuse_edit(where + ": it does not say what to do", "give a map with 'do': rename, merge or split");
  const auto of = [&](const char* key) -> const OrderedJson& {
    if (!json.contains(key)) refuse_edit(fmt::format("{}: '{}' is missing", where, key), "give it");
    return json[key];
  };
  ObjectEdit edit;
  const std::string what = json["do"].get<std::string>();
  if (what == "merge") {
    edit.kind = ObjectEdit::Kind::merge;
    const OrderedJson& objects = of("objects");
    if (!objects.is_array() || objects.size() < 2) refuse_edit(where + ": 'objects' are two or more", "name them");
    for (const OrderedJson& one : objects) edit.objects.push_back(id_of(one, where));
    return edit;
  }
  if (what != "rename" && what != "split")
    refuse_edit(fmt::format("{}: '{}' is nothing to do", where, what), "rename, merge or split");
  edit.objects = {id_of(of("object"), where)};
  if (what == "rename") {
    const OrderedJson& name = of("name");
    if (!name.is_string() || name.get<std::string>().size() > kMostName)
      refuse_edit(fmt::format("{}: a name is text of at most {} bytes", where, kMostName), "shorten it");
    edit.name = name.get<std::string>();
    if (!is_line_of_text(edit.name))
      refuse_edit(where + ": a name has no tabs, line breaks or other control characters",
                  "write it as one line of text");
    return edit;
  }
  edit.kind = ObjectEdit::Kind::split;
  if (json.contains("at")) edit.at = places_of<2>(json["at"], where + ": 'at' is two places", "give one of each part");
  if (json.contains("plane"))
    edit.plane = places_of<3>(json["plane"], where + ": 'plane' is three places", "give three that lie on it");
  if (edit.at && edit.plane) refuse_edit(where + ": 'at' and 'plane' part an object in two ways", "give one of them");
  return edit;
}

OrderedJson json_of(const ObjectEdit& edit) {
  if (edit.kind == ObjectEdit::Kind::merge) return {{"do", "merge"}, {"objects", edit.objects}};
  if (edit.kind == ObjectEdit::Kind::rename)
    return {{"do", "rename"}, {"object", edit.objects[0]}, {"name", edit.name}};
  OrderedJson out{{"do", "split"}, {"object", edit.objects[0]}};
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
      refuse_edit(fmt::format("object {}: the two places do not lie on it, each on a part of its own", body.object),
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
    refuse_edit(fmt::format("object {}: the three places lie on a line, so many planes hold them", body.object),
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
    measure_objects(rows, set_.position, places_of(changed_), set_.cells.edge_m(), set_.up);
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
        refuse_edit(fmt::format("there is no object {}", *id), "take an id of objects.json");
      if (std::find(objects.begin(), id, *id) != id)
        refuse_edit(fmt::format("object {} is named twice", *id), "name it once");
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
      refuse_edit(
          edit.plane ? fmt::format("object {}: all of it lies on one side of the plane", object)
                     : fmt::format("object {}: it has no second piece of a fiftieth of its points", object),
          edit.plane ? "click two points between the parts" : "click a point of each part and split at the points");
    const auto first = static_cast<std::int32_t>(set_.rows.size());
    if (first + most > kMostObjects)
      refuse_edit(fmt::format("object {}: with its parts there are more than {} objects", object, kMostObjects),
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
  const OrderedJson root = OrderedJson::parse(json, nullptr, false);
  if (root.is_discarded()) refuse_edit(where + ": it is not JSON", "give a map");
  return edit_of(root, where);
}

ObjectEdits read_object_edits(const std::string& path) {
  ObjectEdits out;
  if (!fs::exists(path)) return out;
  const OrderedJson root = OrderedJson::parse(read_text_file(path), nullptr, false);
  if (!root.is_object() || !root.contains("objects") || !root["objects"].is_string() || !root.contains("edits") ||
      !root["edits"].is_array())
    refuse_edit(path + ": it is not a file of edits", "put an earlier one in its place, or remove it");
  out.digest = root["objects"].get<std::string>();
  for (const OrderedJson& one : root["edits"])
    out.edits.push_back(edit_of(one, fmt::format("{}: edit {}", path, out.edits.size() + 1)));
  return out;
}

std::string object_edits_text(const ObjectEdits& edits) {
  std::string lines;
  for (const ObjectEdit& edit : edits.edits)
    lines +=
        (lines.empty() ? "\n  " : ",\n  ") + json_of(edit).dump(-1, ' ', false, OrderedJson::error_handler_t::replace);
  return fmt::format("{{\"objects\": {},\n \"edits\": [{}]}}\n",
                     OrderedJson(edits.digest).dump(-1, ' ', false, OrderedJson::error_handler_t::replace), lines);
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
  const fs::path in(folder);
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
