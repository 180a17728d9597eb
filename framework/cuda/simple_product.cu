// Matrix products without cuBLASLt: small ones, several in a launch; and for shapes that it has no kernel for.
#include <cuda_bf16.h>

#include <algorithm>

#include "core/error.h"
#include "cuda/device_code.cuh"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

constexpr int kTile = 16;

__device__ inline float load(const Matrix& m, std::int64_t row, std::int64_t col) {
  const std::int64_t at = m.transposed ? col * m.stride + row : row * m.stride + col;
  return m.type == Element::fp32 ? static_cast<const float*>(m.data)[at]
                                 : __bfloat162float(static_cast<const __nv_bfloat16*>(m.data)[at]);
}

// One thread an element of D, a block 16 x 16 of them; operands pass through shared memory 16 terms at a time.
__global__ void product_kernel(Matrix a, Matrix b, Matrix d, std::int64_t terms, bool add) {
  __shared__ float left[kTile][kTile + 1], right[kTile][kTile + 1];
  const int x = static_cast<int>(threadIdx.x), y = static_cast<int>(threadIdx.y);
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kTile + y;
  const std::int64_t col = static_cast<std::int64_t>(blockIdx.y) * kTile + x;
  float sum = 0;
  for (std::int64_t k = 0; k < terms; k += kTile) {
    left[y][x] = row < d.rows && k + x < terms ? load(a, row, k + x) : 0;
    right[y][x] = k + y < terms && col < d.cols ? load(b, k + y, col) : 0;
    __syncthreads();
#pragma unroll
    for (int j = 0; j < kTile; ++j) sum = fmaf(left[y][j], right[j][x], sum);
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

constexpr int kSmallTile = 32, kSmallRows = 8;

struct SmallProducts {
  SmallProduct all[kMostSmallProducts];
};

__device__ inline float load_fp32(const Matrix& m, std::int64_t row, std::int64_t col) {
  return static_cast<const float*>(m.data)[m.transposed ? col * m.stride + row : row * m.stride + col];
}

// blockIdx.z: product; a block of 32 x 8 threads 32 x 32 numbers of D, a thread 4 of a column.
__global__ void small_products_kernel(const __grid_constant__ SmallProducts products) {
  __shared__ float left[kSmallTile][kSmallTile + 1], right[kSmallTile][kSmallTile + 1];
  constexpr int kEach = kSmallTile / kSmallRows;
  const SmallProduct& p = products.all[blockIdx.z];
  const int x = static_cast<int>(threadIdx.x), y = static_cast<int>(threadIdx.y);
  const std::int64_t row0 = static_cast<std::int64_t>(blockIdx.x) * kSmallTile;
  const std::int64_t col0 = static_cast<std::int64_t>(blockIdx.y) * kSmallTile;
  if (row0 >= p.d.rows || col0 >= p.d.cols) return;
  float sum[kEach] = {};
  for (int pair = 0; pair < 2; ++pair) {
    const Matrix& a = pair == 0 ? p.a : p.a2;
    const Matrix& b = pair == 0 ? p.b : p.b2;
    const std::int64_t terms = a.data == nullptr ? 0 : a.transposed ? a.rows : a.cols;
    for (std::int64_t k = 0; k < terms; k += kSmallTile) {
#pragma unroll
      for (int i = 0; i < kEach; ++i) {
        const int at = y + i * kSmallRows;
        left[at][x] = row0 + at < p.d.rows && k + x < terms ? load_fp32(a, row0 + at, k + x) : 0;
        right[at][x] = k + at < terms && col0 + x < p.d.cols ? load_fp32(b, k + at, col0 + x) : 0;
      }
      __syncthreads();
#pragma unroll
      for (int j = 0; j < kSmallTile; ++j) {
#pragma unroll
        for (int i = 0; i < kEach; ++i) sum[i] = fmaf(left[y + i * kSmallRows][j], right[j][x], sum[i]);
      }
      __syncthreads();
    }
  }
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    const std::int64_t row = row0 + y + i * kSmallRows;
    const auto col = static_cast<std::int32_t>(col0 + x);
    if (row >= p.d.rows || col >= p.d.cols) continue;
    if (!p.c.empty()) sum[i] += p.c(row, col);
    if (p.add) sum[i] += p.d(row, col);
    p.d(row, col) = sum[i];
  }
}

}  // namespace

void small_products(std::span<const SmallProduct> list) {
  SmallProducts products;
  if (list.size() > kMostSmallProducts) throw Error(ErrorKind::internal, "too many small products for one launch");
  unsigned rows = 0, cols = 0;
  for (std::size_t i = 0; i < list.size(); ++i) {
    products.all[i] = list[i];
    rows = std::max(rows, blocks_of(list[i].d.rows, kSmallTile));
    cols = std::max(cols, blocks_of(list[i].d.cols, kSmallTile));
  }
  if (rows == 0 || cols == 0) return;
  const dim3 grid(rows, cols, static_cast<unsigned>(list.size()));
  small_products_kernel<<<grid, dim3(kSmallTile, kSmallRows), 0, launch().stream>>>(products);
  check_launch("small products");
}

void simple_product(const Product& p) {
  if (p.d.rows == 0 || p.d.cols == 0) return;
  constexpr std::int64_t kMostColumns = std::int64_t{65535} * kTile;
  if (p.d.cols > kMostColumns) {
    throw Error(ErrorKind::failure,
                "a matrix product of " + std::to_string(p.d.cols) + " columns; at most " +
                    std::to_string(kMostColumns) + " are computed",
                "");
  }
  const std::int64_t terms = p.a.transposed ? p.a.rows : p.a.cols;
  const dim3 grid(blocks_of(p.d.rows, kTile), blocks_of(p.d.cols, kTile));
  product_kernel<<<grid, dim3(kTile, kTile), 0, launch().stream>>>(p.a, p.b, p.d, terms, p.add);
  check_launch("a plain product");
}

}  // namespace semfield::cuda
