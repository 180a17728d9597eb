#include "execution/render_rays.h"

#include <algorithm>

#include "compute/isa.h"
#include "core/check.h"
#include "execution/lane_executor.h"
#include "model/losses/semantic_cross_entropy.h"

namespace semfield {

namespace {

constexpr std::int64_t kPointUnit = 1024;  // points of a unit of work; results do not depend on it
constexpr std::int64_t kPointTile = 64;    // points of a batch that one lane takes

// body(arena, begin, count) for units of the points.
template <class Body>
void for_points(ThreadArenas& arenas, std::int64_t points, const Body& body) {
  arenas.for_units((points + kPointUnit - 1) / kPointUnit, [&](Workspace& arena, std::int64_t unit) {
    const Workspace::Scope taken(arena);
    body(arena, unit * kPointUnit, std::min(kPointUnit, points - unit * kPointUnit));
  });
}

}  // namespace

template <class Real>
RenderJob<Real> RenderJob<Real>::rows(std::int64_t begin, std::int64_t count) const {
  RenderJob part = *this;
  const auto cut = [&](auto&... views) { ((views = views.row_range(begin, count)), ...); };
  cut(part.origin, part.direction, part.near_far, part.truth, part.color, part.depth, part.opacity, part.label,
      part.entropy, part.confidence, part.truth_probability, part.probability, part.resolution);
  part.heads = heads.row_range(begin, count);
  return part;
}

template <class Real>
void render_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                 const RenderJob<Real>& job, const StepContext& call) {
  StepContext ctx = call;
  const PassParts<Real>& parts = passes.back().parts();
  const Stages<Real>& stages = *parts.stages;
  const HostEnds<Real> ends{stages, *ctx.workspace};
  const Rays<Real> rays{ends.sent(job.origin), ends.sent(job.direction), ends.sent(job.near_far)};
  const bool classes =
      parts.head && !(job.label.empty() && job.entropy.empty() && job.confidence.empty() && job.probability.empty());
  const bool heads = job.heads.size() > 0;
  Proposal<Real> proposal;
  PassTrace<Real> trace;
  for (std::size_t p = 0; p < passes.size(); ++p) {
    ctx.pass = passes[p].parts().number;
    const bool last = p + 1 == passes.size();
    const PassTrace<Real> next =
        passes[p].forward(ctx, kMainGradient, rays, p == 0 ? nullptr : &proposal, p == 0 ? 0 : per_ray[p - 1],
                          {last && classes ? job.origin.rows : 0, last, last && heads});
    trace = next;
    proposal.samples = &trace.samples;
    proposal.weight = trace.weight.row_range(0, trace.samples.count);
  }
  ends.fetch(trace.color, job.color);
  ends.fetch(trace.depth, job.depth);
  ends.fetch(trace.opacity, job.opacity);
  for (const auto& channel : job.heads) {
    const View<const Real> rows = passes.back().values_of({}, trace).heads[channel.name];
    SEMFIELD_CHECK(rows.cols == channel.view.cols, "a channel of the pass, with its columns");
    ends.fetch(rows, channel.view);
  }
  if (!job.resolution.empty()) {
    const View<OpacityResolution> found = ends.room_for(job.resolution);
    stages.opacity_resolutions(trace.samples, trace.weight, passes.back().rules().rendering.far, job.footprint_per_m,
                               found);
    ends.fetch(found, job.resolution);
  }
  if (!classes) return;
  SEMFIELD_CHECK(job.probability.empty() || job.probability.cols == trace.semantic.rows.cols,
                 "probabilities of rays have a column a logit");
  ClassResults<Real> results;
  results.truth = ends.sent(job.truth);
  results.label = ends.room_for(job.label);
  results.entropy = ends.room_for(job.entropy);
  results.confidence = ends.room_for(job.confidence);
  results.truth_probability = ends.room_for(job.truth_probability);
  results.probability = ends.room_for(job.probability);
  stages.class_results(trace.semantic.rows, results);
  ends.fetch(results.label, job.label);
  ends.fetch(results.entropy, job.entropy);
  ends.fetch(results.confidence, job.confidence);
  ends.fetch(results.truth_probability, job.truth_probability);
  ends.fetch(results.probability, job.probability);
}

template <class Real>
void query_density(const Pass<Real>& pass, View<const double> positions, View<Real> sigma, const StepContext& call) {
  StepContext ctx = call;
  ctx.pass = pass.parts().number;
  const HostEnds<Real> ends{*pass.parts().stages, *ctx.workspace};
  const View<Real> found = ends.room_for(sigma);
  pass.density(ctx, ends.sent(positions), found);
  ends.fetch(found, sigma);
}

