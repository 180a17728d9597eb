// Matrix products on the device by cuBLASLt, with what may follow them in the same kernel.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>
#include <span>
#include <type_traits>

#include "core/half.h"
#include "core/view.h"
#include "core/workspace.h"

namespace semfield::cuda {

// The framework's bf16 memory as CUDA's type.

static_assert(sizeof(Bf16) == sizeof(__nv_bfloat16));

inline View<__nv_bfloat16> as_bf16(View<Bf16> v) {
  return {reinterpret_cast<__nv_bfloat16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}
inline View<const __nv_bfloat16> as_bf16(View<const Bf16> v) {
  return {reinterpret_cast<const __nv_bfloat16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}
inline const __nv_bfloat16* as_bf16(const Bf16* p) { return reinterpret_cast<const __nv_bfloat16*>(p); }

enum class Element : std::uint8_t { fp32, bf16 };

template <class T>
constexpr Element element_of() {
  using Plain = std::remove_const_t<T>;
  static_assert(std::is_same_v<Plain, float> || std::is_same_v<Plain, __nv_bfloat16>);
  return std::is_same_v<Plain, float> ? Element::fp32 : Element::bf16;
}

/// A row-major matrix in device memory as an operand; `transposed`: its transpose is meant.
struct Matrix {
  void* data = nullptr;
  std::int64_t rows = 0, cols = 0, stride = 0;  ///< as stored
  Element type = Element::fp32;
  bool transposed = false;

  Matrix() = default;
  template <class T>
  explicit Matrix(View<T> view, bool transpose = false)
      : data(const_cast<std::remove_const_t<T>*>(view.data)),
        rows(view.rows),
        cols(view.cols),
        stride(view.row_stride),
        type(element_of<T>()),
        transposed(transpose) {}
};

/// What happens to D = A B (+ D) before it is written.
enum class Epilogue : std::uint8_t {
  none,
  bias,       ///< D + bias
  relu,       ///< max(D, 0)
  bias_relu,  ///< max(D + bias, 0)
};

/// D = A B, or D + A B with `add`. Operands fp32: products and sums in fp32 (with `tf32` operands are cut to TF32's 10
/// bits of mantissa where cuBLASLt has such a kernel), D fp32; operands bf16: sums in fp32, D fp32 or bf16.
struct Product {
  Matrix a{}, b{}, d{};
  bool add = false;
  bool tf32 = false;
  Epilogue epilogue = Epilogue::none;
  const void* bias = nullptr;  ///< [columns of D], of D's type
};

/// Queues the product on launch().stream. false, and nothing is queued: cuBLASLt has no kernel with this epilogue
/// (Epilogue::none always has one: ours, where cuBLASLt has none). Which algorithm a shape gets is decided once, among
/// those whose sums have a fixed order, so results repeat bit for bit. Every stream has a
/// workspace of its own, so products of several streams may run at the same time.
bool product(const Product& p);
/// Gives back the workspace of a stream that computes no more products. The stream must have ended its work.
void forget_stream(cudaStream_t stream);

/// D = C + A B + A2 B2 (+ D with `add`), all fp32; C, A and B, A2 and B2 may be absent.
struct SmallProduct {
  Matrix a{}, b{}, a2{}, b2{};
  View<const float> c{};
  View<float> d{};
  bool add = false;
};
/// Products that do not depend on each other, in one launch (two where one has many terms and a small D): where
/// cuBLASLt's launches would take longer than the products. Sums in fp32, in an order that depends on shapes alone;
/// with an arena, many terms are summed in parts at the same time.
inline constexpr int kMostSmallProducts = 4;
void small_products(std::span<const SmallProduct> products, Workspace* arena = nullptr);

/// `product` by a plain kernel of ours, Epilogue::none: one thread an element, terms in order.
void simple_product(const Product& p);

}  // namespace semfield::cuda
