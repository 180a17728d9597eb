// Passes over matrices, and products that cuBLASLt has no kernel for or is slow at. Passes are bound by memory: a
// thread moves 4 numbers where rows allow it.
#include <cuda_bf16.h>

#include <algorithm>
#include <optional>
#include <type_traits>

#include "compute/math_functions.h"
#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/kernels.h"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

constexpr int kThreads = 256;

template <class T, int N>
struct alignas(sizeof(T) * N) Pack {
  T v[N];
};

__device__ inline float to_float(float x) { return x; }
__device__ inline float to_float(__nv_bfloat16 x) { return __bfloat162float(x); }
template <class T>
__device__ inline T from_float(float x) {
  if constexpr (std::is_same_v<T, float>) {
    return x;
  } else {
    return __float2bfloat16_rn(x);
  }
}

// Whether rows of the matrix fall into packs of 4.
template <class T>
bool packs(const View<T>& m) {
  return m.cols % 4 == 0 && m.row_stride % 4 == 0 && reinterpret_cast<std::uintptr_t>(m.data) % (4 * sizeof(T)) == 0;
}

// Place of a thread's N numbers.
template <int N>
struct Place {
  std::int64_t row;
  std::int32_t col;
};
template <int N>
__device__ inline Place<N> place_of(std::int64_t i, std::int32_t cols) {
  const std::int32_t groups = cols / N;
  if (i < (std::int64_t{1} << 32)) {  // a 32-bit division is several times cheaper
    const auto at = static_cast<std::uint32_t>(i);
    return {at / static_cast<std::uint32_t>(groups),
            static_cast<std::int32_t>(at % static_cast<std::uint32_t>(groups)) * N};
  }
  return {i / groups, static_cast<std::int32_t>(i % groups) * N};
}

// One thread N numbers of `out`; reads in.cols numbers per row, writes out.cols.
template <class From, class To, int N, bool kAdd>
__global__ void copy_kernel(View<const From> in, View<To> out) {
  const std::int64_t i = thread_index();
  if (i * N >= out.size()) return;
  const Place<N> at = place_of<N>(i, out.cols);
  Pack<To, N> result;
  if constexpr (kAdd) result = *reinterpret_cast<const Pack<To, N>*>(out.row(at.row) + at.col);
  if (at.col < in.cols) {
    const Pack<From, N> source = *reinterpret_cast<const Pack<From, N>*>(in.row(at.row) + at.col);
#pragma unroll
    for (int k = 0; k < N; ++k) {
      const float value = to_float(source.v[k]);
      result.v[k] = from_float<To>(kAdd ? to_float(result.v[k]) + value : value);
    }
  } else if constexpr (!kAdd) {
#pragma unroll
    for (int k = 0; k < N; ++k) result.v[k] = from_float<To>(0);
  }
  *reinterpret_cast<Pack<To, N>*>(out.row(at.row) + at.col) = result;
}

template <class From, class To, bool kAdd>
void copy_or_add(View<const From> in, View<To> out) {
  const bool by_four = packs(in) && packs(out);
  queue("copy of a matrix", blocks_of(out.size() / (by_four ? 4 : 1), kThreads), kThreads,
        by_four ? copy_kernel<From, To, 4, kAdd> : copy_kernel<From, To, 1, kAdd>, in, out);
}

// One thread N numbers: reads y and dy, writes dy.
template <class Act, int N>
__global__ void relu_backward_kernel(View<const Act> y, View<Act> dy) {
  const std::int64_t i = thread_index();
  if (i * N >= dy.size()) return;
  const Place<N> at = place_of<N>(i, dy.cols);
  const Pack<Act, N> of = *reinterpret_cast<const Pack<Act, N>*>(y.row(at.row) + at.col);
  auto* place = reinterpret_cast<Pack<Act, N>*>(dy.row(at.row) + at.col);
  Pack<Act, N> gradient = *place;
#pragma unroll
  for (int k = 0; k < N; ++k) {
    if (!(to_float(of.v[k]) > 0)) gradient.v[k] = from_float<Act>(0);
  }
  *place = gradient;
}

