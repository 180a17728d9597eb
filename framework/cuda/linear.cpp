// Layers as products with epilogues; where cuBLASLt has no such epilogue, as a product and a pass behind it.
#include <type_traits>

#include "cuda/kernels/layers.h"
#include "cuda/launch.h"
#include "cuda/matmul.h"

namespace semfield::cuda {

namespace {

Epilogue forward_epilogue(bool bias, Activation activation, bool mask) {
  if (activation == Activation::none) return bias ? Epilogue::bias : Epilogue::none;
  if (mask) return bias ? Epilogue::bias_relu_mask : Epilogue::relu_mask;
  return bias ? Epilogue::bias_relu : Epilogue::relu;
}

// A bias as a product's epilogue reads it.
View<const float> bias_of(const View<const float>& exact, const View<const float>&) { return exact; }
View<const __nv_bfloat16> bias_of(const View<const float>&, const View<const __nv_bfloat16>& rounded) {
  return rounded;
}

}  // namespace

template <class Act, class Out>
void linear_forward(const LinearForward<Act, Out>& call) {
  if (call.y.size() == 0) return;
  Product p;
  p.a = Matrix(call.x);
  p.b = Matrix(call.weight);
  p.d = Matrix(call.y);
  p.add = call.add;
  const View<const Out> bias = bias_of(call.bias, call.rounded_bias);
  p.epilogue = forward_epilogue(!call.bias.empty(), call.activation, call.mask != nullptr);
  p.bias = bias.data;
  p.mask = call.mask;
  const bool in_one = call.bias.empty() || !bias.empty();
  if (in_one && product(p)) return;
  p.epilogue = Epilogue::none;
  p.bias = nullptr;
  p.mask = nullptr;
  product(p);
  if (!call.bias.empty() || call.activation == Activation::relu) {
    finish_layer(call.bias, call.activation, call.y, call.mask);
  }
}

template <class Act, class Dx>
void linear_backward(const LinearBackward<Act, Dx>& call, Workspace& arena) {
  if (call.dz.rows == 0) return;
  const Workspace::Scope scope(arena);
  if (!call.d_weight.empty()) {
    Product p;
    p.a = Matrix(call.x.col_range(0, static_cast<std::int32_t>(call.d_weight.rows)), true);
    p.b = Matrix(call.dz.col_range(0, call.d_weight.cols));
    p.d = Matrix(call.d_weight);
    p.add = true;
    product(p);
  }
  // Own passes: cuBLASLt's epilogues for the sums and for the gradient of a ReLU are kernels of their own on Hopper,
  // and take more than twice as long.
  if (!call.d_bias.empty()) add_column_sums<Act>(call.dz.col_range(0, call.d_bias.cols), call.d_bias, arena);
  if (call.dx.empty()) return;
  Product p;
  p.a = Matrix(call.dz);
  p.b = Matrix(call.weight, true);
  p.d = Matrix(call.dx);
  p.add = call.add_to_dx;
  product(p);
  if (!call.relu_input) return;
  if constexpr (std::is_same_v<Dx, __nv_bfloat16>) {
    if (call.mask != nullptr && call.dx.cols % 8 == 0 && call.dx.row_stride % 8 == 0) {
      mask_and_sum(call.mask, call.dx, call.dx_sums, arena);
      return;
    }
  }
  relu_backward<Act, Dx>(call.x, call.dx);
  if (!call.dx_sums.empty()) add_column_sums<Dx>(call.dx.col_range(0, call.dx_sums.cols), call.dx_sums, arena);
}

#define SEMFIELD_INSTANTIATE(Act, Out)                                    \
  template void linear_forward<Act, Out>(const LinearForward<Act, Out>&); \
  template void linear_backward<Act, Out>(const LinearBackward<Act, Out>&, Workspace&);
SEMFIELD_INSTANTIATE(float, float)
SEMFIELD_INSTANTIATE(__nv_bfloat16, float)
SEMFIELD_INSTANTIATE(__nv_bfloat16, __nv_bfloat16)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield::cuda
