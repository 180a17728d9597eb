// The field asked at points of space, apart from rays.
#pragma once

#include "execution/pipeline.h"

namespace semfield {

/// Points and where results go, host memory; N rows each, empty = not wanted.
template <class Real>
struct PointQuery {
  View<const double> position;   ///< [N, 3] world
  View<const double> direction;  ///< [N, 3] unit vectors that points are seen along; for `color` alone
  View<Real> sigma;              ///< [N, 1] density after activation, 1/m
  View<Real> color;              ///< [N, 3] in (0, 1)
  View<Real> logits;             ///< [N, K] of a sample of weight 1; only where the pipeline has semantics
};

/// Answers of the last pass, computed by the CPU from the pipeline's store, whatever its steps run on: where that
/// is a device, bring the store up to date first (Executor::download). The same bits for any grouping of points into
/// calls and any number of threads. Not beside another call.
template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query);

}  // namespace semfield
