// Numbers in bf16 and rows of sums that become them. For kernel files alone: everything here is private to the file and
// to its instruction set.
#pragma once

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#include <algorithm>
#include <cstring>

#include "compute/isa.h"
#include "compute/layers.h"

namespace semfield::SEMFIELD_ISA {
namespace {

inline float widen(Bf16 value) {
  const std::uint32_t bits = static_cast<std::uint32_t>(value.bits) << 16;
  float wide;
  std::memcpy(&wide, &bits, sizeof wide);
  return wide;
}

/// To nearest, ties to even; values below the normal range count as 0, as the instructions have it.
inline Bf16 rounded(float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  const std::uint32_t exponent = bits & 0x7F800000u;
  if (exponent == 0x7F800000u)
    return {static_cast<std::uint16_t>((bits >> 16) | ((bits & 0x7FFFFFu) != 0 ? 0x40u : 0u))};
  if (exponent == 0) return {static_cast<std::uint16_t>((bits >> 16) & 0x8000u)};
  return {static_cast<std::uint16_t>((bits + 0x7FFFu + ((bits >> 16) & 1u)) >> 16)};
}

inline bool positive(Bf16 value) { return static_cast<std::int16_t>(value.bits) > 0; }

/// Row `row` of what a layer's sums start from; null: zero.
inline const float* start_of(const Layer<Bf16>& l, std::int64_t row) {
  if (l.start.empty()) return nullptr;
  return l.start.row(!l.row_of.empty() ? l.row_of(row, 0) : l.start.rows == 1 ? 0 : row);
}

/// What follows the sums of a layer's row in columns [col, col + cols), cols <= 32, and where they go.
struct RowEnd {
  bool relu;
  const Bf16* mask;  // null: none
  Bf16* y;           // 32 numbers are written, zeros behind the columns; null: `exact`
  float* exact;
};

inline RowEnd row_end(const Layer<Bf16>& l, std::int64_t row, std::int64_t col) {
  return {l.relu, l.mask.empty() ? nullptr : l.mask.row(row) + col, l.y.empty() ? nullptr : l.y.row(row) + col,
          l.exact.empty() ? nullptr : l.exact.row(row) + col};
}

#if defined(__AVX512BF16__)

inline __m512 first_floats(const float* p, std::int64_t count) {
  if (count >= 16) return _mm512_loadu_ps(p);
  return count <= 0 ? _mm512_setzero_ps() : _mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << count) - 1), p);
}

/// Sums of 32 columns, of which `cols` exist.
inline void finish_row(const RowEnd& end, __m512 left, __m512 right, std::int64_t cols) {
  const auto lanes = static_cast<__mmask32>(cols >= 32 ? ~0u : (1u << cols) - 1);
  if (end.relu) {  // NaN stays NaN
    const __m512 zero = _mm512_setzero_ps();
    left = _mm512_mask_mov_ps(left, _mm512_cmp_ps_mask(left, zero, _CMP_LT_OQ), zero);
    right = _mm512_mask_mov_ps(right, _mm512_cmp_ps_mask(right, zero, _CMP_LT_OQ), zero);
  }
  __mmask32 keep = lanes;
  if (end.mask != nullptr)  // as integers: the positive numbers
    keep = _mm512_mask_cmpgt_epi16_mask(lanes, _mm512_maskz_loadu_epi16(lanes, end.mask), _mm512_setzero_si512());
  if (end.y != nullptr) {
    _mm512_storeu_si512(end.y, _mm512_maskz_mov_epi16(keep, (__m512i)_mm512_cvtne2ps_pbh(right, left)));
    return;
  }
  _mm512_mask_storeu_ps(end.exact, static_cast<__mmask16>(lanes),
                        _mm512_maskz_mov_ps(static_cast<__mmask16>(keep), left));
  _mm512_mask_storeu_ps(end.exact + 16, static_cast<__mmask16>(lanes >> 16),
                        _mm512_maskz_mov_ps(static_cast<__mmask16>(keep >> 16), right));
}
/// Sums in memory, 16 and 16.
inline void finish_row(const RowEnd& end, const float* left, const float* right, std::int64_t cols) {
  finish_row(end, first_floats(left, cols), first_floats(right, cols - 16), cols);
}

/// Word i = (even[i], odd[i]) of 16 numbers.
inline __m512i interleaved(__m256i even, __m256i odd) {
  return _mm512_or_si512(_mm512_cvtepu16_epi32(even), _mm512_slli_epi32(_mm512_cvtepu16_epi32(odd), 16));
}

inline __m512 widened(__m256i numbers) { return (__m512)_mm512_slli_epi32(_mm512_cvtepu16_epi32(numbers), 16); }

#else

inline void finish_row(const RowEnd& end, const float* left, const float* right, std::int64_t cols) {
  for (std::int64_t j = 0; j < 32; ++j) {
    if (j >= cols && end.y == nullptr) return;
    float sum = j >= cols ? 0 : j < 16 ? left[j] : right[j - 16];
    if (end.relu && sum < 0) sum = 0;
    if (j < cols && end.mask != nullptr && !positive(end.mask[j])) sum = 0;
    if (end.y != nullptr) {
      end.y[j] = rounded(sum);
    } else {
      end.exact[j] = sum;
    }
  }
}

#endif

}  // namespace
}  // namespace semfield::SEMFIELD_ISA
