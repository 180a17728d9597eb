// Vectorisable exponentials: exact reduction to |r| <= ln2/2, a degree-7 series, scaling by exponent bits.
#include "core/math_functions.h"

#include <bit>
#include <type_traits>

namespace semfield {

namespace {

// ln 2 = kLn2High + kLn2Low; the high part has 15 bits, so n * kLn2High is exact for |n| < 512.
constexpr float kLog2e = 1.44269504088896341f;
constexpr float kLn2High = 0.693145751953125f;
constexpr float kLn2Low = 1.42860677e-6f;
constexpr float kRound =
    12582912.0f;  // 1.5 * 2^23: adding it rounds to the nearest integer and leaves that in the low bits

struct Reduced {
  float r;  // x - n ln2
  std::int32_t n;
};

// Callers clamp x to [-105, 89] first.
inline Reduced reduce(float x) {
  const float shifted = x * kLog2e + kRound;
  const float n = shifted - kRound;
  return {(x - n * kLn2High) - n * kLn2Low, std::bit_cast<std::int32_t>(shifted) - std::bit_cast<std::int32_t>(kRound)};
}

/// e^r - 1 = r + r^2 (1/2! + r/3! + ... + r^5/7!); the next term is below 6e-9 on |r| <= ln2/2.
inline float expm1_series(float r) {
  float q = 1.0f / 5040.0f;
  q = q * r + 1.0f / 720.0f;
  q = q * r + 1.0f / 120.0f;
  q = q * r + 1.0f / 24.0f;
  q = q * r + 1.0f / 6.0f;
  q = q * r + 0.5f;
  return r + (r * r) * q;
}

inline float power_of_two(std::int32_t n) { return std::bit_cast<float>((n + 127) << 23); }

// Comparisons are written so that NaN passes through the clamps.
inline float clamp_exponent(float x, float low) {
  x = x < low ? low : x;
  return x > 89.0f ? 89.0f : x;
}

inline float exp_value(float x) {
  const Reduced v = reduce(clamp_exponent(x, -105.0f));
  // 2^n in two factors: the first product stays normal, the second rounds into subnormals or overflows to infinity.
  const std::int32_t half = v.n >> 1;
  return (1.0f + expm1_series(v.r)) * power_of_two(half) * power_of_two(v.n - half);
}

inline float expm1_value(float x) {
  const Reduced v = reduce(clamp_exponent(x, -30.0f));
  // 2^n e^r - 1 = 2 (2^(n-1) (e^r - 1) + (2^(n-1) - 1/2)): 2^(n-1) is finite up to n = 128.
  const float scale = power_of_two(v.n - 1);
  return 2.0f * (scale * expm1_series(v.r) + (scale - 0.5f));
}

}  // namespace

template <class Real>
void exp_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) {
    if constexpr (std::is_same_v<Real, float>) {
      x[i] = exp_value(x[i]);
    } else {
      x[i] = std::exp(x[i]);
    }
  }
}

template <class Real>
void expm1_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) {
    if constexpr (std::is_same_v<Real, float>) {
      x[i] = expm1_value(x[i]);
    } else {
      x[i] = std::expm1(x[i]);
    }
  }
}

template <class Real>
void sigmoid_inplace(Real* x, std::int64_t n) {
  for (std::int64_t i = 0; i < n; ++i) {
    if constexpr (std::is_same_v<Real, float>) {
      const float e = exp_value(-std::abs(x[i]));
      x[i] = (x[i] < 0.0f ? e : 1.0f) / (1.0f + e);
    } else {
      x[i] = sigmoid(x[i]);
    }
  }
}

template void exp_inplace<float>(float*, std::int64_t);
template void exp_inplace<double>(double*, std::int64_t);
template void expm1_inplace<float>(float*, std::int64_t);
template void expm1_inplace<double>(double*, std::int64_t);
template void sigmoid_inplace<float>(float*, std::int64_t);
template void sigmoid_inplace<double>(double*, std::int64_t);

}  // namespace semfield
