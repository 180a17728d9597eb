// Tests of the hash grid's levels, addresses and parameters (case C11 and the refusal of C10 among them).
#include <gtest/gtest.h>

#include <algorithm>

#include "encoders/hash_grid/hash_grid.h"

namespace semfield {
namespace {

HashGridParams params_of(int levels, int features, int log2_entries, int base, int finest) {
  return HashGridParams{.levels = levels,
                        .features = features,
                        .log2_entries = log2_entries,
                        .base_resolution = base,
                        .finest_resolution = finest};
}

class Declared final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    specs.push_back(std::move(spec));
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<TensorSpec> specs;
};

const KernelTables& kernels() {
  static const KernelTables tables = [] {
    KernelTables t;
    hash_grid_kernels(t);
    return t;
  }();
  return tables;
}

__extension__ using Wide = unsigned __int128;

TEST(HashGridLevels, DenseAddressesDoNotWrap) {  // C11: 1626^3 > 2^32
  for (std::uint64_t n : {1624u, 1625u, 2047u, 4095u, 1048576u}) {
    for (std::uint64_t x : {std::uint64_t{0}, std::uint64_t{1}, n / 2, n}) {
      for (std::uint64_t y : {std::uint64_t{0}, n / 3, n}) {
        for (std::uint64_t z : {std::uint64_t{0}, n - 1, n}) {
          const auto wide = static_cast<Wide>(n) + 1;
          const Wide expected = x + wide * (y + wide * z);
          EXPECT_TRUE(dense_index<std::uint64_t>(x, y, z, n + 1) == expected) << n;
        }
      }
    }
    EXPECT_TRUE(vertex_count(static_cast<std::int64_t>(n)) == (static_cast<Wide>(n) + 1) * (n + 1) * (n + 1));
  }
  // A 32-bit vertex count would wrap to few entries and call these levels dense.
  const HashGridShape shape = hash_grid_shape(params_of(3, 2, 24, 1625, 6501));
  for (int l = 0; l < 3; ++l) EXPECT_FALSE(shape.level[l].dense) << shape.level[l].resolution;
}

TEST(HashGridLevels, LevelsFollowThePaper) {
  const HashGridShape shape = hash_grid_shape(HashGridParams{});
  EXPECT_EQ(shape.level[0].resolution, 16);
  EXPECT_EQ(shape.level[15].resolution, 2048);
  const double growth = std::exp(std::log(2048.0 / 16) / 15);
  for (int l = 0; l < 16; ++l) {
    EXPECT_NEAR(shape.level[l].resolution, 16 * std::pow(growth, l) - 0.5, 0.5 + 1e-6);
    const auto n = static_cast<std::int64_t>(shape.level[l].resolution + 1);
    EXPECT_EQ(shape.level[l].dense, n * n * n <= 524288);
    EXPECT_EQ(shape.level[l].entries, std::min<std::int64_t>(n * n * n, 524288));
  }
  const HashGridShape powers = hash_grid_shape(params_of(8, 2, 19, 16, 2048));
  for (int l = 0; l < 8; ++l) EXPECT_EQ(powers.level[l].resolution, 16 << l);
  Declared declared;
  HashGrid<float>(params_of(11, 4, 8, 2, 64), {}, kernels()).declare(declared);
  ASSERT_EQ(declared.specs.size(), 11u);
  EXPECT_EQ(declared.specs[0].name, "level_00");
  EXPECT_EQ(declared.specs[10].name, "level_10");
  EXPECT_EQ(declared.specs[10].rows, 256);
  EXPECT_EQ(declared.specs[0].rows, 27);
  EXPECT_EQ(declared.specs[3].cols, 4);
  EXPECT_EQ(declared.specs[3].role, TensorRole::sparse);
  EXPECT_EQ(declared.specs[3].init.high, 1e-4);
  EXPECT_EQ(declared.specs[3].init.low, -1e-4);
}

class RangeOf final : public ParamVisitor {
 public:
  void boolean(const ParamInfo&, bool&) override {}
  void integer(const ParamInfo& info, std::int64_t&) override {
    if (info.name == "finest_resolution") most = info.range.max;
  }
  void real(const ParamInfo&, double&) override {}
  void text(const ParamInfo&, std::string&) override {}
  void choice(const ParamInfo&, int&, std::span<const std::string_view>) override {}
  void integers(const ParamInfo&, std::vector<std::int64_t>&) override {}
  void reals(const ParamInfo&, std::vector<double>&) override {}
  void texts(const ParamInfo&, std::vector<std::string>&) override {}
  double most = 0;
};

TEST(HashGridLevels, RefuseGridsFinerThanWeightsCanTell) {  // C10
  RangeOf range;
  HashGridParams p;
  describe(range, p);
  EXPECT_EQ(range.most, 1 << 20);
  EXPECT_THROW(HashGrid<float>(params_of(2, 2, 10, 16, 1 << 21), {}, kernels()), Error);
}

TEST(HashGridLevels, RefuseImpossibleParameters) {
  const auto errors = [](const HashGridParams& p) {
    Diagnostics diagnostics;
    validate(p, diagnostics);
    return diagnostics.error_count();
  };
  EXPECT_EQ(errors(HashGridParams{}), 0);
  EXPECT_EQ(errors(params_of(4, 3, 10, 4, 8)), 1);
  EXPECT_EQ(errors(params_of(4, 2, 10, 9, 8)), 1);
  EXPECT_EQ(errors(params_of(1, 2, 10, 4, 8)), 1);
  EXPECT_EQ(errors(params_of(1, 2, 10, 8, 8)), 0);
  EXPECT_EQ(errors(params_of(4, 2, 0, 9, 0)), 0);  // to be chosen
  EncoderBuild flat{.in_dims = 2};
  EXPECT_THROW(HashGrid<float>(HashGridParams{}, flat, kernels()), Error);
}

struct Chosen {
  int finest, log2_entries;
  std::vector<std::string> sentences;
};
Chosen chosen_for(HashGridParams p, double extent_m, double pixel_m, Device device = Device::cpu) {
  EncoderBuild build{.device = device, .extent_m = extent_m, .pixel_footprint_m = pixel_m};
  Chosen out{};
  choose(p, build, out.sentences);
  out.finest = p.finest_resolution;
  out.log2_entries = p.log2_entries;
  return out;
}

TEST(HashGridLevels, SizesAreChosenFromTheScene) {
  // 6.4 m at pixels of 25 mm: cells of 20 mm, 320 a side; 12 * 321^2 = 1,236,492 vertices, more than 2^19, but 1 MiB is
  // 2^17 entries of 8 bytes.
  const Chosen room = chosen_for(params_of(8, 2, 0, 16, 0), 6.4, 0.025);
  EXPECT_EQ(room.finest, 320);
  EXPECT_EQ(room.log2_entries, 17);
  ASSERT_EQ(room.sentences.size(), 2u);
  EXPECT_EQ(room.sentences[0],
            "finest_resolution was set to 320 for this scene: a cell is 0.02 wide, and a pixel at the middle depth is "
            "0.025 wide");
  EXPECT_EQ(room.sentences[1], "log2_entries was set to 17, so that a level takes at most 1024 KiB");
  EXPECT_EQ(chosen_for(params_of(8, 8, 0, 16, 0), 6.4, 0.025).log2_entries, 15);  // 32 bytes an entry
  // 2 m at 50 mm: 50 cells, of steps of 8 the nearest is 48; 12 * 49^2 = 28,812 <= 2^15.
  const Chosen small = chosen_for(params_of(8, 2, 0, 16, 0), 2.0, 0.05);
  EXPECT_EQ(small.finest, 48);
  EXPECT_EQ(small.log2_entries, 15);
  EXPECT_EQ(chosen_for(params_of(8, 2, 0, 16, 0), 0.2, 0.05).finest, 16);  // never below the coarsest level
  EXPECT_EQ(chosen_for(params_of(8, 2, 0, 16, 0), 0.2, 0.05).log2_entries, 14);
  EXPECT_EQ(chosen_for(params_of(8, 2, 0, 16, 0), 0, 0).finest, 2048);  // nothing known
  EXPECT_EQ(chosen_for(params_of(8, 2, 0, 16, 0), 6.4, 0.025, Device::cuda).log2_entries, 19);
  // What is written stays, without a word.
  const Chosen fixed = chosen_for(params_of(8, 2, 12, 16, 99), 6.4, 0.025);
  EXPECT_EQ(fixed.finest, 99);
  EXPECT_EQ(fixed.log2_entries, 12);
  EXPECT_TRUE(fixed.sentences.empty());
}

}  // namespace
}  // namespace semfield