// A block sums `rows_each` rows, a thread one column (columns beyond the block's threads in further turns): partial
// [blocks, cols].
template <class Act>
__global__ void partial_sums_kernel(View<const Act> dz, std::int64_t rows_each, View<float> partial) {
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < dz.rows ? begin + rows_each : dz.rows;
  for (std::int32_t col = static_cast<std::int32_t>(threadIdx.x); col < dz.cols; col += blockDim.x) {
    float sum = 0;
#pragma unroll 8
    for (std::int64_t row = begin; row < end; ++row) sum += to_float(dz(row, col));
    partial(blockIdx.x, col) = sum;
  }
}
// A block of 32 x 32 threads sums 32 columns: thread (x, y) the parts y, y + 32, ..., then those 32 sums in order.
__global__ void add_partials_kernel(View<const float> partial, View<float> sums) {
  __shared__ float share[kWarp][kWarp + 1];
  const auto x = static_cast<std::int32_t>(threadIdx.x), y = static_cast<std::int32_t>(threadIdx.y);
  const std::int32_t col = static_cast<std::int32_t>(blockIdx.x) * kWarp + x;
  float sum = 0;
  if (col < sums.cols) {
#pragma unroll 8
    for (std::int64_t part = y; part < partial.rows; part += kWarp) sum += partial(part, col);
  }
  share[y][x] = sum;
  __syncthreads();
  if (y > 0 || col >= sums.cols) return;
  float total = 0;
  for (int k = 0; k < kWarp; ++k) total += share[k][x];
  sums(0, col) += total;
}

// A block sums `rows_each` rows of bf16: 32 threads a row of 256 columns, 8 columns (16 bytes) a thread, so a warp
// reads 512 bytes at a time; groups of threads that share columns are added in order at the end. partial [blocks,
// cols].
constexpr int kSummedColumns = 8;
__global__ void sum_by_eights_kernel(View<const __nv_bfloat16> dz, std::int64_t rows_each, View<float> partial) {
  extern __shared__ float share[];  // [groups][cols]
  const auto threads_a_row = static_cast<int>(dz.cols / kSummedColumns);
  const int groups = static_cast<int>(blockDim.x) / threads_a_row;
  const int group = static_cast<int>(threadIdx.x) / threads_a_row, at = static_cast<int>(threadIdx.x) % threads_a_row;
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < dz.rows ? begin + rows_each : dz.rows;
  float sum[kSummedColumns] = {};
  if (group < groups) {
#pragma unroll 4
    for (std::int64_t row = begin + group; row < end; row += groups) {
      const auto value =
          *reinterpret_cast<const Pack<__nv_bfloat16, kSummedColumns>*>(dz.row(row) + at * kSummedColumns);
#pragma unroll
      for (int k = 0; k < kSummedColumns; ++k) sum[k] += to_float(value.v[k]);
    }
#pragma unroll
    for (int k = 0; k < kSummedColumns; ++k) share[group * dz.cols + at * kSummedColumns + k] = sum[k];
  }
  __syncthreads();
  for (std::int32_t col = static_cast<std::int32_t>(threadIdx.x); col < dz.cols; col += blockDim.x) {
    float total = 0;
    for (int g = 0; g < groups; ++g) total += share[g * dz.cols + col];
    partial(blockIdx.x, col) = total;
  }
}

