#include "session/settings/propagation_params.h"

#include <algorithm>
#include <functional>

namespace semfield {

void describe(ParamVisitor& visit, PropagationParams& p) {
  SEMFIELD_PARAM(visit, p, method, "surface: diffusion over neighbouring cells; vote: labels pooled within a cell");
  SEMFIELD_PARAM(visit, p, min_opacity, "opacity of a rendered pixel below which it has no depth", {0.01, 1});
  SEMFIELD_PARAM(visit, p, cell_m,
                 "surface: edge of a cell, m; 0: three pixels at the scene's middle depth, at least 1/500 of its "
                 "longest side; the verb prints it",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, color_sigma, "surface: difference of colour (0 to 1) at which a weight falls to exp(-1/2)",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, normal_sigma,
                 "surface: distance between unit normals (0 to 2) at which a weight falls to exp(-1/2)", {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, vote_weight,
                 "surface: how strongly one labelled pixel holds its cell, where an edge between equal cells is 1",
                 {1e-6, 1e6});
  SEMFIELD_PARAM(visit, p, min_confidence, "pixels whose most probable class is less probable than this stay void",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, vote_cells_m,
                 "vote: edges of cells, ascending; the first with enough votes counts; []: 0.06, 0.12 and 0.2 m, or "
                 "1.2 %, 2.4 % and 4 % of the longest side of a scene that is no room in metres",
                 {1e-12, 1e12});
  SEMFIELD_PARAM(visit, p, least_votes, "vote: how many votes are enough; the largest cell takes what there is",
                 {1, 1e9});
}

void validate(const PropagationParams& p, Diagnostics& diagnostics) {
  if (!std::is_sorted(p.vote_cells_m.begin(), p.vote_cells_m.end(), std::less_equal<>())) {
    diagnostics.error("config.value.order", "propagate.vote_cells_m", "the edges do not ascend",
                      "write the smallest first, each once");
  }
}

}  // namespace semfield
