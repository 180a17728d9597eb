// CUDA kernels of the hash grid: forward, and the gradient of positions. The gradient of tables is in
// hash_grid_scatter_cuda.cu.
#include "encoders/hash_grid/hash_grid_cuda.cuh"
#include "plugin/kernels.h"

namespace semfield::cuda {

void hash_grid_cuda_kernels(KernelTables& tables);

namespace {

constexpr int kThreads = 256;
constexpr int kThreadCols = 4;   // of y, which a thread writes at once
constexpr int kLanesPerRow = 2;  // neighbours that together write a sector of 32 bytes
constexpr int kBlockRows = kThreads / kLanesPerRow;
constexpr int kGroupCols = kThreadCols * kLanesPerRow;  // of a block
constexpr int kInputThreads = 128;

/// Features of an entry that one thread takes: all, or 4 of 8.
template <int kF>
inline constexpr int kTaken = kF < kThreadCols ? kF : kThreadCols;

template <int kCount>
__device__ inline void load(const float* from, float (&to)[kCount]) {
  if constexpr (kCount == 4) {
    const float4 v = __ldg(reinterpret_cast<const float4*>(from));
    to[0] = v.x, to[1] = v.y, to[2] = v.z, to[3] = v.w;
  } else if constexpr (kCount == 2) {
    const float2 v = __ldg(reinterpret_cast<const float2*>(from));
    to[0] = v.x, to[1] = v.y;
  } else {
    to[0] = __ldg(from);
  }
}
/// Leaves `to` as it is unless `wanted`: one predicated load, where a branch would hold back the loads behind it.
__device__ inline void load_if(bool wanted, const float* from, float (&to)[2]) {
  asm("{ .reg .pred p; setp.ne.s32 p, %3, 0; @p ld.global.nc.v2.f32 {%0, %1}, [%2]; }"
      : "+f"(to[0]), "+f"(to[1])
      : "l"(from), "r"(static_cast<int>(wanted)));
}
__device__ inline void load_if(bool wanted, const float* from, float (&to)[1]) {
  asm("{ .reg .pred p; setp.ne.s32 p, %2, 0; @p ld.global.nc.f32 %0, [%1]; }"
      : "+f"(to[0])
      : "l"(from), "r"(static_cast<int>(wanted)));
}

/// What a level needs between asking for the entries around a position and using them: a thread asks for all of its
/// levels first. Entries of one or two features are read as aligned pairs, of which the far end is the other half
/// whenever the near one's place along x is even (hashed) or its number is (dense): half of all edges take one load. A
/// pair never leaves the table: no near end is the last entry of a dense level, and a hashed one has an even number.
template <int kF, Interpolation kI>
struct Gather {
  static constexpr int kNear = kF > 2 ? kTaken<kF> : 2 * kF;
  Cell cell;
  Edge edge[4];
  float near[4][kNear];
  float far[4][kTaken<kF>] = {};

