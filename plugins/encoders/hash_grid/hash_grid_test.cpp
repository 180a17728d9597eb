// Tests of the hash grid against a long double trilinear reference, beside cases C06 to C14 of tests/numerics.

#include "encoders/hash_grid/hash_grid.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "compute/parallel.h"
#include "core/rng.h"
#include "tests/says.h"

namespace semfield {
namespace {

HashGridParams params_of(int levels, int features, int log2_entries, int base, int finest,
                         Interpolation interpolation = Interpolation::linear) {
  return HashGridParams{.levels = levels,
                        .features = features,
                        .log2_entries = log2_entries,
                        .base_resolution = base,
                        .finest_resolution = finest,
                        .interpolation = interpolation};
}

class Declared final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    specs.push_back(std::move(spec));
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<TensorSpec> specs;
};

/// An encoder with tables of its own.
template <class Real>
struct Grid {
  explicit Grid(const HashGridParams& params, std::uint64_t seed = 1) : encoder(params, {}, kernels()) {
    Declared declared;
    encoder.declare(declared);
    std::uint64_t element = 0;
    for (const TensorSpec& spec : declared.specs) {
      const auto size = static_cast<std::size_t>(spec.rows * spec.cols);
      table.emplace_back(size);
      for (Real& v : table.back()) v = static_cast<Real>(2 * uniform01({seed, 0, 9}, element++) - 1);
      grad.emplace_back(size, Real(0));
    }
    for (std::size_t l = 0; l < table.size(); ++l) {
      value_views.emplace_back(table[l].data(), declared.specs[l].rows, declared.specs[l].cols);
      grad_views.emplace_back(grad[l].data(), declared.specs[l].rows, declared.specs[l].cols);
    }
    width = encoder.traits().out_dims;
  }
  static const KernelTables& kernels() {
    static const KernelTables tables = [] {
      KernelTables t;
      hash_grid_kernels(t);
      return t;
    }();
    return tables;
  }
  Tensors<Real> tensors() const { return {value_views, grad_views}; }
  StepContext context() const { return StepContext{.workspace = &workspace}; }
  std::vector<Real> forward(const std::vector<double>& x) const {
    const auto rows = static_cast<std::int64_t>(x.size() / 3);
    std::vector<Real> y(static_cast<std::size_t>(rows * width), static_cast<Real>(NAN));
    encoder.forward(context(), tensors(), View<const double>(x.data(), rows, 3), View<Real>(y.data(), rows, width));
    return y;
  }
  std::vector<Real> backward(const std::vector<double>& x, const std::vector<Real>& dy) {
    const auto rows = static_cast<std::int64_t>(x.size() / 3);
    std::vector<Real> dx(x.size(), static_cast<Real>(NAN));
    encoder.backward(context(), tensors(), View<const double>(x.data(), rows, 3),
                     View<const Real>(dy.data(), rows, width), View<Real>(dx.data(), rows, 3));
    return dx;
  }
  HashGrid<Real> encoder;
  std::vector<std::vector<Real>> table, grad;
  std::vector<View<Real>> value_views, grad_views;
  std::int32_t width = 0;
  mutable Workspace workspace;
};

std::vector<double> random_points(std::int64_t rows, std::uint64_t seed = 3) {
  std::vector<double> x(static_cast<std::size_t>(3 * rows));
  for (std::size_t i = 0; i < x.size(); ++i) {
    const PhiloxBlock b = random_block({seed, 0, 4}, i);
    x[i] = ((std::uint64_t{b.v[0]} << 21) ^ b.v[1]) * 0x1p-53;
  }
  return x;
}

__extension__ using Wide = unsigned __int128;

/// Entry of a vertex by 128-bit arithmetic.
std::size_t reference_entry(const HashGridLevel& level, const std::uint64_t* v) {
  if (level.dense) {
    const auto n = static_cast<Wide>(level.resolution) + 1;
    return static_cast<std::size_t>(v[0] + n * v[1] + n * n * v[2]);
  }
  const std::uint64_t mixed = v[0] ^ (v[1] * 2654435761ull) ^ (v[2] * 805459861ull);
  return static_cast<std::size_t>((mixed & 0xFFFFFFFFull) % static_cast<std::uint64_t>(level.entries));
}

/// Feature f of level l at x: three nested linear interpolations in long double.
template <class Real>
long double reference(const Grid<Real>& grid, int l, int f, const double* x) {
  const HashGridShape& shape = grid.encoder.shape();
  const HashGridLevel& level = shape.level[l];
  std::uint64_t cell[3];
  long double w[3];
  for (int d = 0; d < 3; ++d) {
    const long double p = std::min(1.0L, std::max(0.0L, static_cast<long double>(x[d]))) * level.resolution;
    cell[d] = static_cast<std::uint64_t>(std::min<long double>(std::floor(p), level.resolution - 1));
    w[d] = p - cell[d];
    if (shape.interpolation == Interpolation::smoothstep) w[d] = w[d] * w[d] * (3 - 2 * w[d]);
  }
  long double along_z[2];
  for (std::uint64_t k = 0; k < 2; ++k) {
    long double along_y[2];
    for (std::uint64_t j = 0; j < 2; ++j) {
      long double ends[2];
      for (std::uint64_t i = 0; i < 2; ++i) {
        const std::uint64_t v[3] = {cell[0] + i, cell[1] + j, cell[2] + k};
        ends[i] = grid.table[l][reference_entry(level, v) * static_cast<std::size_t>(shape.features) + f];
      }
      along_y[j] = ends[0] + w[0] * (ends[1] - ends[0]);
    }
    along_z[k] = along_y[0] + w[1] * (along_y[1] - along_y[0]);
  }
  return along_z[0] + w[2] * (along_z[1] - along_z[0]);
}

template <class Real>
double largest_error(const Grid<Real>& grid, const std::vector<double>& x) {
  const auto y = grid.forward(x);
  const HashGridShape& shape = grid.encoder.shape();
  long double worst = 0;
  for (std::size_t r = 0; r < x.size() / 3; ++r) {
    for (int l = 0; l < shape.levels; ++l) {
      for (int f = 0; f < shape.features; ++f) {
        const Real got = y[r * static_cast<std::size_t>(grid.width) + static_cast<std::size_t>(l * shape.features + f)];
        const long double error = std::fabs(got - reference(grid, l, f, &x[3 * r]));
        worst = std::isnan(got) ? 1e30L : std::max(worst, error);
      }
    }
  }
  return static_cast<double>(worst);
}

TEST(HashGrid, MatchesTheReferenceForEveryShape) {
  const auto x = random_points(133);
  for (int features : {1, 2, 4, 8}) {
    for (Interpolation interpolation : {Interpolation::linear, Interpolation::smoothstep}) {
      const HashGridParams p = params_of(6, features, 12, 4, 300, interpolation);
      EXPECT_LE(largest_error(Grid<float>(p), x), 3e-7) << features;
      EXPECT_LE(largest_error(Grid<double>(p), x), 2e-13) << features;
    }
  }
}

// Blocks, tiles, groups, strides and threads: nothing but the row's own coordinates may decide its bits.
TEST(HashGrid, RowsAndThreadsDoNotChangeBits) {
  Grid<float> grid(params_of(5, 2, 16, 8, 500));  // its tables are large enough to be fetched ahead
  constexpr std::int64_t rows = 50000;            // more than a block, in pieces that threads share
  const auto x = random_points(rows);
  const auto whole = grid.forward(x);
  for (std::int64_t begin : {0, 1, 15, 16, 1023, 1024, 4095, 4096, 8192, 49151, 49152, 49999}) {
    std::vector<float> part(33, -1.f);  // 3 rows of stride 11
    const std::int64_t count = std::min<std::int64_t>(3, rows - begin);
    grid.encoder.forward(grid.context(), grid.tensors(), View<const double>(&x[3 * begin], count, 3),
                         View<float>(part.data(), count, 10, 11));
    for (std::int64_t r = 0; r < count; ++r) {
      for (std::int64_t c = 0; c < 10; ++c) ASSERT_EQ(part[r * 11 + c], whole[(begin + r) * 10 + c]);
      ASSERT_EQ(part[r * 11 + 10], -1.f);
    }
  }
  std::vector<float> dy(whole.rbegin(), whole.rend());
  set_thread_count(1);
  const auto dx = grid.backward(x, dy);
  const auto grads = grid.grad;
  EXPECT_EQ(grid.forward(x), whole);
  for (const int threads : {2, 3, 7, 16}) {
    for (auto& g : grid.grad) std::fill(g.begin(), g.end(), 0.f);
    set_thread_count(threads);
    EXPECT_EQ(grid.forward(x), whole) << threads << " threads";
    EXPECT_EQ(grid.backward(x, dy), dx) << threads << " threads";
    EXPECT_EQ(grid.grad, grads) << threads << " threads";
  }
  set_thread_count(0);
}

// Lanes of a group go through the same instructions: a row that moves within its group keeps the bits of its slope.
TEST(HashGrid, TheFirstRowThatIsNotFiniteIsNamedForAnyThreads) {
  const Grid<float> grid(params_of(3, 2, 6, 2, 5));
  auto x = random_points(60000);
  for (const std::size_t row : {59000, 20001, 9003, 9004}) x[3 * row + 1] = NAN;
  for (const int threads : {1, 2, 7}) {
    set_thread_count(threads);
    EXPECT_HAS(error_of([&] { grid.forward(x); }), "row 9003 ");
  }
  set_thread_count(0);
}

// Tests of the hash grid's levels, addresses and parameters (case C11 and the refusal of C10 among them).

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
  HashGrid<float>(params_of(11, 4, 8, 2, 64), {}, Grid<float>::kernels()).declare(declared);
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
  const KernelTables& kernels = Grid<float>::kernels();
  EXPECT_THROW(HashGrid<float>(HashGridParams{}, EncoderBuild{.in_dims = 2}, kernels), Error);
  EXPECT_THROW(HashGrid<float>(params_of(2, 2, 10, 16, 1 << 21), {}, kernels), Error);  // finer than weights can say
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
  EXPECT_EQ(room.sentences.size(), 2u);
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