// First of `count` ascending numbers that is not below `value`.
__device__ inline std::int64_t lower_bound(const View<const std::int32_t>& numbers, std::int64_t count,
                                           std::int64_t value) {
  std::int64_t low = 0, high = count;
  while (low < high) {
    const std::int64_t middle = (low + high) / 2;
    if (numbers(middle, 0) < value) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

// A block per ray, a thread per column: rows in order.
template <class Act>
__global__ void per_ray_kernel(View<const Act> dz, View<const std::int32_t> ray_of_sample,
                               const std::int32_t* live_rows, View<float> d_ray_term) {
  const std::int64_t ray = blockIdx.x, live = live_count(live_rows, dz.rows);
  const std::int64_t begin = lower_bound(ray_of_sample, live, ray), end = lower_bound(ray_of_sample, live, ray + 1);
  for (std::int32_t col = static_cast<std::int32_t>(threadIdx.x); col < d_ray_term.cols; col += blockDim.x) {
    float sum = 0;
#pragma unroll 8
    for (std::int64_t row = begin; row < end; ++row) sum += to_float(dz(row, col));
    d_ray_term(ray, col) = sum;
  }
}

// sums [1, cols] += sums over the rows of partial [any, cols], in a fixed order.
void add_partials(View<const float> partial, View<float> sums) {
  queue("sums of parts", blocks_of(sums.cols, kWarp), dim3(kWarp, kWarp), add_partials_kernel, partial, sums);
}

void sum_by_eights(View<const __nv_bfloat16> dz, View<float> sums, Workspace& arena) {
  constexpr std::int64_t kLeastRows = 64;
  const std::int64_t parts = std::min<std::int64_t>(8 * multiprocessors(), (dz.rows + kLeastRows - 1) / kLeastRows);
  const std::int64_t rows_each = (dz.rows + parts - 1) / parts;
  const int threads_a_row = dz.cols / kSummedColumns;
  const int threads = std::max(kThreads, threads_a_row) / threads_a_row * threads_a_row;
  const std::size_t shared = sizeof(float) * static_cast<std::size_t>(threads) * kSummedColumns;
  const Workspace::Scope scope(arena);
  const View<float> partial = arena.take<float>(parts, dz.cols);
  sum_by_eights_kernel<<<static_cast<unsigned>(parts), static_cast<unsigned>(threads), shared, launch().stream>>>(
      dz, rows_each, partial);
  check_launch("column sums");
  add_partials(partial.col_range(0, sums.cols), sums);
}

// Several small fp32 products in one launch, where cuBLASLt's launches would take longer than the products.

constexpr int kTile = 32;   // rows and columns of D that a block computes
constexpr int kTerms = 32;  // of a slab: what a block multiplies at a time
constexpr int kGroups = 4;  // groups of 64 threads, each with its own terms of a slab
constexpr int kGroupTerms = kTerms / kGroups;
constexpr int kMicro = 4;           // a thread computes kMicro x kMicro numbers
constexpr int kStride = kTile + 4;  // of shared rows: 16-byte loads, no two of a quarter warp on one bank
constexpr int kSlab = kTerms * kStride;
constexpr int kLoads = kTile * kTerms / kThreads;

struct Products {
  SmallProduct all[kMostSmallProducts];
  View<float> partial[kMostSmallProducts];  // [parts, size of D]; empty: one part, which goes to D
  unsigned first_block[kMostSmallProducts + 1];
  int count;
};

// Where a thread loads its numbers of an operand's 32 x 32 slab: lanes along what lies contiguous in memory.
struct ProductPlace {
  int row, term;
};
template <bool kLanesAlongTerms>
__device__ inline ProductPlace place(int i) {
  const auto x = static_cast<int>(threadIdx.x) % kWarp,
             y = static_cast<int>(threadIdx.x) / kWarp + i * (kThreads / kWarp);
  return kLanesAlongTerms ? ProductPlace{y, x} : ProductPlace{x, y};
}

// A slab of an operand seen as [rows, terms] (B: its transpose), as it waits in registers; `contiguous_terms`: of a
// row, terms lie behind each other in memory.
struct Operand {
  const float* data;
  std::int64_t stride;
  bool contiguous_terms;
  __device__ float at(std::int64_t row, std::int64_t term) const {
    return data[contiguous_terms ? row * stride + term : term * stride + row];
  }
  __device__ ProductPlace place_of(int i) const { return contiguous_terms ? place<true>(i) : place<false>(i); }
  __device__ void load(float (&to)[kLoads], std::int64_t first_row, std::int64_t rows, std::int64_t first_term,
                       std::int64_t terms) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const ProductPlace p = place_of(i);
      const bool inside = first_row + p.row < rows && first_term + p.term < terms;
      to[i] = inside ? at(first_row + p.row, first_term + p.term) : 0.0F;
    }
  }
  __device__ void store(const float (&from)[kLoads], float* slab) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const ProductPlace p = place_of(i);
      slab[p.term * kStride + p.row] = from[i];
    }
  }
};

__device__ inline Operand left_of(const Matrix& a) {
  return {static_cast<const float*>(a.data), a.stride, !a.transposed};
}
__device__ inline Operand right_of(const Matrix& b) {
  return {static_cast<const float*>(b.data), b.stride, b.transposed};
}
__host__ __device__ inline std::int64_t terms_of(const Matrix& a) {
  return a.data == nullptr ? 0 : a.transposed ? a.rows : a.cols;
}

