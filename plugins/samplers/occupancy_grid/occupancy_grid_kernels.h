// Kernel table of the occupancy-grid sampler.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "core/rng.h"
#include "core/small_math.h"
#include "core/view.h"
#include "core/workspace.h"
#include "plugin/sampler.h"

namespace semfield {

inline constexpr std::int32_t kBlockCells = 8;                     ///< a block is 8 x 8 x 8 cells
inline constexpr double kUnbounded = 1e30;                         ///< bound of a block with an occupied cell
inline constexpr std::int64_t kMostSteps = std::int64_t{1} << 20;  ///< a ray's lattice, however small the step
inline constexpr std::int32_t kBitsPerElement =
    16;  ///< bits ride in the low bytes of 1.0, so every element is a finite number

/// Cascade c is the box of cascade 0 grown 2^c times about its centre; each has n^3 cells. A cell of cascade c lies
/// wholly inside or wholly outside the box of cascade c - 1.
struct OccupancyGeometry {
  std::int32_t n = 0;
  std::int32_t cascades = 1;
  Vec3d lo;      ///< corner of cascade 0
  Vec3d cell_m;  ///< cell sizes of cascade 0
  double step_m = 0;
  double equal_m = 0;  ///< distance from the camera up to which steps are equal; 0 = all of them

  /// Density above which a cell of `cascade` is occupied where one of the finest is above `finest`: steps that grow are
  /// twice as long in the next cascade.
  template <class Real>
  SEMFIELD_HD Real occupied_above(Real finest, std::int32_t cascade) const {
    return equal_m > 0 ? finest / static_cast<Real>(1 << cascade) : finest;
  }
  SEMFIELD_HD std::int64_t cells_per_cascade() const { return static_cast<std::int64_t>(n) * n * n; }
  SEMFIELD_HD std::int64_t cells() const { return cascades * cells_per_cascade(); }
  SEMFIELD_HD std::int32_t blocks_per_side() const { return n / kBlockCells; }
  SEMFIELD_HD std::int64_t blocks() const { return cells() / (kBlockCells * kBlockCells * kBlockCells); }
  /// Box of the largest cascade.
  Box outer() const {
    const double grow = static_cast<double>(1 << (cascades - 1));
    const Vec3d half{0.5 * n * cell_m.x * grow, 0.5 * n * cell_m.y * grow, 0.5 * n * cell_m.z * grow};
    const Vec3d center{lo.x + 0.5 * n * cell_m.x, lo.y + 0.5 * n * cell_m.y, lo.z + 0.5 * n * cell_m.z};
    return {center - half, center + half};
  }
};

struct OccupancyCell {
  std::int32_t cascade = 0;
  std::int32_t at[3] = {0, 0, 0};

  SEMFIELD_HD std::int64_t index(std::int32_t n) const {
    return ((static_cast<std::int64_t>(cascade) * n + at[2]) * n + at[1]) * n + at[0];
  }
  SEMFIELD_HD std::int64_t block(std::int32_t side) const {
    return ((static_cast<std::int64_t>(cascade) * side + at[2] / kBlockCells) * side + at[1] / kBlockCells) * side +
           at[0] / kBlockCells;
  }
};

/// A cell of cascade c > 0 in the middle, which a finer cascade covers: never read.
SEMFIELD_HD inline bool covered_by_finer(const OccupancyCell& cell, std::int32_t n) {
  if (cell.cascade == 0) return false;
  for (int i = 0; i < 3; ++i) {
    if (cell.at[i] < n / 4 || cell.at[i] >= n - n / 4) return false;
  }
  return true;
}

SEMFIELD_HD inline OccupancyCell cell_of_index(std::int64_t index, std::int32_t n) {
  OccupancyCell cell;
  cell.at[0] = static_cast<std::int32_t>(index % n);
  cell.at[1] = static_cast<std::int32_t>(index / n % n);
  cell.at[2] = static_cast<std::int32_t>(index / n / n % n);
  cell.cascade = static_cast<std::int32_t>(index / n / n / n);
  return cell;
}

/// World point at `share` (0..1 an axis) of a cell.
SEMFIELD_HD inline Vec3d point_in_cell(const OccupancyGeometry& g, const OccupancyCell& cell, Vec3d share) {
  const double half = 0.5 * g.n, grow = static_cast<double>(1 << cell.cascade);
  Vec3d p;
  for (int i = 0; i < 3; ++i) p[i] = g.lo[i] + ((cell.at[i] + share[i] - half) * grow + half) * g.cell_m[i];
  return p;
}

/// A ray in cell coordinates of cascade 0: position q0 + t qd.
struct CellRay {
  double q0[3], qd[3], inverse[3];

  SEMFIELD_HD CellRay() = default;
  SEMFIELD_HD CellRay(const OccupancyGeometry& g, const double* origin, const double* direction) {
    for (int i = 0; i < 3; ++i) {
      q0[i] = (origin[i] - g.lo[i]) / g.cell_m[i];
      qd[i] = direction[i] / g.cell_m[i];
      inverse[i] = qd[i] == 0 ? 1e30 : 1.0 / qd[i];  // finite: no 0 * inf where the ray lies in a face
    }
  }

