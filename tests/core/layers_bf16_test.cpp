// Layers in bf16: their error bound against float64, exactness where nothing is rounded, bitwise promises, and what
// they must not touch.
#include <gtest/gtest.h>

#include <limits>

#include "compute/bf16/tiles.h"
#include "compute/isa.h"
#include "compute/layers.h"
#include "core/rng.h"

namespace semfield {
namespace {

namespace on_tiles = SEMFIELD_ISA::tiles;
using Plain = SEMFIELD_ISA::EmulatedTiles;

/// Activations in memory of their own, between guards.
class Rows {
 public:
  Rows(std::int64_t rows, std::int32_t cols)
      : bytes_(activation_bytes<Bf16>(rows, cols)),
        memory_(static_cast<std::byte*>(std::aligned_alloc(64, bytes_ + 64)), &std::free),
        view_(activation_rows<Bf16>(memory_.get(), rows, cols)) {
    std::memset(memory_.get(), 0xAB, bytes_ + 64);
  }
  View<Bf16> view() const { return view_; }
  bool guarded() const {
    for (std::size_t i = 0; i < 64; ++i) {
      if (memory_.get()[bytes_ + i] != std::byte{0xAB}) return false;
    }
    return true;
  }
  bool padded_with_zeros() const {
    for (std::int64_t m = 0; m < view_.rows; ++m) {
      for (std::int64_t j = view_.cols; j < view_.row_stride; ++j) {
        if (view_.row(m)[j].bits != 0) return false;
      }
    }
    return true;
  }

 private:
  std::size_t bytes_;
  std::unique_ptr<std::byte, decltype(&std::free)> memory_;
  View<Bf16> view_;
};

float wide(Bf16 value) {
  const std::uint32_t bits = static_cast<std::uint32_t>(value.bits) << 16;
  float f;
  std::memcpy(&f, &bits, sizeof f);
  return f;
}

std::vector<float> random_values(std::int64_t count, std::uint64_t seed) {
  std::vector<float> values(static_cast<std::size_t>(count));
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(2 * uniform01({seed, 0, 1}, i) - 1);
  return values;
}

/// Random rows that bf16 holds exactly.
Rows random_rows(std::int64_t rows, std::int32_t cols, std::uint64_t seed) {
  const auto values = random_values(rows * cols, seed);
  Rows made(rows, cols);
  round_rows(View<const float>(values.data(), rows, cols), made.view());
  return made;
}

class Packed {
 public:
  Packed(View<const float> weight, bool transposed)
      : words_(static_cast<std::uint32_t*>(std::aligned_alloc(64, size(weight, transposed))), &std::free),
        weight_(pack_weight(weight, transposed, words_.get())) {}
  PackedWeight weight() const { return weight_; }