struct Micro {
  float sum[kMicro][kMicro];
};

__device__ inline void multiply(const float* left, const float* right, int group, int ty, int tx, Micro& micro) {
#pragma unroll
  for (int k = 0; k < kGroupTerms; ++k) {
    const int term = group * kGroupTerms + k;
    const float4 a = *reinterpret_cast<const float4*>(left + term * kStride + ty * kMicro);
    const float4 b = *reinterpret_cast<const float4*>(right + term * kStride + tx * kMicro);
    const float rows[kMicro] = {a.x, a.y, a.z, a.w}, cols[kMicro] = {b.x, b.y, b.z, b.w};
#pragma unroll
    for (int r = 0; r < kMicro; ++r) {
#pragma unroll
      for (int c = 0; c < kMicro; ++c) micro.sum[r][c] = fmaf(rows[r], cols[c], micro.sum[r][c]);
    }
  }
}

// A block a tile of one product's D over one part of its terms. Slabs pass through shared memory, the next one on its
// way in registers. Order of a sum: a group's terms as they come, then the groups, then C, then D.
__global__ void __launch_bounds__(kThreads) small_products_kernel(const __grid_constant__ Products products) {
  __shared__ __align__(16) float memory[4 * kSlab];  // two slabs of either operand; at the end the groups' sums
  static_assert(kGroups * kTile * kTile <= 4 * kSlab);
  int index = 0;
  while (blockIdx.x >= products.first_block[index + 1]) ++index;
  const SmallProduct& p = products.all[index];
  const View<float>& partial = products.partial[index];
  const auto row_tiles = static_cast<unsigned>((p.d.rows + kTile - 1) / kTile);
  const auto col_tiles = static_cast<unsigned>((p.d.cols + kTile - 1) / kTile);
  unsigned block = blockIdx.x - products.first_block[index];
  const std::int64_t row0 = std::int64_t{block % row_tiles} * kTile;
  block /= row_tiles;
  const std::int64_t col0 = std::int64_t{block % col_tiles} * kTile, part = block / col_tiles;

  const std::int64_t slabs1 = (terms_of(p.a) + kTerms - 1) / kTerms,
                     slabs = slabs1 + (terms_of(p.a2) + kTerms - 1) / kTerms;
  const std::int64_t parts = partial.empty() ? 1 : partial.rows;
  const std::int64_t begin = slabs * part / parts, end = slabs * (part + 1) / parts;
  const auto thread = static_cast<int>(threadIdx.x);
  const int group = thread / (kThreads / kGroups), ty = thread / 8 % 8, tx = thread % 8;
  Micro micro{};
  float a[kLoads], b[kLoads];
  const auto load = [&](std::int64_t slab) {
    const bool first = slab < slabs1;
    const Matrix &left = first ? p.a : p.a2, &right = first ? p.b : p.b2;
    const std::int64_t term = (first ? slab : slab - slabs1) * kTerms, terms = terms_of(left);
    left_of(left).load(a, row0, p.d.rows, term, terms);
    right_of(right).load(b, col0, p.d.cols, term, terms);
  };
  if (begin < end) load(begin);
  for (std::int64_t slab = begin; slab < end; ++slab) {
    float* const left = memory + (slab - begin) % 2 * 2 * kSlab;
    float* const right = left + kSlab;
    const bool first = slab < slabs1;
    left_of(first ? p.a : p.a2).store(a, left);
    right_of(first ? p.b : p.b2).store(b, right);
    __syncthreads();  // and everybody is done with the slab before the last
    if (slab + 1 < end) load(slab + 1);
    multiply(left, right, group, ty, tx, micro);
  }
  __syncthreads();
#pragma unroll
  for (int r = 0; r < kMicro; ++r) {
#pragma unroll
    for (int c = 0; c < kMicro; ++c) {
      memory[(group * kTile + ty * kMicro + r) * kTile + tx * kMicro + c] = micro.sum[r][c];
    }
  }
  __syncthreads();
  for (int i = thread; i < kTile * kTile; i += kThreads) {
    const std::int64_t row = row0 + i / kTile;
    const auto col = static_cast<std::int32_t>(col0 + i % kTile);
    if (row >= p.d.rows || col >= p.d.cols) continue;
    float sum = 0;
    for (int g = 0; g < kGroups; ++g) sum += memory[g * kTile * kTile + i];
    if (!partial.empty()) {
      partial.row(part)[row * p.d.cols + col] = sum;
      continue;
    }
    if (!p.c.empty()) sum += p.c(row, col);
    if (p.add) sum += p.d(row, col);
    p.d(row, col) = sum;
  }
}

