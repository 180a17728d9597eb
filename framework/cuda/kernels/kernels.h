// The kernels of a step on the device, as host code launches them: layers, Adam, hidden channels, losses, compositing.
#pragma once

#include <cuda_bf16.h>

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "cuda/launch.h"
#include "execution/device_library.h"
#include "model/compositor.h"
#include "model/losses/loss_list.h"
#include "model/losses/semantic_cross_entropy.h"
#include "model/optim/adam.h"
#include "model/render_rules.h"
#include "model/stages.h"
#include "plugin/sampler.h"

namespace semfield::cuda {

// Linear layers over a batch on the device, for activations kept as fp32 or bf16: what fields and the semantic head are
// made of. Twins of compute/layers.h. Everything is queued on launch().stream; products go through cuda/matmul.h.

enum class Activation : std::uint8_t { none, relu };

/// Act: float (products in fp32) or __nv_bfloat16 (operands bf16, sums in fp32). Weights of a product have its type.
/// y = activation(x W + bias), or with `add` activation(y + x W + bias); x [M, in], weight [in, out] (row stride as
/// given), bias [1, out] fp32 or empty, y [M, out] of Act or float.
template <class Act, class Out>
struct LinearForward {
  View<const Act> x{}, weight{};
  View<const float> bias{};
  View<Out> y{};
  Activation activation = Activation::none;
  bool add = false;
  /// The same bias as Out. cuBLASLt adds a bias of the output's type alone: without it, bf16 outputs cost a further
  /// pass.
  View<const Out> rounded_bias{};
};
template <class Act, class Out>
void linear_forward(const LinearForward<Act, Out>& call);

/// From dz [M, out] = dL/d(x W + b): d_weight [in, out] fp32 +=, d_bias [1, out] fp32 +=, dx [M, in] = dz W^T (or +=
/// with add_to_dx). weight [in, out], not transposed: a product reads either way. x, dz and weight may have more
/// columns (rows) than d_weight: padding. Empty views are not computed. Sums have a fixed order.
template <class Act, class Dx>
struct LinearBackward {
  View<const Act> x{}, dz{}, weight{};
  View<float> d_weight{}, d_bias{};
  View<Dx> dx{};
  bool add_to_dx = false;
};
template <class Act, class Dx>
void linear_backward(const LinearBackward<Act, Dx>& call, Workspace& arena);

/// out = in, with conversion; as many rows, strides as given. Columns of `out` beyond in.cols are set to 0 when out is
/// wider.
template <class From, class To>
void convert(View<const From> in, View<To> out);
void fill(View<float> out, float value);
/// out += in.
template <class From, class To>
void add_rows(View<const From> in, View<To> out);
/// dz = y > 0 ? dy : 0.
template <class Act>
void relu_backward(View<const Act> y, View<Act> dy);
/// sums [1, cols] += column sums of dz, rows in an order that depends on their number alone.
template <class Act>
void add_column_sums(View<const Act> dz, View<float> sums, Workspace& arena);
/// y [M, out] = share [M, 1] bias [1, out].
void shared_bias_forward(View<const float> share, View<const float> bias, View<float> y);
/// From dy [M, out]: d_share [M, 1] = dy bias^T, d_bias [1, out] += share^T dy. Sums have a fixed order.
struct SharedBiasBackward {
  View<const float> share, bias, dy;
  View<float> d_share, d_bias;
};
void shared_bias_backward(const SharedBiasBackward& call, Workspace& arena);
/// d_ray_term [R, out] = sum of dz over each ray's samples, rays in order; ray_of_sample ascending. Rows that are not
/// in use are not added. dz may have more columns: padding.
template <class Act>
void per_ray_backward(View<const Act> dz, View<const std::int32_t> ray_of_sample, View<float> d_ray_term);

// What networks do to rows beside products, on the device: the ends of layers, sines, colours.

/// out = sums + start, then the ReLU and the mask: `out` [M, N]. start: empty, one row for all, or row row_of[m], or
/// row m. out may be `sums`, and `start` may be `out`. Act: float or __nv_bfloat16; Sums: that or float.
template <class Sums, class Act>
struct LayerEnd {
  View<const Sums> sums;
  View<const float> start;
  View<const std::int32_t> row_of;
  bool relu = false;
  View<const Act> mask;  ///< [M, N] or empty: 0 where it is not positive
  View<Act> out;
};
template <class Sums, class Act>
void finish_rows(const LayerEnd<Sums, Act>& end);

/// value = sin(frequency sums) and, where it is given, slope = frequency cos(frequency sums).
template <class Act>
void sine_rows(View<const float> sums, float frequency, View<Act> value, View<Act> slope);
/// dz = sums times slope.
template <class Act>
void times_slope(View<const Act> slope, View<const float> sums, View<Act> dz);

/// out [M, N] = row ray_of_sample[m] of in [R, N].
void gather_rows(View<const float> in, View<const std::int32_t> ray_of_sample, View<float> out);
/// rows = sigmoid(rows).
void sigmoid_rows(View<float> rows);
/// d_logit = d_value value (1 - value).
void logit_gradient(View<const float> value, View<const float> d_value, View<float> d_logit);

// Adam on the device, twin of the kernels of model/optim/adam.

/// Notes a fault of Stage::gradient (row: number of the tensor) for a value, gradient or moment from which no update
/// may start, over all tensors; limits as first_unsound. Of a touched_only tensor all gradients, and values and moments
/// of the touched rows of one of kTableWindows windows a step, as on the CPU. Nothing is changed.
void check_gradients(const AdamTable<float>& table);

/// As Stages::adam, and zeroes all gradients, unless a fault is noted: then nothing is written. `step` and the table
/// are device memory, so that one launch of a captured graph serves all tensors in every step. The bits of a CPU
/// with fused multiply-add; arrays that start on 16 bytes, and tables of 1, 2, 4 or 8 columns, are the fast case.
void adam_update(const AdamStep* step, const AdamTable<float>& table);

// The part of compositing that has many channels: sums of hidden channels along rays, and their gradients.

/// out [n, H] = sum of w h over the samples of the first n rays. hidden [M, H], Act float or __nv_bfloat16.
template <class Act>
void hidden_forward(const Samples<float>& samples, View<const float> weight, View<const Act> hidden, View<float> out);

/// d_hidden = w dL/d(out) for samples of the first d_out.rows rays, 0 in its rows behind them; with relu_output where
/// hidden > 0 alone: the gradient before the ReLU that made it. dots [M, 1], where it is not empty: dL/d(out) . h of
/// those samples; its other rows are left alone.
template <class Act>
struct HiddenBackward {
  View<const float> weight{};
  View<const Act> hidden{};
  View<const float> d_out{};
  View<float> dots{};
  View<Act> d_hidden{};  ///< may have more rows than `hidden`
  bool relu_output = false;
  /// d_hidden lies in 8 x 8 blocks (FusedGrad::hidden): contiguous, rows and columns multiples of 8.
  bool blocked = false;
};
template <class Act>
void hidden_backward(const Samples<float>& samples, const HiddenBackward<Act>& call);

// Losses on the device, twins of losses/: gradients per ray, and sums of a step in a fixed order.

/// Sums of one pass over a batch.
struct LossSums {
  double squares = 0;                 ///< sum of squared colour errors over rays and channels
  double semantic = 0;                ///< weighted cross-entropy in nats, before division
  double terms[kMostLossTerms] = {};  ///< of the list `losses`
  std::int64_t labelled = 0;
  std::int64_t samples = 0;  ///< in use
  std::int64_t drawn = 0;    ///< of which they are
  std::int32_t dense = 0;    ///< 1: some sample has density
};

/// d_color = 2 (color - target) / normaliser [R, 3], and sums->squares in a fixed order (sums: device memory). Sums of
/// blocks go through `arena`.
void photometric_loss(Workspace& arena, View<const float> color, View<const float> target, double normaliser,
                      View<float> d_color, LossSums* sums);

/// As semfield::semantic_cross_entropy with the normaliser read from launch().cell: d_logits [N, C], sums->semantic
/// and labelled. hard [N, 1] or soft [N, C] (device); class_weight [1, C] (device) or empty. A logit of a
/// labelled ray that is not finite is a fault of Stage::logits, a label outside -1..C-1 or a soft value that is no
/// probability one of Stage::label; such a ray counts as unlabelled.
void semantic_cross_entropy(Workspace& arena, View<const float> logits, const SemanticTargets& targets,
                            View<const float> class_weight, double scale, View<float> d_logits, LossSums* sums);

/// *total = the sum of `count` numbers, all device memory, in an order that depends on `count` alone.
void sum_in_order(const double* numbers, std::int64_t count, double* total);

/// sums->samples = first[R], sums->drawn = drawn[R], sums->dense = any sigma > 0.
void count_samples(View<const std::int32_t> first, View<const std::int32_t> drawn, View<const float> sigma,
                   LossSums* sums);

/// As Stages::class_results.
void class_results(View<float> logits, const ClassResults<float>& results);

// The largest size of a number in a matrix, from which sums in fixed point take their unit.

/// *largest = the larger of itself and the bits of the largest |value| of the rows in use (launch().live_rows); those
/// of a NaN are larger than any number's. Device memory; the order does not matter, so matrices may be looked at beside
/// each other.
void find_largest(View<const float> values, std::uint32_t* largest);

// Stages of a pass on the device, with the meaning of model/stages.h. All views are
// device memory; everything is queued on launch().stream.
//
// A batch of samples is as large as the samplers' capacity, because the host does not wait for their number: rows
// [first[R], capacity) hold t = 0, delta = 0 and the last ray's number. Every stage leaves finite values there, and
// gradient 0.

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

// The stages of a pass on the device as a table.

const Stages<float>& stages();
const HeadKernels<float>& head_kernels();
const CameraKernels<float>& camera_kernels();

/// As Stages::reached, in views whose memory is there; `counts` [R, 1] is scratch. Rows behind those chosen get
/// t = delta = source = 0 and the last ray's number.
void reached_samples(const Samples<float>& samples, View<const float> sigma, const ReachedBy& rule,
                     View<std::int32_t> counts, const ChosenSamples<float>& chosen);
/// As Stages::spread.
void spread_rows(const ChosenSamples<float>& chosen, View<const float> from, View<float> to);
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

// The kernels that a build with CUDA adds to the plugins' tables.

/// Those of networks (plugin/mlp) and heads (plugin/head).
void add_mlp_kernels(KernelTables& tables);
void add_head_kernels(KernelTables& tables);
/// Adds these, and calls NAME_cuda_kernels of every linked plugin that has a NAME_cuda.cu. Generated by
/// framework/cuda/CMakeLists.txt.
void add_plugin_kernels(KernelTables& tables);

// Learning a grouping on the device.

/// As DeviceLibrary::learn_grouping. A step is a gather of its points, the network forward, its slow copy forward where
/// there is one, the grouping's kernel, the network backward and Adam, all queued; draws of many steps are sent at
/// once.
void learn_grouping(const GroupingLessons& lessons);

/// slow = share * slow + (1 - share) * value.
void follow(std::span<const float> value, std::span<float> slow, double share);

}  // namespace semfield::cuda
