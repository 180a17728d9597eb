// The matrix product with A and B rounded to bf16 and sums in fp32, for one instruction set.
#if defined(SEMFIELD_TILES)
#include "compute/amx/gemm.h"
#else
#include "compute/gemm_tiles.h"
#endif

namespace semfield::SEMFIELD_ISA {

void bf16_gemm(const Gemm<float>& g);

#if defined(SEMFIELD_TILES)

void bf16_gemm(const Gemm<float>& g) { amx::gemm<SEMFIELD_TILES>(g); }

#else

namespace {

// A block of A and B: kBlockK x kBlockN of B (128 KiB of pairs, in L2) against kBlockM rows of A (24 KiB, in L1).
constexpr std::int64_t kBlockK = 256, kBlockN = 256;

#if defined(__AVX512BF16__)

constexpr std::int64_t kPairs = kBlockK / 2;
constexpr std::int64_t kBlockM = 48, kGroupsM = 6;

// The first n (of up to 16) floats, zeros beyond.
inline __attribute__((always_inline)) __m512 load(const float* p, std::int64_t n) {
  if (n >= 16) return _mm512_loadu_ps(p);
  return n <= 0 ? _mm512_setzero_ps() : _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << n) - 1), p);
}

/// Columns are kept in groups that a tile or its neighbours read together; group g of `width` columns (the last one of
/// `last_width`, both multiples of 16) begins at out + g * width * kPairs and has rows without gaps:
/// out[p][i] = (in[2p][i], in[2p+1][i]), zeros beyond the last column and row. Whole rows are read in turn: they come
/// from far, and single groups of them would come slowly.
void pack_row_pairs(const float* in, std::int64_t stride, std::int64_t rows, std::int64_t cols, std::int64_t width,
                    std::int64_t last_width, std::uint32_t* out) {
  // Element 2i of the result is word i (of the row in the low half), 2i+1 word 16+i.
  alignas(64) static constexpr std::uint16_t kInterleave[32] = {0,  16, 1,  17, 2,  18, 3,  19, 4,  20, 5,
                                                                21, 6,  22, 7,  23, 8,  24, 9,  25, 10, 26,
                                                                11, 27, 12, 28, 13, 29, 14, 30, 15, 31};
  const __m512i order = _mm512_load_si512(kInterleave);
  for (std::int64_t r = 0; r < rows; r += 2) {
    const bool pair = r + 1 < rows;
    for (std::int64_t first = 0; first < cols; first += width) {
      const std::int64_t here = std::min(width, cols - first);
      const std::int64_t padded = here == width ? width : last_width;
      const float* low_row = in + r * stride + first;
      const float* high_row = low_row + stride;
      std::uint32_t* to = out + first * kPairs + r / 2 * padded;
      for (std::int64_t i = 0; i < padded; i += 16) {
        const bool whole = i + 16 <= here;
        const __m512 low = whole ? _mm512_loadu_ps(low_row + i) : load(low_row + i, here - i);
        const __m512 high = !pair   ? _mm512_setzero_ps()
                            : whole ? _mm512_loadu_ps(high_row + i)
                                    : load(high_row + i, here - i);
        _mm512_storeu_si512(to + i, _mm512_permutexvar_epi16(order, (__m512i)_mm512_cvtne2ps_pbh(high, low)));
      }
    }
  }
}

/// out[i][p] = (in[i][2p], in[i][2p+1]): rows of floats to rows of bf16, zeros up to a multiple of 32.
void pack_rows(const float* in, std::int64_t stride, std::int64_t rows, std::int64_t k, std::uint32_t* out) {
  for (std::int64_t i = 0; i < rows; ++i) {
    const float* from = in + i * stride;
    std::uint32_t* to = out + i * kPairs;
    std::int64_t c = 0;
    for (; c + 32 <= k; c += 32) {
      const __m512 low = _mm512_loadu_ps(from + c), high = _mm512_loadu_ps(from + c + 16);
      _mm512_storeu_si512(to + c / 2, (__m512i)_mm512_cvtne2ps_pbh(high, low));
    }
    for (; c < k; c += 32) {
      const __m512 low = load(from + c, k - c), high = load(from + c + 16, k - c - 16);
      _mm512_storeu_si512(to + c / 2, (__m512i)_mm512_cvtne2ps_pbh(high, low));
    }
  }
}