// blockIdx.y: product; a thread one number of D: its parts in order, then C, then D.
__global__ void add_parts_kernel(const __grid_constant__ Products products) {
  const SmallProduct& p = products.all[blockIdx.y];
  const View<float>& partial = products.partial[blockIdx.y];
  const std::int64_t i = thread_index();
  if (partial.empty() || i >= p.d.size()) return;
  float sum = 0;
#pragma unroll 8
  for (std::int64_t part = 0; part < partial.rows; ++part) sum += partial.row(part)[i];
  const std::int64_t row = i / p.d.cols;
  const auto col = static_cast<std::int32_t>(i % p.d.cols);
  if (!p.c.empty()) sum += p.c(row, col);
  if (p.add) sum += p.d(row, col);
  p.d(row, col) = sum;
}

// Matrix products of shapes that cuBLASLt has no kernel for.

constexpr int kSimpleTile = 16;

__device__ inline float load(const Matrix& m, std::int64_t row, std::int64_t col) {
  const std::int64_t at = m.transposed ? col * m.stride + row : row * m.stride + col;
  return m.type == Element::fp32 ? static_cast<const float*>(m.data)[at]
                                 : __bfloat162float(static_cast<const __nv_bfloat16*>(m.data)[at]);
}

// One thread an element of D, a block 16 x 16 of them; operands pass through shared memory 16 terms at a time.
__global__ void product_kernel(Matrix a, Matrix b, Matrix d, std::int64_t terms, bool add) {
  __shared__ float left[kSimpleTile][kSimpleTile + 1], right[kSimpleTile][kSimpleTile + 1];
  const int x = static_cast<int>(threadIdx.x), y = static_cast<int>(threadIdx.y);
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kSimpleTile + y;
  const std::int64_t col = static_cast<std::int64_t>(blockIdx.y) * kSimpleTile + x;
  float sum = 0;
  for (std::int64_t k = 0; k < terms; k += kSimpleTile) {
    left[y][x] = row < d.rows && k + x < terms ? load(a, row, k + x) : 0;
    right[y][x] = k + y < terms && col < d.cols ? load(b, k + y, col) : 0;
    __syncthreads();
#pragma unroll
    for (int j = 0; j < kSimpleTile; ++j) sum = fmaf(left[y][j], right[j][x], sum);
    __syncthreads();
  }
  if (row >= d.rows || col >= d.cols) return;
  if (add) sum += load(d, row, col);
  if (d.type == Element::fp32) {
    static_cast<float*>(d.data)[row * d.stride + col] = sum;
  } else {
    static_cast<__nv_bfloat16*>(d.data)[row * d.stride + col] = __float2bfloat16_rn(sum);
  }
}

// A bias that enters each row of a layer by a share of its own: products of one row or one column, which take as long
// as moving y does.

constexpr int kWarps = kThreads / kWarp;
constexpr int kWarpRows = 4;
constexpr int kBlockRows = kWarps * kWarpRows;
constexpr int kLaneColumns = 8;  // at once
constexpr int kColumns = kWarp * kLaneColumns;

// A warp per row; 4 C B written per row.
__global__ void __launch_bounds__(kThreads)
    forward_kernel(View<const float> share, View<const float> bias, View<float> y) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kWarps + threadIdx.x / kWarp;
  if (row >= y.rows) return;
  const float factor = share(row, 0);
  float* const to = y.row(row);
  for (auto c = static_cast<std::int32_t>(threadIdx.x % kWarp); c < y.cols; c += kWarp) to[c] = factor * bias(0, c);
}

