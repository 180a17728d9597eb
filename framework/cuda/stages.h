// The stages of a pass on the device.
#pragma once

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

}  // namespace semfield::cuda
