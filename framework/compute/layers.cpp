#include "compute/layers.h"

#include "compute/gemm.h"
#include "isa_list.h"

namespace semfield {

SEMFIELD_FOR_EVERY_ISA(SEMFIELD_DECLARE_VARIANT, fill_bf16_kernels, Bf16Kernels)

const Bf16Kernels& bf16_kernels() {
  static constexpr IsaVariant<void (*)(Bf16Kernels&)> kVariants[] = {
      SEMFIELD_FOR_EVERY_ISA(SEMFIELD_VARIANT, fill_bf16_kernels)};
  static const Bf16Kernels chosen = [] {
    Bf16Kernels filled{};
    best_variant(kVariants)(filled);
    return filled;
  }();
  return chosen;
}

namespace {

bool padded(View<const Bf16> rows) { return rows.row_stride >= bf16_stride(rows.cols); }

template <class Activation>
void check_shapes(const Layer<Activation>& l, std::int64_t in, std::int64_t out) {
  SEMFIELD_CHECK(l.x.cols == in, "the input of a layer does not fit");
  SEMFIELD_CHECK(l.y.empty() != l.exact.empty(), "a layer has one result");
  const std::int64_t rows = l.y.empty() ? l.exact.rows : l.y.rows, cols = l.y.empty() ? l.exact.cols : l.y.cols;
  SEMFIELD_CHECK(rows == l.x.rows && cols == out, "the result of a layer does not fit");
  SEMFIELD_CHECK(l.start.empty() || l.start.cols == out, "the start of a layer does not fit");
  SEMFIELD_CHECK(l.row_of.empty() || l.row_of.rows == rows, "the rows that a layer starts from do not fit");
  SEMFIELD_CHECK(rows == 0 || l.start.empty() || !l.row_of.empty() || l.start.rows == 1 || l.start.rows == rows,
                 "the start of a layer has too few rows");
  SEMFIELD_CHECK(l.mask.empty() || (l.mask.rows == rows && l.mask.cols == out), "the mask of a layer does not fit");
}

template <class Real>
void apply_with_gemm(const Layer<Real>& l) {
  check_shapes(l, l.weight.rows, l.weight.cols);
  const View<Real> y = l.y.empty() ? l.exact : l.y;
  Gemm<Real> g{.m = l.x.rows,
               .n = l.weight.cols,
               .k = l.x.cols,
               .a = l.x.data,
               .a_row = l.x.row_stride,
               .b = l.weight.data,
               .b_row = l.weight.row_stride,
               .c = y.data,
               .c_row = y.row_stride,
               .relu = l.relu,
               .mask = l.mask.data,
               .mask_row = l.mask.row_stride};
  if (!l.start.empty() && l.start.data == y.data) {
    g.accumulate = true;
  } else if (!l.start.empty() && l.row_of.empty() && l.start.rows == 1) {
    g.bias = l.start.data;
  } else if (!l.start.empty()) {
    g.row_term = l.start.data;
    g.row_term_stride = l.start.row_stride;
    g.row_of = l.row_of.data;
    g.row_of_stride = l.row_of.row_stride;
  }
  gemm(g);
}

template <class Activation>
void check_gradient(View<const Activation> x, View<const Activation> dz, View<const SumOf<Activation>> d_weight,
                    View<const SumOf<Activation>> d_bias) {
  SEMFIELD_CHECK(x.rows == dz.rows, "shapes of a weight gradient do not fit");
  SEMFIELD_CHECK(d_weight.empty() || (d_weight.rows == x.cols && d_weight.cols == dz.cols),
                 "shapes of a weight gradient do not fit");
  SEMFIELD_CHECK(d_bias.empty() || d_bias.cols == dz.cols, "bias gradient has another width");
}

template <class Real>
void gradient_with_gemm(View<const Real> x, View<const Real> dz, View<Real> d_weight, View<Real> d_bias) {
  check_gradient<Real>(x, dz, d_weight, d_bias);
  if (!d_weight.empty()) gemm_at_b_add<Real>(x, dz, d_weight);
  if (!d_bias.empty()) cpu_kernels<Real>().bias_backward(dz, d_bias);
}

}  // namespace

std::int64_t packed_weight_words(std::int64_t in, std::int64_t out) { return bf16_kernels().packed_words(in, out); }

PackedWeight pack_weight(View<const float> weight, bool transposed, std::uint32_t* words) {
  bf16_kernels().pack_weight(weight, transposed, words);
  return {words, transposed ? weight.cols : weight.rows, transposed ? weight.rows : weight.cols};
}

void apply(const Layer<float>& layer) { apply_with_gemm(layer); }
void apply(const Layer<double>& layer) { apply_with_gemm(layer); }

void apply(const Layer<Bf16>& l) {
  check_shapes(l, l.weight.in, l.weight.out);
  SEMFIELD_CHECK(padded(l.x) && (l.y.empty() || padded(l.y)), "rows of bf16 are not padded");
  if (l.x.rows == 0) return;
  bf16_kernels().layer(l);
}

void weight_gradient(View<const float> x, View<const float> dz, View<float> d_weight, View<float> d_bias) {
  gradient_with_gemm(x, dz, d_weight, d_bias);
}
void weight_gradient(View<const double> x, View<const double> dz, View<double> d_weight, View<double> d_bias) {
  gradient_with_gemm(x, dz, d_weight, d_bias);
}
void weight_gradient(View<const Bf16> x, View<const Bf16> dz, View<float> d_weight, View<float> d_bias) {
  check_gradient<Bf16>(x, dz, d_weight, d_bias);
  SEMFIELD_CHECK(padded(x) && padded(dz), "rows of bf16 are not padded");
  if (!d_weight.empty()) bf16_kernels().weight_gradient(x, dz, d_weight);
  if (!d_bias.empty()) bf16_kernels().add_rows(dz, d_bias);
}

void per_ray_sum(View<const float> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term) {
  SEMFIELD_CHECK(d_ray_term.cols == dz.cols && ray_of_sample.rows == dz.rows, "ray gradient does not fit");
  cpu_kernels<float>().per_ray_backward(dz, ray_of_sample, d_ray_term);
}
void per_ray_sum(View<const double> dz, View<const std::int32_t> ray_of_sample, View<double> d_ray_term) {
  SEMFIELD_CHECK(d_ray_term.cols == dz.cols && ray_of_sample.rows == dz.rows, "ray gradient does not fit");
  cpu_kernels<double>().per_ray_backward(dz, ray_of_sample, d_ray_term);
}
void per_ray_sum(View<const Bf16> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term) {
  SEMFIELD_CHECK(d_ray_term.cols == dz.cols && ray_of_sample.rows == dz.rows, "ray gradient does not fit");
  for (std::int64_t r = 0; r < d_ray_term.rows; ++r) std::fill_n(d_ray_term.row(r), d_ray_term.cols, 0.0F);
  for (std::int64_t m = 0; m < dz.rows;) {
    const std::int32_t ray = ray_of_sample(m, 0);
    std::int64_t end = m + 1;
    while (end < dz.rows && ray_of_sample(end, 0) == ray) ++end;
    bf16_kernels().add_rows(dz.row_range(m, end - m), d_ray_term.row_range(ray, 1));
    m = end;
  }
}

void round_rows(View<const float> from, View<Bf16> to, View<const Bf16> mask) {
  SEMFIELD_CHECK(from.rows == to.rows && from.cols == to.cols && padded(to), "shapes of a copy do not fit");
  SEMFIELD_CHECK(mask.empty() || (mask.rows == to.rows && mask.cols == to.cols), "the mask of a copy does not fit");
  bf16_kernels().round_rows(from, to, mask);
}

View<const Bf16> rounded_rows(View<const float> values, Workspace& arena) {
  const View<Bf16> rounded = take_activations<Bf16>(arena, values.rows, values.cols);
  round_rows(values, rounded);
  return rounded;
}

void widen_rows(View<const Bf16> from, View<float> to) {
  SEMFIELD_CHECK(from.rows == to.rows && from.cols == to.cols, "shapes of a copy do not fit");
  bf16_kernels().widen_rows(from, to);
}

void weighted_row_sum(View<const float> weight, View<const Bf16> rows, View<float> sum) {
  SEMFIELD_CHECK(weight.rows == rows.rows && sum.cols == rows.cols, "shapes of a sum of rows do not fit");
  bf16_kernels().weighted_sum(weight, rows, sum);
}

void weighted_row_sum_backward(View<const float> weight, View<const Bf16> rows, View<const float> d_sum,
                               View<float> dots, View<Bf16> d_rows) {
  SEMFIELD_CHECK(weight.rows == rows.rows && d_sum.cols == rows.cols, "shapes of a sum of rows do not fit");
  SEMFIELD_CHECK(d_rows.rows == rows.rows && d_rows.cols == rows.cols && padded(d_rows) && padded(rows),
                 "shapes of a sum of rows do not fit");
  SEMFIELD_CHECK(dots.empty() || dots.rows == rows.rows, "shapes of a sum of rows do not fit");
  bf16_kernels().weighted_sum_backward(weight, rows, d_sum, dots, d_rows);
}

template <class Real>
void transpose(View<const Real> in, View<Real> out) {
  SEMFIELD_CHECK(in.rows == out.cols && in.cols == out.rows, "shapes of a transpose do not fit");
  constexpr std::int32_t kBlock = 16;  // a block's rows stay in cache while its columns are written
  for (std::int64_t r0 = 0; r0 < in.rows; r0 += kBlock) {
    const std::int64_t r1 = std::min<std::int64_t>(in.rows, r0 + kBlock);
    for (std::int32_t c = 0; c < in.cols; ++c) {
      for (std::int64_t r = r0; r < r1; ++r) out(c, static_cast<std::int32_t>(r)) = in(r, c);
    }
  }
}

template void transpose<float>(View<const float>, View<float>);
template void transpose<double>(View<const double>, View<double>);

}  // namespace semfield
