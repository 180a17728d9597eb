// When tests of the fused kernels of the big network run.
#pragma once

#include "fields/nerf_mlp/nerf_mlp.h"
#include "tests/cuda/device_fixture.h"

namespace semfield::testing {

inline NerfMlpShape usual_shape() {
  return NerfMlpShape{.position_dims = 63, .direction_dims = 27, .precision = Precision::bf16};
}

/// First line of every test that launches them.
#define SEMFIELD_NEEDS_FUSED()                                                  \
  SEMFIELD_NEEDS_DEVICE();                                                      \
  if (!::semfield::cuda::nerf_mlp_is_fused(::semfield::testing::usual_shape())) \
  GTEST_SKIP() << "the GPU is not of compute capability 9.0"

}  // namespace semfield::testing
