#include "compute/peak_probe.h"

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>

#include "compute/bf16/tiles.h"
#include "compute/isa.h"
#include "compute/parallel.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace semfield {

namespace {

// Two products a cycle with a latency of four or five need ten chains; twelve and two operands fit into 16 registers.
constexpr int kChains = kProbeChains;
constexpr std::int64_t kRounds = kProbeRounds;

std::atomic<double> g_sink;  // results go here, so that no loop is left out

using Loop = double (*)(float start);

// A chain a = a * scale + shift nears shift / (1 - scale) = 1: no overflow, no subnormal numbers. Chains start
// from different values, or the compiler would keep one for all.
#define SEMFIELD_FMA_LOOP(name, bytes, attribute)                                                                      \
  attribute double name(float start) {                                                                                 \
    typedef float Vector __attribute__((vector_size(bytes)));                                                          \
    Vector chain[kChains];                                                                                             \
    for (int i = 0; i < kChains; ++i) chain[i] = Vector{} + (start + static_cast<float>(i));                           \
    Vector scale = Vector{} + static_cast<float>(kProbeScale), shift = Vector{} + static_cast<float>(1 - kProbeScale); \
    asm volatile("" : "+m"(scale), "+m"(shift)); /* not known to the compiler */                                       \
    for (std::int64_t round = 0; round < kRounds; ++round) {                                                           \
      _Pragma("GCC unroll 12") for (int i = 0; i < kChains; ++i) chain[i] = chain[i] * scale + shift;                  \
    }                                                                                                                  \
    double sum = 0;                                                                                                    \
    for (int i = 0; i < kChains; ++i) {                                                                                \
      for (std::size_t k = 0; k < (bytes) / sizeof(float); ++k) sum += static_cast<double>(chain[i][k]);               \
    }                                                                                                                  \
    return sum;                                                                                                        \
  }

SEMFIELD_FMA_LOOP(fma_loop_16, 16, )
#if defined(__x86_64__)
SEMFIELD_FMA_LOOP(fma_loop_32, 32, __attribute__((target("avx2,fma"))))
SEMFIELD_FMA_LOOP(fma_loop_64, 64, __attribute__((target("avx512f"))))

__attribute__((target("avx512f,avx512bf16"))) double bf16_loop(float start) {
  __m512 chain[kChains];
  for (int i = 0; i < kChains; ++i) chain[i] = _mm512_set1_ps(start + static_cast<float>(i));
  // Sums only grow here, but too slowly to reach infinity in a call.
  const __m512bh a = _mm512_cvtne2ps_pbh(_mm512_set1_ps(start * 0.001F), _mm512_set1_ps(0.002F));
  const __m512bh b = _mm512_cvtne2ps_pbh(_mm512_set1_ps(0.003F), _mm512_set1_ps(start));
  for (std::int64_t round = 0; round < kRounds; ++round) {
#pragma GCC unroll 12
    for (int i = 0; i < kChains; ++i) chain[i] = _mm512_dpbf16_ps(chain[i], a, b);
  }
  double sum = 0;
  for (int i = 0; i < kChains; ++i) {
    alignas(64) std::array<float, 16> values;
    _mm512_store_ps(values.data(), chain[i]);
    for (const float v : values) sum += static_cast<double>(v);
  }
  return sum;
}
#endif

#if defined(__x86_64__)
constexpr std::int64_t kTileRounds = 2000;  // of one call
constexpr double kTileFlop = 2.0 * 4 * kTileRounds * 16 * 16 * 32;

double tile_loop(float start) {
  isa_build::HardwareTiles tiles;
  alignas(64) std::array<float, 256> operand;  // as bf16: 0 and start in turn, where its lower half is 0
  operand.fill(start);
  tiles.load<4>(operand.data(), 64);
  tiles.load<5>(operand.data(), 64);
  tiles.zero<0>();
  tiles.zero<1>();
  tiles.zero<2>();
  tiles.zero<3>();
  for (std::int64_t round = 0; round < kTileRounds; ++round) {
    tiles.multiply_add<0, 4, 5>();
    tiles.multiply_add<1, 4, 5>();
    tiles.multiply_add<2, 4, 5>();
    tiles.multiply_add<3, 4, 5>();
  }
  double sum = 0;
  const auto add = [&] {
    for (const float value : operand) sum += static_cast<double>(value);
  };
  tiles.store<0>(operand.data(), 64);
  add();
  tiles.store<1>(operand.data(), 64);
  add();
  tiles.store<2>(operand.data(), 64);
  add();
  tiles.store<3>(operand.data(), 64);
  add();
  return sum;
}
#endif

struct Width {
  Loop loop;
  int floats;
};

Width widest() {
#if defined(__x86_64__)
  if (__builtin_cpu_supports("avx512f")) return {fma_loop_64, 16};
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return {fma_loop_32, 8};
#endif
  return {fma_loop_16, 4};
}

/// Units a second: `call` does `units` of them, and every thread repeats it for `seconds`.
template <class Call>
double rate(int threads, double seconds, double units, const Call& call) {
  using Clock = std::chrono::steady_clock;
  const int before = thread_count();
  set_thread_count(threads);
  std::atomic<std::int64_t> calls{0};
  const auto begin = Clock::now();
  const auto elapsed = [&] { return std::chrono::duration<double>(Clock::now() - begin).count(); };
  parallel_for(threads, [&](std::int64_t thread) {
    double sum = 0;
    std::int64_t mine = 0;
    for (const double end = elapsed() + seconds; mine == 0 || elapsed() < end; ++mine) sum += call(thread + mine);
    calls += mine;
    g_sink = sum;
  });
  const double wall = elapsed();
  set_thread_count(before);
  return units * static_cast<double>(calls) / wall;
}

double fp32_flop(const Width& width) { return 2.0 * kChains * kRounds * width.floats; }
constexpr double kBf16Flop = 2.0 * kChains * kRounds * 32;

}  // namespace

double peak_fp32_flops(int threads, double seconds) {
  const Width width = widest();
  return rate(threads, seconds, fp32_flop(width),
              [&](std::int64_t n) { return width.loop(1 + 0.01F * static_cast<float>(n % 8)); });
}

double peak_bf16_flops(int threads, double seconds) {
#if defined(__x86_64__)
  if (processor_has_tiles()) {
    return rate(threads, seconds, kTileFlop,
                [](std::int64_t n) { return tile_loop(1 + 0.01F * static_cast<float>(n % 8)); });
  }
  if (__builtin_cpu_supports("avx512bf16")) {
    return rate(threads, seconds, kBf16Flop,
                [](std::int64_t n) { return bf16_loop(1 + 0.01F * static_cast<float>(n % 8)); });
  }
#endif
  (void)threads, (void)seconds;
  return 0;
}

std::vector<ProbeCall> probe_calls() {
  const Width width = widest();
  std::vector<ProbeCall> calls{{"fp32", fp32_flop(width), width.loop(1)}};
#if defined(__x86_64__)
  if (__builtin_cpu_supports("avx512bf16")) calls.push_back({"bf16", kBf16Flop, bf16_loop(1)});
  if (processor_has_tiles()) calls.push_back({"tiles", kTileFlop, tile_loop(1)});
#endif
  return calls;
}

}  // namespace semfield