  /// For features [first, first + kTaken).
  __device__ inline void ask(const GridLevel& level, const double (&u)[3], int first) {
    cell = find_cell<kI>(level, u);
#pragma unroll
    for (int e = 0; e < 4; ++e) edge[e] = edge_of(level, cell, e);
#pragma unroll
    for (int e = 0; e < 4; ++e) {
      if constexpr (kF > 2) {
        load(level.table + static_cast<std::size_t>(edge[e].near) * kF + first, near[e]);
        load(level.table + static_cast<std::size_t>(edge[e].far) * kF + first, far[e]);
      } else {
        load(level.table + static_cast<std::size_t>(edge[e].near & ~1U) * kF, near[e]);
        load_if(!together(e), level.table + static_cast<std::size_t>(edge[e].far) * kF, far[e]);
      }
    }
  }
  __device__ inline bool together(int e) const { return (edge[e].near ^ edge[e].far) == 1; }
  /// Feature f of an edge's ends, once they have come.
  __device__ inline float near_value(int e, int f) const {
    if constexpr (kF > 2) return near[e][f];
    return (edge[e].near & 1) != 0 ? near[e][kNear - kF + f] : near[e][f];
  }
  __device__ inline float far_value(int e, int f) const {
    if constexpr (kF > 2) return far[e][f];
    const float other = (edge[e].near & 1) != 0 ? near[e][f] : near[e][kNear - kF + f];
    return together(e) ? other : far[e][f];
  }
  /// As on the CPU: edges summed in order, then along x.
  __device__ inline float interpolated(int f) const {
    float a = 0, b = 0;
#pragma unroll
    for (int e = 0; e < 4; ++e) {
      a += edge_weight(cell, e) * near_value(e, f);
      b += edge_weight(cell, e) * far_value(e, f);
    }
    return a + cell.far[0] * (b - a);
  }
};

/// One thread 4 columns of a row: 4, 2 or 1 levels, or half of one; two neighbours write 32 bytes of y together. Blocks
/// with the same 8 columns follow each other, finest first, so that few tables at a time pass through the L2 cache. All
/// 8 vertices of a thread's levels are requested before the first is used. A row and level: 5 sectors of a table on
/// average where features are 2 and nothing is in a cache (a far end shares its near end's 32 bytes in 3 of 4 hashed
/// cells), 24 bytes of x once in 8 columns, 4 F bytes written. Deterministic.
template <int kF, Interpolation kI>
__global__ void __launch_bounds__(kThreads)
    forward_kernel(const __grid_constant__ Grid grid, View<const double> x, View<float> y, bool aligned,
                   const std::int32_t* live_rows, FaultKey* fault) {
  const std::int64_t row =
      static_cast<std::int64_t>(blockIdx.x) * kBlockRows + static_cast<int>(threadIdx.x) / kLanesPerRow;
  const int col = static_cast<int>(gridDim.y - 1 - blockIdx.y) * kGroupCols +
                  static_cast<int>(threadIdx.x) % kLanesPerRow * kThreadCols;
  if (row >= x.rows || col >= y.cols) return;
  float out[kThreadCols] = {};
  if (row < live_count(live_rows, x.rows)) {
    const double* const from = x.row(row);
    const double at[3] = {__ldg(from), __ldg(from + 1), __ldg(from + 2)};
    if (col == 0 && !(isfinite(at[0]) && isfinite(at[1]) && isfinite(at[2]))) {
      note_fault(fault, Stage::encoded_position, row);
    }
    const double u[3] = {clamp_unit(at[0]), clamp_unit(at[1]), clamp_unit(at[2])};
    constexpr int kLevels = kThreadCols / kTaken<kF>;
    Gather<kF, kI> gather[kLevels];
#pragma unroll
    for (int l = 0; l < kLevels; ++l) {
      const int level = min(col / kF + l, grid.levels - 1);  // behind the last level: computed, not stored
      gather[l].ask(grid.level[level], u, col % kF);
    }
#pragma unroll
    for (int c = 0; c < kThreadCols; ++c) out[c] = gather[c / kTaken<kF>].interpolated(c % kTaken<kF>);
  }
  float* const to = y.row(row) + col;
  if (aligned && col + kThreadCols <= y.cols) {
    *reinterpret_cast<float4*>(to) = make_float4(out[0], out[1], out[2], out[3]);
    return;
  }
#pragma unroll
  for (int c = 0; c < kThreadCols; ++c) {
    if (col + c < y.cols) to[c] = out[c];
  }
}

/// Gradient of u for one level: sum over vertices of N w'_d(place) times the other axes' weights times <dy, entry>.
template <int kF, Interpolation kI>
__device__ inline void level_gradient(const GridLevel& level, const double (&u)[3], const float* dy, double (&sum)[3]) {
  Gather<kF, kI> gather;
  float product[2][4] = {};  // <dy, entry> at near and far ends
#pragma unroll
  for (int first = 0; first < kF; first += kTaken<kF>) {
    gather.ask(level, u, first);
#pragma unroll
    for (int e = 0; e < 4; ++e) {
#pragma unroll
      for (int f = 0; f < kTaken<kF>; ++f) {
        product[0][e] += dy[first + f] * gather.near_value(e, f);
        product[1][e] += dy[first + f] * gather.far_value(e, f);
      }
    }
  }
  const Cell& cell = gather.cell;
  float slope[3];
#pragma unroll
  for (int d = 0; d < 3; ++d) {
    slope[d] =
        static_cast<float>(level.resolution) * far_weight_slope(axis_cell<float>(u[d], level.resolution).place, kI);
  }
  float along[4], across_y[2] = {0, 0}, across_z[2] = {0, 0}, x_sum = 0;
#pragma unroll
  for (int e = 0; e < 4; ++e) {
    along[e] = product[0][e] + cell.far[0] * (product[1][e] - product[0][e]);
    x_sum += edge_weight(cell, e) * (product[1][e] - product[0][e]);
  }
#pragma unroll
  for (int b = 0; b < 2; ++b) {
    across_y[b] = along[2 * b + 1] - along[2 * b];  // at z near, far
    across_z[b] = along[b + 2] - along[b];          // at y near, far
  }
  sum[0] += slope[0] * x_sum;
  sum[1] += slope[1] * (across_y[0] + cell.far[2] * (across_y[1] - across_y[0]));
  sum[2] += slope[2] * (across_z[0] + cell.far[1] * (across_z[1] - across_z[0]));
}

/// One thread per row, over its levels, summed in double; 0 along an axis on which the row was clamped. A row: 24 + 4 L
/// F bytes and 8 L entries read, 12 bytes written. Deterministic.
template <int kF, Interpolation kI>
__global__ void __launch_bounds__(kInputThreads)
    input_kernel(const __grid_constant__ Grid grid, View<const double> x, View<const float> dy, View<float> dx) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kInputThreads + threadIdx.x;
  if (row >= x.rows) return;
  const double at[3] = {x(row, 0), x(row, 1), x(row, 2)};
  const double u[3] = {clamp_unit(at[0]), clamp_unit(at[1]), clamp_unit(at[2])};
  double sum[3] = {0, 0, 0};
  for (int l = 0; l < grid.levels; ++l) {
    float d[kF];
#pragma unroll
    for (int f = 0; f < kF; ++f) d[f] = dy(row, l * kF + f);
    level_gradient<kF, kI>(grid.level[l], u, d, sum);
  }
#pragma unroll
  for (int d = 0; d < 3; ++d) dx(row, d) = at[d] >= 0 && at[d] <= 1 ? static_cast<float>(sum[d]) : 0.F;
}

std::int64_t forward(const HashGridShape& shape, const View<float>* tables, View<const double> x, View<float> y,
                     Workspace&) {
  if (x.rows == 0) return -1;
  const Grid grid = make_grid(shape, tables);
  const dim3 blocks(blocks_of(x.rows, kBlockRows), blocks_of(y.cols, kGroupCols));
  with_kind(shape, [&]<int kF, Interpolation kI>() {
    forward_kernel<kF, kI>
        <<<blocks, kThreads, 0, launch().stream>>>(grid, x, y, rows_aligned(y), launch().live_rows, launch().fault);
  });
  check_launch("hash grid forward");
  return first_fault_row(Stage::encoded_position);
}

void backward_input(const HashGridShape& shape, const View<float>* tables, View<const double> x, View<const float> dy,
                    View<float> dx) {
  if (x.rows == 0) return;
  const Grid grid = make_grid(shape, tables);
  with_kind(shape, [&]<int kF, Interpolation kI>() {
    input_kernel<kF, kI><<<blocks_of(x.rows, kInputThreads), kInputThreads, 0, launch().stream>>>(grid, x, dy, dx);
  });
  check_launch("hash grid gradient of positions");
}

const HashGridKernels<float> kTable{forward, hash_grid_scatter, backward_input};

}  // namespace

void hash_grid_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'hash_grid'", &kTable); }

}  // namespace semfield::cuda
