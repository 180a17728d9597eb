// A step's rows for a position encoder with tables: collected tile by tile, or drawn ahead of all tiles.
#include <algorithm>
#include <cstring>

#include "compute/parallel.h"
#include "execution/lane_executor.h"

namespace semfield {

namespace {
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