// A warp 4 rows, a block 32; a lane every 32nd column, 8 of them at once. dy is read once, 4 C B per row. partial
// [blocks, C]: the block's share of d_bias, rows in order within a warp, then the warps. d_share: a lane's columns in
// order, then the lanes in a fixed tree. Behind the last row and column the last is read, so that no load waits for a
// branch, and counts 0.
__global__ void __launch_bounds__(kThreads)
    backward_kernel(View<const float> share, View<const float> bias, View<const float> dy, View<float> d_share,
                    View<float> partial) {
  __shared__ float of_warp[kWarps][kColumns];
  const int lane = static_cast<int>(threadIdx.x % kWarp), warp = static_cast<int>(threadIdx.x / kWarp);
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kBlockRows + warp * kWarpRows;
  const float* row[kWarpRows];
  float factor[kWarpRows], dot[kWarpRows] = {};
#pragma unroll
  for (int i = 0; i < kWarpRows; ++i) {
    const std::int64_t r = min(first + i, dy.rows - 1);
    row[i] = dy.row(r);
    factor[i] = r == first + i ? share(r, 0) : 0.0F;
  }
  for (std::int32_t base = 0; base < dy.cols; base += kColumns) {
    float d[kWarpRows][kLaneColumns], of_column[kLaneColumns];
#pragma unroll
    for (int j = 0; j < kLaneColumns; ++j) {
      const std::int32_t wanted = base + lane + j * kWarp, c = min(wanted, dy.cols - 1);
      of_column[j] = c == wanted ? bias(0, c) : 0.0F;
#pragma unroll
      for (int i = 0; i < kWarpRows; ++i) d[i][j] = row[i][c];
    }
#pragma unroll
    for (int j = 0; j < kLaneColumns; ++j) {
      float sum = 0;
#pragma unroll
      for (int i = 0; i < kWarpRows; ++i) {
        dot[i] += d[i][j] * of_column[j];
        sum += d[i][j] * factor[i];
      }
      of_warp[warp][lane + j * kWarp] = sum;
    }
    __syncthreads();
    const auto c = static_cast<std::int32_t>(threadIdx.x);
    if (base + c < dy.cols) {
      float total = 0;
      for (int w = 0; w < kWarps; ++w) total += of_warp[w][c];
      partial(blockIdx.x, base + c) = total;
    }
    __syncthreads();  // the sums are read before the next columns' come
  }
  static_assert(kColumns == kThreads);
#pragma unroll
  for (int i = 0; i < kWarpRows; ++i) {
    const float total = warp_sum(dot[i]);
    if (lane == 0 && first + i < dy.rows) d_share(first + i, 0) = total;
  }
}

// One thread per number, bound by memory; rows are short and strided, so a thread finds its row by a division.

/// body(row, column) for every number of `rows` x `cols`.
template <class Body>
__global__ void each_kernel(std::int64_t rows, std::int32_t cols, Body body) {
  const std::int64_t i = thread_index();
  if (i < rows * cols) body(i / cols, static_cast<std::int32_t>(i % cols));
}
template <class Body>
void for_each(std::int64_t rows, std::int32_t cols, const char* what, Body body) {
  queue(what, blocks_of(rows * cols, kThreads), kThreads, each_kernel<Body>, rows, cols, body);
}

template <class Sums, class Act>
struct EndOfRow {
  LayerEnd<Sums, Act> end;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    float value = to_float(end.sums(row, col));
    if (!end.start.empty() && col < end.start.cols)
      value += end.start(!end.row_of.empty() ? end.row_of(row, 0) : end.start.rows == 1 ? 0 : row, col);
    if (end.relu && value < 0) value = 0;  // NaN stays NaN
    if (!end.mask.empty() && !(to_float(end.mask(row, col)) > 0)) value = 0;
    end.out(row, col) = from_float<Act>(value);
  }
};

template <class Act>
struct SineOfRow {
  View<const float> sums;
  float frequency;
  View<Act> value, slope;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    double turns = static_cast<double>(sums(row, col)) * (static_cast<double>(frequency) * 0.15915494309189535);
    turns -= rint(turns);
    float sine = 0, cosine = 0;
    sincos_of_quarters(4.0 * turns, sine, cosine);
    value(row, col) = from_float<Act>(sine);
    if (!slope.empty()) slope(row, col) = from_float<Act>(frequency * cosine);
  }
};

template <class Act>
struct SlopeOfRow {
  View<const Act> slope;
  View<const float> sums;
  View<Act> dz;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    dz(row, col) = from_float<Act>(sums(row, col) * to_float(slope(row, col)));
  }
};

