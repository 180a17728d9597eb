// Some of the pixels of many frames by their rank: counts of blocks, in place of a list that outweighs the pixels.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "compute/parallel.h"

namespace semfield {

/// A training pixel: frame by its place in the training split, row * width + column.
struct TrainPixel {
  std::int32_t frame = 0;
  std::int32_t index = 0;
};

struct PixelRanks {
  static constexpr std::int64_t kBlock = 64;  ///< pixels; a block lies in one frame
  std::vector<std::size_t> block_offsets;     ///< first block of each frame, and the total
  std::vector<std::uint32_t> before;          ///< [blocks + 1] chosen pixels before each block; the last counts all

  std::uint32_t count() const { return before.empty() ? 0 : before.back(); }
  /// Of a frame: the rank of its first pixel that is chosen, and of the next frame's.
  std::uint32_t first_of(std::size_t frame) const { return before[block_offsets[frame]]; }

  /// `pixels` of each frame, 0 for one that has none; `chosen(TrainPixel)` is asked once for every pixel, from any
  /// thread.
  template <class Chosen>
  void index(const std::vector<std::int64_t>& pixels, const Chosen& chosen) {
    block_offsets.assign(1, 0);
    for (const std::int64_t n : pixels)
      block_offsets.push_back(block_offsets.back() + static_cast<std::size_t>((n + kBlock - 1) / kBlock));
    before.assign(block_offsets.back() + 1, 0);
    parallel_for(std::ssize(pixels), [&](std::int64_t frame) {
      const auto f = static_cast<std::size_t>(frame);
      for (std::size_t b = block_offsets[f]; b < block_offsets[f + 1]; ++b) {
        const std::int64_t begin = static_cast<std::int64_t>(b - block_offsets[f]) * kBlock;
        for (std::int64_t p = begin; p < std::min(begin + kBlock, pixels[f]); ++p)
          before[b + 1] += chosen(TrainPixel{static_cast<std::int32_t>(f), static_cast<std::int32_t>(p)}) ? 1 : 0;
      }
    });
    for (std::size_t b = 1; b < before.size(); ++b) before[b] += before[b - 1];
  }

  /// The pixel of a rank below count(); `chosen` as it was indexed.
  template <class Chosen>
  TrainPixel at(std::uint32_t rank, const Chosen& chosen) const {
    const auto after = std::upper_bound(before.begin(), before.end(), rank);
    const auto block = static_cast<std::size_t>(after - before.begin()) - 1;
    const auto next_frame = std::upper_bound(block_offsets.begin(), block_offsets.end(), block);
    const auto frame = static_cast<std::size_t>(next_frame - block_offsets.begin()) - 1;
    TrainPixel pixel{static_cast<std::int32_t>(frame),
                     static_cast<std::int32_t>(static_cast<std::int64_t>(block - block_offsets[frame]) * kBlock)};
    for (std::uint32_t left = rank - before[block];; ++pixel.index) {
      if (!chosen(pixel)) continue;
      if (left-- == 0) return pixel;
    }
  }
};

}  // namespace semfield