 private:
  static std::size_t size(View<const float> w, bool transposed) {
    const std::int64_t words = transposed ? packed_weight_words(w.cols, w.rows) : packed_weight_words(w.rows, w.cols);
    return static_cast<std::size_t>((words * 4 + 63) / 64 * 64);
  }
  std::unique_ptr<std::uint32_t, decltype(&std::free)> words_;
  PackedWeight weight_;
};

float as_bf16(float value) {
  Rows one(1, 1);
  round_rows(View<const float>(&value, 1, 1), one.view());
  return wide(one.view()(0, 0));
}

struct Shape {
  std::int64_t rows;
  std::int32_t in, out;
};
const Shape kShapes[] = {{1, 1, 1},    {5, 7, 3},     {16, 32, 16},   {17, 33, 17},  {32, 63, 256}, {33, 256, 29},
                         {64, 64, 64}, {97, 300, 70}, {130, 16, 130}, {600, 48, 65}, {53, 513, 33}, {0, 8, 8}};

enum class Start { none, one, per_ray, per_row };

TEST(Bf16Layers, StayWithinTheirErrorBoundForEveryShapeAndStart) {
  int cases = 0;
  for (const Shape& s : kShapes) {
    const Rows x = random_rows(s.rows, s.in, 1), mask = random_rows(s.rows, s.out, 2);
    const auto w = random_values(std::int64_t{s.in} * s.out, 3), starts = random_values((s.rows + 5) * s.out, 4);
    const View<const float> weight(w.data(), s.in, s.out);
    std::vector<float> turned(w.size()), rounded(w.size());
    for (std::size_t i = 0; i < w.size(); ++i) rounded[i] = as_bf16(w[i]);
    for (std::int32_t i = 0; i < s.in; ++i) {
      for (std::int32_t j = 0; j < s.out; ++j) turned[j * s.in + i] = w[i * s.out + j];
    }
    std::vector<std::int32_t> ray(static_cast<std::size_t>(s.rows));
    for (std::size_t i = 0; i < ray.size(); ++i) ray[i] = static_cast<std::int32_t>(i * 5 / ray.size());
    const Packed plain(weight, false), from_transpose(View<const float>(turned.data(), s.out, s.in), true);
    for (const bool transposed : {false, true}) {
      for (const Start start : {Start::none, Start::one, Start::per_ray, Start::per_row}) {
        for (int ends = 0; ends < 4; ++ends) {
          Layer<Bf16> l{.x = x.view(), .weight = (transposed ? from_transpose : plain).weight()};
          if (start == Start::one) l.start = View<const float>(starts.data(), 1, s.out);
          if (start == Start::per_row) l.start = View<const float>(starts.data(), s.rows, s.out);
          if (start == Start::per_ray) {
            l.start = View<const float>(starts.data(), 5, s.out);
            l.row_of = View<const std::int32_t>(ray.data(), s.rows, 1);
          }
          l.relu = (ends & 1) != 0;
          if ((ends & 2) != 0) l.mask = mask.view();
          const Rows y(s.rows, s.out);
          std::vector<float> exact(static_cast<std::size_t>(s.rows * (s.out + 3) + 1), 12345.0F);
          l.y = y.view();
          apply(l);
          l.y = {};
          l.exact = View<float>(exact.data(), s.rows, s.out, s.out + 3);
          apply(l);
          ASSERT_TRUE(y.guarded() && y.padded_with_zeros());
          for (std::int64_t m = 0; m < s.rows; ++m) {
            for (std::int32_t j = 0; j < s.out; ++j) {
              double sum = 0, magnitude = 0;
              if (start != Start::none) {
                const std::int64_t row = start == Start::one ? 0 : start == Start::per_row ? m : ray[m];
                sum = starts[row * s.out + j];
              }
              for (std::int32_t k = 0; k < s.in; ++k) {
                const double product =
                    static_cast<double>(wide(x.view()(m, k))) * static_cast<double>(rounded[k * s.out + j]);
                sum += product;
                magnitude += std::fabs(product);
              }
              if (l.relu) sum = std::max(sum, 0.0);
              if (!l.mask.empty() && !(wide(mask.view()(m, j)) > 0)) sum = 0;
              const float got = exact[m * (s.out + 3) + j];
              ASSERT_NEAR(got, sum, (s.in + 2) * std::ldexp(1.0, -23) * (magnitude + 1))
                  << s.rows << " x " << s.in << " x " << s.out << " at " << m << ", " << j;
              ASSERT_EQ(wide(y.view()(m, j)), as_bf16(got));
            }
            for (std::int64_t j = s.out; j < s.out + 3; ++j) ASSERT_EQ(exact[m * (s.out + 3) + j], 12345.0F);
          }
          ++cases;
        }
      }
      if (s.rows > 200) break;
    }
  }
  EXPECT_EQ(cases, (12 * 2 - 1) * 4 * 4);
}

TEST(Bf16Layers, AnElementsBitsDependOnItsOwnRowAlone) {
  const Rows x = random_rows(150, 70, 5), whole(150, 40);
  const auto w = random_values(70 * 40, 6);
  const Packed weight(View<const float>(w.data(), 70, 40), false);
  apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .y = whole.view()});
  for (std::int64_t row = 0, size = 1; row < 150; row += size++) {
    const std::int64_t count = std::min(size, 150 - row);
    const Rows own(count, 70), part(count, 40);
    for (std::int64_t m = 0; m < count; ++m)
      std::memcpy(own.view().row(m), x.view().row(row + m), 2 * static_cast<std::size_t>(own.view().row_stride));
    apply(Layer<Bf16>{.x = own.view(), .weight = weight.weight(), .y = part.view()});
    for (std::int64_t m = 0; m < count; ++m)
      ASSERT_EQ(std::memcmp(part.view().row(m), whole.view().row(row + m), 80), 0) << "row " << row + m;
  }
}