  /// The same ray with t counted from `begin` in units of `unit`.
  SEMFIELD_HD CellRay in_units(double begin, double unit) const {
    CellRay out;
    for (int i = 0; i < 3; ++i) {
      out.q0[i] = q0[i] + begin * qd[i];
      out.qd[i] = qd[i] * unit;
      out.inverse[i] = qd[i] == 0 ? 1e30 : 1.0 / out.qd[i];
    }
    return out;
  }

  SEMFIELD_HD OccupancyCell cell_at(const OccupancyGeometry& g, double t) const {
    const double half = 0.5 * g.n;
    double q[3] = {q0[0] + t * qd[0], q0[1] + t * qd[1], q0[2] + t * qd[2]};
    OccupancyCell cell;
    if (g.cascades > 1) {
      double reach = 0;
      for (double v : q) reach = std::fmax(reach, std::fabs(v - half));
      double size = half;
      while (reach >= size && cell.cascade + 1 < g.cascades) {
        cell.cascade += 1;
        size *= 2;
      }
      const double shrink = half / size;
      for (double& v : q) v = (v - half) * shrink + half;
    }
    for (int i = 0; i < 3; ++i) {
      const auto at = static_cast<std::int32_t>(q[i]);  // q >= 0 up to rounding, which the clamp takes up
      cell.at[i] = at < 0 ? 0 : at >= g.n ? g.n - 1 : at;
    }
    return cell;
  }

  /// Distance where the ray leaves the aligned cube of `size` cells (1 or kBlockCells) around `cell`.
  SEMFIELD_HD double exit(const OccupancyGeometry& g, const OccupancyCell& cell, std::int32_t size) const {
    const double half = 0.5 * g.n, grow = static_cast<double>(1 << cell.cascade);
    double t = 1e300;
    for (int i = 0; i < 3; ++i) {
      const std::int32_t border = (cell.at[i] & ~(size - 1)) + (qd[i] < 0 ? 0 : size);
      const double q = (border - half) * grow + half;
      const double reach = (q - q0[i]) * inverse[i];
      t = reach < t ? reach : t;
    }
    return t;
  }
};

/// Distances along a ray whose steps grow: unrolled, all steps are equal. Up to `equal_m` a distance is itself; from
/// there on each doubling of it is as long as the first `equal_m`, so that steps double when the distance does. Powers
/// of two only: the same bits on every device.
struct UnrolledDistance {
  double equal_m = 0;

  SEMFIELD_HD double of(double t) const {
    const int octave = t < equal_m ? 0 : std::ilogb(t / equal_m);
    return std::ldexp(t, -octave) + octave * equal_m;
  }
  SEMFIELD_HD double back(double unrolled) const {
    const double turns = std::floor(unrolled / equal_m) - 1;
    const int octave = turns > 0 ? static_cast<int>(turns) : 0;
    return std::ldexp(unrolled - octave * equal_m, octave);
  }
};

/// Sample i of a ray of `count` intervals, which are equal when they are unrolled, stands at begin + (i + u) * step.
struct StepLattice {
  double near_m = 0, step_m = 0, u = 0.5;
  std::int64_t count = 0;
  UnrolledDistance distance;  ///< equal_m 0: nothing is unrolled
  double begin_m = 0;         ///< near, unrolled

  SEMFIELD_HD bool grows() const { return distance.equal_m > 0; }
  SEMFIELD_HD double at(std::int64_t i) const {
    const double steps = static_cast<double>(i) + u;
    return grows() ? distance.back(begin_m + steps * step_m) : near_m + steps * step_m;
  }
  /// Length of the intervals [i, to).
  SEMFIELD_HD double length_m(std::int64_t i, std::int64_t to) const {
    if (!grows()) return static_cast<double>(to - i) * step_m;
    return distance.back(begin_m + static_cast<double>(to) * step_m) -
           distance.back(begin_m + static_cast<double>(i) * step_m);
  }
  /// Where a distance from the origin lies, in steps from sample 0.
  SEMFIELD_HD double place_of(double t) const { return (distance.of(t) - begin_m) / step_m - u; }
  /// First sample after i whose index is not below `place`, up to rounding on the near side: it may be one too early,
  /// never too late.
  SEMFIELD_HD std::int64_t next(std::int64_t i, double place) const {
    const double steps = place - 1e-9;
    if (steps >= static_cast<double>(count)) return count;
    const auto to = static_cast<std::int64_t>(std::floor(steps)) + 1;
    return to > i ? to : i + 1;
  }
};

/// The part of a ray inside the grid's box, cut into steps.
struct MarchedRay {
  CellRay ray, steps;  ///< in metres from the origin; in steps from the lattice's sample 0, where they are equal
  StepLattice lattice;
  double span_m = 0, far_m = 0;  ///< span: unrolled

