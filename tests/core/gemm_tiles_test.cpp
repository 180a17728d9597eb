// The product on tiles with every instruction that is not the build's own written in plain C++: what a processor
// without AVX-512 can check of it.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <vector>

#include "compute/amx/gemm.h"
#include "compute/isa.h"
#include "core/rng.h"

namespace semfield {
namespace {

struct Operands {
  Operands(std::int64_t m, std::int64_t n, std::int64_t k, bool transposed, bool integers)
      : a(size(m, k)), b(size(k, n)), c(size(m, n)), mask(size(m, n)) {
    std::uint64_t seed = 1;
    for (std::vector<float>* values : {&a, &b, &c, &mask}) {
      ++seed;
      for (std::size_t i = 0; i < values->size(); ++i) {
        const double u = 2 * uniform01({seed, 0, 1}, i) - 1;
        (*values)[i] = static_cast<float>(integers ? std::round(15 * u) : u);
      }
    }
    g = {.m = m,
         .n = n,
         .k = k,
         .a = a.data(),
         .a_row = transposed ? 1 : k,
         .a_col = transposed ? m : 1,
         .b = b.data(),
         .b_row = n,
         .c = c.data(),
         .c_row = n,
         .accumulate = true,
         .relu = true,
         .mask = mask.data(),
         .mask_row = n,
         .precision = Precision::bf16};
  }
  static std::size_t size(std::int64_t rows, std::int64_t cols) { return static_cast<std::size_t>(rows * cols); }
  std::vector<float> a, b, c, mask;
  Gemm<float> g;
};

constexpr std::int64_t kShapes[][3] = {{1, 9, 9},    {16, 16, 32},   {33, 17, 65},
                                       {64, 64, 64}, {40, 300, 600}, {70, 29, 1030}};

TEST(GemmTiles, IsExactWhereNothingNeedsRounding) {
  for (const auto& [m, n, k] : kShapes) {
    for (const bool transposed : {false, true}) {
      Operands o(m, n, k, transposed, true);
      const std::vector<float> before = o.c;
      SEMFIELD_ISA::amx::gemm<SEMFIELD_ISA::EmulatedTiles>(o.g);
      for (std::int64_t i = 0; i < m; ++i) {
        for (std::int64_t j = 0; j < n; ++j) {
          double sum = before[static_cast<std::size_t>(i * n + j)];
          for (std::int64_t p = 0; p < k; ++p)
            sum += static_cast<double>(o.g.a[i * o.g.a_row + p * o.g.a_col]) * static_cast<double>(o.g.b[p * n + j]);
          if (sum < 0 || !(o.mask[static_cast<std::size_t>(i * n + j)] > 0)) sum = 0;
          ASSERT_EQ(o.c[static_cast<std::size_t>(i * n + j)], sum)
              << m << " x " << n << " x " << k << " at " << i << ", " << j;
        }
      }
    }
  }
}

// Where the program itself runs on tiles, in registers or emulated with AVX-512, its bits are these.
TEST(GemmTiles, HasTheBitsOfTheProgramsOwn) {
  if (isa() != Isa::amx_emulated && isa() != Isa::amx_bf16)
    GTEST_SKIP() << "products run by " << isa_name(isa()) << "; SEMFIELD_ISA=amx_emulated compares";
  for (const auto& [m, n, k] : kShapes) {
    for (const bool transposed : {false, true}) {
      Operands plain(m, n, k, transposed, false), own(m, n, k, transposed, false);
      SEMFIELD_ISA::amx::gemm<SEMFIELD_ISA::EmulatedTiles>(plain.g);
      gemm(own.g);
      EXPECT_EQ(std::memcmp(plain.c.data(), own.c.data(), plain.c.size() * sizeof(float)), 0)
          << m << " x " << n << " x " << k;
    }
  }
}

}  // namespace
}  // namespace semfield
