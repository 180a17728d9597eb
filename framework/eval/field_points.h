// The field at points of space: density, colour, class probabilities, label and entropy.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/small_math.h"
#include "core/view.h"
#include "eval/evaluator.h"
#include "scene/scene.h"

namespace semfield {

/// Row by row; what was not asked for, or what a field without semantics does not know, is empty.
struct FieldPoints {
  std::vector<float> sigma;         ///< [N] density, 1/m; 0 outside the bounds that rays are clipped to
  std::vector<float> rgb;           ///< [N * 3] in [0, 1]
  std::vector<std::int16_t> label;  ///< [N] class index (not logit)
  std::vector<float> probability;   ///< [N * C] of classes; 0 for classes without a logit
  std::vector<float> entropy;       ///< [N] nats
};

/// Semantics are those of a sample of weight 1: what a ray would tell that met nothing but this point. `directions`
/// [N] unit vectors that the points are seen along, or empty: no colour is made. Throws Error(data) for a position or
/// direction that is not finite. As query_points (execution/render_rays.h).
FieldPoints field_at(Pipeline<float>& pipeline, std::span<const Vec3d> positions, std::span<const Vec3d> directions,
                     const RayLimits& limits, const ClassOfLogit& class_of_logit, int classes);

}  // namespace semfield