  /// False when nothing of [near, far] lies in the box.
  SEMFIELD_HD bool begin(const OccupancyGeometry& g, const Box& box, const double* origin, const double* direction,
                         double near_m, double far_limit_m) {
    double enter = 0, leave = 0;
    if (!intersect(box, {origin[0], origin[1], origin[2]}, {direction[0], direction[1], direction[2]}, enter, leave))
      return false;
    lattice.near_m = std::max(near_m, enter);
    far_m = std::min(far_limit_m, leave);
    lattice.distance.equal_m = g.equal_m;
    lattice.begin_m = lattice.grows() ? lattice.distance.of(lattice.near_m) : lattice.near_m;
    span_m = (lattice.grows() ? lattice.distance.of(far_m) : far_m) - lattice.begin_m;
    if (!(span_m > 0)) return false;
    ray = CellRay(g, origin, direction);
    const double count = std::ceil(span_m / g.step_m);
    lattice.count = count < static_cast<double>(kMostSteps)
                        ? std::max<std::int64_t>(1, static_cast<std::int64_t>(count))
                        : kMostSteps;
    return true;
  }
  /// After `lattice.count` or `lattice.u` changed.
  SEMFIELD_HD void lay_out() {
    lattice.step_m = span_m / static_cast<double>(lattice.count);
    if (lattice.grows()) return;
    far_m = lattice.near_m + lattice.step_m * static_cast<double>(lattice.count);
    steps = ray.in_units(lattice.at(0), lattice.step_m);
  }
  /// Metres between the first and the last border of the lattice.
  SEMFIELD_HD double length_m() const { return lattice.grows() ? far_m - lattice.near_m : span_m; }
  SEMFIELD_HD OccupancyCell cell_at(const OccupancyGeometry& g, std::int64_t i) const {
    return lattice.grows() ? ray.cell_at(g, lattice.at(i)) : steps.cell_at(g, static_cast<double>(i));
  }
  /// First sample that is not surely in the aligned cube of `size` cells around sample i's `cell`.
  SEMFIELD_HD std::int64_t behind(const OccupancyGeometry& g, const OccupancyCell& cell, std::int32_t size,
                                  std::int64_t i) const {
    const double exit = lattice.grows() ? lattice.place_of(ray.exit(g, cell, size)) : steps.exit(g, cell, size);
    return lattice.next(i, exit);
  }
};

/// What may still be passed over on a ray. Half of the budget goes evenly along the ray (densities up to budget / (2
/// span) always pass), half to whoever comes first.
struct SkipBudget {
  double even_density = 0;
  double left = 0;

  SEMFIELD_HD SkipBudget(double budget, double span_m) : even_density(0.5 * budget / span_m), left(0.5 * budget) {}
  SEMFIELD_HD bool affords(double bound, double length_m) {
    if (bound >= kUnbounded) return false;
    if (bound <= even_density) return true;
    if (bound * length_m > left) return false;
    left -= bound * length_m;
    return true;
  }
};

/// Empty bit of a cell: bit (i mod 16) of the low 16 bits of element i / 16; 1 = empty.
template <class Real>
SEMFIELD_HD inline bool is_empty_cell(const unsigned char* bits, std::int64_t i) {
  const unsigned char byte = bits[(i / kBitsPerElement) * static_cast<std::int64_t>(sizeof(Real)) + ((i >> 3) & 1)];
  return ((byte >> (i & 7)) & 1) != 0;
}

class KernelTables;

/// The state tensors; strides are 1.
template <class Real>
struct OccupancyState {
  Real* density = nullptr;      ///< [cells]
  Real* empty_bits = nullptr;   ///< [cells / 16]
  Real* block_bound = nullptr;  ///< [blocks] largest density of the block, kUnbounded with an occupied cell in it
  Real* summary = nullptr;      ///< [3] mean density, density above which a cell is occupied, share of occupied cells
};

struct OccupancySampleArgs {
  OccupancyGeometry geometry;
  std::int64_t max_samples = 0;
  bool keep_last = false;  ///< the last step of a ray is never skipped
  double skip_budget = 0;  ///< infinite: plain threshold
  bool jitter = false;
  RandomAddress random;
  std::int64_t first_ray = 0;
  Workspace* workspace = nullptr;  ///< read on devices other than the CPU
};

struct OccupancyUpdateArgs {
  OccupancyGeometry geometry;
  std::int64_t parts = 1, part = 0;  ///< cells with index mod parts == part are drawn
  double decay = 1;                  ///< of a drawn cell's old value
  double threshold = 0.01;           ///< optical depth of a step
  RandomAddress random;
  Workspace* workspace = nullptr;
};

template <class Real>
struct OccupancyGridKernels {
  void (*sample)(const OccupancySampleArgs& args, const OccupancyState<Real>& state, const Rays<Real>& rays,
                 Samples<Real>& out) = nullptr;
  /// Draws a point in each chosen cell and keeps the larger of its density and the decayed old value.
  void (*update)(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state,
                 const DensityQuery<Real>& query) = nullptr;
  /// Makes bits, block bounds and summary from the densities.
  void (*publish)(const OccupancyUpdateArgs& args, const OccupancyState<Real>& state) = nullptr;
};

void occupancy_grid_kernels(KernelTables& tables);

/// Throws Error(failure) that names the place [3] and the density.
[[noreturn]] void bad_density(const double* position, double sigma);

}  // namespace semfield