struct FillOfRow {
  View<float> out;
  float value;
  __device__ void operator()(std::int64_t row, std::int32_t col) const { out(row, col) = value; }
};

struct GatherOfRow {
  View<const float> in;
  View<const std::int32_t> ray_of_sample;
  View<float> out;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    out(row, col) = in(ray_of_sample(row, 0), col);
  }
};

struct SigmoidOfRow {
  View<float> rows;
  __device__ void operator()(std::int64_t row, std::int32_t col) const { rows(row, col) = sigmoid(rows(row, col)); }
};

struct LogitOfRow {
  View<const float> value, d_value;
  View<float> d_logit;
  __device__ void operator()(std::int64_t row, std::int32_t col) const {
    d_logit(row, col) = d_value(row, col) * (value(row, col) * (1.0F - value(row, col)));
  }
};

}  // namespace

template <class From, class To>
void convert(View<const From> in, View<To> out) {
  copy_or_add<From, To, false>(in, out);
}

template <class From, class To>
void add_rows(View<const From> in, View<To> out) {
  copy_or_add<From, To, true>(in, out);
}

template <class Act>
void relu_backward(View<const Act> y, View<Act> dy) {
  const bool by_four = packs(y) && packs(dy);
  queue("relu backward", blocks_of(dy.size() / (by_four ? 4 : 1), kThreads), kThreads,
        by_four ? relu_backward_kernel<Act, 4> : relu_backward_kernel<Act, 1>, y, dy);
}

template <class Act>
void add_column_sums(View<const Act> dz, View<float> sums, Workspace& arena) {
  if (dz.size() == 0) return;
  if constexpr (std::is_same_v<Act, __nv_bfloat16>) {
    constexpr int kMostColumns = 1024 * kSummedColumns;
    if (dz.cols % kSummedColumns == 0 && dz.cols <= kMostColumns && dz.row_stride % kSummedColumns == 0 &&
        reinterpret_cast<std::uintptr_t>(dz.data) % 16 == 0)
      return sum_by_eights(dz, sums, arena);
  }
  constexpr std::int64_t kMostParts = 1024;
  constexpr std::int64_t kLeastRows = 64;
  const std::int64_t parts = std::min<std::int64_t>(kMostParts, (dz.rows + kLeastRows - 1) / kLeastRows);
  const std::int64_t rows_each = (dz.rows + parts - 1) / parts;
  const Workspace::Scope scope(arena);
  const View<float> partial = arena.take<float>(parts, dz.cols);
  queue("column sums", static_cast<unsigned>(parts), kThreads, partial_sums_kernel<Act>, dz, rows_each, partial);
  add_partials(partial, sums);
}

template <class Act>
void per_ray_backward(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term) {
  if (d_ray_term.size() == 0) return;
  constexpr int kColumns = 128;
  queue("sums over rays", static_cast<unsigned>(d_ray_term.rows), kColumns, per_ray_kernel<Act>, dz, ray_of_sample,
        launch().live_rows, d_ray_term);
}

void small_products(std::span<const SmallProduct> list, Workspace* arena) {
  constexpr std::int64_t kTermsOfPart = 256, kMostParts = 32;
  if (list.size() > kMostSmallProducts)
    throw Error(ErrorKind::internal, "internal.cuda.shape", "too many small products for one launch");
  std::optional<Workspace::Scope> scope;
  if (arena != nullptr) scope.emplace(*arena);
  Products products{};
  std::int64_t in_parts = 0;  // the largest D that is summed from parts
  for (const SmallProduct& p : list) {
    const int i = products.count++;
    products.all[i] = p;
    const std::int64_t tiles = std::int64_t{blocks_of(p.d.rows, kTile)} * blocks_of(p.d.cols, kTile);
    const bool in_one = arena == nullptr || tiles >= multiprocessors();
    const std::int64_t parts =
        std::clamp<std::int64_t>((terms_of(p.a) + terms_of(p.a2)) / kTermsOfPart, 1, in_one ? 1 : kMostParts);
    if (parts > 1 && p.d.size() > 0) {
      products.partial[i] = arena->take<float>(parts, static_cast<std::int32_t>(p.d.size()));
      in_parts = std::max(in_parts, p.d.size());
    }
    products.first_block[i + 1] = products.first_block[i] + static_cast<unsigned>(tiles * parts);
  }
  queue("small products", products.first_block[products.count], kThreads, small_products_kernel, products);
  const dim3 grid(blocks_of(in_parts, kThreads), static_cast<unsigned>(products.count));
  queue("parts of small products", grid, kThreads, add_parts_kernel, products);
}

