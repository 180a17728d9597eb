// The kernels of layers in bf16, compiled once per instruction set (compute/isa.h).
#pragma once

#include "compute/layers.h"

namespace semfield {

struct Bf16Kernels {
  std::int64_t (*packed_words)(std::int64_t in, std::int64_t out);
  void (*pack_weight)(View<const float> weight, bool transposed, std::uint32_t* words);
  void (*layer)(const Layer<Bf16>& layer);
  void (*weight_gradient)(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight);
  void (*add_rows)(View<const Bf16> rows, View<float> sum);  // sum [1, cols] += every row, in order
  void (*round_rows)(View<const float> from, View<Bf16> to, View<const Bf16> mask);
  void (*widen_rows)(View<const Bf16> from, View<float> to);
  void (*weighted_sum)(View<const float> weight, View<const Bf16> rows, View<float> sum);
  void (*weighted_sum_backward)(View<const float> weight, View<const Bf16> rows, View<const float> d_sum,
                                View<float> dots, View<Bf16> d_rows);
};

/// Of the instruction set in use.
const Bf16Kernels& bf16_kernels();

}  // namespace semfield
