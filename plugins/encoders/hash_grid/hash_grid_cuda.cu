// CUDA kernels of the hash grid: forward, and the gradients of positions and tables.

#include <algorithm>
#include <bit>
#include <cstdint>
#include <nv/target>

#include "core/check.h"
#include "core/workspace.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"
#include "encoders/hash_grid/hash_grid_kernels.h"
#include "plugin/kernels.h"

namespace semfield::cuda {

/// A level's table (or its gradient) with what its entries' numbers are made of: x + y_step y + z_step z in a dense
/// level, (x ^ y_step y ^ z_step z) & mask in a hashed one.
struct GridLevel {
  float* table = nullptr;
  double resolution = 0;
  std::uint32_t entries = 0;
  std::uint32_t y_step = 0, z_step = 0;
  std::uint32_t mask = 0;
  bool dense = false;
};

/// A kernel argument: 40 bytes per level.
struct Grid {
  GridLevel level[kHashGridMaxLevels];
  std::int32_t levels = 0;
};

inline Grid make_grid(const HashGridShape& shape, const View<float>* tables) {
  Grid grid;
  grid.levels = shape.levels;
  for (std::int32_t l = 0; l < shape.levels; ++l) {
    const HashGridLevel& from = shape.level[l];
    GridLevel& to = grid.level[l];
    SEMFIELD_CHECK(reinterpret_cast<std::uintptr_t>(tables[l].data) % 16 == 0, "tables start on 16-byte boundaries");
    to.table = tables[l].data;
    to.resolution = static_cast<double>(from.resolution);
    to.entries = static_cast<std::uint32_t>(from.entries);
    to.mask = to.entries - 1;
    to.dense = from.dense;
    const auto vertices = static_cast<std::uint32_t>(from.resolution) + 1;
    to.y_step = from.dense ? dense_index<std::uint32_t>(0, 1, 0, vertices) : hash_index(0, 1, 0, ~0U);
    to.z_step = from.dense ? dense_index<std::uint32_t>(0, 0, 1, vertices) : hash_index(0, 0, 1, ~0U);
  }
  return grid;
}

/// The cell around a position: addends of its vertices' entries, near and far, and weights of the far ones.
struct Cell {
  std::uint32_t x;
  std::uint32_t y[2], z[2];
  float far[3];
};

/// u [3] in [0, 1].
template <Interpolation kI>
__device__ inline Cell find_cell(const GridLevel& level, const double (&u)[3]) {
  AxisCell<float> at[3];
  Cell cell;
#pragma unroll
  for (int d = 0; d < 3; ++d) {
    at[d] = axis_cell<float>(u[d], level.resolution);
    cell.far[d] = far_weight(at[d].place, kI);
  }
  cell.x = at[0].cell;
  cell.y[0] = at[1].cell * level.y_step;
  cell.y[1] = cell.y[0] + level.y_step;
  cell.z[0] = at[2].cell * level.z_step;
  cell.z[1] = cell.z[0] + level.z_step;
  return cell;
}

/// Both ends of edge e along x: the far one along y, z where bit 0, 1 of e is set.
struct Edge {
  std::uint32_t near, far;
};

__device__ inline Edge edge_of(const GridLevel& level, const Cell& cell, int e) {
  const std::uint32_t y = cell.y[e & 1], z = cell.z[e >> 1];
  const std::uint32_t sum = cell.x + y + z, mixed = (cell.x ^ y ^ z) & level.mask;
  const std::uint32_t far_mixed = ((cell.x + 1) ^ y ^ z) & level.mask;
  return level.dense ? Edge{sum, sum + 1} : Edge{mixed, far_mixed};
}

/// Weight of edge e: along y times along z.
__device__ inline float edge_weight(const Cell& cell, int e) {
  const float wy = (e & 1) != 0 ? cell.far[1] : 1.F - cell.far[1];
  const float wz = (e >> 1) != 0 ? cell.far[2] : 1.F - cell.far[2];
  return wy * wz;
}

/// True when rows of `view` can be read and written in 16-byte pieces.
template <class T>
inline bool rows_aligned(View<T> view) {
  return reinterpret_cast<std::uintptr_t>(view.data) % 16 == 0 && view.row_stride % 4 == 0;
}

/// Calls f with the compile-time choices (features, interpolation).
template <class F>
void with_kind(const HashGridShape& shape, const F& f) {
  with_features(shape.features, [&]<int kF>() {
    if (shape.interpolation == Interpolation::smoothstep) return f.template operator()<kF, Interpolation::smoothstep>();
    f.template operator()<kF, Interpolation::linear>();
  });
}

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

// CUDA kernels of the hash grid: gradient of the tables, added by vector reductions, or in fixed point where sums must
// not depend on their order.

constexpr int kWarps = kThreads / kWarp;
constexpr int kVertices = 8;
constexpr int kSegments = kWarp / kVertices;  // of a warp: 8 lanes each, one a vertex
constexpr int kSegmentRows = kVertices;       // consecutive; runs of them within one cell are summed in registers
constexpr int kWarpRows = kSegments * kSegmentRows;
constexpr int kScatterRows = kWarps * kWarpRows;
constexpr int kScatterCols = 8;  // columns of dy that a warp works on: a sector of 32 bytes
constexpr int kMostGroupLevels = 8;
constexpr std::uint32_t kNoEntry = 0xFFFFFFFFU;

/// 8 words of each of 32 rows in shared memory, 8 rows a segment. The halves of every other 4 rows are swapped and
/// segments lie 8 words apart, so that neither 8 rows written in 16-byte pieces by 8 lanes nor one row a segment read
/// by all lanes meet in a bank.
template <class T>
struct RowTable {
  alignas(16) T word[kSegments][8 * kVertices + 8];
  __device__ inline T* at(int segment, int i, int col) { return word[segment] + i * 8 + (col ^ (i & 4)); }
  __device__ inline void write(int segment, int i, const T (&row)[8]) {
    struct alignas(16) Piece {
      T word[4];
    };
    *reinterpret_cast<Piece*>(at(segment, i, 0)) = {row[0], row[1], row[2], row[3]};
    *reinterpret_cast<Piece*>(at(segment, i, 4)) = {row[4], row[5], row[6], row[7]};
  }
};
struct WarpTables {
  RowTable<std::uint32_t> entry;  // by vertex
  RowTable<float> weight;         // by vertex
  RowTable<float> dy;             // by column
};

/// grad[0 .. kCount) += sum, in whatever order: one reduction of 8 or 16 bytes where the chip has it (sm_90).
template <int kCount>
__device__ inline void reduce(float* grad, const float* sum) {
  if constexpr (kCount == 8) {
    reduce<4>(grad, sum);
    reduce<4>(grad + 4, sum + 4);
  } else if constexpr (kCount == 1) {
    atomicAdd(grad, sum[0]);
  } else if constexpr (kCount == 2) {
    NV_IF_ELSE_TARGET(
        NV_PROVIDES_SM_90,
        (asm volatile("red.relaxed.gpu.global.add.v2.f32 [%0], {%1, %2};" ::"l"(grad), "f"(sum[0]), "f"(sum[1]));),
        (atomicAdd(grad, sum[0]); atomicAdd(grad + 1, sum[1]);))
  } else {
    NV_IF_ELSE_TARGET(NV_PROVIDES_SM_90,
                      (asm volatile("red.relaxed.gpu.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(grad),
                                    "f"(sum[0]), "f"(sum[1]), "f"(sum[2]), "f"(sum[3]));),
                      (for (int f = 0; f < 4; ++f) atomicAdd(grad + f, sum[f]);))
  }
}

/// Adds to the tables' gradients. The order of sums, and so their last bits, change from run to run.
struct FloatSums {
  static constexpr int kPairedFeatures = 0;  ///< none
  __device__ inline void prepare() {}
  template <int kF>
  __device__ inline void add(const GridLevel& level, int, std::uint32_t entry, const float* sum, unsigned) const {
    reduce<kF>(level.table + static_cast<std::size_t>(entry) * kF, sum);
  }
};

/// Adds whole multiples of 2^-k to 64-bit sums: whole numbers add up to the same in any order. With a the largest |dy|
/// of the call and M rows, |dy| < 2^(e+1) for e = floor(log2 a) (at least -127) and M <= 2^m; weights of a row sum to
/// 1, so a sum stays below M 2^(e+1) and k = 61 - m - e leaves it below 2^62; k is at most 126, whose 2^-k is the
/// smallest normal number. Each addend is rounded by at most 2^-(k+1) <= M a 2^-61, 2^-43 a for 2^18 rows; an entry's n
/// addends (at most 8 M) by n times that. Runs within one cell are summed in fp32 before, in the order of rows.
struct FixedSums {
  const std::uint32_t* largest = nullptr;  ///< bits of a
  unsigned long long* sums = nullptr;      ///< of a group's levels
  std::int64_t offset[kMostGroupLevels] = {};
  int rows_log2 = 0;  ///< m
  float scale = 0;    ///< 2^k, once prepared

