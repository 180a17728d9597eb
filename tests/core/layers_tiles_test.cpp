// Layers on tiles with every instruction that is not the build's own written in plain C++: what a processor without
// AVX-512 can check of them.
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <vector>

#include "compute/bf16/tile_layers.h"
#include "compute/isa.h"
#include "core/rng.h"

namespace semfield {
namespace {

namespace on_tiles = SEMFIELD_ISA::tiles;
using Plain = SEMFIELD_ISA::EmulatedTiles;

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
        x[static_cast<std::size_t>(m * layer.x.row_stride + k)] =
            SEMFIELD_ISA::rounded(value(static_cast<std::size_t>(m * in + k)));
    }
    for (std::vector<float>* values : {&weight, &start}) {
      ++seed;
      for (std::size_t i = 0; i < values->size(); ++i) (*values)[i] = value(i);
    }
    layer.start = View<const float>(start.data(), rows, out);
    layer.relu = true;
    words.resize(static_cast<std::size_t>(on_tiles::packed_words(in, out)));
    on_tiles::pack_weight(
        in, out, [&](std::int64_t k, std::int64_t n) { return weight[static_cast<std::size_t>(k * out + n)]; },
        words.data());
    layer.weight = {words.data(), in, out};
  }
  std::vector<Bf16> x, y;
  std::vector<float> weight, start;
  std::vector<std::uint32_t> words;
  Layer<Bf16> layer;
};

struct Shape {
  std::int64_t rows;
  std::int32_t in, out;
};
constexpr Shape kShapes[] = {{1, 9, 9}, {16, 32, 16}, {33, 65, 17}, {64, 64, 64}, {40, 600, 300}, {70, 130, 29}};

TEST(LayersOnTiles, AreExactWhereNothingNeedsRounding) {
  for (const auto& [rows, in, out] : kShapes) {
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
        ASSERT_EQ(gradient[static_cast<std::size_t>(i * in + j)], sum) << i << ", " << j << " of " << in;
      }
    }
    for (std::int64_t m = 0; m < rows; ++m) {
      for (std::int32_t n = 0; n < out; ++n) {
        double sum = o.start[static_cast<std::size_t>(m * out + n)];
        for (std::int32_t k = 0; k < in; ++k)
          sum += static_cast<double>(SEMFIELD_ISA::widen(o.layer.x(m, k))) *
                 static_cast<double>(o.weight[static_cast<std::size_t>(k * out + n)]);
        ASSERT_EQ(sums[static_cast<std::size_t>(m * out + n)], std::max(sum, 0.0))
            << rows << " x " << in << " x " << out << " at " << m << ", " << n;
      }
    }
  }
}

// Where the program itself runs on tiles, in registers or emulated with AVX-512, its bits are these.
TEST(LayersOnTiles, HaveTheBitsOfTheProgramsOwn) {
  if (isa() != Isa::amx_emulated && isa() != Isa::amx_bf16)
    GTEST_SKIP() << "layers run by " << isa_name(isa()) << "; SEMFIELD_ISA=amx_emulated compares";
  for (const auto& [rows, in, out] : kShapes) {
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
