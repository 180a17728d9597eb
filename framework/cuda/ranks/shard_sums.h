// What shards of a step leave, brought together on the device: gradients added as a tree, encoder rows joined.
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "core/view.h"
#include "cuda/ranks/exchange.h"

namespace semfield::cuda {

/// A tensor's gradient: numbers [at, at + count) of every shard's block, a multiple of 4, and where their sum goes.
/// Blocks and `to` start on 16 bytes.
struct ShardTensor {
  std::int64_t at = 0, count = 0;
  float* to = nullptr;
};
/// Device memory, `longest`: the largest count.
struct ShardTensors {
  const ShardTensor* all = nullptr;
  int count = 0;
  std::int64_t longest = 0;
};
/// to += ((0 + 1) + (2 + 3)) + ((4 + 5) + (6 + 7)) for every tensor; block[s]: of shard s.
void add_shards(const ShardTensors& tensors, const std::array<const float*, kShards>& block);

/// Rows of an encoder with the gradient at its outputs, contiguous; the first *count are in use, and *largest is the
/// largest |dy| among them (kernels/kernels.h). Device memory.
struct EncoderRows {
  View<double> x;                    ///< [N, 3]
  View<float> dy;                    ///< [N, D]
  std::int32_t* count = nullptr;     ///< null: all rows are in use
  std::uint32_t* largest = nullptr;  ///< null: not known
};
/// to = the rows in use of all parts, in order, their number, and the largest of the parts that know theirs. At most
/// kShards parts.
void join_rows(std::span<const EncoderRows> parts, const EncoderRows& to);

}  // namespace semfield::cuda
