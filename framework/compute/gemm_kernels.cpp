// The matrix product in the precision of its operands, for one instruction set.
#include "compute/gemm_tiles.h"
#include "compute/isa.h"

namespace semfield::SEMFIELD_ISA {

void gemm_kernels(CpuKernels<float>& kernels);
void gemm_kernels(CpuKernels<double>& kernels);

namespace {

// Rows of B per block: the packed panel (kBlockK x kMaxVecs vectors, 64 KiB at 64-byte vectors) streams from L2 once a
// tile.
constexpr std::int64_t kBlockK = 256;

/// Columns [col, col + cols) of C, rows k0 .. k0+count of B: the panel of B is packed to contiguous, zero-padded rows.
template <class Real>
void panel(const Gemm<Real>& g, std::int64_t col, int cols, std::int64_t k0, std::int64_t count) {
  using Op = MultiplyAdd<Real>;
  alignas(64) Real packed[kBlockK * kMaxVecs * kLanesOf<Op>];
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  const Cover<Op> shape = cover_of<Op>(cols, transposed);
  const int width = shape.width;
  const Real* b = g.b + k0 * g.b_row + col;
  std::int64_t b_row = g.b_row;
  // Packing costs one copy of the panel: worth it when several tiles read it, needed when its last vector is partial.
  if (b_row != width && (cols != width || g.m >= 2 * shape.rows)) {
    for (std::int64_t k = 0; k < count; ++k) {
      Real* row = packed + k * width;
      std::memcpy(row, b + k * b_row, sizeof(Real) * static_cast<std::size_t>(cols));
      for (int i = cols; i < width; ++i) row[i] = Real(0);
    }
    b = packed;
    b_row = width;
  }
  Real strip[kMaxRows * kBlockK];  // rows of A when neither of its strides is 1
  TileArgs<Op> t{};
  t.b = b;
  t.b_row = b_row;
  t.k = count;
  t.cols = cols;
  run_tiles(g, shape, t, 0, g.m, col, k0, count, [&](std::int64_t row, int rows) {
    t.a = g.a + row * g.a_row + k0 * g.a_col;
    t.a_step = transposed ? g.a_col : g.a_row;
    if (transposed || g.a_col == 1) return;
    for (int i = 0; i < rows; ++i) {
      for (std::int64_t k = 0; k < count; ++k) strip[i * kBlockK + k] = t.a[i * g.a_row + k * g.a_col];
    }
    t.a = strip;
    t.a_step = kBlockK;
  });
}

template <class Real>
void gemm(const Gemm<Real>& g) {
  constexpr std::int64_t kPanel = kMaxVecs * kLanesOf<MultiplyAdd<Real>>;
  for (std::int64_t col = 0; col < g.n; col += kPanel) {
    const int cols = static_cast<int>(std::min(kPanel, g.n - col));
    // With k = 0 one empty block still writes the start.
    for (std::int64_t k0 = 0; k0 == 0 || k0 < g.k; k0 += kBlockK) panel(g, col, cols, k0, std::min(kBlockK, g.k - k0));
  }
}

}  // namespace

void gemm_kernels(CpuKernels<float>& kernels) { kernels.gemm = gemm<float>; }
void gemm_kernels(CpuKernels<double>& kernels) { kernels.gemm = gemm<double>; }

}  // namespace semfield::SEMFIELD_ISA
