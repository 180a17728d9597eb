// The section `propagate`: how labels spread over a learned surface. Declared here, where sections are read; used in
// surface/fuse/.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/error.h"

namespace semfield {

enum class PropagationMethod : std::uint8_t { surface, vote };
template <>
struct ChoiceNames<PropagationMethod> {
  static constexpr std::array<std::string_view, 2> names{"surface", "vote"};
};

struct PropagationParams {
  PropagationMethod method = PropagationMethod::surface;
  double min_opacity = 0.5;
  double cell_m = 0;
  double color_sigma = 0.04;
  double normal_sigma = 0.25;
  double vote_weight = 1;
  double min_confidence = 0;
  std::vector<double> vote_cells_m;
  double least_votes = 8;
};
void describe(ParamVisitor& visit, PropagationParams& params);
void validate(const PropagationParams& params, Diagnostics& diagnostics);

}  // namespace semfield
