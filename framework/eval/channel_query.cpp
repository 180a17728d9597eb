#include "eval/channel_query.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <limits>
#include <nlohmann/json.hpp>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "execution/lane_executor.h"
#include "formats/npz.h"
#include "system/files.h"

namespace semfield {

namespace {

constexpr const char* kRemedy = "encode the words with the model that made the dataset's channel";

std::string file_name(const std::string& word) {
  std::string name = word;
  for (char& c : name) {
    const bool kept = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '-';
    if (!kept) c = '_';
  }
  return name;
}

void require_sound(const std::string& path, const QueryVector& query, std::int32_t length) {
  const std::string place = fmt::format("'{}': vector '{}'", path, query.name);
  if (std::ssize(query.values) != length)
    throw Error(ErrorKind::data, "render.query.length",
                fmt::format("{} has {} numbers, and the channel {}", place, query.values.size(), length), kRemedy);
  double square = 0;
  for (const float value : query.values) square += static_cast<double>(value) * static_cast<double>(value);
  if (!std::isfinite(square))
    throw Error(ErrorKind::data, "render.query.value", place + " has a number that is not finite", kRemedy);
  if (square == 0)
    throw Error(ErrorKind::data, "render.query.value", place + " is zero, which has no direction", kRemedy);
}

std::vector<QueryVector> read_json(const std::string& path) {
  nlohmann::json words;
  try {
    words = nlohmann::json::parse(read_text_file(path));
  } catch (const nlohmann::json::exception& error) {
    throw Error(ErrorKind::data, "render.query.format", fmt::format("'{}' is not JSON: {}", path, error.what()),
                "write a map from words to lists of numbers");
  }
  std::vector<QueryVector> queries;
  const auto refuse = [&](const std::string& what) {
    throw Error(ErrorKind::data, "render.query.format", fmt::format("'{}': {}", path, what),
                "write a map from words to lists of numbers: {\"chair\": [0.1, ...]}");
  };
  if (!words.is_object() || words.empty()) refuse("expected a map from words to vectors");
  for (const auto& [word, numbers] : words.items()) {
    QueryVector query{file_name(word), {}};
    if (!numbers.is_array()) refuse("'" + word + "' is not a list of numbers");
    for (const auto& number : numbers) {
      if (!number.is_number()) refuse("'" + word + "' holds something that is not a number");
      const double value = number.get<double>();  // a float has no place for some, which are then refused as infinite
      query.values.push_back(std::abs(value) <= std::numeric_limits<float>::max() ? static_cast<float>(value)
                                                                                  : INFINITY);
    }
    queries.push_back(std::move(query));
  }
  return queries;
}

std::vector<QueryVector> read_array(const std::string& path) {
  const NumpyArray array = read_npy(path, [&](std::span<const std::int64_t> shape) {
    if (shape.size() == 1 || shape.size() == 2) return;
    throw Error(ErrorKind::data, "render.query.format", fmt::format("'{}' has the shape {}", path, shape_text(shape)),
                "write one vector [D] or several [N, D]");
  });
  const std::string stem = file_name(std::filesystem::path(path).stem().string());
  if (array.shape.size() == 1) return {{stem, array.values}};
  std::vector<QueryVector> queries;
  for (std::int64_t i = 0; i < array.shape[0]; ++i) {
    const auto row = array.values.begin() + i * array.shape[1];
    queries.push_back({fmt::format("{}_{}", stem, i), {row, row + array.shape[1]}});
  }
  return queries;
}

}  // namespace

std::vector<QueryVector> read_queries(const std::string& path, std::int32_t length) {
  std::vector<QueryVector> queries = path.ends_with(".json") ? read_json(path) : read_array(path);
  for (const QueryVector& query : queries) {
    require_sound(path, query, length);
    if (std::count_if(queries.begin(), queries.end(), [&](const auto& other) { return other.name == query.name; }) > 1)
      throw Error(ErrorKind::data, "render.query.name",
                  fmt::format("'{}': two vectors would be written as '{}'", path, query.name),
                  "give them names that differ in letters or digits");
  }
  return queries;
}

std::vector<float> cosine_map(const FrameChannel& map, const std::vector<float>& vector, View<const float> axes) {
  std::vector<double> along(static_cast<std::size_t>(map.cols));
  double square = 0;
  for (std::size_t d = 0; d < vector.size(); ++d) {
    const auto value = static_cast<double>(vector[d]);
    square += value * value;
    if (axes.empty()) along[d] = value;
    for (std::int32_t k = 0; !axes.empty() && k < map.cols; ++k)
      along[static_cast<std::size_t>(k)] += value * static_cast<double>(axes(static_cast<std::int64_t>(d), k));
  }
  const double length = std::sqrt(square);
  std::vector<float> cosines(static_cast<std::size_t>(map.height) * static_cast<std::size_t>(map.width));
  parallel_for(map.height, [&](std::int64_t y) {
    for (std::int64_t cell = y * map.width; cell < (y + 1) * map.width; ++cell) {
      const float* const row = map.values.data() + cell * map.cols;
      double dot = 0, own = 0;
      for (std::int32_t k = 0; k < map.cols; ++k) {
        const auto value = static_cast<double>(row[k]);
        dot += value * along[static_cast<std::size_t>(k)];
        own += value * value;
      }
      cosines[static_cast<std::size_t>(cell)] =
          own > 0 ? static_cast<float>(std::clamp(dot / (std::sqrt(own) * length), -1.0, 1.0)) : 0.0F;
    }
  });
  return cosines;
}

namespace {

void require_finite(std::span<const Vec3d> vectors, const char* what) {
  for (std::size_t i = 0; i < vectors.size(); ++i) {
    const Vec3d& v = vectors[i];
    if (!std::isfinite(v.x) || !std::isfinite(v.y) || !std::isfinite(v.z))
      throw Error(ErrorKind::data, "usage.points.not_finite",
                  fmt::format("{} {}: ({}, {}, {}) is not finite", what, i, v.x, v.y, v.z), "leave such rows out");
  }
}

bool inside(const Box& box, const Vec3d& p) {
  return p.x >= box.lo.x && p.x <= box.hi.x && p.y >= box.lo.y && p.y <= box.hi.y && p.z >= box.lo.z && p.z <= box.hi.z;
}

}  // namespace

FieldPoints field_at(Pipeline<float>& pipeline, std::span<const Vec3d> positions, std::span<const Vec3d> directions,
                     const RayLimits& limits, const ClassOfLogit& class_of_logit, int classes) {
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  SEMFIELD_CHECK(directions.empty() || directions.size() == positions.size(), "a direction for every position");
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  require_finite(positions, "position");
  require_finite(directions, "direction");
  FieldPoints out;
  if (positions.empty()) return out;
  const auto count = std::ssize(positions);
  out.sigma.resize(positions.size());
  PointQuery<float> query;
  query.position = {&positions.data()->x, count, 3};
  query.sigma = {out.sigma.data(), count, 1};
  if (!directions.empty()) {
    out.rgb.resize(3 * positions.size());
    query.direction = {&directions.data()->x, count, 3};
    query.color = {out.rgb.data(), count, 3};
  }
  const auto logits = static_cast<std::int32_t>(class_of_logit.size());
  std::vector<float> values(pipeline.has_semantics() ? positions.size() * class_of_logit.size() : 0);
  if (!values.empty()) query.logits = {values.data(), count, logits};
  query_points(pipeline, query);
  for (float& value : out.rgb) value = std::clamp(value, 0.0F, 1.0F);
  if (limits.clip)
    for (std::size_t i = 0; i < positions.size(); ++i)
      if (!inside(limits.bounds, positions[i])) out.sigma[i] = 0;
  if (values.empty()) return out;
  out.label.resize(positions.size());
  out.entropy.resize(positions.size());
  ClassResults<float> results;
  results.label = {out.label.data(), count, 1};
  results.entropy = {out.entropy.data(), count, 1};
  cpu_stages<float>().class_results(query.logits, results);  // values are probabilities from here on
  out.probability.resize(positions.size() * static_cast<std::size_t>(classes));
  for (std::size_t i = 0; i < positions.size(); ++i) {
    out.label[i] = static_cast<std::int16_t>(class_of_logit[static_cast<std::size_t>(out.label[i])]);
    for (std::size_t k = 0; k < class_of_logit.size(); ++k)
      out.probability[i * static_cast<std::size_t>(classes) + static_cast<std::size_t>(class_of_logit[k])] =
          values[i * class_of_logit.size() + k];
  }
  return out;
}

}  // namespace semfield
