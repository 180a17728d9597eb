// Where a channel points in the direction of a given vector: words as the model that made the channel encodes them.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"
#include "core/view.h"
#include "eval/evaluator.h"
#include "scene/scene.h"

namespace semfield {

struct QueryVector {
  std::string name;  ///< of output files: letters, digits, '-' and '_'
  std::vector<float> values;
};

/// Vectors of a file: .json, a map from names to lists of numbers; or .npy, one vector [D] named as the file, or
/// several [N, D] named with a number behind. Throws Error(data) naming file and name for a vector that is empty, of
/// another length than `length`, not finite or zero.
std::vector<QueryVector> read_queries(const std::string& path, std::int32_t length);

/// Cosines [H * W] in [-1, 1] between the rows of `map` and the vector, which has as many values as the map has columns
/// or, with `axes` [D, map.cols], D: what of it lies off the axes makes the cosine smaller. 0 for a row of zeros.
std::vector<float> cosine_map(const FrameChannel& map, const std::vector<float>& vector, View<const float> axes);

// The field at points of space: density, colour, class probabilities, label and entropy.

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
/// direction that is not finite. As query_points (execution/lane_executor.h).
FieldPoints field_at(Pipeline<float>& pipeline, std::span<const Vec3d> positions, std::span<const Vec3d> directions,
                     const RayLimits& limits, const ClassOfLogit& class_of_logit, int classes);

}  // namespace semfield
