// The stages of a pass that are no plugins, as a table of functions for a device.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "core/error.h"
#include "core/half.h"
#include "core/non_copyable.h"
#include "core/rng.h"
#include "core/view.h"
#include "model/compositor.h"
#include "model/optim/adam.h"
#include "model/render_rules.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/sampler.h"

namespace semfield {

/// K kept samples of the first R rays; lives in the tile's workspace.
template <class Real>
struct BranchTrace {
  Samples<Real> samples;
  View<std::int32_t> source;  ///< [K, 1] number of the sample in the pass
  View<Real> weight;          ///< [K, 1] compositing weight, a constant here
  View<Real> share;           ///< [R, 1] sum of a ray's kept weights
  View<Real> input;           ///< [K, Dp (+ F)] encoded position (and the field's feature)
  FieldOut<Real> out;         ///< feature [K, B] alone
  View<Real> feature;         ///< [K, B] what the head reads: the same, or what dropout left of it
  Saved saved;
};

/// Samples begin <= k < end of every ray that light reaches: those in front of which the transmittance is `least` or
/// more.
struct ReachedBy {
  std::int64_t begin = 0, end = 0;
  double least = 0;
};

/// Samples of some, in order; lives in the tile's workspace.
template <class Real>
struct ChosenSamples {
  Samples<Real> samples;
  View<std::int32_t> source;  ///< [K, 1] number among those that they were chosen from
};

/// Values that the end of a stage looks at.
enum class Guarded : std::uint8_t {
  encoded_position,
  encoded_direction,
  raw_density,
  sample_color,
  feature,
  semantic_feature,
  color,
  depth,
  opacity,
  logits,
  channel,           ///< of a head beside that of class logits
  encoded_gradient,  ///< of a lone tile
};

/// Whose values they are, for messages.
template <class Real>
struct GuardPlace {
  std::string_view pass;
  std::int64_t first_ray = 0;
  const Samples<Real>* samples = nullptr;
};

/// Dropout of the semantic branch's feature.
struct Dropout {
  RandomAddress random;
  std::int64_t first_ray = 0;
  double share = 0;
};

/// Address of the dropout's random values; that of other heads also has their prefix in front.
inline constexpr const char* kBranchDropout = "semantic_branch/dropout";
/// Columns that share a block of random numbers.
inline constexpr std::int32_t kDropoutGroup = 4;
/// What is left of columns 4 g .. 4 g + 3 of a ray's kept sample `k`, of `cols`: factors 0 or 1 / (1 - share). Rays are
/// numbered through the batch, so tiles do not matter.
struct DropoutFactors {
  float of[kDropoutGroup];
};
SEMFIELD_HD inline DropoutFactors dropout_factors(const RandomAddress& address, double share, std::int64_t ray,
                                                  std::int64_t k, std::int32_t group, std::int32_t cols) {
  const auto row = (static_cast<std::uint64_t>(ray) << 20) + static_cast<std::uint64_t>(k);
  const PhiloxBlock block =
      random_block(address, row * static_cast<std::uint64_t>(cols) + static_cast<std::uint64_t>(group));
  const double below = share * 4294967296.0;
  const auto stays = static_cast<float>(1 / (1 - share));
  DropoutFactors factors;
  for (std::int32_t i = 0; i < kDropoutGroup; ++i)
    factors.of[i] = static_cast<double>(block.v[i]) < below ? 0.0F : stays;
  return factors;
}

/// Backward of the sum of hidden activations in bf16 along rays, and of the ReLU that made them.
template <class Real>
struct RoundedSumBackward {
  View<const Real> weight{};  ///< [M, 1]
  View<const Bf16> hidden{};  ///< [N, H], activations
  View<const Real> d_out{};   ///< [rays, H]
  View<Real> dots{};          ///< [M, 1] dL/d(out) . h of the samples of those rays; empty: not wanted
  View<Bf16> d_hidden{};  ///< N rows or more: dL/d(hidden) before the ReLU, 0 in rows behind the samples of those rays
  bool blocked = false;   ///< d_hidden lies in 8 x 8 blocks (FieldGrad::hidden)
};

/// What rendering asks of logits [R, C]; R rows each, one column but for `probability`, empty: not wanted.
template <class Real>
struct ClassResults {
  View<const std::int16_t> truth;  ///< true classes; only for truth_probability
  View<std::int16_t> label;        ///< argmax class
  View<Real> entropy;              ///< nats
  View<Real> confidence;           ///< largest class probability
  View<Real> truth_probability;    ///< of the true class; 0 where void
  View<Real> probability;          ///< [R, C] softmax of the logits
};

template <class Real>
struct CameraKernels;

/// Functions on views of one device. On a CPU a pass works on a tile and knows how many samples it has. On
/// another device it works on a batch with room for all samples that there can be; rows behind those in use hold finite
/// numbers and get gradient 0. Entries that may be null say so.
template <class Real>
struct Stages {
  const HeadKernels<Real>* head = nullptr;
  const CameraKernels<Real>* cameras = nullptr;  ///< model/camera_corrections.h
  bool host_memory = true;                       ///< counts of samples can be read
  std::int64_t density_batch = 0;                ///< positions that a density query evaluates at once

