// oneDNN as the engine of matrix products: the results of our kernels within rounding, and the same promises.
#include "compute/gemm_engine.h"

#include <gtest/gtest.h>

#include <cstring>
#include <utility>
#include <vector>

#include "core/error.h"
#include "core/rng.h"
#include "core/work_scope.h"

namespace semfield {
namespace {

std::vector<float> random_values(std::int64_t count, std::uint64_t seed) {
  std::vector<float> values(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(2 * uniform01({seed, 0, 1}, i) - 1);
  return values;
}

class GemmEngineTest : public ::testing::Test {
 protected:
  void SetUp() override {
    try {
      work_.gemm = choose_gemm_engine(GemmEngine::onednn);
    } catch (const Error& error) {
      GTEST_SKIP() << error.what();
    }
  }

  WorkSettings work_;
  WorkScope scope_{work_};

  // C of the product by the chosen engine, and by our kernels.
  static std::vector<float> by(GemmEngine engine, Gemm<float> g, std::vector<float> c) {
    WorkSettings work;
    work.gemm = choose_gemm_engine(engine);
    const WorkScope scope(work);
    g.c = c.data();
    gemm(g);
    return c;
  }
};

TEST_F(GemmEngineTest, AgreesWithOurKernels) {
  int cases = 0;
  for (const std::int64_t m : {1, 63, 64, 200}) {
    for (const std::int64_t n : {1, 3, 17, 64}) {
      for (const std::int64_t k : {1, 31, 64, 300}) {
        for (const Precision precision : {Precision::fp32, Precision::bf16}) {
          const std::int64_t a_row = k + 3, b_row = n + 1, c_row = n + 2;
          const auto a = random_values(m * a_row, 1), b = random_values(k * b_row, 2), extra = random_values(4 * n, 3);
          const auto mask = random_values(m * n, 4), c = random_values(m * c_row, 5);
          std::vector<std::int32_t> row_of(static_cast<std::size_t>(m));
          for (std::int64_t i = 0; i < m; ++i)
            row_of[static_cast<std::size_t>(i)] = static_cast<std::int32_t>(i * 4 / m);
          for (int kind = 0; kind < 5; ++kind) {
            Gemm<float> g{
                .m = m, .n = n, .k = k, .a = a.data(), .a_row = a_row, .b = b.data(), .b_row = b_row, .c_row = c_row};
            g.precision = precision;
            if (kind == 1) g.accumulate = true;
            if (kind == 2) g.bias = extra.data();
            if (kind == 3) {
              g.row_term = extra.data();
              g.row_term_stride = n;
              g.row_of = row_of.data();
            }
            if (kind == 4) {
              g.mask = mask.data();
              g.mask_row = n;
            }
            g.relu = kind == 2 || kind == 3;
            const auto theirs = by(GemmEngine::onednn, g, c), ours = by(GemmEngine::builtin, g, c);
            for (std::size_t i = 0; i < c.size(); ++i) {
              ASSERT_NEAR(theirs[i], ours[i], 1e-5 * static_cast<double>(k + 1))
                  << "m " << m << " n " << n << " k " << k << " kind " << kind << " at " << i;
            }
            ++cases;
          }
        }
      }
    }
  }
  EXPECT_EQ(cases, 4 * 4 * 4 * 2 * 5);
}

TEST_F(GemmEngineTest, WeightGradientsAgreeWithOurKernels) {
  for (const std::int64_t rows : {1, 255, 256, 700}) {
    for (const auto& [m, n] : {std::pair<std::int64_t, std::int64_t>{33, 20}, {33, 1}, {2, 20}, {2, 1}}) {
      for (const Precision precision : {Precision::fp32, Precision::bf16}) {
        const std::int64_t c_row = n + 2;
        const auto x = random_values(rows * m, 6), dy = random_values(rows * n, 7), c = random_values(m * c_row, 8);
        const Gemm<float> g{.m = m,
                            .n = n,
                            .k = rows,
                            .a = x.data(),
                            .a_row = 1,
                            .a_col = m,
                            .b = dy.data(),
                            .b_row = n,
                            .c_row = c_row,
                            .accumulate = true,
                            .precision = precision};
        const auto theirs = by(GemmEngine::onednn, g, c), ours = by(GemmEngine::builtin, g, c);
        for (std::size_t i = 0; i < c.size(); ++i) {
          ASSERT_NEAR(theirs[i], ours[i], 1e-5 * static_cast<double>(rows + 1)) << m << " x " << n << " at " << i;
        }
      }
    }
  }
}

TEST_F(GemmEngineTest, SplittingRowsGivesTheSameBits) {
  for (const Precision precision : {Precision::fp32, Precision::bf16}) {
    const auto a = random_values(150 * 40, 9), b = random_values(40 * 24, 10);
    std::vector<float> whole(150 * 24), split(150 * 24);
    Gemm<float> g{.m = 150,
                  .n = 24,
                  .k = 40,
                  .a = a.data(),
                  .a_row = 40,
                  .b = b.data(),
                  .b_row = 24,
                  .c = whole.data(),
                  .c_row = 24,
                  .precision = precision};
    gemm(g);
    for (std::int64_t row = 0, size = 1; row < 150; row += size++) {
      g.m = std::min<std::int64_t>(size, 150 - row);
      g.a = a.data() + row * 40;
      g.c = split.data() + row * 24;
      gemm(g);
    }
    EXPECT_EQ(std::memcmp(whole.data(), split.data(), whole.size() * sizeof(float)), 0);
  }
}

TEST_F(GemmEngineTest, IsNamed) {
  EXPECT_EQ(gemm_engine_text().rfind("oneDNN ", 0), 0u) << gemm_engine_text();
  work_.gemm = choose_gemm_engine(GemmEngine::builtin);
  EXPECT_EQ(gemm_engine_text().rfind("built-in, ", 0), 0u) << gemm_engine_text();
}

}  // namespace
}  // namespace semfield
