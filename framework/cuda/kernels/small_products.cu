// Several small fp32 products in one launch, where cuBLASLt's launches would take longer than the products.
#include <algorithm>
#include <optional>

#include "core/error.h"
#include "cuda/kernels/device_code.cuh"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

constexpr int kTile = 32;   // rows and columns of D that a block computes
constexpr int kTerms = 32;  // of a slab: what a block multiplies at a time
constexpr int kThreads = 256;
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
struct Place {
  int row, term;
};
template <bool kLanesAlongTerms>
__device__ inline Place place(int i) {
  const auto x = static_cast<int>(threadIdx.x) % kWarp,
             y = static_cast<int>(threadIdx.x) / kWarp + i * (kThreads / kWarp);
  return kLanesAlongTerms ? Place{y, x} : Place{x, y};
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
  __device__ Place place_of(int i) const { return contiguous_terms ? place<true>(i) : place<false>(i); }
  __device__ void load(float (&to)[kLoads], std::int64_t first_row, std::int64_t rows, std::int64_t first_term,
                       std::int64_t terms) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const Place p = place_of(i);
      const bool inside = first_row + p.row < rows && first_term + p.term < terms;
      to[i] = inside ? at(first_row + p.row, first_term + p.term) : 0.0F;
    }
  }
  __device__ void store(const float (&from)[kLoads], float* slab) const {
#pragma unroll
    for (int i = 0; i < kLoads; ++i) {
      const Place p = place_of(i);
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
__device__ inline std::int64_t terms_of(const Matrix& a) {
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
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
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

}  // namespace

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
    const auto terms = [](const Matrix& a) { return a.data == nullptr ? 0 : a.transposed ? a.rows : a.cols; };
    const bool in_one = arena == nullptr || tiles >= multiprocessors();
    const std::int64_t parts =
        std::clamp<std::int64_t>((terms(p.a) + terms(p.a2)) / kTermsOfPart, 1, in_one ? 1 : kMostParts);
    if (parts > 1 && p.d.size() > 0) {
      products.partial[i] = arena->take<float>(parts, static_cast<std::int32_t>(p.d.size()));
      in_parts = std::max(in_parts, p.d.size());
    }
    products.first_block[i + 1] = products.first_block[i] + static_cast<unsigned>(tiles * parts);
  }
  const unsigned blocks = products.first_block[products.count];
  if (blocks == 0) return;
  small_products_kernel<<<blocks, kThreads, 0, launch().stream>>>(products);
  check_launch("small products");
  if (in_parts == 0) return;
  const dim3 grid(blocks_of(in_parts, kThreads), static_cast<unsigned>(products.count));
  add_parts_kernel<<<grid, kThreads, 0, launch().stream>>>(products);
  check_launch("parts of small products");
}

}  // namespace semfield::cuda
