// CPU kernels of the occupancy-grid sampler: whole empty blocks, then whole empty cells, are passed over in one jump.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "plugin/kernels.h"
#include "plugin/quadrature.h"
#include "samplers/occupancy_grid/occupancy_grid_kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

static_assert(std::endian::native == std::endian::little, "empty_bits keeps its bits in the low bytes");

constexpr std::int64_t kChunkCells = 4096;  // cells that a thread takes at a time
constexpr std::int64_t kRoundChunks = 64;   // of one density query

// Lattice samples [i, to) that are all passed over, or all evaluated.
struct Stretch {
  std::int64_t to;
  bool empty;
};

template <class Real>
struct GridReader {
  const OccupancyGeometry& geometry;
  const OccupancyState<Real>& state;
  const unsigned char* bits;
  bool is_plain_threshold;
  bool keep_last;

  Stretch stretch_from(const MarchedRay& ray, SkipBudget& budget, std::int64_t i) const {
    const OccupancyCell cell = ray.cell_at(geometry, i);
    const double block_bound = static_cast<double>(state.block_bound[cell.block(geometry.blocks_per_side())]);
    if (block_bound < kUnbounded) {
      const std::int64_t to = ray.behind(geometry, cell, kBlockCells, i);
      if (budget.affords(block_bound, ray.lattice.length_m(i, to))) return {to, true};
    }
    const std::int64_t index = cell.index(geometry.n);
    const std::int64_t to = ray.behind(geometry, cell, 1, i);
    // `behind` is never too late, so all of them lie in this cell.
    if (!is_empty_cell<Real>(bits, index)) return {to, false};
    const double bound = is_plain_threshold ? 0.0 : static_cast<double>(state.density[index]);
    if (budget.affords(bound, ray.lattice.length_m(i, to))) return {to, true};
    return {i + 1, false};
  }
};

// A ray on its way. A step of the way waits for the one before it, from cell to exit to next index; kTogether rays that
// take turns keep the CPU busy.
constexpr std::int64_t kTogether = 4;

struct March : MarchedRay {
  SkipBudget budget{0, 1};
  std::int64_t row = 0;  // of its first sample
  std::int64_t i = 0, written = 0;
  bool active = false;

  void restart(double skip_budget) {
    lay_out();
    budget = SkipBudget(skip_budget, length_m());
    i = written = 0;
  }
};

template <class Real>
March begin_march(const OccupancySampleArgs& args, const Box& box, const Rays<Real>& rays, std::int64_t r) {
  March march;
  double near_m = 0, far_m = 0;
  if (!ray_span(rays.near_far, r, args.first_ray, near_m, far_m)) return march;
  if (!march.begin(args.geometry, box, rays.origin.row(r), rays.direction.row(r), near_m, far_m)) return march;
  march.lattice.u =
      args.jitter ? static_cast<double>(uniform01(args.random, static_cast<std::uint64_t>(args.first_ray + r))) : 0.5;
  march.restart(args.skip_budget);
  march.active = true;
  return march;
}

// The next stretch of a ray. When it has more samples than there may be, the ray begins anew with half the steps; a
// lattice of at most max_samples steps fits.
template <class Real>
void advance(const GridReader<Real>& grid, const OccupancySampleArgs& args, March& march, Samples<Real>& out) {
  const StepLattice& lattice = march.lattice;
  Stretch stretch = grid.stretch_from(march, march.budget, march.i);
  if (stretch.empty && grid.keep_last) stretch.to = std::min(stretch.to, lattice.count - 1);
  if (stretch.empty && stretch.to > march.i) {
    march.i = stretch.to;
  } else {
    const std::int64_t end = std::max(stretch.to, march.i + 1);
    if (march.written + end - march.i > args.max_samples) {
      march.lattice.count = (lattice.count + 1) / 2;
      return march.restart(args.skip_budget);
    }
    for (; march.i < end; ++march.i, ++march.written) {
      *out.t.row(march.row + march.written) = round_inside<Real>(lattice.at(march.i), lattice.near_m, march.far_m);
      *out.delta.row(march.row + march.written) = static_cast<Real>(lattice.length_m(march.i, march.i + 1));
    }
  }
  march.active = march.i < lattice.count;
}

template <class Real>
void sample(const OccupancySampleArgs& args, const OccupancyState<Real>& state, const Rays<Real>& rays,
            Samples<Real>& out) {
  const Box box = args.geometry.outer();
  const GridReader<Real> grid{args.geometry, state, reinterpret_cast<const unsigned char*>(state.empty_bits),
                              std::isinf(args.skip_budget), args.keep_last};
  std::int64_t count = 0;
  for (std::int64_t first = 0; first < rays.near_far.rows; first += kTogether) {
    const std::int64_t together = std::min(kTogether, rays.near_far.rows - first);
    March march[kTogether];
    for (std::int64_t k = 0; k < together; ++k) {
      march[k] = begin_march(args, box, rays, first + k);
      march[k].row = count + k * args.max_samples;  // room for all of them; closed up below
    }
    for (bool any = true; any;) {
      any = false;
      for (std::int64_t k = 0; k < together; ++k) {
        if (march[k].active) advance(grid, args, march[k], out);
        any = any || march[k].active;
      }
    }
    for (std::int64_t k = 0; k < together; ++k) {
      *out.first.row(first + k) = static_cast<std::int32_t>(count);
      for (std::int64_t j = 0; j < march[k].written; ++j, ++count) {
        *out.t.row(count) = *out.t.row(march[k].row + j);
        *out.delta.row(count) = *out.delta.row(march[k].row + j);
        *out.ray_of_sample.row(count) = static_cast<std::int32_t>(first + k);
      }
    }
  }
  *out.first.row(rays.near_far.rows) = static_cast<std::int32_t>(count);
  out.count = count;
}