TEST(Bf16Layers, WeightGradientsAddUpTheRows) {
  for (const Shape& s : kShapes) {
    const Rows x = random_rows(s.rows, s.in, 7), dz = random_rows(s.rows, s.out, 8);
    auto dw = random_values(std::int64_t{s.in} * (s.out + 2), 9), db = random_values(s.out, 10);
    const auto dw_before = dw, db_before = db;
    weight_gradient(x.view(), dz.view(), View<float>(dw.data(), s.in, s.out, s.out + 2),
                    View<float>(db.data(), 1, s.out));
    for (std::int32_t j = 0; j < s.out; ++j) {
      double bias = db_before[j], size = 0;
      for (std::int64_t m = 0; m < s.rows; ++m) {
        bias += static_cast<double>(wide(dz.view()(m, j)));
        size += std::fabs(static_cast<double>(wide(dz.view()(m, j))));
      }
      ASSERT_NEAR(db[j], bias, static_cast<double>(s.rows + 1) * std::ldexp(1.0, -23) * (size + 1));
      for (std::int32_t i = 0; i < s.in; ++i) {
        const auto at = static_cast<std::size_t>(i * (s.out + 2) + j);
        double sum = dw_before[at], magnitude = 0;
        for (std::int64_t m = 0; m < s.rows; ++m) {
          const double product = static_cast<double>(wide(x.view()(m, i))) * static_cast<double>(wide(dz.view()(m, j)));
          sum += product;
          magnitude += std::fabs(product);
        }
        ASSERT_NEAR(dw[at], sum, static_cast<double>(s.rows + 1) * std::ldexp(1.0, -23) * (magnitude + 1))
            << s.rows << " x " << s.in << " x " << s.out << " at " << i << ", " << j;
      }
    }
    for (std::int32_t i = 0; i < s.in; ++i) {
      for (std::int32_t j = s.out; j < s.out + 2; ++j) {
        const auto at = static_cast<std::size_t>(i * (s.out + 2) + j);
        ASSERT_EQ(dw[at], dw_before[at]) << "between the rows of d_weight";
      }
    }
  }
}

TEST(Bf16Layers, RoundToNearestEvenAndKeepWhatIsNoNumber) {
  const float inf = std::numeric_limits<float>::infinity();
  EXPECT_EQ(as_bf16(1.00390625F), 1.0F);
  EXPECT_EQ(as_bf16(1.0039064F), 1.0078125F);
  EXPECT_EQ(as_bf16(1.01171875F), 1.015625F);
  EXPECT_EQ(as_bf16(inf), inf);
  EXPECT_TRUE(std::isnan(as_bf16(std::numeric_limits<float>::quiet_NaN())));
  Rows x(1, 4);
  const float values[] = {std::numeric_limits<float>::quiet_NaN(), 1, 2, 3}, one[] = {1, 1, 1, 1};
  round_rows(View<const float>(values, 1, 4), x.view());
  const Packed weight(View<const float>(one, 4, 1), false);
  float y = 0;
  apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .relu = true, .exact = View<float>(&y, 1, 1)});
  EXPECT_TRUE(std::isnan(y));
}

