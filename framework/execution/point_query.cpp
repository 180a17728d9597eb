#include "execution/point_query.h"

#include <algorithm>

#include "compute/float_mode.h"
#include "execution/lane_executor.h"
#include "execution/thread_arenas.h"

namespace semfield {

namespace {
constexpr std::int64_t kUnit = 1024;  // points of a unit of work; results do not depend on it
}

template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query) {
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  const Pass<Real>& pass = pipeline.passes().back();
  if (!query.sigma.empty()) pipeline.lanes().density(query.position, query.sigma);
  if (query.color.empty() && query.logits.empty()) return;
  ThreadArenas arenas;
  const std::int64_t total = query.position.rows;
  arenas.for_units((total + kUnit - 1) / kUnit, [&](Workspace& arena, std::int64_t unit) {
    const std::int64_t begin = unit * kUnit, count = std::min(kUnit, total - begin);
    const Workspace::Scope taken(arena);
    StepContext ctx;
    ctx.seed = pipeline.options().seed;
    ctx.pass = pass.parts().number;
    ctx.workspace = &arena;
    const View<const double> places = query.position.row_range(begin, count);
    if (!query.color.empty())
      pass.point_colors(ctx, places, query.direction.row_range(begin, count), query.color.row_range(begin, count));
    if (!query.logits.empty()) {
      const View<Real> rows = arena.take<Real>(count, pass.point_dims());
      pass.point_rows(ctx, places, rows);
      pass.point_forward(ctx, 0, rows, query.logits.row_range(begin, count));
    }
  });
}

template void query_points<float>(Pipeline<float>&, const PointQuery<float>&);
template void query_points<double>(Pipeline<double>&, const PointQuery<double>&);

}  // namespace semfield
