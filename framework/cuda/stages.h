// The stages of a pass on the device.
#pragma once

#include <vector>

#include "core/workspace.h"
#include "cuda/kernels/kernels.h"
#include "losses/loss_list.h"
#include "model/stages.h"

namespace semfield::cuda {

const Stages<float>& stages();
const HeadKernels<float>& head_kernels();
const CameraKernels<float>& camera_kernels();

/// As Stages::keep, in views of `most` rows whose memory is there: kept.first, t, delta and ray_of_sample, source,
/// weight, and a ray's sum of weights into share. Rows behind the kept ones get t = delta = weight = source = 0 and the
/// last ray's number.
void keep_samples(const Samples<float>& samples, View<const float> weight, float least, const BranchTrace<float>& kept);
/// As Stages::join; rows behind those kept are 0.
void join_inputs(const BranchTrace<float>& trace, View<const float> position, View<const float> feature);
/// As Stages::drop_out.
void drop_out(const Dropout& rule, const Samples<float>& samples, View<const float> from, View<float> to);

/// As Stages::count_up.
void count_up(View<std::int32_t> numbers);
/// Row i of `to` and `to_logit` is row choice(i, 0) of `from` and `logit`.
void choose_points(View<const std::int32_t> choice, View<const float> from, View<const std::int16_t> logit,
                   View<float> to, View<std::int16_t> to_logit);

// The list `losses` on the device: each one's kernel, and their sums of a step.

/// A loss of the list, and what adds it on the device.
struct DeviceLoss {
  std::shared_ptr<const Loss> loss;
  LossKernel add = nullptr;
};

/// In the order of the list. Throws Error(unavailable) naming the first loss without kernels.
std::vector<DeviceLoss> loss_kernels(const LossList& losses, const KernelTables* tables);
/// Adds gradients of the losses whose bit is set in `which`, scaled by launch().cell; sums->terms gets their sums, in a
/// fixed order. `call` has everything but `scale` and `of_ray`.
void add_losses(Workspace& arena, const std::vector<DeviceLoss>& losses, std::uint32_t which, LossCall call,
                LossSums* sums);

}  // namespace semfield::cuda