// Cells of one density query, and what it answers.
template <class Real>
struct QueriedCells {
  View<double> position;    // [held, 3]
  View<Real> sigma;         // [held, 1]
  View<std::int64_t> cell;  // [held, 1]
};

template <class Real>
struct UpdateJob {
  const OccupancyUpdateArgs& args;
  const OccupancyState<Real>& state;
  QueriedCells<Real> asked;
  std::int64_t chosen;       // cells of this update
  std::int64_t first_chunk;  // of the round
  std::int64_t rows[kRoundChunks];

  // A point in each cell of a chunk, from the row on where the chunk's cells would stand if all were asked for.
  void draw(std::int64_t slot) {
    const OccupancyGeometry& g = args.geometry;
    const std::int64_t begin = (first_chunk + slot) * kChunkCells;
    const std::int64_t end = std::min(begin + kChunkCells, chosen);
    std::int64_t row = slot * kChunkCells;
    for (std::int64_t j = begin; j < end; ++j) {
      const std::int64_t index = args.part + j * args.parts;
      const OccupancyCell cell = cell_of_index(index, g.n);
      if (covered_by_finer(cell, g.n)) continue;
      const PhiloxBlock random = random_block(args.random, static_cast<std::uint64_t>(index));
      const Vec3d share{random.v[0] * 0x1p-32, random.v[1] * 0x1p-32, random.v[2] * 0x1p-32};
      const Vec3d p = point_in_cell(g, cell, share);
      for (int i = 0; i < 3; ++i) asked.position(row, i) = p[i];
      *asked.cell.row(row) = index;
      ++row;
    }
    rows[slot] = row - slot * kChunkCells;
  }

  // Brings the chunks together and returns the number of cells.
  std::int64_t close_up(std::int64_t chunks) {
    std::int64_t count = 0;
    for (std::int64_t slot = 0; slot < chunks; count += rows[slot++]) {
      const std::int64_t from = slot * kChunkCells;
      if (from == count || rows[slot] == 0) continue;
      const auto n = static_cast<std::size_t>(rows[slot]);
      std::memmove(asked.position.row(count), asked.position.row(from), n * 3 * sizeof(double));
      std::memmove(asked.cell.row(count), asked.cell.row(from), n * sizeof(std::int64_t));
    }
    return count;
  }

  void check(std::int64_t row) const {
    const Real sigma = *asked.sigma.row(row);
    if (!(sigma >= 0) || std::isinf(sigma)) bad_density(asked.position.row(row), static_cast<double>(sigma));
  }

  void absorb(std::int64_t row) const {
    Real& value = state.density[*asked.cell.row(row)];
    value = std::max(value * static_cast<Real>(args.decay), *asked.sigma.row(row));  // an unseen cell holds -1
  }
};

// Densities are asked for outside parallel bodies, so that the framework may spread a query over threads and processes.
template <class Real>
void update(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state, const DensityQuery<Real>& query) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the occupancy grid needs scratch memory");
  const std::int64_t cells = args.geometry.cells();
  const std::int64_t chosen = args.part < cells ? (cells - args.part + args.parts - 1) / args.parts : 0;
  const std::int64_t chunk_count = (chosen + kChunkCells - 1) / kChunkCells;
  const std::int64_t held = std::min(chunk_count, kRoundChunks) * kChunkCells;
  Workspace::Scope scope(*args.workspace);
  UpdateJob<Real> job{args,
                      state,
                      {args.workspace->take<double>(held, 3), args.workspace->take<Real>(held, 1),
                       args.workspace->take<std::int64_t>(held, 1)},
                      chosen,
                      0,
                      {}};
  const auto each = [](std::int64_t rows, const auto& body) {
    parallel_for((rows + kChunkCells - 1) / kChunkCells, [&](std::int64_t chunk) {
      for (std::int64_t r = chunk * kChunkCells; r < std::min(rows, (chunk + 1) * kChunkCells); ++r) body(r);
    });
  };
  for (; job.first_chunk < chunk_count; job.first_chunk += kRoundChunks) {
    const std::int64_t round = std::min(kRoundChunks, chunk_count - job.first_chunk);
    parallel_for(round, [&job](std::int64_t slot) { job.draw(slot); });
    const std::int64_t rows = job.close_up(round);
    if (rows == 0) continue;
    query(job.asked.position.row_range(0, rows), job.asked.sigma.row_range(0, rows));
    each(rows, [&job](std::int64_t row) { job.check(row); });  // a bad density leaves the round's cells alone
    each(rows, [&job](std::int64_t row) { job.absorb(row); });
  }
}

