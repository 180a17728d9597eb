// The small network of the usual widths in one kernel a direction: hidden and colour up to 64 wide, one hidden layer,
// two colour layers, bf16 operands. Nothing is saved: backward computes the activations again from the 4 D bytes of an
// encoded position, where saving them would cost 2 (64 + 16 + 64 + 64) bytes per sample twice.
#pragma once

#include "fields/tiny_mlp/tiny_mlp_kernels.h"
#include "fields/tiny_mlp/tiny_mlp_tile.cuh"

namespace semfield::cuda::tiny {

/// Shared memory of the largest kernel; a device that gives a block less takes the layers one by one.
inline constexpr std::size_t kMostSharedMemory = 112 * 1024;
/// Whether the fused kernels compute this network on the current device.
bool fused_applies(const TinyMlpShape& shape);
/// Whether they hand the feature on in bf16 too.
bool shares_feature(const TinyMlpShape& shape);

/// Arguments of either kernel.
struct FusedCall {
  Network network;
  FieldIn<float> in;
  bool hidden_feature = true;  ///< the feature is the hidden layer, else the geometry features
  const std::int32_t* live = nullptr;
  bool vector_position = false, vector_direction = false, vector_feature = false;
};
FusedCall fused_call(const TinyMlpShape& shape, const Tensors<float>& tensors, const FieldIn<float>& in);

void fused_forward(const TinyMlpShape& shape, const Tensors<float>& tensors, const FieldIn<float>& in,
                   const FieldOut<float>& out);
void fused_backward(const TinyMlpShape& shape, Workspace& arena, const Tensors<float>& tensors,
                    const FieldIn<float>& in, View<const float> rgb, const FieldGrad<float>& grad,
                    View<float> d_position);

/// Calls run.template operator()<position tiles, direction tiles>() for the shape's widths.
template <class Run>
void with_tiles(const TinyMlpShape& shape, const Run& run) {
  const auto with_direction = [&]<int kPositionTiles>() {
    if (shape.has_direction()) {
      run.template operator()<kPositionTiles, 1>();
    } else {
      run.template operator()<kPositionTiles, 0>();
    }
  };
  if (shape.position_dims <= kGroup) {
    with_direction.template operator()<1>();
  } else if (shape.position_dims <= 2 * kGroup) {
    with_direction.template operator()<2>();
  } else {
    with_direction.template operator()<4>();
  }
}

/// Most shared memory that a block of the current device may have.
std::size_t shared_memory_limit();
/// Lets a kernel use `bytes` of shared memory, and gives the blocks of it that the device holds at a time.
unsigned resident_blocks(const void* kernel, int threads, std::size_t bytes);

}  // namespace semfield::cuda::tiny
