#include "execution/train_rays.h"

namespace semfield {

namespace {

// Of the cross-entropy, and of the losses of the list that move logits.
template <class Real>
View<Real> semantic_gradient(std::size_t pass, const TrainedRays& rays, const PassTrace<Real>& trace, Workspace& arena,
                             StepExecutor<Real>& executor) {
  const View<Real> d_logits = arena.take<Real>(trace.semantic_rays, trace.logits.cols);
  executor.semantic_loss(pass, arena, trace.logits, semantic_targets(rays.batch.targets, trace.semantic_rays),
                         d_logits);
  if (const std::uint32_t which = executor.active_losses() & executor.losses().of_heads(); which != 0) {
    RayGradients<Real> d;
    d.heads.set(channel::logits, d_logits);
    executor.add_losses(pass, arena, which, rays.batch.targets, values_of<Real>(rays.batch.near_far, trace), d);
  }
  return d_logits;
}

}  // namespace

template <class Real>
void train_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                const TrainedRays& call, const StepContext& step, StepExecutor<Real>& executor) {
  StepContext ctx = step;
  Workspace& arena = *ctx.workspace;
  const Stages<Real>& stages = *passes.front().parts().stages;
  const RayBatch& batch = call.batch;
  const Rays<Real> rays{batch.origin, batch.direction, batch.near_far};
  const std::int64_t count = batch.origin.rows;
  const auto colored = [&](auto view) { return view.row_range(call.first_color, count - call.first_color); };
  const auto zeroed = [&](bool wanted, std::int64_t rows) {
    const View<Real> view = wanted ? arena.take<Real>(rows, 1) : View<Real>();
    if (wanted) stages.fill(view, Real(0));
    return view;
  };
  PassRequest request;
  request.semantic_rays = call.semantic_rays;
  request.room = call.room;
  Proposal<Real> proposal;
  PassTrace<Real> previous;
  for (std::size_t p = 0; p < passes.size(); ++p) {
    const Pass<Real>& pass = passes[p];
    ctx.pass = pass.parts().number;
    PassTrace<Real> trace =
        executor.drawn() != nullptr
            ? pass.forward(ctx, call.lane, rays, *executor.drawn(), request)
            : pass.forward(ctx, call.lane, rays, p == 0 ? nullptr : &proposal, p == 0 ? 0 : per_ray[p - 1], request);
    const bool branched = pass.has_branch() && trace.semantic_rays > 0;
    if (branched) {  // it needs nothing of what follows
      const StepContext beside = executor.begin_branch(ctx);
      pass.branch_forward(beside, call.lane, rays, trace);
      pass.branch_backward(beside, call.lane, trace, semantic_gradient(p, call, trace, *beside.workspace, executor));
      executor.end_branch();
    }
    RayGradients<Real> d;
    d.color = arena.take<Real>(count, 3);
    if (call.first_color > 0) stages.fill(d.color.row_range(0, call.first_color), Real(0));
    executor.color_loss(p, arena, colored(View<const Real>(trace.color)), colored(batch.targets.color),
                        colored(d.color));
    executor.count(p, trace);
    View<Real> d_logits;
    if (trace.semantic_rays > 0 && !branched) d_logits = semantic_gradient(p, call, trace, arena, executor);
    const LossList& losses = executor.losses();
    if (const std::uint32_t which = executor.active_losses() & ~losses.of_heads(); which != 0) {
      const auto moved = [&](std::string_view channel) { return (which & losses.moving(channel)) != 0; };
      d.depth = zeroed(moved(channel::depth), count);
      d.weight = zeroed(moved(channel::weight), trace.samples.count);
      d.sigma = zeroed(moved(channel::sigma), trace.samples.count);
      executor.add_losses(p, arena, which, batch.targets, values_of<Real>(batch.near_far, trace), d);
    }
    View<Real> d_encoded;
    if (pass.scatters()) d_encoded = executor.encoded_gradient(p, trace, arena);
    pass.backward(ctx, call.lane, trace, d, d_logits, d_encoded);
    if (pass.scatters()) executor.use_encoded_gradient(p, trace, ctx, d_encoded);
    if (branched) executor.join_branch();
    executor.pass_done(p);
    previous = trace;
    proposal.samples = &previous.samples;
    proposal.weight = previous.weight.row_range(0, previous.samples.count);
  }
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                     \
  template void train_rays<Real>(const std::vector<Pass<Real>>&, const std::vector<std::int64_t>&, const TrainedRays&, \
                                 const StepContext&, StepExecutor<Real>&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
