#include "execution/point_network.h"

#include <algorithm>
#include <cstring>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "execution/lane_executor.h"
#include "losses/semantic_cross_entropy.h"

namespace semfield {

namespace {
constexpr std::int64_t kUnit = 1024;  // points of a unit of work; results do not depend on it
constexpr std::int64_t kTile = 64;    // points of a batch that one lane takes

// body(arena, begin, count) for units of the points.
template <class Body>
void for_points(ThreadArenas& arenas, std::int64_t points, const Body& body) {
  arenas.for_units((points + kUnit - 1) / kUnit, [&](Workspace& arena, std::int64_t unit) {
    const Workspace::Scope taken(arena);
    body(arena, unit * kUnit, std::min(kUnit, points - unit * kUnit));
  });
}

constexpr std::int64_t kRowsAhead = 1024;  // encoded in one call; by row, so it changes no bits

template <class Real>
Rays<Real> rays_of_tile(const RayBatch& batch, std::int64_t tile, std::int64_t tile_rays) {
  const std::int64_t begin = tile * tile_rays, count = std::min(tile_rays, batch.origin.rows - begin);
  Rays<Real> rays;
  rays.origin = batch.origin.row_range(begin, count);
  rays.direction = batch.direction.row_range(begin, count);
  rays.near_far = batch.near_far.row_range(begin, count);
  return rays;
}

template <class T>
void grow(std::vector<T>& buffer, std::int64_t size) {
  if (buffer.size() < static_cast<std::size_t>(size)) buffer.resize(static_cast<std::size_t>(size));
}

template <class T>
std::size_t bytes_of(const std::vector<T>& buffer) {
  return buffer.capacity() * sizeof(T);
}

}  // namespace

template <class Real>
void query_points(Pipeline<Real>& pipeline, const PointQuery<Real>& query) {
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  const Pass<Real>& pass = pipeline.passes().back();
  if (!query.sigma.empty()) pipeline.lanes().density(query.position, query.sigma);
  if (query.color.empty() && query.logits.empty()) return;
  ThreadArenas arenas;
  for_points(arenas, query.position.rows, [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
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

template <class Real>
std::vector<Tensor<Real>*> semantic_tensors(ParamStore<Real>& store) {
  std::vector<Tensor<Real>*> tensors;
  for (Tensor<Real>& tensor : store.all())
    if (tensor.rule.semantic && tensor.grad.size() > 0) tensors.push_back(&tensor);
  return tensors;
}

template <class Real>
struct LanePoints<Real>::Batch {
  std::int64_t step = 0;
  std::vector<Real> rows;           // [B, dims]
  std::vector<std::int16_t> logit;  // [B]
  std::vector<Tensor<Real>*> tensors;
};

template <class Real>
StepContext LanePoints<Real>::context(std::int64_t step, bool training, Workspace& arena) const {
  StepContext ctx;
  ctx.seed = pipeline_.options().seed;
  ctx.step = step;
  ctx.training = training;
  ctx.pass = pass().parts().number;
  ctx.workspace = &arena;
  return ctx;
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
void LanePoints<Real>::gradients(const Batch& batch) {
  const auto rows = static_cast<std::int64_t>(batch.logit.size());
  const auto dims = static_cast<std::int32_t>(static_cast<std::int64_t>(batch.rows.size()) / rows);
  const std::int64_t tiles = (rows + kTile - 1) / kTile;
  const std::int32_t classes = pass().parts().head->width();
  const int lanes = static_cast<int>(std::min<std::int64_t>(pipeline_.store().lanes(), tiles));
  const View<const Real> input(batch.rows.data(), rows, dims);
  arenas_.for_units(lanes, [&](Workspace& arena, std::int64_t lane) {
    for (std::int64_t tile = lane; tile < tiles; tile += lanes) {
      const std::int64_t begin = tile * kTile, count = std::min(kTile, rows - begin);
      const Workspace::Scope taken(arena);
      StepContext ctx = context(batch.step, true, arena);
      ctx.first_ray = begin;
      const View<Real> logits = arena.take<Real>(count, classes), d_logits = arena.take<Real>(count, classes);
      const PointTrace<Real> trace =
          pass().point_forward(ctx, static_cast<int>(lane), input.row_range(begin, count), logits);
      SemanticTargets targets;
      targets.hard = {batch.logit.data() + begin, count, 1};
      semantic_cross_entropy<Real>(logits, targets, {}, static_cast<double>(rows), 1, d_logits, begin);
      pass().point_backward(ctx, static_cast<int>(lane), trace, d_logits);
    }
  });
  for (Tensor<Real>* tensor : batch.tensors) {  // in lane order
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
  Batch batch;
  batch.tensors = semantic_tensors(pipeline_.store());
  const auto clear = [](const AlignedBuffer<Real>& buffer) { std::fill_n(buffer.data(), buffer.size(), Real(0)); };
  for (const Tensor<Real>* tensor : batch.tensors) clear(tensor->grad);  // of the last step of training
  batch.rows.resize(static_cast<std::size_t>(lessons.batch * lessons.rows.cols));
  batch.logit.resize(static_cast<std::size_t>(lessons.batch));
  for (AdamStep update : lessons.updates) {
    const StepContext ctx = context(batch.step, true, arenas_.own());
    pass().derive(ctx);
    for (std::int64_t b = 0; b < lessons.batch; ++b) {
      const std::int32_t point = lessons.choice[static_cast<std::size_t>(batch.step * lessons.batch + b)];
      std::copy_n(lessons.rows.row(point), lessons.rows.cols, batch.rows.data() + b * lessons.rows.cols);
      batch.logit[static_cast<std::size_t>(b)] = lessons.logit[static_cast<std::size_t>(point)];
    }
    gradients(batch);
    pass().derive_backward(ctx);
    for (const Tensor<Real>* tensor : batch.tensors) {
      if (tensor->learned()) {
        update.decay = tensor->spec.rows > 1 ? update.learning_rate * lessons.weight_decay : 0;
        adam_dense<Real>(update, tensor->view(tensor->value), tensor->view(tensor->grad), tensor->view(tensor->moment1),
                         tensor->view(tensor->moment2), 0, tensor->spec.rows);
      }
      clear(tensor->grad);
    }
    ++batch.step;
  }
  for (const Tensor<Real>* tensor : batch.tensors) {
    clear(tensor->moment1);
    clear(tensor->moment2);
  }
  pass().derive(context(batch.step, true, arenas_.own()));
}

template <class Real>
void LanePoints<Real>::write() {
  pass().derive(context(0, true, arenas_.own()));
}

#define SEMFIELD_INSTANTIATE(Real)                                                      \
  template void query_points<Real>(Pipeline<Real>&, const PointQuery<Real>&);           \
  template std::vector<Tensor<Real>*> semantic_tensors<Real>(ParamStore<Real> & store); \
  template class LanePoints<Real>;
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

// A step's rows for a position encoder with tables: collected tile by tile, or drawn ahead of all tiles.

template <class Real>
View<Real> EncoderInbox<Real>::append(View<const double> tile_x, std::int32_t dims) {
  const auto begin = static_cast<std::size_t>(rows), count = static_cast<std::size_t>(tile_x.rows);
  const auto width = static_cast<std::size_t>(dims);
  x.resize((begin + count) * 3);
  dy.resize((begin + count) * width);
  std::memcpy(x.data() + begin * 3, tile_x.data, count * 3 * sizeof(double));
  rows += tile_x.rows;
  return View<Real>(dy.data() + begin * width, tile_x.rows, dims);
}

template <class Real>
std::size_t LaneExecutor<Real>::Ahead::bytes() const {
  return bytes_of(t) + bytes_of(delta) + bytes_of(ray_of_sample) + bytes_of(first) + bytes_of(x) + bytes_of(encoded) +
         bytes_of(d_encoded);
}

template <class Real>
void LaneExecutor<Real>::draw_ahead(std::int64_t step, const RayBatch& batch, std::int64_t tiles) {
  Ahead& a = ahead_;
  const Pass<Real>& pass = passes()[0];
  const std::int64_t capacity = pipeline_.per_ray()[0] * pipeline_.tile_rays();
  grow(a.t, tiles * capacity);
  grow(a.delta, tiles * capacity);
  grow(a.ray_of_sample, tiles * capacity);
  grow(a.first, tiles * (pipeline_.tile_rays() + 1));
  grow(a.tiles, tiles);
  grow(a.row, tiles);
  arenas_.for_units(tiles, [&](Workspace& arena, std::int64_t tile) {
    if (!is_own(tile)) return;
    StepContext ctx = context(step, true, tile * pipeline_.tile_rays(), arena);
    ctx.pass = passes()[0].parts().number;
    const Rays<Real> rays = rays_of_tile<Real>(batch, tile, pipeline_.tile_rays());
    Samples<Real>& samples = a.tiles[static_cast<std::size_t>(tile)].samples;
    samples.t = {a.t.data() + tile * capacity, capacity, 1};
    samples.delta = {a.delta.data() + tile * capacity, capacity, 1};
    samples.ray_of_sample = {a.ray_of_sample.data() + tile * capacity, capacity, 1};
    samples.first = {a.first.data() + tile * (pipeline_.tile_rays() + 1), rays.origin.rows + 1, 1};
    pass.sample(ctx, rays, nullptr, samples);
  });
  // Lane after lane, as the encoder's gradients are summed. Lane l has the tiles l, l + lanes, ... Those of other
  // processes have no rows here.
  const std::int32_t dims = pass.encoded_dims();
  a.rows = 0;
  grow(a.lane_begin, options().lanes + 1);
  for (int lane = 0; lane < options().lanes; ++lane) {
    a.lane_begin[static_cast<std::size_t>(lane)] = a.rows;
    for (std::int64_t tile = lane; tile < tiles && is_own(tile); tile += options().lanes) {
      a.row[static_cast<std::size_t>(tile)] = a.rows;
      a.rows += a.tiles[static_cast<std::size_t>(tile)].samples.count;
    }
  }
  a.lane_begin.back() = a.rows;
  grow(a.x, 3 * a.rows);
  grow(a.encoded, dims * a.rows);
  grow(a.d_encoded, dims * a.rows);
  arenas_.for_units(tiles, [&](Workspace& arena, std::int64_t tile) {
    if (!is_own(tile)) return;
    SampledTile<Real>& sampled = a.tiles[static_cast<std::size_t>(tile)];
    const std::int64_t row = a.row[static_cast<std::size_t>(tile)], count = sampled.samples.count;
    sampled.x = {a.x.data() + 3 * row, count, 3};
    sampled.encoded = {a.encoded.data() + dims * row, count, dims};
    pass.locate(context(step, true, tile * pipeline_.tile_rays(), arena),
                rays_of_tile<Real>(batch, tile, pipeline_.tile_rays()), sampled.samples, sampled.x);
  });
  const auto encode = [&](Workspace& arena, std::int64_t begin, std::int64_t count) {
    pass.encode(context(step, true, 0, arena), kMainGradient, {a.x.data() + 3 * begin, count, 3},
                {a.encoded.data() + dims * begin, count, dims});
  };
  if (a.rows == 0) return;
  if (pass.parts().position->traits().whole_batch) return encode(arenas_.own(), 0, a.rows);
  arenas_.for_units((a.rows + kRowsAhead - 1) / kRowsAhead, [&](Workspace& arena, std::int64_t i) {
    encode(arena, i * kRowsAhead, std::min(kRowsAhead, a.rows - i * kRowsAhead));
  });
}

template <class Real>
void LaneExecutor<Real>::scatter(std::int64_t step) {
  StepContext ctx = context(step, true);
  for (std::size_t p = 0; p < passes().size(); ++p) {
    if (!passes()[p].scatters()) continue;
    if (!draws_ahead()) {
      ctx.pass = passes()[p].parts().number;
      gather(p);
    }
    EncodedRows<Real> rows{{ahead_.x.data(), ahead_.rows, 3},
                           {ahead_.d_encoded.data(), ahead_.rows, passes()[p].encoded_dims()}};
    if (ranks_) rows = ranks_->gather_rows(rows);
    passes()[p].scatter(ctx, rows.x, rows.d_encoded);
  }
}

// What the lanes have for pass p, lane after lane, where a pass that draws ahead has its rows: an encoder's tables are
// then walked once.
template <class Real>
void LaneExecutor<Real>::gather(std::size_t p) {
  Ahead& a = ahead_;
  a.rows = 0;
  grow(a.lane_begin, std::ssize(inboxes_) + 1);
  for (std::size_t lane = 0; lane < inboxes_.size(); ++lane) {
    a.lane_begin[lane] = a.rows;
    a.rows += inboxes_[lane][p].rows;
  }
  const std::int32_t dims = passes()[p].encoded_dims();
  grow(a.x, 3 * a.rows);
  grow(a.d_encoded, dims * a.rows);
  parallel_for(std::ssize(inboxes_), [&](std::int64_t lane) {
    const EncoderInbox<Real>& inbox = inboxes_[static_cast<std::size_t>(lane)][p];
    const std::int64_t begin = a.lane_begin[static_cast<std::size_t>(lane)];
    std::copy_n(inbox.x.data(), 3 * inbox.rows, a.x.data() + 3 * begin);
    std::copy_n(inbox.dy.data(), dims * inbox.rows, a.d_encoded.data() + dims * begin);
  });
}

#define SEMFIELD_INSTANTIATE(Real)                                                           \
  template struct EncoderInbox<Real>;                                                        \
  template std::size_t LaneExecutor<Real>::Ahead::bytes() const;                             \
  template void LaneExecutor<Real>::draw_ahead(std::int64_t, const RayBatch&, std::int64_t); \
  template void LaneExecutor<Real>::gather(std::size_t);                                     \
  template void LaneExecutor<Real>::scatter(std::int64_t);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
