// Rows of a learned encoder with their gradients, of all shards of a step: gathered from every rank, scattered at once.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "cuda/memory.h"
#include "cuda/ranks/shard_sums.h"

namespace semfield::cuda {

/// All ranks scatter the same rows in the same order, so the bits of a table do not depend on who walked which shard.
/// Where hardly a row of a shard is unused (its gradient is 0), shards write into their place at once; else the rows in
/// use are collected.
class GatheredRows {
 public:
  struct Size {
    std::int32_t dims = 0;              ///< of the encoder's output
    std::vector<std::int64_t> of_rank;  ///< most rows of each rank
    int rank = 0;
    bool in_place = false;
    bool operator==(const Size&) const = default;
  };
  explicit GatheredRows(Size size);

  const Size& size() const { return size_; }
  /// Before the shards of a step.
  void begin();
  /// This rank's rows [first, first + rows), in place.
  EncoderRows place(std::int64_t first, std::int64_t rows) const;
  /// Bits of this rank's largest |dy|.
  std::uint32_t* largest() const { return block(size_.rank).largest; }
  /// Not in place: this rank's rows, from its shards in order.
  void collect(std::span<const EncoderRows> of_shards) const { join_rows(of_shards, block(size_.rank)); }
  /// [ranks, each]: rank r writes row r, and reads all once they have met.
  float* blocks() const { return blocks_.data(); }
  std::size_t each() const { return each_; }
  /// Those of all ranks, once they have met.
  EncoderRows joined() const;

 private:
  EncoderRows block(int rank) const;
  Size size_;
  std::int64_t most_ = 0, all_ = 0;  // rows of a rank, of all
  std::size_t each_ = 0;             // numbers of a block
  Buffer<float> blocks_, joined_;
};

}  // namespace semfield::cuda
