// Passes over matrices that are not products. All are bound by memory: a thread moves 4 numbers where rows allow it.
#include <cuda_bf16.h>

#include <algorithm>
#include <type_traits>

#include "cuda/kernels/device_code.cuh"
#include "cuda/kernels/layers.h"
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

__device__ inline std::int64_t thread_index() {
  return static_cast<std::int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
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
  if (out.size() == 0) return;
  if (packs(in) && packs(out)) {
    copy_kernel<From, To, 4, kAdd><<<blocks_of(out.size() / 4, kThreads), kThreads, 0, launch().stream>>>(in, out);
  } else {
    copy_kernel<From, To, 1, kAdd><<<blocks_of(out.size(), kThreads), kThreads, 0, launch().stream>>>(in, out);
  }
  check_launch("copy of a matrix");
}

__global__ void fill_kernel(View<float> out, float value) {
  const std::int64_t i = thread_index();
  if (i >= out.size()) return;
  const Place<1> at = place_of<1>(i, out.cols);
  out(at.row, at.col) = value;
}

// 32 x 32 numbers a block of 32 x 8 threads through shared memory, so that reads and writes are rows.
__global__ void transpose_kernel(View<const float> in, View<float> out) {
  __shared__ float tile[kWarp][kWarp + 1];
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.y) * kWarp;
  const std::int32_t col = static_cast<std::int32_t>(blockIdx.x) * kWarp;
  const auto x = static_cast<std::int32_t>(threadIdx.x);
  for (int y = static_cast<int>(threadIdx.y); y < kWarp; y += 8) {
    if (row + y < in.rows && col + x < in.cols) tile[y][x] = in(row + y, col + x);
  }
  __syncthreads();
  for (int y = static_cast<int>(threadIdx.y); y < kWarp; y += 8) {
    if (col + y < in.cols && row + x < in.rows) out(col + y, static_cast<std::int32_t>(row + x)) = tile[x][y];
  }
}

// One thread N numbers: reads y and dy, writes dy.
template <class Act, class Grad, int N>
__global__ void relu_backward_kernel(View<const Act> y, View<Grad> dy) {
  const std::int64_t i = thread_index();
  if (i * N >= dy.size()) return;
  const Place<N> at = place_of<N>(i, dy.cols);
  const Pack<Act, N> of = *reinterpret_cast<const Pack<Act, N>*>(y.row(at.row) + at.col);
  auto* place = reinterpret_cast<Pack<Grad, N>*>(dy.row(at.row) + at.col);
  Pack<Grad, N> gradient = *place;
#pragma unroll
  for (int k = 0; k < N; ++k) {
    if (!(to_float(of.v[k]) > 0)) gradient.v[k] = from_float<Grad>(0);
  }
  *place = gradient;
}

