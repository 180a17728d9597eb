// CPU kernels of the hash grid: 16 samples at a time, a level for all rows of a call, so that its table is in cache.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/workspace.h"
#include "encoders/hash_grid/hash_grid_kernels.h"
#include "encoders/hash_grid/hash_grid_lanes.h"
#include "plugin/kernels.h"

namespace semfield::SEMFIELD_ISA {

void hash_grid_cpu_kernels(KernelTables& tables);

namespace {

constexpr std::int64_t kBlockRows = 49152;  // a level is finished for so many rows before its table is left
constexpr std::int64_t kPieceRows = 4096;   // of a level's forward that a thread takes at a time; whole groups
constexpr std::int64_t kCopyRows = 1024;
constexpr std::int64_t kInputTaskRows = 256;

/// Calls f with the level's compile-time choices: (features, dense, interpolation).
template <std::int32_t kFeatures, class F>
void with_level_kind(const HashGridLevel& level, Interpolation interpolation, const F& f) {
  if (interpolation == Interpolation::smoothstep) {
    if (level.dense) {
      f.template operator()<kFeatures, true, Interpolation::smoothstep>();
    } else {
      f.template operator()<kFeatures, false, Interpolation::smoothstep>();
    }
  } else {
    if (level.dense) {
      f.template operator()<kFeatures, true, Interpolation::linear>();
    } else {
      f.template operator()<kFeatures, false, Interpolation::linear>();
    }
  }
}
template <class F>
void with_features(std::int32_t features, const F& f) {
  switch (features) {
    case 1:
      return f.template operator()<1>();
    case 2:
      return f.template operator()<2>();
    case 4:
      return f.template operator()<4>();
    default:
      return f.template operator()<8>();
  }
}
template <class F>
void with_kind(const HashGridLevel& level, std::int32_t features, Interpolation interpolation, const F& f) {
  with_features(features, [&]<std::int32_t kFeatures>() { with_level_kind<kFeatures>(level, interpolation, f); });
}

void keep_least(std::atomic<std::int64_t>& least, std::int64_t value) {
  std::int64_t known = least;
  while (value < known && !least.compare_exchange_weak(known, value)) {
  }
}

std::int64_t first_bad_row(View<const double> x) {
  for (std::int64_t r = 0; r < x.rows; ++r) {
    if (!std::isfinite(x(r, 0)) || !std::isfinite(x(r, 1)) || !std::isfinite(x(r, 2))) return r;
  }
  return -1;
}

/// kLanes rows of x from row r on, contiguous; rows behind the last one are 0.
class RowReader {
 public:
  explicit RowReader(View<const double> x) : x_(x) {}
  const double* at(std::int64_t r) {
    if (x_.row_stride == 3 && r + kLanes <= x_.rows) return x_.row(r);
    for (std::int64_t i = 0; i < kLanes; ++i) {
      for (int d = 0; d < 3; ++d) copy_[3 * i + d] = r + i < x_.rows ? x_(r + i, d) : 0.0;
    }
    return copy_;
  }

 private:
  View<const double> x_;
  alignas(64) double copy_[3 * kLanes];
};

/// Reads a table in order, a load a cache line, when so many rows are to come that most of its lines will be used: the
/// hardware fetches a stream several times as fast as single lines.
template <class Real>
void warm(const Real* table, std::int64_t values, std::int64_t rows) {
  constexpr std::int64_t kLine = 64 / static_cast<std::int64_t>(sizeof(Real));
  if (4 * rows < values / kLine) return;
  for (std::int64_t i = 0; i < values; i += kLine) {
    asm volatile("" : : "r"(static_cast<const volatile Real*>(table)[i]));
  }
}

/// Calls f(edges, first row) for each group of rows of x. Edges are found one group ahead: by the time they are read
/// they have left the store buffer.
template <class Real, bool kDense, Interpolation kI, class F>
void for_groups(const HashGridLevel& level, View<const double> x, const F& f) {
  Edges<Real> edges[2];
  RowReader rows(x);
  find_edges<Real, kDense, kI>(level, rows.at(0), edges[0]);
  int now = 0;
  for (std::int64_t r = 0; r < x.rows; r += kLanes, now ^= 1) {
    const std::int64_t next = r + kLanes;
    if (next < x.rows) find_edges<Real, kDense, kI>(level, rows.at(next), edges[now ^ 1]);
    f(edges[now], r);
  }
}

/// Values of a block of rows, level by level: level l's are [rows, F] from value(l) on. Kernels read and write them as
/// a stream, where a level's share of a row of y would cost a cache line a row.
template <class Real>
struct Columns {
  Real* data;
  std::int64_t stride;  // elements between levels