void simple_product(const Product& p) {
  if (p.d.rows == 0 || p.d.cols == 0) return;
  constexpr std::int64_t kMostColumns = std::int64_t{65535} * kSimpleTile;
  if (p.d.cols > kMostColumns) {
    throw Error(ErrorKind::failure, "internal.cuda.shape",
                "a matrix product of " + std::to_string(p.d.cols) + " columns; at most " +
                    std::to_string(kMostColumns) + " are computed",
                "");
  }
  const dim3 grid(blocks_of(p.d.rows, kSimpleTile), blocks_of(p.d.cols, kSimpleTile));
  queue("a plain product", grid, dim3(kSimpleTile, kSimpleTile), product_kernel, p.a, p.b, p.d, terms_of(p.a), p.add);
}

void shared_bias_forward(View<const float> share, View<const float> bias, View<float> y) {
  queue("shared bias", blocks_of(y.rows, kWarps), kThreads, forward_kernel, share, bias, y);
}

void shared_bias_backward(const SharedBiasBackward& call, Workspace& arena) {
  if (call.dy.size() == 0) return;
  const Workspace::Scope scope(arena);
  const unsigned blocks = blocks_of(call.dy.rows, kBlockRows);
  const View<float> partial = arena.take<float>(blocks, call.dy.cols);
  queue("gradient of a shared bias", blocks, kThreads, backward_kernel, call.share, call.bias, call.dy, call.d_share,
        partial);
  add_partials(partial, call.d_bias);
}

template <class Sums, class Act>
void finish_rows(const LayerEnd<Sums, Act>& end) {
  for_each(end.out.rows, end.out.cols, "the end of a layer", EndOfRow<Sums, Act>{end});
}

template <class Act>
void sine_rows(View<const float> sums, float frequency, View<Act> value, View<Act> slope) {
  for_each(value.rows, value.cols, "a layer of sines", SineOfRow<Act>{sums, frequency, value, slope});
}

template <class Act>
void times_slope(View<const Act> slope, View<const float> sums, View<Act> dz) {
  for_each(dz.rows, dz.cols, "the gradient of a layer of sines", SlopeOfRow<Act>{slope, sums, dz});
}

#define SEMFIELD_INSTANTIATE(Act)                                                              \
  template void relu_backward<Act>(View<const Act>, View<Act>);                                \
  template void add_column_sums<Act>(View<const Act>, View<float>, Workspace&);                \
  template void per_ray_backward<Act>(View<const Act>, View<const std::int32_t>, View<float>); \
  template void sine_rows<Act>(View<const float>, float, View<Act>, View<Act>);                \
  template void times_slope<Act>(View<const Act>, View<const float>, View<Act>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE
template void convert<float, float>(View<const float>, View<float>);
template void convert<float, __nv_bfloat16>(View<const float>, View<__nv_bfloat16>);
template void convert<__nv_bfloat16, __nv_bfloat16>(View<const __nv_bfloat16>, View<__nv_bfloat16>);
template void convert<__nv_bfloat16, float>(View<const __nv_bfloat16>, View<float>);
template void add_rows<float, float>(View<const float>, View<float>);
template void finish_rows<float, float>(const LayerEnd<float, float>&);
template void finish_rows<float, __nv_bfloat16>(const LayerEnd<float, __nv_bfloat16>&);
template void finish_rows<__nv_bfloat16, __nv_bfloat16>(const LayerEnd<__nv_bfloat16, __nv_bfloat16>&);

void fill(View<float> out, float value) { for_each(out.rows, out.cols, "fill", FillOfRow{out, value}); }

void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out) {
  for_each(out.rows, out.cols, "rows of rays for samples", GatherOfRow{in, ray_of_sample, out});
}

void sigmoid_rows(View<float> rows) { for_each(rows.rows, rows.cols, "a sigmoid", SigmoidOfRow{rows}); }

void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit) {
  for_each(d_logit.rows, d_logit.cols, "the gradient of a sigmoid", LogitOfRow{value, d_value, d_logit});
}

}  // namespace semfield::cuda
