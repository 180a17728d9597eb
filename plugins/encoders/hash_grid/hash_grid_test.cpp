// Tests of the hash grid's bits, levels and parameters; cases C06 to C14 of tests/numerics have its values and slopes.

#include "encoders/hash_grid/hash_grid.h"

#include <algorithm>

#include "core/rng.h"
#include "tests/conformance/rows.h"
#include "tests/encoder_box.h"
#include "tests/says.h"
#include "tests/threads.h"

namespace semfield {
namespace {

const KernelTables& kernels() { return testkit::linked_registry().kernels(); }

// Grids are {levels, features, log2_entries, base and finest resolution, interpolation}.

template <class Real>
testkit::EncoderBox<Real> grid_of(const HashGridParams& params) {
  return testkit::EncoderBox<Real>(std::make_unique<HashGrid<Real>>(params, EncoderBuild{}, kernels()));
}

std::vector<double> random_points(std::int64_t rows) {
  std::vector<double> x(static_cast<std::size_t>(3 * rows));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const PhiloxBlock b = random_block({3, 0, 4}, i);
    x[i] = ((std::uint64_t{b.v[0]} << 21) ^ b.v[1]) * 0x1p-53;
  }
  return x;
}

// The weight w of a cell's far corner becomes w^2 (3 - 2 w): as if the point lay there.
TEST(HashGrid, SmoothstepMovesPointsWithinTheirCells) {
  constexpr double kCells = 37;
  std::vector<double> x = random_points(133), moved = x;
  for (double& v : moved) {
    const double cell = std::floor(v * kCells), w = v * kCells - cell;
    v = (cell + w * w * (3 - 2 * w)) / kCells;
  }
  for (const int features : {1, 2, 4, 8}) {
    auto smooth = grid_of<double>({1, features, 12, 37, 37, Interpolation::smoothstep});
    auto linear = grid_of<double>({1, features, 12, 37, 37});
    const std::vector<double> got = smooth.forward(x), want = linear.forward(moved);
    for (std::size_t i = 0; i < got.size(); ++i) ASSERT_NEAR(got[i], want[i], 2e-13) << features;
  }
}

// Blocks, tiles, groups, strides and threads: nothing but the row's own coordinates may decide its bits.
TEST(HashGrid, RowsAndThreadsDoNotChangeBits) {
  auto grid = grid_of<float>({5, 2, 16, 8, 500});  // its tables are large enough to be fetched ahead
  constexpr std::int64_t rows = 50000;             // more than a block, in pieces that threads share
  const auto x = random_points(rows);
  const auto whole = grid.forward(x);
  for (std::int64_t begin : {0, 1, 15, 16, 1023, 1024, 4095, 4096, 8192, 49151, 49152, 49997}) {
    const auto at = x.begin() + 3 * begin;
    const auto part = grid.forward(std::vector<double>(at, at + 9));
    EXPECT_TRUE(std::equal(part.begin(), part.end(), whole.begin() + 10 * begin)) << begin;
  }
  const std::vector<float> dy(whole.rbegin(), whole.rend());
  std::vector<float> dx, grad;
  for (const int threads : {1, 2, 3, 7, 16}) {
    const ThreadScope scope(threads);
    grid.tensors().fill_grads(0);
    EXPECT_EQ(grid.forward(x), whole) << threads << " threads";
    const auto slopes = grid.backward(x, dy);
    std::vector<float> sums;
    for (std::size_t l = 0; l < grid.tensors().count(); ++l)
      sums.insert(sums.end(), grid.tensors().grad(l).data, grid.tensors().grad(l).data + grid.tensors().grad(l).size());
    if (threads == 1) dx = slopes, grad = sums;
    EXPECT_EQ(slopes, dx) << threads << " threads";
    EXPECT_EQ(sums, grad) << threads << " threads";
  }
}

TEST(HashGrid, TheFirstRowThatIsNotFiniteIsNamedForAnyThreads) {
  auto grid = grid_of<float>({3, 2, 6, 2, 5});
  auto x = random_points(60000);
  for (const std::size_t row : {59000, 20001, 9003, 9004}) x[3 * row + 1] = NAN;
  for (const int threads : {1, 2, 7}) {
    const ThreadScope scope(threads);
    EXPECT_HAS(error_of([&] { grid.forward(x); }), "row 9003 ");
  }
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
  const HashGridShape powers = hash_grid_shape({8, 2, 19, 16, 2048});
  for (int l = 0; l < 8; ++l) EXPECT_EQ(powers.level[l].resolution, 16 << l);
  const std::vector<TensorSpec> specs = grid_of<float>({11, 4, 8, 2, 64}).tensors().specs();
  ASSERT_EQ(specs.size(), 11u);
  EXPECT_EQ(specs[0].name, "level_00");
  EXPECT_EQ(specs[10].name, "level_10");
  EXPECT_EQ(specs[10].rows, 256);
  EXPECT_EQ(specs[0].rows, 27);
  EXPECT_EQ(specs[3].cols, 4);
  EXPECT_EQ(specs[3].role, TensorRole::sparse);
  EXPECT_EQ(specs[3].init.high, 1e-4);
  EXPECT_EQ(specs[3].init.low, -1e-4);
}

TEST(HashGridLevels, RefuseImpossibleParameters) {
  const auto errors = [](const HashGridParams& p) {
    Diagnostics diagnostics;
    validate(p, diagnostics);
    return diagnostics.error_count();
  };
  EXPECT_EQ(errors(HashGridParams{}), 0);
  EXPECT_EQ(errors({4, 3, 10, 4, 8}), 1);
  EXPECT_EQ(errors({4, 2, 10, 9, 8}), 1);
  EXPECT_EQ(errors({1, 2, 10, 4, 8}), 1);
  EXPECT_EQ(errors({1, 2, 10, 8, 8}), 0);
  EXPECT_EQ(errors({4, 2, 0, 9, 0}), 0);  // to be chosen
  EXPECT_THROW(HashGrid<float>(HashGridParams{}, EncoderBuild{.in_dims = 2}, kernels()), Error);
}

struct Chosen {
  int finest, log2_entries;
  std::vector<std::string> sentences;
};
Chosen chosen_for(HashGridParams p, double extent_m, double pixel_m, Device device = Device::cpu) {
  EncoderBuild build{.device = device, .extent_m = extent_m, .pixel_footprint_m = pixel_m};
  std::vector<std::string> sentences;
  choose(p, build, sentences);
  return {p.finest_resolution, p.log2_entries, sentences};
}

TEST(HashGridLevels, SizesAreChosenFromTheScene) {
  // 6.4 m at pixels of 25 mm: cells of 20 mm, 320 a side; 12 * 321^2 = 1,236,492 vertices, more than 2^19, but 1 MiB is
  // 2^17 entries of 8 bytes.
  const Chosen room = chosen_for({8, 2, 0, 16, 0}, 6.4, 0.025);
  EXPECT_EQ(room.finest, 320);
  EXPECT_EQ(room.log2_entries, 17);
  EXPECT_EQ(room.sentences.size(), 2u);
  EXPECT_EQ(chosen_for({8, 8, 0, 16, 0}, 6.4, 0.025).log2_entries, 15);  // 32 bytes an entry
  // 2 m at 50 mm: 50 cells, of steps of 8 the nearest is 48; 12 * 49^2 = 28,812 <= 2^15.
  const Chosen small = chosen_for({8, 2, 0, 16, 0}, 2.0, 0.05);
  EXPECT_EQ(small.finest, 48);
  EXPECT_EQ(small.log2_entries, 15);
  EXPECT_EQ(chosen_for({8, 2, 0, 16, 0}, 0.2, 0.05).finest, 16);  // never below the coarsest level
  EXPECT_EQ(chosen_for({8, 2, 0, 16, 0}, 0.2, 0.05).log2_entries, 14);
  EXPECT_EQ(chosen_for({8, 2, 0, 16, 0}, 0, 0).finest, 2048);  // nothing known
  EXPECT_EQ(chosen_for({8, 2, 0, 16, 0}, 6.4, 0.025, Device::cuda).log2_entries, 19);
  // What is written stays, without a word.
  const Chosen fixed = chosen_for({8, 2, 12, 16, 99}, 6.4, 0.025);
  EXPECT_EQ(fixed.finest, 99);
  EXPECT_EQ(fixed.log2_entries, 12);
  EXPECT_TRUE(fixed.sentences.empty());
}

}  // namespace
}  // namespace semfield
