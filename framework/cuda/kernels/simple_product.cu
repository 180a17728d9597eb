// Matrix products of shapes that cuBLASLt has no kernel for.
#include <cuda_bf16.h>

#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
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

}  // namespace

void simple_product(const Product& p) {
  if (p.d.rows == 0 || p.d.cols == 0) return;
  constexpr std::int64_t kMostColumns = std::int64_t{65535} * kTile;
  if (p.d.cols > kMostColumns) {
    throw Error(ErrorKind::failure, "internal.cuda.shape",
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
