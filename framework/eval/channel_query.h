// Where a channel points in the direction of a given vector: words as the model that made the channel encodes them.
#pragma once

#include <string>
#include <vector>

#include "core/view.h"
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

}  // namespace semfield
