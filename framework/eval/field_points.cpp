#include "eval/field_points.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "core/check.h"
#include "core/error.h"
#include "execution/render_rays.h"

namespace semfield {

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