// One thread up to 32 columns of a row, which are one word of the mask.
template <class Act>
__global__ void finish_kernel(View<const float> bias, bool relu, View<Act> y, std::uint32_t* mask) {
  const std::int32_t words = (y.cols + 31) / 32;
  const std::int64_t i = thread_index();
  if (i >= y.rows * words) return;
  const std::int64_t row = i / words;
  const std::int32_t word = static_cast<std::int32_t>(i % words);
  std::uint32_t bits = 0;
  for (std::int32_t k = 0; k < 32 && word * 32 + k < y.cols; ++k) {
    const std::int32_t col = word * 32 + k;
    float value = to_float(y(row, col));
    if (!bias.empty()) value += bias(0, col);
    if (relu && value < 0) value = 0;  // NaN stays NaN
    const Act kept = from_float<Act>(value);
    if (to_float(kept) > 0) bits |= 1u << k;
    y(row, col) = kept;
  }
  if (mask != nullptr) mask[row * (mask_stride_bits(y.cols) / 32) + word] = bits;
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

// A block masks and sums `rows_each` rows: 32 threads a row of 256 columns, 8 columns (16 bytes, a byte of the mask) a
// thread, so a warp moves 512 bytes at a time; groups of threads that share columns are added in order at the end.
// partial [blocks, cols].
constexpr int kMaskedColumns = 8;
template <bool kMask>
__global__ void mask_and_sum_kernel(const std::uint8_t* mask, std::int64_t mask_stride, View<__nv_bfloat16> dx,
                                    std::int64_t rows_each, View<float> partial) {
  extern __shared__ float share[];  // [groups][cols]
  const auto threads_a_row = static_cast<int>(dx.cols / kMaskedColumns);
  const int groups = static_cast<int>(blockDim.x) / threads_a_row;
  const int group = static_cast<int>(threadIdx.x) / threads_a_row, at = static_cast<int>(threadIdx.x) % threads_a_row;
  const std::int64_t begin = static_cast<std::int64_t>(blockIdx.x) * rows_each;
  const std::int64_t end = begin + rows_each < dx.rows ? begin + rows_each : dx.rows;
  float sum[kMaskedColumns] = {};
  if (group < groups) {
#pragma unroll 4
    for (std::int64_t row = begin + group; row < end; row += groups) {
      auto* const place = reinterpret_cast<Pack<__nv_bfloat16, kMaskedColumns>*>(dx.row(row) + at * kMaskedColumns);
      Pack<__nv_bfloat16, kMaskedColumns> value = *place;
      const unsigned bits = kMask ? mask[row * mask_stride + at] : 0xFFu;
#pragma unroll
      for (int k = 0; k < kMaskedColumns; ++k) {
        if ((bits >> k & 1u) == 0) value.v[k] = from_float<__nv_bfloat16>(0);
        sum[k] += to_float(value.v[k]);
      }
      if (kMask) *place = value;
    }
#pragma unroll
    for (int k = 0; k < kMaskedColumns; ++k) share[group * dx.cols + at * kMaskedColumns + k] = sum[k];
  }
  __syncthreads();
  for (std::int32_t col = static_cast<std::int32_t>(threadIdx.x); col < dx.cols; col += blockDim.x) {
    float total = 0;
    for (int g = 0; g < groups; ++g) total += share[g * dx.cols + col];
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

}  // namespace

template <class From, class To>
void convert(View<const From> in, View<To> out) {
  copy_or_add<From, To, false>(in, out);
}

template <class From, class To>
void add_rows(View<const From> in, View<To> out) {
  copy_or_add<From, To, true>(in, out);
}

void fill(View<float> out, float value) {
  if (out.size() == 0) return;
  fill_kernel<<<blocks_of(out.size(), kThreads), kThreads, 0, launch().stream>>>(out, value);
  check_launch("fill");
}

void transpose(View<const float> in, View<float> out) {
  if (in.size() == 0) return;
  const dim3 grid(blocks_of(in.cols, kWarp), blocks_of(in.rows, kWarp));
  transpose_kernel<<<grid, dim3(kWarp, 8), 0, launch().stream>>>(in, out);
  check_launch("transpose");
}

template <class Act, class Grad>
void relu_backward(View<const Act> y, View<Grad> dy) {
  if (dy.size() == 0) return;
  if (packs(y) && packs(dy)) {
    relu_backward_kernel<Act, Grad, 4><<<blocks_of(dy.size() / 4, kThreads), kThreads, 0, launch().stream>>>(y, dy);
  } else {
    relu_backward_kernel<Act, Grad, 1><<<blocks_of(dy.size(), kThreads), kThreads, 0, launch().stream>>>(y, dy);
  }
  check_launch("relu backward");
}

template <class Act>
void finish_layer(View<const float> bias, Activation activation, View<Act> y, std::uint32_t* mask) {
  if (y.size() == 0) return;
  const std::int64_t words = (y.cols + 31) / 32;
  finish_kernel<Act><<<blocks_of(y.rows * words, kThreads), kThreads, 0, launch().stream>>>(
      bias, activation == Activation::relu, y, mask);
  check_launch("bias and activation");
}

namespace {

// mask null: sums alone.
void sum_by_eights(const std::uint32_t* mask, View<__nv_bfloat16> dx, View<float> sums, Workspace& arena) {
  constexpr std::int64_t kLeastRows = 64;
  const std::int64_t parts = std::min<std::int64_t>(8 * multiprocessors(), (dx.rows + kLeastRows - 1) / kLeastRows);
  const std::int64_t rows_each = (dx.rows + parts - 1) / parts;
  const int threads_a_row = dx.cols / kMaskedColumns;
  const int threads = std::max(kThreads, threads_a_row) / threads_a_row * threads_a_row;
  const std::size_t shared = sizeof(float) * static_cast<std::size_t>(threads) * kMaskedColumns;
  const Workspace::Scope scope(arena);
  const View<float> partial = arena.take<float>(parts, dx.cols);
  const auto kernel = mask != nullptr ? mask_and_sum_kernel<true> : mask_and_sum_kernel<false>;
  kernel<<<static_cast<unsigned>(parts), static_cast<unsigned>(threads), shared, launch().stream>>>(
      reinterpret_cast<const std::uint8_t*>(mask), mask_stride_bits(dx.cols) / 8, dx, rows_each, partial);
  check_launch("mask and column sums");
  if (!sums.empty()) add_partials(partial.col_range(0, sums.cols), sums);
}

}  // namespace

template <class Act>
void add_column_sums(View<const Act> dz, View<float> sums, Workspace& arena) {
  if (dz.size() == 0) return;
  if constexpr (std::is_same_v<Act, __nv_bfloat16>) {
    constexpr int kMostColumns = 1024 * kMaskedColumns;
    if (dz.cols % kMaskedColumns == 0 && dz.cols <= kMostColumns && dz.row_stride % kMaskedColumns == 0 &&
        reinterpret_cast<std::uintptr_t>(dz.data) % 16 == 0) {
      const View<Act> rows(const_cast<Act*>(dz.data), dz.rows, dz.cols, dz.row_stride, dz.device);
      return sum_by_eights(nullptr, rows, sums, arena);
    }
  }
  constexpr std::int64_t kMostParts = 1024;
  constexpr std::int64_t kLeastRows = 64;
  const std::int64_t parts = std::min<std::int64_t>(kMostParts, (dz.rows + kLeastRows - 1) / kLeastRows);
  const std::int64_t rows_each = (dz.rows + parts - 1) / parts;
  const Workspace::Scope scope(arena);
  const View<float> partial = arena.take<float>(parts, dz.cols);
  partial_sums_kernel<Act><<<static_cast<unsigned>(parts), kThreads, 0, launch().stream>>>(dz, rows_each, partial);
  check_launch("column sums");
  add_partials(partial, sums);
}

void mask_and_sum(const std::uint32_t* mask, View<__nv_bfloat16> dx, View<float> sums, Workspace& arena) {
  if (dx.size() > 0) sum_by_eights(mask, dx, sums, arena);
}

void add_partials(View<const float> partial, View<float> sums) {
  if (sums.size() == 0) return;
  add_partials_kernel<<<blocks_of(sums.cols, kWarp), dim3(kWarp, kWarp), 0, launch().stream>>>(partial, sums);
  check_launch("sums of parts");
}

template <class Act>
void per_ray_backward(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term) {
  if (d_ray_term.size() == 0) return;
  constexpr int kColumns = 128;
  per_ray_kernel<Act><<<static_cast<unsigned>(d_ray_term.rows), kColumns, 0, launch().stream>>>(
      dz, ray_of_sample, launch().live_rows, d_ray_term);
  check_launch("sums over rays");
}

#define SEMFIELD_INSTANTIATE(Act)                                                            \
  template void finish_layer<Act>(View<const float>, Activation, View<Act>, std::uint32_t*); \
  template void add_column_sums<Act>(View<const Act>, View<float>, Workspace&);              \
  template void per_ray_backward<Act>(View<const Act>, View<const std::int32_t>, View<float>);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(__nv_bfloat16)
#undef SEMFIELD_INSTANTIATE
template void convert<float, float>(View<const float>, View<float>);
template void convert<float, __nv_bfloat16>(View<const float>, View<__nv_bfloat16>);
template void convert<__nv_bfloat16, __nv_bfloat16>(View<const __nv_bfloat16>, View<__nv_bfloat16>);
template void convert<__nv_bfloat16, float>(View<const __nv_bfloat16>, View<float>);
template void add_rows<float, float>(View<const float>, View<float>);
template void add_rows<float, __nv_bfloat16>(View<const float>, View<__nv_bfloat16>);
template void add_rows<__nv_bfloat16, float>(View<const __nv_bfloat16>, View<float>);
template void relu_backward<float, float>(View<const float>, View<float>);
template void relu_backward<__nv_bfloat16, float>(View<const __nv_bfloat16>, View<float>);
template void relu_backward<__nv_bfloat16, __nv_bfloat16>(View<const __nv_bfloat16>, View<__nv_bfloat16>);

}  // namespace semfield::cuda
