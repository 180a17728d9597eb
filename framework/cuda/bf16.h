// The framework's bf16 memory as CUDA's type.
#pragma once

#include <cuda_bf16.h>

#include "core/half.h"
#include "core/view.h"

namespace semfield::cuda {

static_assert(sizeof(Bf16) == sizeof(__nv_bfloat16));

inline View<__nv_bfloat16> as_bf16(View<Bf16> v) {
  return {reinterpret_cast<__nv_bfloat16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}
inline View<const __nv_bfloat16> as_bf16(View<const Bf16> v) {
  return {reinterpret_cast<const __nv_bfloat16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}
inline const __nv_bfloat16* as_bf16(const Bf16* p) { return reinterpret_cast<const __nv_bfloat16*>(p); }

}  // namespace semfield::cuda
