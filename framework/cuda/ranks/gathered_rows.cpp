#include "cuda/ranks/gathered_rows.h"

#include <algorithm>
#include <numeric>

#include "cuda/launch.h"

namespace semfield::cuda {

namespace {

// Of a block: the number of its rows and their largest |dy|, x, dy; in numbers, each part on a 256-byte boundary.
struct Layout {
  static constexpr std::size_t kAlign = 64;
  std::size_t x = kAlign, dy, end;
  Layout(std::int64_t rows, std::int32_t dims)
      : dy(x + padded(static_cast<std::size_t>(rows) * 6)),  // float64
        end(dy + padded(static_cast<std::size_t>(rows) * static_cast<std::size_t>(dims))) {}
  static std::size_t padded(std::size_t count) { return (count + kAlign - 1) / kAlign * kAlign; }
};

// `room`: what the block is laid out for.
EncoderRows rows_in(float* block, std::int64_t room, std::int64_t rows, std::int32_t dims) {
  const Layout at(room, dims);
  EncoderRows all;
  all.x = {reinterpret_cast<double*>(block + at.x), rows, 3, 3, Device::cuda};
  all.dy = {block + at.dy, rows, dims, dims, Device::cuda};
  all.count = reinterpret_cast<std::int32_t*>(block);
  all.largest = reinterpret_cast<std::uint32_t*>(block) + 1;
  return all;
}

}  // namespace

GatheredRows::GatheredRows(Size size)
    : size_(std::move(size)),
      most_(*std::max_element(size_.of_rank.begin(), size_.of_rank.end())),
      all_(std::accumulate(size_.of_rank.begin(), size_.of_rank.end(), std::int64_t{0})),
      each_(Layout(most_, size_.dims).end),
      blocks_(size_.of_rank.size() * each_, "rows of an encoder") {
  if (size_.of_rank.size() == 1) return;
  joined_ = Buffer<float>(Layout(all_, size_.dims).end, "rows of an encoder of all ranks");
}

EncoderRows GatheredRows::block(int rank) const {
  EncoderRows rows = rows_in(blocks_.data() + static_cast<std::size_t>(rank) * each_, most_,
                             size_.of_rank[static_cast<std::size_t>(rank)], size_.dims);
  if (size_.in_place) rows.count = nullptr;
  return rows;
}

void GatheredRows::begin() {
  check(cudaMemsetAsync(largest(), 0, sizeof(std::uint32_t), launch().stream), "clearing a largest gradient");
}

EncoderRows GatheredRows::place(std::int64_t first, std::int64_t rows) const {
  EncoderRows own = block(size_.rank);
  own.x = own.x.row_range(first, rows);
  own.dy = own.dy.row_range(first, rows);
  return own;
}

EncoderRows GatheredRows::joined() const {
  if (size_.of_rank.size() == 1) return block(0);
  std::vector<EncoderRows> parts;
  for (int r = 0; r < static_cast<int>(size_.of_rank.size()); ++r) parts.push_back(block(r));
  const EncoderRows all = rows_in(joined_.data(), all_, all_, size_.dims);
  check(cudaMemsetAsync(all.largest, 0, sizeof *all.largest, launch().stream), "clearing a largest gradient");
  join_rows(parts, all);
  return all;
}

}  // namespace semfield::cuda
