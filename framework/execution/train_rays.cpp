#include "execution/train_rays.h"

namespace semfield {

namespace {

// One pass of the rays, and what becomes of it.
template <class Real>
struct PassWalk {
  const Pass<Real>& pass;
  std::size_t number;
  const TrainedRays<Real>& rays;
  StepExecutor<Real>& executor;

  void add_losses(std::uint32_t which, const PassTrace<Real>& trace, Workspace& arena,
                  const RayGradients<Real>& d) const {
    if (which == 0) return;
    const RayBatch& batch = rays.batch;
    executor.add_losses(number, arena, which, batch.targets, pass.values_of(batch.near_far, trace), d);
  }

  // Of the cross-entropy, and of the losses of the list that move logits.
  View<Real> semantic_gradient(const PassTrace<Real>& trace, Workspace& arena) const {
    const View<Real> d_logits = arena.take<Real>(trace.semantic_rays, trace.semantic.rows.cols);
    executor.semantic_loss(number, arena, trace.semantic.rows,
                           semantic_targets(rays.batch.targets, trace.semantic_rays), d_logits);
    RayGradients<Real> d;
    d.heads.set(channel::logits, d_logits);
    add_losses(executor.active_losses() & executor.losses().on_logits(), trace, arena, d);
    return d_logits;
  }

  // Of the losses that move channels of the other heads.
  ChannelTable<Real> head_gradients(const PassTrace<Real>& trace, Workspace& arena) const {
    RayGradients<Real> d;
    for (const HeadParts<Real>& head : pass.parts().heads) {
      const View<Real> rows = arena.take<Real>(rays.batch.origin.rows, head.head->width());
      pass.parts().stages->fill(rows, Real(0));
      d.heads.set(head.channel, rows);
    }
    add_losses(executor.active_losses() & executor.losses().on_heads(), trace, arena, d);
    return d.heads;
  }
};

}  // namespace

template <class Real>
void train_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                const TrainedRays<Real>& call, const StepContext& step, StepExecutor<Real>& executor) {
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
  const CameraCorrections<Real>* const cameras = call.cameras;
  const View<const float> camera = cameras != nullptr ? batch.targets.more[channel::camera] : View<const float>();
  const View<Real> d_ray = cameras != nullptr && cameras->rules().poses ? arena.take<Real>(count, 6) : View<Real>();
  if (!d_ray.empty()) stages.fill(d_ray, Real(0));
  PassRequest request;
  request.semantic_rays = call.semantic_rays;
  request.room = call.room;
  Proposal<Real> proposal;
  PassTrace<Real> previous;
  for (std::size_t p = 0; p < passes.size(); ++p) {
    const Pass<Real>& pass = passes[p];
    ctx.pass = pass.parts().number;
    const std::uint32_t active = executor.active_losses();
    const LossList& losses = executor.losses();
    const std::uint32_t of_heads = pass.parts().heads.empty() ? 0 : active & losses.reading_heads();
    request.heads = of_heads != 0;
    PassTrace<Real> trace =
        executor.drawn() != nullptr
            ? pass.forward(ctx, call.lane, rays, *executor.drawn(), request)
            : pass.forward(ctx, call.lane, rays, p == 0 ? nullptr : &proposal, p == 0 ? 0 : per_ray[p - 1], request);
    const PassWalk<Real> walk{pass, p, call, executor};
    const bool branched = pass.has_branch() && trace.semantic_rays > 0, apart = branched || trace.with_heads;
    if (apart) {  // it needs nothing of what follows
      const StepContext beside = executor.begin_branch(ctx);
      if (branched) {
        pass.branch_forward(beside, call.lane, rays, trace);
        pass.branch_backward(beside, call.lane, trace, walk.semantic_gradient(trace, *beside.workspace));
      }
      if (trace.with_heads) {
        pass.heads_forward(beside, call.lane, rays, trace);
        pass.heads_backward(beside, call.lane, trace, walk.head_gradients(trace, *beside.workspace));
      }
      executor.end_branch();
    }
    RayGradients<Real> d;
    d.color = arena.take<Real>(count, 3);
    if (call.first_color > 0) stages.fill(d.color.row_range(0, call.first_color), Real(0));
    if (cameras != nullptr && cameras->rules().colors) {
      const View<Real> shown = arena.take<Real>(count, 3), d_shown = arena.take<Real>(count, 3);
      cameras->show(camera, trace.color, shown);
      if (call.first_color > 0) stages.fill(d_shown.row_range(0, call.first_color), Real(0));
      executor.color_loss(p, arena, colored(View<const Real>(shown)), colored(batch.targets.color), colored(d_shown));
      cameras->show_backward(call.lane, camera, trace.color, d_shown, d.color);
    } else {
      executor.color_loss(p, arena, colored(View<const Real>(trace.color)), colored(batch.targets.color),
                          colored(d.color));
    }
    executor.count(p, trace);
    View<Real> d_logits;
    if (trace.semantic_rays > 0 && !branched) d_logits = walk.semantic_gradient(trace, arena);
    const std::uint32_t apart_losses = losses.on_logits() | losses.on_heads() | (losses.reading_heads() & ~of_heads);
    if (const std::uint32_t which = active & ~apart_losses; which != 0) {
      const auto moved = [&](std::string_view channel) { return (which & losses.moving(channel)) != 0; };
      d.depth = zeroed(moved(channel::depth), count);
      d.weight = zeroed(moved(channel::weight), trace.samples.count);
      d.sigma = zeroed(moved(channel::sigma), trace.samples.count);
      walk.add_losses(which, trace, arena, d);
    }
    View<Real> d_encoded;
    if (pass.scatters()) {
      d_encoded = executor.encoded_gradient(p, trace, arena);
    } else if (!d_ray.empty()) {
      d_encoded = arena.take<Real>(trace.samples.count, trace.encoded.cols);
    }
    pass.backward(ctx, call.lane, trace, d, d_logits, d_encoded);
    if (!d_ray.empty()) pass.ray_gradient(ctx, rays, trace, d_encoded, d_ray);
    if (pass.scatters()) executor.use_encoded_gradient(p, trace, ctx, d_encoded);
    if (!d_ray.empty() && p + 1 == passes.size()) cameras->move_backward(call.lane, camera, batch.direction, d_ray);
    if (apart) executor.join_branch();
    executor.pass_done(p);
    previous = trace;
    proposal.samples = &previous.samples;
    proposal.weight = previous.weight.row_range(0, previous.samples.count);
  }
}

#define SEMFIELD_INSTANTIATE(Real)                                                                 \
  template void train_rays<Real>(const std::vector<Pass<Real>>&, const std::vector<std::int64_t>&, \
                                 const TrainedRays<Real>&, const StepContext&, StepExecutor<Real>&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