TEST(Bf16Layers, SumsOfWeightedRowsAndTheirGradients) {
  for (const std::int32_t cols : {32, 64, 96, 128}) {
    const std::int64_t rows = 9;
    const Rows hidden = random_rows(rows, cols, 11), d_hidden(rows, cols);
    auto weight = random_values(rows, 12), d_sum = random_values(cols, 13);
    weight[3] = 0;
    std::vector<float> sum(static_cast<std::size_t>(cols), 7.0F), dots(static_cast<std::size_t>(rows), 7.0F);
    const View<const float> w(weight.data(), rows, 1);
    weighted_row_sum(w, hidden.view(), View<float>(sum.data(), 1, cols));
    weighted_row_sum_backward(w, hidden.view(), View<const float>(d_sum.data(), 1, cols),
                              View<float>(dots.data(), rows, 1), d_hidden.view());
    for (std::int32_t c = 0; c < cols; ++c) {
      double want = 0;
      for (std::int64_t k = 0; k < rows; ++k) {
        const float w_k = weight[k], d = d_sum[c];
        const float h = wide(hidden.view()(k, c));
        want += static_cast<double>(w_k) * static_cast<double>(h);
        EXPECT_EQ(wide(d_hidden.view()(k, c)), h > 0 ? as_bf16(w_k * d) : 0.0F);
      }
      EXPECT_NEAR(sum[c], want, 1e-5);
    }
    for (std::int64_t k = 0; k < rows; ++k) {
      double want = 0;
      for (std::int32_t c = 0; c < cols; ++c)
        want += static_cast<double>(wide(hidden.view()(k, c))) * static_cast<double>(d_sum[c]);
      EXPECT_NEAR(dots[k], want, 1e-4);
    }
  }
}

TEST(Bf16Layers, RowsAreRoundedThroughAMaskAndWidened) {
  for (const std::int32_t cols : {1, 7, 32, 45, 64}) {
    const std::int64_t rows = 5;
    const auto values = random_values(rows * (cols + 1), 14);
    const Rows mask = random_rows(rows, cols, 15), masked(rows, cols), whole(rows, cols);
    const View<const float> from(values.data(), rows, cols, cols + 1);
    round_rows(from, whole.view());
    round_rows(from, masked.view(), mask.view());
    std::vector<float> back(static_cast<std::size_t>(rows * cols));
    widen_rows(whole.view(), View<float>(back.data(), rows, cols));
    ASSERT_TRUE(whole.guarded() && whole.padded_with_zeros() && masked.padded_with_zeros());
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t c = 0; c < cols; ++c) {
        const float want = as_bf16(from(m, c));
        EXPECT_EQ(back[m * cols + c], want);
        EXPECT_EQ(wide(masked.view()(m, c)), wide(mask.view()(m, c)) > 0 ? want : 0.0F);
      }
    }
  }
}

TEST(Bf16Layers, SumsARaysRowsInOrder) {
  const std::vector<std::int32_t> ray_of{0, 0, 2, 2, 2, 3};
  const Rows dz = random_rows(6, 70, 16);
  std::vector<float> sums(4 * 70, 5.0F);
  per_ray_sum(dz.view(), View<const std::int32_t>(ray_of.data(), 6, 1), View<float>(sums.data(), 4, 70));
  for (std::int32_t ray = 0; ray < 4; ++ray) {
    for (std::int32_t c = 0; c < 70; ++c) {
      float want = 0;
      for (std::int64_t m = 0; m < 6; ++m) {
        if (ray_of[m] == ray) want += wide(dz.view()(m, c));
      }
      EXPECT_EQ(sums[ray * 70 + c], want);
    }
  }
}

TEST(Bf16Layers, RefuseShapesThatDoNotFit) {
  const Rows x(4, 8), y(4, 8);
  const std::vector<float> w(64);
  const Packed weight(View<const float>(w.data(), 8, 8), false);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight()}), std::exception);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view().col_range(0, 7), .weight = weight.weight(), .y = y.view()}),
               std::exception);
  const View<Bf16> dense(y.view().data, 4, 8);
  EXPECT_THROW(apply(Layer<Bf16>{.x = x.view(), .weight = weight.weight(), .y = dense}), std::exception)
      << "rows not padded";
}

// Layers on tiles with every instruction that is not the build's own written in plain C++: what a CPU without
// AVX-512 can check of them.