template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query) {
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  const Pass<Real>& pass = pipeline.passes().back();
  if (!query.sigma.empty()) pipeline.lanes().density(query.position, query.sigma);
  if (query.color.empty() && query.logits.empty()) return;
  ThreadArenas arenas;
  for_points(arenas, query.position.rows, [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
    const StepContext ctx{.seed = pipeline.options().seed, .pass = pass.parts().number, .workspace = &arena};
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

template <class Real>
std::vector<Tensor<Real>*> semantic_tensors(ParamStore<Real>& store) {
  std::vector<Tensor<Real>*> tensors;
  for (Tensor<Real>& tensor : store.all())
    if (tensor.rule.semantic && tensor.grad.size() > 0) tensors.push_back(&tensor);
  return tensors;
}

template <class Real>
StepContext LanePoints<Real>::context(std::int64_t step, bool training, Workspace& arena) const {
  return {.seed = pipeline_.options().seed,
          .step = step,
          .training = training,
          .pass = pass().parts().number,
          .workspace = &arena};
}

template <class Real>
void LanePoints<Real>::rows(View<const double> positions, View<Real> rows) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  for_points(arenas_, positions.rows, [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
    pass().point_rows(context(0, false, arena), positions.row_range(begin, count), rows.row_range(begin, count));
  });
}

template <class Real>
void LanePoints<Real>::logits(View<const Real> rows, View<Real> logits) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  for_points(arenas_, rows.rows, [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
    (void)pass().point_forward(context(0, false, arena), kMainGradient, rows.row_range(begin, count),
                               logits.row_range(begin, count));
  });
}

template <class Real>
void LanePoints<Real>::gradients(std::int64_t step, View<const Real> input, View<const std::int16_t> logit,
                                 const std::vector<Tensor<Real>*>& tensors) {
  const std::int64_t rows = input.rows;
  const std::int64_t tiles = (rows + kPointTile - 1) / kPointTile;
  const std::int32_t classes = pass().parts().head->width();
  const int lanes = static_cast<int>(std::min<std::int64_t>(pipeline_.store().lanes(), tiles));
  arenas_.for_units(lanes, [&](Workspace& arena, std::int64_t lane) {
    for (std::int64_t tile = lane; tile < tiles; tile += lanes) {
      const std::int64_t begin = tile * kPointTile, count = std::min(kPointTile, rows - begin);
      const Workspace::Scope taken(arena);
      StepContext ctx = context(step, true, arena);
      ctx.first_ray = begin;
      const View<Real> logits = arena.take<Real>(count, classes), d_logits = arena.take<Real>(count, classes);
      const PointTrace<Real> trace =
          pass().point_forward(ctx, static_cast<int>(lane), input.row_range(begin, count), logits);
      SemanticTargets targets;
      targets.hard = logit.row_range(begin, count);
      semantic_cross_entropy<Real>(logits, targets, {}, static_cast<double>(rows), 1, d_logits, begin);
      pass().point_backward(ctx, static_cast<int>(lane), trace, d_logits);
    }
  });
  for (Tensor<Real>* tensor : tensors) {  // in lane order
    const auto size = static_cast<std::size_t>(tensor->size());
    for (int lane = 0; lane < lanes; ++lane) {
      Real* const from = tensor->lanes.data() + static_cast<std::size_t>(lane) * size;
      for (std::size_t i = 0; i < size; ++i) tensor->grad.data()[i] += from[i];
      std::fill_n(from, size, Real(0));
    }
  }
}

template <class Real>
void LanePoints<Real>::learn(const PointLessons<Real>& lessons) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  const std::vector<Tensor<Real>*> tensors = semantic_tensors(pipeline_.store());
  const auto clear = [](const AlignedBuffer<Real>& buffer) { std::fill_n(buffer.data(), buffer.size(), Real(0)); };
  for (const Tensor<Real>* tensor : tensors) clear(tensor->grad);  // of the last step of training
  std::int64_t step = 0;
  std::vector<Real> rows(static_cast<std::size_t>(lessons.batch * lessons.rows.cols));
  std::vector<std::int16_t> logit(static_cast<std::size_t>(lessons.batch));
  for (AdamStep update : lessons.updates) {
    const StepContext ctx = context(step, true, arenas_.own());
    pass().derive(ctx);
    for (std::int64_t b = 0; b < lessons.batch; ++b) {
      const std::int32_t point = lessons.choice[static_cast<std::size_t>(step * lessons.batch + b)];
      std::copy_n(lessons.rows.row(point), lessons.rows.cols, rows.data() + b * lessons.rows.cols);
      logit[static_cast<std::size_t>(b)] = lessons.logit[static_cast<std::size_t>(point)];
    }
    gradients(step, {rows.data(), lessons.batch, lessons.rows.cols}, {logit.data(), lessons.batch, 1}, tensors);
    pass().derive_backward(ctx);
    for (const Tensor<Real>* tensor : tensors) {
      if (tensor->learned()) {
        update.decay = tensor->spec.rows > 1 ? update.learning_rate * lessons.weight_decay : 0;
        adam_dense<Real>(update, tensor->view(tensor->value), tensor->view(tensor->grad), tensor->view(tensor->moment1),
                         tensor->view(tensor->moment2), 0, tensor->spec.rows);
      }
      clear(tensor->grad);
    }
    ++step;
  }
  for (const Tensor<Real>* tensor : tensors) {
    clear(tensor->moment1);
    clear(tensor->moment2);
  }
  pass().derive(context(step, true, arenas_.own()));
}

template <class Real>
void LanePoints<Real>::write() {
  pass().derive(context(0, true, arenas_.own()));
}

#define SEMFIELD_INSTANTIATE(Real)                                                                          \
  template struct RenderJob<Real>;                                                                          \
  template void render_rays<Real>(const std::vector<Pass<Real>>&, const std::vector<std::int64_t>&,         \
                                  const RenderJob<Real>&, const StepContext&);                              \
  template void query_density<Real>(const Pass<Real>&, View<const double>, View<Real>, const StepContext&); \
  template void query_points<Real>(Pipeline<Real>&, const PointQuery<Real>&);                               \
  template std::vector<Tensor<Real>*> semantic_tensors<Real>(ParamStore<Real> & store);                     \
  template class LanePoints<Real>;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
