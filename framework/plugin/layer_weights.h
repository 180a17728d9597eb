// A weight among a component's tensors, and what layers read of it: for components whose kernels are written on
// compute/layers.h.
#pragma once

#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

#include "compute/isa.h"
#include "compute/layers.h"
#include "core/half.h"
#include "plugin/parametric.h"

namespace semfield {

/// Rows [first, first + rows) of a weight [in, out], those of one input, by the indices of its tensors; -1: there is
/// none. In bf16 both rearranged tensors hold packed words (compute/layers.h).
struct LayerWeight {
  int weight = -1;
  int forward = -1;   ///< rearranged; only in bf16: in fp32 the weight itself is read
  int backward = -1;  ///< rearranged: the transpose
  std::int32_t first = 0, rows = 0, cols = 0;
};

/// Appends the rearranged tensors that a CPU's kernels read of specs[weight], whose name they begin with.
LayerWeight rearranged_weight(std::vector<TensorSpec>& specs, int weight, std::int32_t first, std::int32_t rows,
                              Precision precision);

namespace SEMFIELD_ISA {
namespace {  // of a kernel file and its instruction set

/// Fills them: once per step, for each weight whatever the others do.
template <class Activation, class Real>
void rearrange(const LayerWeight& w, const Tensors<Real>& t) {
  static_assert(std::is_same_v<SumOf<Activation>, Real>);
  const View<const Real> weight =
      View<const Real>(t.value[static_cast<std::size_t>(w.weight)]).row_range(w.first, w.rows);
  const View<Real> backward = t.value[static_cast<std::size_t>(w.backward)];
  if constexpr (std::is_same_v<Activation, Bf16>) {
    (void)pack_weight(weight, false,
                      reinterpret_cast<std::uint32_t*>(t.value[static_cast<std::size_t>(w.forward)].data));
    (void)pack_weight(weight, true, reinterpret_cast<std::uint32_t*>(backward.data));
  } else {
    transpose<Real>(weight, backward);
  }
}

/// The weight [rows, cols] as a layer reads it.
template <class Activation, class Real>
typename LayerTypes<Activation>::Weight forward_weight(const LayerWeight& w, const Tensors<Real>& t) {
  if constexpr (std::is_same_v<Activation, Bf16>) {
    const float* words = t.value[static_cast<std::size_t>(w.forward)].data;
    return {reinterpret_cast<const std::uint32_t*>(words), w.rows, w.cols};
  } else {
    return View<const Real>(t.value[static_cast<std::size_t>(w.weight)]).row_range(w.first, w.rows);
  }
}

/// Its transpose [cols, rows], for the gradient at the layer's input.
template <class Activation, class Real>
typename LayerTypes<Activation>::Weight backward_weight(const LayerWeight& w, const Tensors<Real>& t) {
  const View<const Real> tensor = t.value[static_cast<std::size_t>(w.backward)];
  if constexpr (std::is_same_v<Activation, Bf16>) {
    return {reinterpret_cast<const std::uint32_t*>(tensor.data), w.cols, w.rows};
  } else {
    return tensor;
  }
}

}  // namespace
}  // namespace SEMFIELD_ISA
}  // namespace semfield