  /// Whole groups of rows, and a little more: columns a power of two apart would fall on the same sets of the cache.
  Columns(Workspace& workspace, const HashGridShape& shape, std::int64_t all_rows)
      : stride(stride_of(shape, all_rows)) {
    data = workspace.take<Real>(shape.levels, static_cast<std::int32_t>(stride)).data;
  }
  static std::int64_t stride_of(const HashGridShape& shape, std::int64_t all_rows) {
    return ((std::min(kBlockRows, all_rows) + kLanes - 1) / kLanes * kLanes + 40) * shape.features;
  }
  Real* value(std::int32_t level) const { return data + level * stride; }
};

template <class Real>
std::size_t scratch_bytes(const HashGridShape& shape, std::int64_t rows) {
  ScratchSum sum;
  sum.take<Real>(shape.levels, Columns<Real>::stride_of(shape, rows));
  return sum.bytes();
}

/// Between columns and rows of y, over every thread.
template <class Real, bool kToRows, class Row>
void transpose(const HashGridShape& shape, const Columns<Real>& columns, View<Row> y) {
  struct Call {
    const HashGridShape& shape;
    const Columns<Real>& columns;
    View<Row> y;
  };
  const Call call{shape, columns, y};
  parallel_for((y.rows + kCopyRows - 1) / kCopyRows, [&call](std::int64_t task) {
    with_features(call.shape.features, [&]<std::int32_t kF>() {
      const std::int64_t end = std::min(call.y.rows, (task + 1) * kCopyRows);
      for (std::int64_t r = task * kCopyRows; r < end; ++r) {
        for (std::int32_t l = 0; l < call.shape.levels; ++l) {
          Real* const column = call.columns.value(l) + r * kF;
          if constexpr (kToRows) {
            std::memcpy(call.y.row(r) + l * kF, column, sizeof(Real) * kF);
          } else {
            std::memcpy(column, call.y.row(r) + l * kF, sizeof(Real) * kF);
          }
        }
      }
    });
  });
}

/// f(level, piece, whether the thread begins with the level) for every piece of every level. Threads begin apart from
/// each other, the finest level first, and stay with a level, whose table they then have in cache, while it has pieces.
template <class F>
void for_level_pieces(std::int32_t levels, std::int64_t pieces, const F& f) {
  if (pieces == 1)
    return parallel_for(levels, [&](std::int64_t i) { f(static_cast<std::int32_t>(levels - 1 - i), 0, true); });
  struct alignas(64) Next {
    std::atomic<std::int64_t> piece{0};
  } next[kHashGridMaxLevels];
  const std::int64_t workers = std::min<std::int64_t>(thread_count(), levels * pieces);
  parallel_for(workers, [&](std::int64_t worker) {
    const std::int64_t first = worker * levels / workers;
    for (std::int64_t k = 0; k < levels; ++k) {
      const auto level = static_cast<std::int32_t>(levels - 1 - (first + k) % levels);
      std::atomic<std::int64_t>& piece = next[level].piece;
      bool begins = true;
      for (std::int64_t p = piece++; p < pieces; p = piece++, begins = false) f(level, p, begins);
    }
  });
}

/// One task a level. Finest first: the dear ones start early and the cheap coarse ones fill the gaps.
template <class F>
void for_levels(std::int32_t levels, const F& f) {
  parallel_for(levels, [&f, levels](std::int64_t i) { f(static_cast<std::int32_t>(levels - 1 - i)); });
}

template <class Real>
std::int64_t forward(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<Real> y,
                     Workspace& workspace) {
  const Workspace::Scope scope(workspace);
  const Columns<Real> columns(workspace, shape, x.rows);
  constexpr std::int64_t kNone = std::numeric_limits<std::int64_t>::max();
  std::atomic<std::int64_t> bad{kNone};
  for (std::int64_t begin = 0; begin < x.rows && bad == kNone; begin += kBlockRows) {
    const std::int64_t rows = std::min(kBlockRows, x.rows - begin);
    for_level_pieces(
        shape.levels, (rows + kPieceRows - 1) / kPieceRows, [&](std::int32_t l, std::int64_t p, bool begins) {
          const std::int64_t at = p * kPieceRows;
          const View<const double> piece = x.row_range(begin + at, std::min(kPieceRows, rows - at));
          if (l == 0) {
            if (const std::int64_t row = first_bad_row(piece); row >= 0) keep_least(bad, begin + at + row);
          }
          const HashGridLevel& level = shape.level[l];
          const Real* const table = tables[l].data;
          Real* const column = columns.value(l) + at * shape.features;
          if (begins) warm(table, level.entries * shape.features, rows);
          with_kind(level, shape.features, shape.interpolation, [&]<std::int32_t kF, bool kDense, Interpolation kI>() {
            for_groups<Real, kDense, kI>(level, piece, [&](const Edges<Real>& edges, std::int64_t r) {
              interpolate<Real, kF, kDense>(edges, table, column + r * kF);
            });
          });
        });
    transpose<Real, true>(shape, columns, y.row_range(begin, rows));
  }
  return bad == kNone ? -1 : bad.load();
}

/// d table[v] += w_v dy, a level in one thread, rows in order.
template <class Real>
void backward_tables(const HashGridShape& shape, const View<Real>* grads, View<const double> x, View<const Real> dy,
                     Workspace& workspace) {
  const Workspace::Scope scope(workspace);
  const Columns<Real> columns(workspace, shape, x.rows);
  for (std::int64_t begin = 0; begin < x.rows; begin += kBlockRows) {
    const std::int64_t rows = std::min(kBlockRows, x.rows - begin);
    const View<const double> block = x.row_range(begin, rows);
    transpose<Real, false>(shape, columns, dy.row_range(begin, rows));
    for_levels(shape.levels, [&](std::int32_t l) {
      const HashGridLevel& level = shape.level[l];
      Real* const grad = grads[l].data;
      warm(grad, level.entries * shape.features, rows);
      with_kind(level, shape.features, shape.interpolation, [&]<std::int32_t kF, bool kDense, Interpolation kI>() {
        for_groups<Real, kDense, kI>(level, block, [&](const Edges<Real>& edges, std::int64_t r) {
          scatter<Real, kF, kDense>(edges, grad, std::min<std::int64_t>(kLanes, rows - r), columns.value(l) + r * kF);
        });
      });
    });
  }
}

/// dx of at most kInputTaskRows rows, a level for all of them at a time; 0 along an axis on which a row was clamped.
template <class Real>
void input_gradient(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<const Real> dy,
                    View<Real> dx) {
  double slopes[kInputTaskRows / kLanes][3][kLanes] = {};
  RowReader rows(x);
  for (std::int32_t l = 0; l < shape.levels; ++l) {
    const HashGridLevel& level = shape.level[l];
    with_kind(level, shape.features, shape.interpolation, [&]<std::int32_t kF, bool kDense, Interpolation kI>() {
      for (std::int64_t r = 0; r < x.rows; r += kLanes) {
        alignas(64) Real gradient[kF][kLanes];
        for (std::int64_t i = 0; i < kLanes; ++i) {
          for (std::int32_t f = 0; f < kF; ++f) gradient[f][i] = r + i < x.rows ? dy(r + i, l * kF + f) : Real(0);
        }
        add_slopes<Real, kF, kDense, kI>(level, tables[l].data, rows.at(r), gradient, slopes[r / kLanes]);
      }
    });
  }
  for (std::int64_t r = 0; r < x.rows; ++r) {
    for (std::int32_t d = 0; d < 3; ++d) {
      const bool inside = x(r, d) >= 0 && x(r, d) <= 1;
      dx(r, d) = inside ? static_cast<Real>(slopes[r / kLanes][d][r % kLanes]) : Real(0);
    }
  }
}

template <class Real>
void backward_input(const HashGridShape& shape, const View<Real>* tables, View<const double> x, View<const Real> dy,
                    View<Real> dx) {
  struct Call {
    const HashGridShape& shape;
    const View<Real>* tables;
    View<const double> x;
    View<const Real> dy;
    View<Real> dx;
  };
  const Call call{shape, tables, x, dy, dx};
  parallel_for((x.rows + kInputTaskRows - 1) / kInputTaskRows, [&call](std::int64_t task) {
    const std::int64_t begin = task * kInputTaskRows, rows = std::min(kInputTaskRows, call.x.rows - begin);
    input_gradient<Real>(call.shape, call.tables, call.x.row_range(begin, rows), call.dy.row_range(begin, rows),
                         call.dx.row_range(begin, rows));
  });
}

template <class Real>
const HashGridKernels<Real> kTable{forward<Real>, backward_tables<Real>, backward_input<Real>, scratch_bytes<Real>};

}  // namespace

void hash_grid_cpu_kernels(KernelTables& tables) {
  tables.add(Device::cpu, "encoder 'hash_grid'", &kTable<float>);
  tables.add(Device::cpu, "encoder 'hash_grid'", &kTable<double>);
}

}  // namespace semfield::SEMFIELD_ISA