// One slab of blocks: 8 layers of cells of one cascade.
struct SlabTotals {
  double density = 0;
  std::int64_t seen = 0;
  std::int64_t empty = 0;
  std::int64_t counted = 0;
};

template <class Real>
struct PublishJob {
  const OccupancyGeometry& geometry;
  const OccupancyState<Real>& state;
  Real occupied_above;
  SlabTotals* totals;

  std::int64_t first_cell(std::int64_t slab) const { return slab * kBlockCells * geometry.n * geometry.n; }
  std::int64_t slab_cells() const { return static_cast<std::int64_t>(kBlockCells) * geometry.n * geometry.n; }
  bool covered(std::int64_t index) const {
    return geometry.cascades > 1 && covered_by_finer(cell_of_index(index, geometry.n), geometry.n);
  }

  void add_up(std::int64_t slab) const {
    SlabTotals sum;
    const std::int64_t begin = first_cell(slab);
    for (std::int64_t i = begin; i < begin + slab_cells(); ++i) {
      if (!(state.density[i] >= 0)) continue;
      sum.density += static_cast<double>(state.density[i]);
      sum.seen += 1;
    }
    totals[slab] = sum;
  }

  void mark(std::int64_t slab) const {
    SlabTotals& sum = totals[slab];
    const std::int64_t begin = first_cell(slab);
    const std::int64_t side = geometry.blocks_per_side();
    Real* bounds = state.block_bound + slab * side * side;
    std::fill(bounds, bounds + side * side, Real(0));
    for (std::int64_t row = begin; row < begin + slab_cells(); row += geometry.n) {
      Real* row_bounds = bounds + row / geometry.n % geometry.n / kBlockCells * side;
      for (std::int64_t word = row; word < row + geometry.n; word += kBitsPerElement) {
        mark_word(word, row_bounds + (word - row) / kBlockCells, sum);
      }
    }
  }

  // 16 cells of a row; they lie in two blocks.
  void mark_word(std::int64_t word, Real* bounds, SlabTotals& sum) const {
    const Real above =
        geometry.occupied_above(occupied_above, static_cast<std::int32_t>(word / geometry.cells_per_cascade()));
    std::uint32_t bits = 0;
    for (std::int32_t half = 0; half < kBitsPerElement; half += kBlockCells) {
      if (covered(word + half)) continue;  // a finer grid's border is a multiple of 8 cells
      Real bound = bounds[half / kBlockCells];
      for (std::int32_t b = half; b < half + kBlockCells; ++b) {
        const Real density = state.density[word + b];
        const bool occupied = density < 0 || density > above;
        bits |= static_cast<std::uint32_t>(!occupied) << b;
        bound = std::max(bound, occupied ? static_cast<Real>(kUnbounded) : density);
      }
      sum.counted += kBlockCells;
      bounds[half / kBlockCells] = bound;
    }
    sum.empty += std::popcount(bits);
    const auto low = static_cast<std::uint16_t>(bits);
    Real element = 1;
    std::memcpy(&element, &low, sizeof low);
    state.empty_bits[word / kBitsPerElement] = element;
  }
};

template <class Real>
void publish(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state) {
  const OccupancyGeometry& g = args.geometry;
  const std::int64_t slabs = static_cast<std::int64_t>(g.cascades) * g.blocks_per_side();
  Workspace::Scope scope(*args.workspace);
  SlabTotals* totals = args.workspace->take<SlabTotals>(slabs, 1).data;
  PublishJob<Real> job{g, state, Real(0), totals};
  parallel_for(slabs, [&job](std::int64_t slab) { job.add_up(slab); });
  double density = 0;
  std::int64_t seen = 0;
  for (std::int64_t s = 0; s < slabs; ++s) {
    density += totals[s].density;
    seen += totals[s].seen;
  }
  // A grid without any density tells nothing yet: leaving out everything would end all learning.
  if (!(density > 0)) return;
  const double mean = density / static_cast<double>(seen);
  // Half the mean, so that a grid of equal densities is occupied, not empty.
  job.occupied_above = static_cast<Real>(std::min(args.threshold / g.step_m, 0.5 * mean));
  parallel_for(slabs, [&job](std::int64_t slab) { job.mark(slab); });
  std::int64_t occupied = 0, counted = 0;
  for (std::int64_t s = 0; s < slabs; ++s) {
    occupied += totals[s].counted - totals[s].empty;
    counted += totals[s].counted;
  }
  state.summary[0] = static_cast<Real>(mean);
  state.summary[1] = job.occupied_above;
  state.summary[2] = static_cast<Real>(static_cast<double>(occupied) / static_cast<double>(counted));
}

template <class Real>
const OccupancyGridKernels<Real> kTable{sample<Real>, update<Real>, publish<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(occupancy_grid, "sampler 'occupancy_grid'", kTable)

}  // namespace semfield::SEMFIELD_ISA
