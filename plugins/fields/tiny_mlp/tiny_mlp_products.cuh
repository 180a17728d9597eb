// Products of the small network in plain fused multiply-adds, for layers of any width; and the loops around them.
#pragma once

#include <cstdint>

#include "compute/precision.h"
#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda::tiny {

enum class Epilogue : std::uint8_t { none, relu, sigmoid };

/// c [M, N] = epilogue(start + a b), a [M, K], b [K, N] or, transposed, [N, K]. start is c's old value with `add`, else
/// row ray_of_sample[m] of `start` [R, N], or its only row where ray_of_sample is empty, or 0. mask [M, N]: c = 0 where
/// mask <= 0, the gradient of a ReLU. Rows behind *live (null: none) become 0. Every element is one chain of fused
/// multiply-adds over k ascending, whatever M is.
struct Product {
  View<const float> a, b;
  bool transposed = false;
  View<float> c;
  View<const float> start;
  View<const std::int32_t> ray_of_sample;
  bool add = false;
  Epilogue epilogue = Epilogue::none;
  View<const float> mask;
  const std::int32_t* live = nullptr;
};
/// bf16: operands are rounded, sums stay fp32.
void product(const Product& p, Precision precision);

/// d_weight [in, out] += x^T dz and d_bias [1, out] += column sums of dz over the rows before *live; x [M, in], dz [M,
/// out]. Empty views are not computed. Sums over fixed ranges of rows are added in order: same bits in every run.
struct WeightGradient {
  View<const float> x, dz;
  View<float> d_weight, d_bias;
  const std::int32_t* live = nullptr;
};
void weight_gradient(const WeightGradient& g, Precision precision, Workspace& arena);

/// d_ray_term [R, N] = sum of dz [M, N] over each ray's samples in order; rays without samples get 0.
void sum_per_ray(View<const float> dz, View<const std::int32_t> ray_of_sample, const std::int32_t* live,
                 View<float> d_ray_term);

/// out [M, N] = in, or with `add` += in; an empty `in` counts as zeros. Rows behind *live become 0.
void copy_rows(View<const float> in, View<float> out, const std::int32_t* live, bool add = false);

/// out [M, N] = mask > 0 ? out : 0.
void mask_rows(View<const float> mask, View<float> out);

/// out [M, N] = row ray_of_sample[m] of in [R, N].
void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out);

/// d_logit [M, 3] = d_rgb rgb (1 - rgb).
void logit_gradient(View<const float> rgb, View<const float> d_rgb, View<float> d_logit);

}  // namespace semfield::cuda::tiny
