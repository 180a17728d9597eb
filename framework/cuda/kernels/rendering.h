// Stages of a pass on the device, with the meaning of model/stages.h. All views are
// device memory; everything is queued on launch().stream.
//
// A batch of samples is as large as the samplers' capacity, because the host does not wait for their number: rows
// [first[R], capacity) hold t = 0, delta = 0 and the last ray's number. Every stage leaves finite values there, and
// gradient 0.
#pragma once

#include "core/rng.h"
#include "cuda/launch.h"
#include "model/compositor.h"
#include "model/density_activation.h"
#include "model/render_rules.h"
#include "plugin/sampler.h"

namespace semfield::cuda {

/// x [M, 3] = map(origin + t direction), in float64; unused rows get `offset`. A coordinate,
/// distance or interval that is not finite is a fault of Stage::samples.
void locate(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<double> x);
/// As Stages::locate_backward: sums over a ray's samples in float64, in a fixed tree.
void locate_backward(const Rays<float>& rays, const Samples<float>& samples, const DomainMap& map, View<const float> dx,
                     View<float> d_ray);
/// locate for positions [N, 3] in world metres (density queries).
void map_positions(View<const double> positions, const DomainMap& map, View<double> x);

/// sigma = f(raw + bias + deviation N(0, 1)) * per_m; raw is overwritten with what f saw. deviation 0: no noise. Sample
/// k of ray first_ray + r draws at index (first_ray + r) 2^20 + k, as on the CPU. A result that is not in [0, inf) is a
/// fault of Stage::density, a raw value that is not finite one of Stage::raw_density; row = sample.
void density_forward(const DensityRule& rule, const Samples<float>* samples, View<float> raw, View<float> sigma);
/// d_raw = d_sigma f'(raw) * per_m; may be the same memory.
void density_backward(const DensityRule& rule, View<const float> raw, View<const float> d_sigma, View<float> d_raw);

/// As semfield::composite_forward; `in.hidden` and `out.hidden` cover the first out.hidden.rows rays. One warp per ray;
/// scalars of a ray in float64. Weights of unused rows are 0. A colour of a sample that is not finite is a fault of
/// Stage::color with its row.
void composite_forward(const CompositeIn<float>& in, const CompositeOut<float>& out);
/// As semfield::composite_backward. Gradients of unused rows, and of samples behind the first grad.hidden.rows rays in
/// d_hidden, are 0. d_sigma is scratch on the way.
void composite_backward(const CompositeIn<float>& in, const CompositeOut<float>& out, const CompositeGrad<float>& grad,
                        View<float> d_sigma, View<float> d_rgb, View<float> d_hidden);

/// As Stages::opacity_resolutions; result [R, 1].
void opacity_resolutions(const Samples<float>& samples, View<const float> weight, FarMode far, double footprint_per_m,
                         View<OpacityResolution> result);

/// A value of values [N, C] that is not finite is a fault of `stage` with its row.
void guard_finite(Stage stage, View<const float> values);

}  // namespace semfield::cuda
