#include "execution/lane_ranks.h"

#include <algorithm>
#include <cstdlib>
#include <numeric>
#include <type_traits>

namespace semfield {

namespace {

// A message carries this many pieces of gradients, so that a rank adds its lanes to one while the next rank has those
// before it.
constexpr std::int64_t kPiecesTogether = 64;

template <class T>
std::span<std::byte> bytes_of(std::vector<T>& values, std::size_t count) {
  return std::as_writable_bytes(std::span(values.data(), count));
}

}  // namespace

template <class Real>
LaneRanks<Real>::LaneRanks(Ranks& ranks, int lanes) : ranks_(&ranks), lanes_(lanes) {}

// Rank r begins with the lane before which there are as near to r / size of all tiles as can be.
template <class Real>
void LaneRanks<Real>::share_out(std::int64_t tiles) {
  const std::int64_t each = tiles / lanes_, more = tiles % lanes_;
  first_.assign(static_cast<std::size_t>(ranks_->size()) + 1, lanes_);
  int lane = 0;
  for (int rank = 0; rank < ranks_->size(); ++rank) {
    const auto off = [&](std::int64_t l) {  // tiles too many or too few, times the number of ranks
      return std::abs((l * each + std::min(l, more)) * ranks_->size() - tiles * rank);
    };
    while (lane < lanes_ && off(lane + 1) < off(lane)) ++lane;
    first_[static_cast<std::size_t>(rank)] = lane;
  }
}

template <class Real>
void LaneRanks<Real>::gather_losses(std::vector<StepLosses>& tiles) {
  static_assert(std::is_trivially_copyable_v<StepLosses>);
  const auto count = std::ssize(tiles);
  // Of a rank its lanes in order, of a lane its tiles.
  const auto each_of = [&](int rank, const auto& body) {
    for (int lane = first_of(rank); lane < first_of(rank + 1); ++lane) {
      for (std::int64_t tile = lane; tile < count; tile += lanes_) body(tiles[static_cast<std::size_t>(tile)]);
    }
  };
  std::vector<StepLosses> own, all(tiles.size());
  std::vector<std::size_t> bytes(static_cast<std::size_t>(ranks_->size()));
  each_of(ranks_->rank(), [&](const StepLosses& losses) { own.push_back(losses); });
  for (int r = 0; r < ranks_->size(); ++r) {
    std::size_t tiles_of_rank = 0;
    each_of(r, [&](const StepLosses&) { ++tiles_of_rank; });
    bytes[static_cast<std::size_t>(r)] = tiles_of_rank * sizeof(StepLosses);
  }
  ranks_->all_gather(std::as_bytes(std::span(own)), bytes_of(all, all.size()), bytes);
  std::size_t next = 0;
  for (int r = 0; r < ranks_->size(); ++r) each_of(r, [&](StepLosses& losses) { losses = all[next++]; });
}

template <class Real>
EncodedRows<Real> LaneRanks<Real>::gather_rows(const EncodedRows<Real>& own) {
  const std::vector<std::int64_t> rows = all_of(*ranks_, own.x.rows);
  const std::int64_t total = std::accumulate(rows.begin(), rows.end(), std::int64_t{0});
  const std::int32_t dims = own.d_encoded.cols;
  const auto gather = [&](const auto* from, auto& to, std::int64_t cols) {
    const std::size_t row_bytes = static_cast<std::size_t>(cols) * sizeof *from;
    std::vector<std::size_t> bytes;
    for (const std::int64_t count : rows) bytes.push_back(static_cast<std::size_t>(count) * row_bytes);
    const auto size = static_cast<std::size_t>(total * cols);
    if (to.size() < size) to.resize(size);
    const std::span<const std::byte> mine(reinterpret_cast<const std::byte*>(from),
                                          static_cast<std::size_t>(own.x.rows) * row_bytes);
    ranks_->all_gather(mine, bytes_of(to, size), bytes);
  };
  gather(own.x.data, x_, 3);
  gather(own.d_encoded.data, d_encoded_, dims);
  return {{x_.data(), total, 3}, {d_encoded_.data(), total, dims}};
}

template <class Real>
void LaneRanks<Real>::share_rows(View<Real> column, const std::function<void(std::int64_t, std::int64_t)>& compute) {
  const auto part = [&](int rank) { return part_of(column.rows, rank, ranks_->size()); };
  const auto [begin, end] = part(ranks_->rank());
  agree(*ranks_, [&, first = begin, last = end] { compute(first, last); });
  std::vector<Real> own, all(static_cast<std::size_t>(column.rows));
  for (std::int64_t r = begin; r < end; ++r) own.push_back(*column.row(r));
  std::vector<std::size_t> bytes;
  for (int r = 0; r < ranks_->size(); ++r)
    bytes.push_back(static_cast<std::size_t>(part(r).second - part(r).first) * sizeof(Real));
  ranks_->all_gather(std::as_bytes(std::span(own)), bytes_of(all, all.size()), bytes);
  for (std::int64_t r = 0; r < column.rows; ++r) *column.row(r) = all[static_cast<std::size_t>(r)];
}

template <class Real>
void LaneRanks<Real>::sum_lanes(ParamStore<Real>& store) {
  const std::int64_t pieces = store.lane_pieces();
  const int rank = ranks_->rank(), last = ranks_->size() - 1;
  // Between the gradients, which lie apart, and a message; `copy` gets the gradient's elements and their place there.
  const auto each = [&](std::int64_t begin, std::int64_t count, const auto& copy) {
    std::size_t at = 0;
    for (std::int64_t piece = begin; piece < begin + count; ++piece) {
      const View<Real> part = store.lane_piece(piece);
      const auto size = static_cast<std::size_t>(part.cols);
      if (sums_.size() < at + size) sums_.resize(at + size);
      copy(part.data, sums_.data() + at, size);
      at += size;
    }
    return at;
  };
  const auto size = [](Real*, Real*, std::size_t) {};
  const auto pack = [](Real* grad, Real* place, std::size_t n) { std::copy_n(grad, n, place); };
  const auto unpack = [](Real* grad, Real* place, std::size_t n) { std::copy_n(place, n, grad); };
  for (std::int64_t begin = 0; begin < pieces; begin += kPiecesTogether) {
    const std::int64_t count = std::min(kPiecesTogether, pieces - begin);
    if (rank > 0) {
      ranks_->receive(rank - 1, bytes_of(sums_, each(begin, count, size)));
      each(begin, count, unpack);
    }
    store.reduce_lanes(begin, count, first(), end());
    if (rank < last) ranks_->send(rank + 1, bytes_of(sums_, each(begin, count, pack)));
  }
  const std::size_t all = each(0, pieces, pack);
  ranks_->broadcast(bytes_of(sums_, all), last);
  if (rank < last) each(0, pieces, unpack);
}

template class LaneRanks<float>;
template class LaneRanks<double>;

}  // namespace semfield
