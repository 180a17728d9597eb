// The tile instructions of AMX, and a portable twin of them with the same bits. For kernel files alone: everything here
// is private to the file and to its instruction set.
#pragma once

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#include <cstdint>
#include <cstring>

#include "compute/isa.h"

namespace semfield::SEMFIELD_ISA {
namespace {

// A tile is 16 rows of 64 bytes: 16 x 16 sums, or 16 x 32 numbers in bf16.
constexpr std::int64_t kTileRows = 16, kTileCols = 16, kTileDepth = 32;
constexpr std::int64_t kTileWords = kTileRows * 16;  // 32-bit words of a tile in memory without gaps

/// The eight tile registers, written in instructions that every CPU has: C += A B as the CPU does it, the
/// products of even and of odd depth summed apart from zero, then together, then into C [Intel SDM, TDPBF16PS].
class EmulatedTiles {
 public:
  template <int kTile>
  void zero() {
    std::memset(tiles_[kTile], 0, sizeof tiles_[kTile]);
  }
  template <int kTile>
  void load(const void* from, std::int64_t stride_bytes) {
    for (std::int64_t i = 0; i < kTileRows; ++i)
      std::memcpy(tiles_[kTile] + i * 16, static_cast<const std::byte*>(from) + i * stride_bytes, 64);
  }
  template <int kTile>
  void store(void* to, std::int64_t stride_bytes) const {
    for (std::int64_t i = 0; i < kTileRows; ++i)
      std::memcpy(static_cast<std::byte*>(to) + i * stride_bytes, tiles_[kTile] + i * 16, 64);
  }
  template <int kC, int kA, int kB>
  void multiply_add() {
    for (std::int64_t m = 0; m < kTileRows; ++m) {
      float even[kTileCols] = {}, odd[kTileCols] = {};
      for (std::int64_t k = 0; k < 16; ++k) {
        const std::uint32_t a = tiles_[kA][m * 16 + k];
        for (std::int64_t n = 0; n < kTileCols; ++n) {
          const std::uint32_t b = tiles_[kB][k * 16 + n];
          even[n] += low(a) * low(b);
          odd[n] += high(a) * high(b);
        }
      }
      for (std::int64_t n = 0; n < kTileCols; ++n) {
        float c;
        std::memcpy(&c, &tiles_[kC][m * 16 + n], sizeof c);
        c += even[n] + odd[n];
        std::memcpy(&tiles_[kC][m * 16 + n], &c, sizeof c);
      }
    }
  }

 private:
  static float number(std::uint32_t bits) {
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
  }
  static float low(std::uint32_t pair) { return number(pair << 16); }
  static float high(std::uint32_t pair) { return number(pair & 0xFFFF0000u); }

  std::uint32_t tiles_[8][kTileWords];
};

#if defined(__x86_64__)
/// The registers themselves, whole tiles, while it lives. Configured by each product: another library of the process
/// may have configured them in between.
class HardwareTiles {
 public:
  HardwareTiles() {
    struct alignas(64) Config {
      std::uint8_t palette = 1, start_row = 0, reserved[14] = {};
      std::uint16_t row_bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
      std::uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
    };
    static constexpr Config kConfig;
    __asm__ volatile("ldtilecfg %0" ::"m"(kConfig));
  }
  ~HardwareTiles() { __asm__ volatile("tilerelease"); }
  HardwareTiles(const HardwareTiles&) = delete;
  HardwareTiles& operator=(const HardwareTiles&) = delete;

  // In assembler: the compilers' own functions for these instructions take the number of a tile as a literal.
  template <int kTile>
  void zero() {
    __asm__ volatile("tilezero %%tmm%c0" ::"i"(kTile));
  }
  template <int kTile>
  void load(const void* from, std::int64_t stride_bytes) {
    __asm__ volatile("tileloadd (%0,%1,1), %%tmm%c2" ::"r"(from), "r"(stride_bytes), "i"(kTile) : "memory");
  }
  template <int kTile>
  void store(void* to, std::int64_t stride_bytes) const {
    __asm__ volatile("tilestored %%tmm%c2, (%0,%1,1)" ::"r"(to), "r"(stride_bytes), "i"(kTile) : "memory");
  }
  template <int kC, int kA, int kB>
  void multiply_add() {
    __asm__ volatile("tdpbf16ps %%tmm%c0, %%tmm%c1, %%tmm%c2" ::"i"(kB), "i"(kA), "i"(kC));
  }
};
#endif

}  // namespace
}  // namespace semfield::SEMFIELD_ISA