  /// Rows of a batch that are in use, for the stages that follow: device memory, null: all. Gives what was set before.
  /// Null where host_memory.
  const std::int32_t* (*set_live_rows)(const std::int32_t* count) = nullptr;
  /// to = from, byte by byte, of the same shape. Either may be host memory (View::device says it).
  void (*copy)(View<const std::byte> from, View<std::byte> to) = nullptr;

  /// x [M, 3] = map(origin + t direction), in float64. Distances, intervals and positions must be finite.
  void (*locate)(const GuardPlace<Real>& place, const Rays<Real>& rays, const DomainMap& map, View<double> x) = nullptr;
  /// d_ray [R, 6] += gradients of origin and direction of each ray, from dx [M, 3] of its samples.
  void (*locate_backward)(const Rays<Real>& rays, const Samples<Real>& samples, const DomainMap& map,
                          View<const Real> dx, View<Real> d_ray) = nullptr;
  /// locate for positions [N, 3] in world metres.
  void (*map_positions)(View<const double> positions, const DomainMap& map, View<double> x) = nullptr;
  void (*density_forward)(const DensityRule& rule, const Samples<Real>* samples, View<Real> raw,
                          View<Real> sigma) = nullptr;
  void (*density_backward)(const DensityRule& rule, View<const Real> raw, View<const Real> d_sigma,
                           View<Real> d_raw) = nullptr;
  /// At most `most` samples into `arena`; a ray without any stays, with none. More are a fault of the device's room.
  ChosenSamples<Real> (*reached)(Workspace& arena, const Samples<Real>& samples, View<const Real> sigma,
                                 const ReachedBy& rule, std::int64_t most) = nullptr;
  /// to(source(k)) = from(k), [K, 1].
  void (*spread)(const ChosenSamples<Real>& chosen, View<const Real> from, View<Real> to) = nullptr;
  void (*composite_forward)(const CompositeIn<Real>& in, const CompositeOut<Real>& out) = nullptr;
  void (*composite_backward)(const CompositeIn<Real>& in, const CompositeOut<Real>& out,
                             const CompositeGrad<Real>& grad, View<Real> d_sigma, View<Real> d_rgb,
                             View<Real> d_hidden) = nullptr;
  void (*fill)(View<Real> values, Real value) = nullptr;
  /// numbers(i, 0) = i.
  void (*count_up)(View<std::int32_t> numbers) = nullptr;
  /// to += from.
  void (*add)(View<const Real> from, View<Real> to) = nullptr;

  /// Of the semantic branch. keep: samples of the first trace.share.rows rays with weight >= least and > 0, in order,
  /// at most `most`; fills trace.samples, source, weight and share in `arena`.
  void (*keep)(Workspace& arena, const Samples<Real>& samples, View<const Real> weight, Real least, std::int64_t most,
               BranchTrace<Real>& trace) = nullptr;
  /// trace.input = [position, row `source` of feature]; feature may be empty.
  void (*join)(const BranchTrace<Real>& trace, View<const Real> position, View<const Real> feature) = nullptr;
  /// to = from with a share of its values set to 0 and the others divided by 1 - share (dropout_factors).
  void (*drop_out)(const Dropout& rule, const Samples<Real>& samples, View<const Real> from, View<Real> to) = nullptr;
  /// out [R, H] = sum over each ray's samples of weight [K, 1] times values [K, H].
  void (*sum_by_weight)(const Samples<Real>& samples, View<const Real> weight, View<const Real> values,
                        View<Real> out) = nullptr;
  /// d_values [K, H] = weight times d_out [R, H] of the sample's ray.
  void (*sum_by_weight_backward)(const Samples<Real>& samples, View<const Real> weight, View<const Real> d_out,
                                 View<Real> d_values) = nullptr;

