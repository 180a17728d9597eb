// The stages of a pass on the device.
#pragma once

#include "model/stages.h"

namespace semfield::cuda {

const Stages<float>& stages();
const HeadKernels<float>& head_kernels();

/// As Stages::keep, in views of `most` rows whose memory is there: kept.first, t, delta and ray_of_sample, source,
/// weight, and a ray's sum of weights into share. Rows behind the kept ones get t = delta = weight = source = 0 and the
/// last ray's number.
void keep_samples(const Samples<float>& samples, View<const float> weight, float least, const BranchTrace<float>& kept);
/// As Stages::join; rows behind those kept are 0.
void join_inputs(const BranchTrace<float>& trace, View<const float> position, View<const float> feature);
/// As Stages::drop_out.
void drop_out(const Dropout& rule, const Samples<float>& samples, View<const float> from, View<float> to);

}  // namespace semfield::cuda