struct Operands {
  Operands(std::int64_t rows, std::int32_t in, std::int32_t out, bool integers)
      : x(activation_bytes<Bf16>(rows, in) / sizeof(Bf16)),
        y(activation_bytes<Bf16>(rows, out) / sizeof(Bf16)),
        weight(static_cast<std::size_t>(in * out)),
        start(static_cast<std::size_t>(rows * out)) {
    std::uint64_t seed = 1;
    const auto value = [&](std::size_t i) {
      const double u = 2 * uniform01({seed, 0, 1}, i) - 1;
      return static_cast<float>(integers ? std::round(15 * u) : u);
    };
    layer.x = activation_rows<Bf16>(reinterpret_cast<std::byte*>(x.data()), rows, in);
    layer.y = activation_rows<Bf16>(reinterpret_cast<std::byte*>(y.data()), rows, out);
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t k = 0; k < in; ++k)
        x[m * layer.x.row_stride + k] = SEMFIELD_ISA::rounded(value(static_cast<std::size_t>(m * in + k)));
    }
    for (std::vector<float>* values : {&weight, &start}) {
      ++seed;
      for (std::size_t i = 0; i < values->size(); ++i) (*values)[i] = value(i);
    }
    layer.start = View<const float>(start.data(), rows, out);
    layer.relu = true;
    words.resize(static_cast<std::size_t>(on_tiles::packed_words(in, out)));
    on_tiles::pack_weight(
        in, out, [&](std::int64_t k, std::int64_t n) { return weight[k * out + n]; }, words.data());
    layer.weight = {words.data(), in, out};
  }
  std::vector<Bf16> x, y;
  std::vector<float> weight, start;
  std::vector<std::uint32_t> words;
  Layer<Bf16> layer;
};

constexpr Shape kTileShapes[] = {{1, 9, 9}, {16, 32, 16}, {33, 65, 17}, {64, 64, 64}, {40, 600, 300}, {70, 130, 29}};

TEST(LayersOnTiles, AreExactWhereNothingNeedsRounding) {
  for (const auto& [rows, in, out] : kTileShapes) {
    Operands o(rows, in, out, true);
    std::vector<float> sums(o.start.size()), gradient(static_cast<std::size_t>(in * in), 1.0F);
    o.layer.y = {};
    o.layer.exact = View<float>(sums.data(), rows, out);
    on_tiles::layer<Plain>(o.layer);
    on_tiles::weight_gradient<Plain>(o.layer.x, o.layer.x, View<float>(gradient.data(), in, in));
    for (std::int32_t i = 0; i < in; ++i) {
      for (std::int32_t j = 0; j < in; ++j) {
        double sum = 1;
        for (std::int64_t m = 0; m < rows; ++m)
          sum += static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, i))) *
                 static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, j)));
        ASSERT_EQ(gradient[i * in + j], sum) << i << ", " << j << " of " << in;
      }
    }
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t n = 0; n < out; ++n) {
        double sum = o.start[m * out + n];
        for (std::int32_t k = 0; k < in; ++k)
          sum += static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, k))) * static_cast<double>(o.weight[k * out + n]);
        ASSERT_EQ(sums[m * out + n], std::max(sum, 0.0))
            << rows << " x " << in << " x " << out << " at " << m << ", " << n;
      }
    }
  }
}

// Where the program itself runs on tiles, in registers or emulated with AVX-512, its bits are these.
TEST(LayersOnTiles, HaveTheBitsOfTheProgramsOwn) {
  if (isa() != Isa::amx_emulated && isa() != Isa::amx_bf16)
    GTEST_SKIP() << "layers run by " << isa_name(isa()) << "; SEMFIELD_ISA=amx_emulated compares";
  for (const auto& [rows, in, out] : kTileShapes) {
    Operands plain(rows, in, out, false), own(rows, in, out, false);
    on_tiles::layer<Plain>(plain.layer);
    apply(own.layer);
    EXPECT_EQ(std::memcmp(plain.y.data(), own.y.data(), plain.y.size() * sizeof(Bf16)), 0)
        << rows << " x " << in << " x " << out;
    std::vector<float> expected(plain.weight), found(plain.weight);
    on_tiles::weight_gradient<Plain>(plain.layer.x, plain.layer.y, View<float>(expected.data(), in, out));
    weight_gradient(own.layer.x, own.layer.y, View<float>(found.data(), in, out), {});
    EXPECT_EQ(std::memcmp(expected.data(), found.data(), found.size() * sizeof(float)), 0)
        << rows << " x " << in << " x " << out;
  }
}

}  // namespace
}  // namespace semfield