  /// 2^k for sign 1, 2^-k for sign -1; both are normal fp32 numbers.
  __device__ inline float power(int sign) const {
    const int e = static_cast<int>(*largest >> 23) - 127;
    return __int_as_float((127 + sign * min(61 - rows_log2 - e, 126)) << 23);
  }
  __device__ inline void prepare() { scale = power(1); }
  __device__ inline void put(unsigned long long* to, float sum) const {
    const long long whole = __float2ll_rn(sum * scale);  // the product is exact
    if (whole != 0) atomicAdd(to, static_cast<unsigned long long>(whole));
  }
  /// Two features: the lanes of an edge's ends, neighbours, add together, one the first feature of both ends and the
  /// other the second, so that an entry's two sums fall into one sector at once.
  static constexpr int kPairedFeatures = 2;
  template <int kF>
  __device__ inline void add(const GridLevel&, int l, std::uint32_t entry, const float* sum, unsigned together) const {
    unsigned long long* const level = sums + offset[l];
    if constexpr (kF == kPairedFeatures) {
      const bool far = (threadIdx.x & 1) != 0;
      const float other = __shfl_xor_sync(together, far ? sum[0] : sum[1], 1);
      const std::uint32_t other_entry = __shfl_xor_sync(together, entry, 1);
      put(level + std::int64_t{far ? other_entry : entry} * kF + far, far ? other : sum[0]);
      put(level + std::int64_t{far ? entry : other_entry} * kF + far, far ? sum[1] : other);
    } else {
#pragma unroll
      for (int f = 0; f < kF; ++f) put(level + std::int64_t{entry} * kF + f, sum[f]);
    }
  }
};

/// A row's 8 columns of dy from `col` on; 0 behind the last.
__device__ inline void load_columns(View<const float> dy, std::int64_t row, int col, bool aligned, float (&d)[8]) {
  const float* const from = dy.row(row) + col;
  if (aligned && col + kScatterCols <= dy.cols) {
    const float4 a = __ldg(reinterpret_cast<const float4*>(from)), b = __ldg(reinterpret_cast<const float4*>(from) + 1);
    d[0] = a.x, d[1] = a.y, d[2] = a.z, d[3] = a.w;
    d[4] = b.x, d[5] = b.y, d[6] = b.z, d[7] = b.w;
    return;
  }
#pragma unroll
  for (int c = 0; c < kScatterCols; ++c) d[c] = col + c < dy.cols ? __ldg(from + c) : 0.F;
}

/// Numbers and weights of the 8 vertices around u into row i of the tables; vertex v is far along x, y, z where bit 0,
/// 1, 2 of v is set.
template <Interpolation kI>
__device__ inline void write_vertices(WarpTables& tables, int segment, int i, const GridLevel& level,
                                      const double (&u)[3]) {
  const Cell cell = find_cell<kI>(level, u);
  std::uint32_t entry[8];
  float weight[8];
#pragma unroll
  for (int e = 0; e < 4; ++e) {
    const Edge edge = edge_of(level, cell, e);
    const float w = edge_weight(cell, e);
    entry[2 * e] = edge.near;
    entry[2 * e + 1] = edge.far;
    weight[2 * e] = w * (1.F - cell.far[0]);
    weight[2 * e + 1] = w * cell.far[0];
  }
  tables.entry.write(segment, i, entry);
  tables.weight.write(segment, i, weight);
}

/// What a lane has summed of one level and not yet added: its vertex of the cell in which the last rows lay.
template <int kF>
struct Run {
  std::uint32_t entry = kNoEntry;
  float sum[kF] = {};
};

/// Adds what lanes have summed whose `flush` is set, and, with Sums that pair lanes, their neighbours'. By all lanes.
/// Returns whether this lane's sum was added.
template <int kF, class Sums>
__device__ inline bool flush_run(bool flush, const GridLevel& level, int l, const Sums& sums, const Run<kF>& run) {
  unsigned together = 0;
  if constexpr (kF == Sums::kPairedFeatures) {
    const unsigned own = __ballot_sync(kFullMask, flush);
    together = own | (own & 0x55555555U) << 1 | (own & 0xAAAAAAAAU) >> 1;
    flush = (together >> (threadIdx.x % kWarp) & 1) != 0;
  }
  if (flush) sums.template add<kF>(level, l, run.entry, run.sum, together);
  return flush;
}

/// One level: lane v walks through its segment's rows (bit i of `rows`: dy of row i is not all zero) with vertex v, and
/// adds what it has summed whenever the vertex changes.
template <int kF, class Sums>
__device__ inline void walk(WarpTables& tables, int segment, int v, unsigned rows, int col, const GridLevel& level,
                            int l, const Sums& sums) {
  std::uint32_t entry[kSegmentRows];
  float weight[kSegmentRows];
#pragma unroll
  for (int i = 0; i < kSegmentRows; ++i) {
    entry[i] = *tables.entry.at(segment, i, v);
    weight[i] = *tables.weight.at(segment, i, v);
  }
  Run<kF> run;
#pragma unroll
  for (int i = 0; i < kSegmentRows; ++i) {
    const std::uint32_t next = (rows >> i & 1) != 0 ? entry[i] : run.entry;
    const bool moved = next != run.entry;
    const bool flushed = flush_run(moved && run.entry != kNoEntry, level, l, sums, run);
    if (moved || flushed) run = {next, {}};
#pragma unroll
    for (int f = 0; f < kF; ++f) run.sum[f] += weight[i] * *tables.dy.at(segment, i, col + f);
  }
  flush_run(run.entry != kNoEntry, level, l, sums, run);
}

/// A warp 32 rows and 8 columns of dy, 8 / F levels. Its 4 segments take 8 consecutive rows each: first lane i finds
/// the vertices of the segment's row i, then lane v sums vertex v over the rows. Rows come along rays, so on coarse
/// levels runs of them share a cell and cost one addition, which is what those levels' few entries can take; on fine
/// levels neighbouring lanes' vertices are neighbours along x, whose additions fall into one 32-byte sector in 3 of 4
/// hashed cells. Groups of levels follow each other, finest first. A row: 24 bytes of x once in 8 columns, 4 L F of dy,
/// and 5 sectors of a table a fine level. Rows whose dy is zero cost their reading.
template <int kF, Interpolation kI, class Sums>
__device__ inline void scatter_rows(const Grid& grid, View<const double> x, View<const float> dy, int group,
                                    bool aligned, Sums sums, const std::int32_t* live_rows, unsigned block) {
  __shared__ WarpTables shared[kWarps];
  const int warp = static_cast<int>(threadIdx.x) / kWarp, lane = static_cast<int>(threadIdx.x) % kWarp;
  const int segment = lane / kVertices, v = lane % kVertices;
  WarpTables& tables = shared[warp];
  const std::int64_t rows = live_count(live_rows, x.rows);
  const std::int64_t begin = (static_cast<std::int64_t>(block) * kWarps + warp) * kWarpRows, row = begin + lane;
  if (begin >= rows) return;  // a whole warp; nothing here waits for the block
  constexpr int kLevels = kScatterCols / kF;
  sums.prepare();
  float d[kScatterCols] = {};
  double u[3] = {};
  if (row < rows) {
    load_columns(dy, row, group * kScatterCols, aligned, d);
#pragma unroll
    for (int a = 0; a < 3; ++a) u[a] = clamp_unit(__ldg(x.row(row) + a));
  }
  tables.dy.write(segment, v, d);
#pragma unroll
  for (int l = 0; l < kLevels; ++l) {
    if (group * kLevels + l >= grid.levels) break;
    bool any = false;
#pragma unroll
    for (int f = 0; f < kF; ++f) any = any || d[l * kF + f] != 0;  // NaN is not 0
    const unsigned wanted = __ballot_sync(kFullMask, any);
    if (wanted == 0) continue;
    const GridLevel& level = grid.level[group * kLevels + l];
    write_vertices<kI>(tables, segment, v, level, u);
    __syncwarp();
    walk<kF>(tables, segment, v, wanted >> (segment * kVertices) & 0xFF, l * kF, level, l, sums);
    __syncwarp();
  }
}

template <int kF, Interpolation kI>
__global__ void __launch_bounds__(kThreads, 4)
    scatter_kernel(const __grid_constant__ Grid grid, View<const double> x, View<const float> dy, bool aligned,
                   const std::int32_t* live_rows) {
  scatter_rows<kF, kI>(grid, x, dy, static_cast<int>(gridDim.y - 1 - blockIdx.y), aligned, FloatSums{}, live_rows,
                       blockIdx.x);
}

template <int kF, Interpolation kI>
__global__ void __launch_bounds__(kThreads, 4)
    scatter_fixed_kernel(const __grid_constant__ Grid grid, View<const double> x, View<const float> dy, int group,
                         bool aligned, FixedSums sums, const std::int32_t* live_rows) {
  scatter_rows<kF, kI>(grid, x, dy, group, aligned, sums, live_rows, blockIdx.x);
}

/// Gradients of a group's levels += their sums, which are 0 afterwards; blockIdx.y is the level within the group, one
/// thread two numbers at a time. Where dy is not finite sums mean nothing: every level's first gradient becomes NaN,
/// which the check before the update finds. 16 bytes read a pair of numbers, 32 more where one is not 0.
__global__ void __launch_bounds__(kThreads) add_sums_kernel(const __grid_constant__ Grid grid, std::int32_t features,
                                                            int first_level, const __grid_constant__ FixedSums sums) {
  const int l = static_cast<int>(blockIdx.y);
  const GridLevel& level = grid.level[first_level + l];
  const auto unit = static_cast<double>(sums.power(-1));
  const bool finite = *sums.largest < 0x7F800000U;
  const std::int64_t thread = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (!finite && thread == 0) level.table[0] = __int_as_float(0x7FC00000);
  const std::int64_t pairs = (static_cast<std::int64_t>(level.entries) * features + 1) / 2;
  auto* const from = reinterpret_cast<longlong2*>(sums.sums + sums.offset[l]);
  const std::int64_t step = static_cast<std::int64_t>(gridDim.x) * kThreads;
#pragma unroll 4
  for (std::int64_t i = thread; i < pairs; i += step) {
    const longlong2 sum = from[i];  // asked for before the pair before is written
    if ((sum.x | sum.y) == 0) continue;
    from[i] = longlong2{0, 0};
    float* const to = level.table + 2 * i;
    if (finite && sum.x != 0) to[0] += static_cast<float>(static_cast<double>(sum.x) * unit);
    if (finite && sum.y != 0) to[1] += static_cast<float>(static_cast<double>(sum.y) * unit);
  }
}

/// Group after group, so that 64-bit sums take 8 bytes an entry and feature of the largest group alone, and are still
/// in the L2 cache when they are added.
void scatter_fixed(const HashGridShape& shape, const Grid& grid, View<const double> x, View<const float> dy,
                   Workspace& workspace) {
  constexpr std::int64_t kAlign = 32;  // sums: 256 bytes
  const int group_levels = kScatterCols / shape.features;
  const auto padded = [&](int l) { return (shape.level[l].entries * shape.features + kAlign - 1) / kAlign * kAlign; };
  std::int64_t most = 0;
  for (int begin = 0; begin < shape.levels; begin += group_levels) {
    std::int64_t values = 0;
    for (int l = begin; l < std::min(begin + group_levels, shape.levels); ++l) values += padded(l);
    most = std::max(most, values);
  }
  const Workspace::Scope scope(workspace);
  FixedSums sums;
  const std::size_t bytes = static_cast<std::size_t>(most) * sizeof(unsigned long long);
  sums.sums = reinterpret_cast<unsigned long long*>(workspace.take_bytes(bytes));
  sums.rows_log2 = std::bit_width(static_cast<std::uint64_t>(x.rows - 1));
  const cudaStream_t stream = launch().stream;
  auto* const largest = workspace.take<std::uint32_t>(1, 1).data;
  check(cudaMemsetAsync(largest, 0, sizeof *largest, stream), "hash grid: largest gradient");
  find_largest(dy, largest);
  sums.largest = largest;
  check(cudaMemsetAsync(sums.sums, 0, bytes, stream), "hash grid: clearing sums");
  for (int begin = 0; begin < shape.levels; begin += group_levels) {
    const int levels = std::min(group_levels, shape.levels - begin);
    std::int64_t values = 0, largest_level = 0;
    for (int l = 0; l < levels; ++l) {
      sums.offset[l] = values;
      values += padded(begin + l);
      largest_level = std::max(largest_level, padded(begin + l));
    }
    with_kind(shape, [&]<int kF, Interpolation kI>() {
      scatter_fixed_kernel<kF, kI><<<blocks_of(x.rows, kScatterRows), kThreads, 0, stream>>>(
          grid, x, dy, begin / group_levels, rows_aligned(dy), sums, launch().live_rows);
    });
    check_launch("hash grid scatter");
    const dim3 blocks(std::min(blocks_of(largest_level, 2 * kThreads), 8U * static_cast<unsigned>(multiprocessors())),
                      static_cast<unsigned>(levels));
    add_sums_kernel<<<blocks, kThreads, 0, stream>>>(grid, shape.features, begin, sums);
    check_launch("hash grid sums");
  }
}

void backward_tables(const HashGridShape& shape, const View<float>* grads, View<const double> x, View<const float> dy,
                     Workspace& workspace) {
  if (x.rows == 0) return;
  const Grid grid = make_grid(shape, grads);
  if (launch().deterministic) {
    scatter_fixed(shape, grid, x, dy, workspace);
  } else {
    const dim3 blocks(blocks_of(x.rows, kScatterRows), blocks_of(dy.cols, kScatterCols));
    with_kind(shape, [&]<int kF, Interpolation kI>() {
      scatter_kernel<kF, kI>
          <<<blocks, kThreads, 0, launch().stream>>>(grid, x, dy, rows_aligned(dy), launch().live_rows);
    });
    check_launch("hash grid scatter");
  }
}

const HashGridKernels<float> kTable{forward, backward_tables, backward_input};

}  // namespace

void hash_grid_cuda_kernels(KernelTables& tables) { tables.add(Device::cuda, "encoder 'hash_grid'", &kTable); }

}  // namespace semfield::cuda
