#include "execution/train_rays.h"

#include <algorithm>
#include <cstring>

#include "core/check.h"

namespace semfield {

RayBatch RayBatch::rows(std::int64_t begin, std::int64_t count) const {
  RayBatch out = *this;
  each_array(out, [&](auto& view) {
    if (!view.empty()) view = view.row_range(begin, count);
  });
  if (label_only.empty()) return out;
  const std::int64_t at = skipped + begin, tile = at / tile_rays;
  out.label_only = label_only.row_range(tile, (at + count + tile_rays - 1) / tile_rays - tile);
  out.skipped = at - tile * tile_rays;
  return out;
}

std::int64_t RayBatch::without_color() const {
  if (label_only.empty() || label_only.rows == 0) return 0;
  return std::clamp<std::int64_t>(label_only(0, 0) - skipped, 0, origin.rows);
}

RayBatch BatchShape::batch() const {
  RayBatch out;
  const auto there = [&](auto& view, std::int32_t cols) {
    view.rows = rays;
    view.cols = cols;
    view.row_stride = cols;
  };
  there(out.origin, 3);
  there(out.direction, 3);
  there(out.near_far, 2);
  there(out.targets.color, 3);
  if (labels) there(out.targets.label, 1);
  for (std::int32_t i = 0; i < channels; ++i) {
    const Channel& one = more[static_cast<std::size_t>(i)];
    View<const float> view;
    there(view, one.cols);
    out.targets.more.set(one.name, view);
  }
  out.tile_rays = tile_rays;
  return out;
}

BatchShape shape_of(const RayBatch& batch) {
  BatchShape shape;
  shape.rays = batch.origin.rows;
  shape.tiles = batch.label_only.empty() ? 0 : batch.label_only.rows;
  shape.tile_rays = batch.tile_rays;
  shape.labels = batch.targets.label.cols > 0;  // a layout of a shape has no data
  for (const auto& one : batch.targets.more) {
    SEMFIELD_CHECK(one.name.size() < BatchShape::kNameBytes, "the name of a channel has at most 31 characters");
    BatchShape::Channel& to = shape.more[static_cast<std::size_t>(shape.channels++)];
    std::memcpy(to.name, one.name.data(), one.name.size());
    to.cols = one.view.cols;
  }
  return shape;
}

BatchLayout::BatchLayout(const RayBatch& like)
    : shape_(shape_of(like)), label_only_(like.label_only.data, like.label_only.data + shape_.tiles) {
  constexpr std::size_t kAlignBytes = 256;
  each_array(like, [this]<class T>(const View<const T>& view) {
    if (view.cols == 0) return;
    at_.push_back(bytes_);
    bytes_ += (static_cast<std::size_t>(view.size()) * sizeof(T) + kAlignBytes - 1) / kAlignBytes * kAlignBytes;
  });
}

bool BatchLayout::fits(const RayBatch& batch) const {
  const View<const std::int64_t>& counts = batch.label_only;
  return shape_of(batch) == shape_ && std::equal(label_only_.begin(), label_only_.end(), counts.data);
}

void BatchLayout::write(const RayBatch& batch, std::byte* block) const {
  std::size_t next = 0;
  each_array(batch, [&]<class T>(const View<const T>& view) {
    if (view.cols == 0) return;
    SEMFIELD_CHECK(!view.empty() && view.contiguous(), "rows of a batch lie behind each other");
    std::memcpy(block + at_[next++], view.data, static_cast<std::size_t>(view.size()) * sizeof(T));
  });
}

RayBatch BatchLayout::in(const std::byte* block, Device device) const {
  RayBatch out = shape_.batch();
  std::size_t next = 0;
  each_array(out, [&]<class T>(View<const T>& view) {
    if (view.cols == 0) return;
    view = {reinterpret_cast<const T*>(block + at_[next++]), view.rows, view.cols, view.cols, device};
  });
  if (!label_only_.empty()) out.label_only = {label_only_.data(), std::ssize(label_only_), 1};
  return out;
}

double color_normaliser(const RayBatch& batch) {
  std::int64_t rays = batch.origin.rows;
  for (std::int64_t t = 0; t < batch.label_only.rows; ++t) rays -= batch.label_only(t, 0);
  return static_cast<double>(std::max<std::int64_t>(1, 3 * rays));
}

SemanticTargets semantic_targets(const RayTargets& targets, std::int64_t rays) {
  const View<const float> soft = targets.more[channel::soft_label];
  SemanticTargets out;
  if (soft.empty()) {
    out.hard = targets.label.row_range(0, rays);
  } else {
    out.soft = soft.row_range(0, rays);
  }
  return out;
}

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
  request.reached_room = call.reached_room;
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
