// The lanes of a step over several processes: which ones are whose, and what the processes exchange so that every sum
// keeps the order that it has in one process.
#pragma once

#include <cstddef>
#include <functional>
#include <vector>

#include "execution/ranks/ranks.h"
#include "execution/ray_batch.h"
#include "model/param_store.h"

namespace semfield {

/// Rows of an encoder that learns, and the gradient at its outputs.
template <class Real>
struct EncodedRows {
  View<const double> x;        ///< [M, 3]
  View<const Real> d_encoded;  ///< [M, D]
};

/// Rank r has a range of lanes, and those of rank r + 1 follow them. Where some lanes have a tile more than others, the
/// ranges are as long as it takes for ranks to have equally many tiles. Every call is made by all ranks.
template <class Real>
class LaneRanks {
 public:
  LaneRanks(Ranks& ranks, int lanes);

  Ranks& all() const { return *ranks_; }
  /// Lanes of this process.
  int first() const { return first_of(ranks_->rank()); }
  int end() const { return first_of(ranks_->rank() + 1); }

  /// Before a step of so many tiles.
  void share_out(std::int64_t tiles);
  /// In: the losses of the tiles of own lanes. Out: of all.
  void gather_losses(std::vector<StepLosses>& tiles);
  /// Rows of all lanes in lane order, from those of own lanes; valid until the next call.
  EncodedRows<Real> gather_rows(const EncodedRows<Real>& own);
  /// Calls compute(begin, end) for this rank's part of the rows of `column` [N, 1], and brings those of the others.
  void share_rows(View<Real> column, const std::function<void(std::int64_t begin, std::int64_t end)>& compute);
  /// ParamStore::reduce_lanes over the lanes of all: the sum walks from rank to rank, each of which adds its lanes to
  /// it, and the last one's goes to all. A process sends and receives each gradient twice at most, however many there
  /// are.
  void sum_lanes(ParamStore<Real>& store);

 private:
  int first_of(int rank) const { return first_.empty() ? 0 : first_[static_cast<std::size_t>(rank)]; }

  Ranks* ranks_;
  int lanes_;
  std::vector<int> first_;  // [ranks + 1] lanes; none before a step
  std::vector<double> x_;
  std::vector<Real> d_encoded_, sums_;
};

extern template class LaneRanks<float>;
extern template class LaneRanks<double>;

}  // namespace semfield
