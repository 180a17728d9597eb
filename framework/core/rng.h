// Addressed randomness: value = f(seed, step, stream, index). Counter-based Philox4x32-10 [Salmon11]: no generator
// object exists, so results never depend on threads, chunk size or resume.
#pragma once

#include <cmath>
#include <cstdint>
#include <string_view>

#include "core/view.h"

namespace semfield {

struct PhiloxBlock {
  std::uint32_t v[4];
};

/// One Philox4x32-10 block [Salmon11, Fig. 2 and Tab. 2].
SEMFIELD_HD inline PhiloxBlock philox4x32(PhiloxBlock counter, std::uint32_t key0, std::uint32_t key1) {
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t p0 = std::uint64_t{0xD2511F53u} * counter.v[0];
    const std::uint64_t p1 = std::uint64_t{0xCD9E8D57u} * counter.v[2];
    counter = {{static_cast<std::uint32_t>(p1 >> 32) ^ counter.v[1] ^ key0, static_cast<std::uint32_t>(p1),
                static_cast<std::uint32_t>(p0 >> 32) ^ counter.v[3] ^ key1, static_cast<std::uint32_t>(p0)}};
    key0 += 0x9E3779B9u;
    key1 += 0xBB67AE85u;
  }
  return counter;
}

/// FNV-1a of a name: the stream number of a component ("sampler/stratified"), fixed at compile time.
SEMFIELD_HD constexpr std::uint32_t stream_id(std::string_view name) {
  std::uint32_t h = 2166136261u;
  for (char c : name) h = (h ^ static_cast<unsigned char>(c)) * 16777619u;
  return h;
}

/// Where a random value lives. `index` is the caller's own numbering (ray * samples + sample, element of a tensor,
/// ...).
struct RandomAddress {
  std::uint64_t seed = 0;
  std::uint64_t step = 0;
  std::uint32_t stream = 0;
};

SEMFIELD_HD inline PhiloxBlock random_block(const RandomAddress& a, std::uint64_t index) {
  // The counter holds index and step, the key holds seed and stream; step is folded to 32 bits with its high half in
  // the key.
  const PhiloxBlock counter{{static_cast<std::uint32_t>(index), static_cast<std::uint32_t>(index >> 32),
                             static_cast<std::uint32_t>(a.step), a.stream}};
  return philox4x32(counter,
                    static_cast<std::uint32_t>(a.seed) ^ static_cast<std::uint32_t>(a.step >> 32) * 0x85EBCA6Bu,
                    static_cast<std::uint32_t>(a.seed >> 32));
}

/// Uniform in [0, 1), exactly representable: multiples of 2^-24, so 1 - u is exact and the largest value is 1 - 2^-24.
SEMFIELD_HD inline float uniform01(const RandomAddress& a, std::uint64_t index) {
  return static_cast<float>(random_block(a, index).v[0] >> 8) * 5.9604644775390625e-8f;
}

/// Uniform integer in [0, n) by multiply-shift (bias below n * 2^-64).
SEMFIELD_HD inline std::uint64_t uniform_below(const RandomAddress& a, std::uint64_t index, std::uint64_t n) {
  const PhiloxBlock b = random_block(a, index);
  const std::uint64_t x = (std::uint64_t{b.v[0]} << 32) | b.v[1];
  __extension__ using Wide = unsigned __int128;
  return static_cast<std::uint64_t>((static_cast<Wide>(x) * n) >> 64);
}

/// Standard normal by Box-Muller; the first uniform is shifted off zero.
SEMFIELD_HD inline double normal01(const RandomAddress& a, std::uint64_t index) {
  const PhiloxBlock b = random_block(a, index);
  const double u = (static_cast<double>(b.v[0]) + 0.5) * 0x1p-32;
  const double v = static_cast<double>(b.v[1]) * 0x1p-32;
  return std::sqrt(-2.0 * std::log(u)) * std::cos(6.283185307179586 * v);
}

}  // namespace semfield