/// One block of B against all rows of A.
void block(const Gemm<float>& g, std::int64_t col0, std::int64_t cols0, std::int64_t k0, std::int64_t count) {
  constexpr std::int64_t kPanel = 64;
  alignas(64) std::uint32_t packed_b[kPairs * kBlockN];
  alignas(64) std::uint32_t packed_a[kPairs * kBlockM * kGroupsM];
  float strip[kBlockK];
  const bool transposed = g.a_row == 1 && g.a_col != 1;
  const auto width_of = [](const Cover<PairDot>& shape) { return std::max(shape.width, 16); };
  const Cover<PairDot> last = cover_of<PairDot>(static_cast<int>((cols0 - 1) % kPanel + 1), transposed);
  pack_row_pairs(g.b + k0 * g.b_row + col0, g.b_row, count, cols0, kPanel, width_of(last), packed_b);
  TileArgs<PairDot> t{};
  t.a_step = transposed ? kBlockM : kPairs;
  t.k = (count + 1) / 2;
  // A transposed comes in groups of columns, several at a time; else its rows are converted as they are needed.
  const std::int64_t ahead = transposed ? kBlockM * kGroupsM : kBlockM;
  for (std::int64_t row0 = 0; row0 < g.m; row0 += kBlockM) {
    const std::int64_t end = std::min(row0 + kBlockM, g.m);
    const float* a = g.a + row0 * g.a_row + k0 * g.a_col;
    if (transposed) {
      if (row0 % ahead == 0) pack_row_pairs(a, g.a_col, count, std::min(ahead, g.m - row0), kBlockM, kBlockM, packed_a);
    } else if (g.a_col == 1) {
      pack_rows(a, g.a_row, end - row0, count, packed_a);
    } else {
      for (std::int64_t i = 0; i < end - row0; ++i) {
        for (std::int64_t k = 0; k < count; ++k) strip[k] = a[i * g.a_row + k * g.a_col];
        pack_rows(strip, 0, 1, count, packed_a + i * kPairs);
      }
    }
    const std::uint32_t* first = packed_a + row0 % ahead * kPairs;
    for (std::int64_t p = 0; p < cols0; p += kPanel) {
      const Cover<PairDot> shape = p + kPanel < cols0 ? cover_of<PairDot>(kPanel, transposed) : last;
      t.b = packed_b + p * kPairs;
      t.b_row = width_of(shape);
      t.cols = static_cast<int>(std::min(kPanel, cols0 - p));
      run_tiles(g, shape, t, row0, end, col0 + p, k0, count,
                [&](std::int64_t row, int) { t.a = first + (row - row0) * (transposed ? 1 : kPairs); });
    }
  }
}

#else

// Without bf16 instructions: both operands rounded in fp32, then fused multiply-adds. Slower than fp32 alone; for the
// same results, within the tolerance of the precision, on any processor.
inline float to_bf16(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  const std::uint32_t exponent = bits & 0x7F800000u;
  if (exponent == 0x7F800000u) return value;
  // Round to nearest, ties to even; values below the normal range count as 0, as the instructions have it.
  bits = exponent == 0 ? bits & 0x80000000u : (bits + 0x7FFFu + ((bits >> 16) & 1u)) & 0xFFFF0000u;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

/// One block of B against all rows of A.
void block(const Gemm<float>& g, std::int64_t col0, std::int64_t cols0, std::int64_t k0, std::int64_t count) {
  using Op = MultiplyAdd<float>;
  constexpr std::int64_t kPanel = kMaxVecs * kLanesOf<Op>;
  alignas(64) float packed_b[kBlockK * kPanel];
  float packed_a[kMaxRows * kBlockK];
  for (std::int64_t first = 0; first < cols0; first += kPanel) {
    TileArgs<Op> t{};
    t.cols = static_cast<int>(std::min(kPanel, cols0 - first));
    const Cover<Op> shape = cover_of<Op>(t.cols, false);
    for (std::int64_t k = 0; k < count; ++k) {
      const float* from = g.b + (k0 + k) * g.b_row + col0 + first;
      for (int i = 0; i < shape.width; ++i) packed_b[k * shape.width + i] = i < t.cols ? to_bf16(from[i]) : 0.0f;
    }
    t.a = packed_a;
    t.a_step = kBlockK;
    t.b = packed_b;
    t.b_row = shape.width;
    t.k = count;
    run_tiles(g, shape, t, 0, g.m, col0 + first, k0, count, [&](std::int64_t row, int rows) {
      const float* a = g.a + row * g.a_row + k0 * g.a_col;
      for (int i = 0; i < rows; ++i) {
        for (std::int64_t k = 0; k < count; ++k) packed_a[i * kBlockK + k] = to_bf16(a[i * g.a_row + k * g.a_col]);
      }
    });
  }
}

#endif

}  // namespace

void bf16_gemm(const Gemm<float>& g) {
  for (std::int64_t col = 0; col < g.n; col += kBlockN) {
    const std::int64_t cols = std::min(kBlockN, g.n - col);
    for (std::int64_t k0 = 0; k0 == 0 || k0 < g.k; k0 += kBlockK) block(g, col, cols, k0, std::min(kBlockK, g.k - k0));
  }
}

#endif

}  // namespace semfield::SEMFIELD_ISA