  /// Of heads that take activations in bf16 (Head::takes_rounded); else null.
  void (*rounded_sum)(const Samples<Real>& samples, View<const Real> weight, View<const Bf16> hidden,
                      View<Real> out) = nullptr;
  void (*rounded_sum_backward)(const Samples<Real>& samples, const RoundedSumBackward<Real>& call) = nullptr;

  /// Of rendering. Logits are overwritten.
  void (*class_results)(View<Real> logits, const ClassResults<Real>& results) = nullptr;
  /// Of every ray (model/compositor.h).
  void (*opacity_resolutions)(const Samples<Real>& samples, View<const Real> weight, FarMode far,
                              double footprint_per_m, View<OpacityResolution> result) = nullptr;

  /// One update of all learned tensors, whose gradients of touched rows are 0 afterwards; on a device all gradients.
  /// `step` lies where the tensors do.
  void (*adam)(const AdamStep* step, const AdamTable<Real>& table) = nullptr;

  /// Values must be finite, a row per sample or per ray. A CPU throws RayFault; a device notes the fault, and may
  /// leave a value to the stage that makes or reads it.
  void (*guard)(const GuardPlace<Real>& place, Guarded value, View<const Real> values) = nullptr;
  /// Density after activation must be in [0, inf); null: density_forward looked.
  void (*guard_density)(const GuardPlace<Real>& place, View<const Real> sigma) = nullptr;
  /// The same for positions that belong to no ray.
  void (*guard_density_at)(View<const double> positions, View<const Real> raw, View<const Real> sigma) = nullptr;
};

/// Those of the CPU.
template <class Real>
const Stages<Real>& cpu_stages();

/// Stages work on the rows in use while it lives.
template <class Real>
class LiveRows : NonCopyable {
 public:
  /// count: device memory; null: all rows.
  LiveRows(const Stages<Real>& stages, const std::int32_t* count) : set_(stages.set_live_rows) {
    if (set_ != nullptr) before_ = set_(count);
  }
  LiveRows(const Stages<Real>& stages, const Samples<Real>& samples)
      : LiveRows(stages, samples.first.data + samples.first.rows - 1) {}
  ~LiveRows() {
    if (set_ != nullptr) (void)set_(before_);
  }

 private:
  const std::int32_t* (*set_)(const std::int32_t*);
  const std::int32_t* before_ = nullptr;
};

// Values of rays that no later stage may see: found at the stage that made them, named by pass, ray and sample.

/// An error that belongs to one ray. Who knows the rays' pixels adds frame and pixel.
class RayFault : public Error {
 public:
  /// `ray` counts within the batch of a step, or within the call that rendered.
  RayFault(std::int64_t ray, ErrorKind kind, Code code, std::string message, std::string remedy = {});
  std::int64_t ray() const noexcept { return ray_; }

 private:
  std::int64_t ray_;
};

/// The remedy of a value that left the numbers during training.
std::string_view fault_remedy();

/// Rays of a call as they come in: origin, direction and limits of each must be finite, and colours where they are
/// given ([R, 3], else empty). Throws RayFault; first_ray is added to its number.
template <class Real>
void guard_rays(const Rays<Real>& rays, View<const float> target, std::int64_t first_ray);

/// The checks of one tile of one pass. Every value is looked at, as whole arrays: a tile costs a reading of what is in
/// cache. Both throw RayFault for the first bad value. `place.samples` may lack t (rounds of rendering): then a message
/// names the ray alone.

/// Distances finite, intervals finite and not negative, coordinates x [M, 3] finite.
template <class Real>
void guard_samples(const GuardPlace<Real>& place, View<const double> x);
/// values, a row per sample or per ray, each finite: Stages::guard of a CPU.
template <class Real>
void guard_values(const GuardPlace<Real>& place, Guarded value, View<const Real> values);

}  // namespace semfield
