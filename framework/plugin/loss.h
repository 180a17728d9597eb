// Loss: a term in addition to colour and cross-entropy, what it reads of rays, what it gives, and its parameters.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/check.h"
#include "core/error.h"
#include "core/view.h"
#include "plugin/kernels.h"

namespace semfield {

// Named channels: what rays carry in addition to what every ray has, as a small table of views by name.

/// Names of the channels that the framework itself fills. Targets, a row per ray of a batch:
///   color       [R, 3] in [0, 1]
///   label       [R, 1] class, negative: none
///   soft_label  [R, C] class probabilities; a row of zeros: none
///   depth       [R, 1] metres along the ray; 0: unknown
///   alpha       [R, 1] how much of the pixel the subject covers, 0 to 1; negative: unknown
///   camera      [R, 1] number of the training camera
/// Outputs of a pass, a row per ray:
///   color       [R, 3]
///   depth       [R, 1] sum of w t, metres along the ray
///   opacity     [R, 1] sum of w
///   logits      [S, C] of the first S rays, those behind them have no label
/// and a row per sample: weight [M, 1], sigma [M, 1] 1/m after activation.
namespace channel {
inline constexpr std::string_view color = "color", label = "label", soft_label = "soft_label", depth = "depth",
                                  alpha = "alpha", camera = "camera", opacity = "opacity", weight = "weight",
                                  sigma = "sigma", logits = "logits";
}  // namespace channel

/// Most channels that a table holds.
inline constexpr std::size_t kMostChannels = 8;

/// Views by name, all of the same rows. It owns neither: names and numbers outlive the table. Copies allocate nothing.
template <class T>
class ChannelTable {
 public:
  struct Channel {
    std::string_view name;
    View<T> view;
  };

  ChannelTable() = default;
  template <class Other>
  ChannelTable(const ChannelTable<Other>& other) {  // NOLINT: of const views
    for (const auto& one : other) set(one.name, one.view);
  }

  /// An empty view where no channel has the name.
  View<T> operator[](std::string_view name) const {
    for (const Channel& one : *this)
      if (one.name == name) return one.view;
    return {};
  }
  /// Adds a channel, or replaces that of this name.
  void set(std::string_view name, View<T> view) {
    for (std::size_t i = 0; i < count_; ++i) {
      if (all_[i].name != name) continue;
      all_[i].view = view;
      return;
    }
    SEMFIELD_CHECK(count_ < kMostChannels, "too many channels");
    all_[count_++] = {name, view};
  }
  /// Rows [begin, begin + count) of every channel that has any.
  ChannelTable row_range(std::int64_t begin, std::int64_t count) const {
    ChannelTable out;
    for (const Channel& one : *this) out.set(one.name, one.view.empty() ? one.view : one.view.row_range(begin, count));
    return out;
  }

  std::size_t size() const { return count_; }
  const Channel* begin() const { return all_.data(); }
  const Channel* end() const { return all_.data() + count_; }
  Channel* begin() { return all_.data(); }
  Channel* end() { return all_.data() + count_; }

 private:
  std::array<Channel, kMostChannels> all_{};
  std::size_t count_ = 0;
};

/// What the rays of a batch, or of a tile of one, are compared with. R rows each; empty: not known.
struct RayTargets {
  View<const float> color;         ///< [R, 3] in [0, 1]
  View<const std::int16_t> label;  ///< [R, 1] class, negative: none
  ChannelTable<const float> more;  ///< [R, K] each: soft_label, depth and whatever else the losses read
};

/// What a pass makes of the rays. M samples: row m of t, delta, sigma and weight.
template <class Real>
struct RayValues {
  View<const double> near_far;     ///< [R, 2] metres along the ray; near == far: an empty ray
  View<const std::int32_t> first;  ///< [R+1, 1]: ray r owns samples first[r] .. first[r+1] - 1, t ascending
  View<const Real> t, delta;       ///< metres along the ray, and length of the sample's interval
  View<const Real> sigma;          ///< 1/m, after activation
  View<const Real> weight;         ///< compositing weights
  View<const Real> color;          ///< [R, 3]
  View<const Real> depth;          ///< [R, 1] sum of w t, metres along the ray
  View<const Real> opacity;        ///< [R, 1] sum of w
  ChannelTable<const Real> heads;  ///< what heads make, by name: logits [S, C]. Rays from S on have no row
  double unit_m = 1;               ///< rendering.unit_m: losses by distance divide by it
};

/// dL/d(values). Losses add to them; those that no loss moves may be empty.
template <class Real>
struct RayGradients {
  View<Real> color;          ///< [R, 3]
  View<Real> depth;          ///< [R, 1]
  View<Real> weight;         ///< [M, 1]; a gradient of opacity is the same value at all samples of the ray
  View<Real> sigma;          ///< [M, 1] direct, in addition to what the other gradients make of it
  ChannelTable<Real> heads;  ///< of RayValues::heads, the same shapes
};

/// A loss and its slope.
struct LossValue {
  double value = 0, slope = 0;
};

/// What every loss of the list has; the parameters of a loss derive from it and set their own defaults.
struct LossRule {
  double weight = 0;     ///< factor relative to the colour loss
  double from_step = 0;  ///< share of train.steps (step_of_share)
};
inline void describe_rule(ParamVisitor& visit, LossRule& p) {
  SEMFIELD_PARAM(visit, p, weight, "factor of the term relative to the colour loss", {0, 1e6});
  SEMFIELD_PARAM(visit, p, from_step,
                 "share of train.steps after which the term begins, and never before train.schedule.hold_steps",
                 {0, 1});
}

/// The channels of a loss, by name.
struct LossTraits {
  std::vector<std::string_view> targets{};  ///< those that it cannot do without
  std::vector<std::string_view> heads{};    ///< of RayValues::heads that it reads
  /// Gradients that it adds to: color, depth, weight and sigma, or channels of heads. One that moves a head's channel
  /// moves heads' channels alone, because a semantic branch takes its gradients before the rest of the pass.
  std::vector<std::string_view> moves{};

  bool reads_target(std::string_view name) const { return holds(targets, name); }
  bool reads_head(std::string_view name) const { return holds(heads, name); }
  bool does_move(std::string_view name) const { return holds(moves, name); }

 private:
  static bool holds(const std::vector<std::string_view>& names, std::string_view name) {
    for (const std::string_view one : names)
      if (one == name) return true;
    return false;
  }
};

class Loss;

/// One call of a loss on a device; all views and pointers are the device's memory.
struct LossCall {
  RayTargets targets;
  RayValues<float> values;
  RayGradients<float> gradients;
  const double* scale = nullptr;  ///< as in Loss::add
  double* of_ray = nullptr;       ///< [R] gets each ray's loss, 0 for a ray that does not count
};
/// As Loss::add, queued where the device works.
using LossKernel = void (*)(const Loss& loss, const LossCall& call);
/// The table of a loss on a device; NAME_cuda.cu adds that of its class as "loss 'NAME'".
template <class Term>
struct LossKernels {
  LossKernel add = nullptr;
};

/// All calls are const: a loss owns its parameters and constants only.
class Loss {
 public:
  virtual ~Loss() = default;
  virtual LossRule rule() const = 0;
  virtual LossTraits traits() const = 0;
  /// Rays of a whole batch that the mean is taken over; 0: the loss is 0 for the batch. Host memory.
  virtual std::int64_t counted_rays(const RayTargets&, std::int64_t rays) const { return rays; }
  /// Sum over the rays, before weight and division, and `scale` times its gradients into `gradients`. One thread; a
  /// ray's share depends on that ray alone. Samples are views of a whole tile; `first` holds places in them.
  virtual double add(const RayTargets& targets, const RayValues<float>& values, double scale,
                     const RayGradients<float>& gradients) const = 0;
  virtual double add(const RayTargets& targets, const RayValues<double>& values, double scale,
                     const RayGradients<double>& gradients) const = 0;
  /// Throws Error(unavailable): "loss 'glow' has no cuda kernels in this build (has: none)".
  virtual LossKernel kernel(Device device, std::string_view owner, const KernelTables& tables) const = 0;
};

/// Base of a loss with parameters (derived from LossRule, with describe() and, where needed, validate()), whose one
/// code for both precisions is `template <class Real> double sum(targets, values, scale, gradients) const`.
template <class Term, class ParamsOfTerm>
class LossOf : public Loss {
 public:
  using Params = ParamsOfTerm;
  explicit LossOf(const Params& p = {}) : params(p) {}
  Params params;

  LossRule rule() const final { return params; }
  double add(const RayTargets& targets, const RayValues<float>& values, double scale,
             const RayGradients<float>& gradients) const final {
    return static_cast<const Term&>(*this).template sum<float>(targets, values, scale, gradients);
  }
  double add(const RayTargets& targets, const RayValues<double>& values, double scale,
             const RayGradients<double>& gradients) const final {
    return static_cast<const Term&>(*this).template sum<double>(targets, values, scale, gradients);
  }
  LossKernel kernel(Device device, std::string_view owner, const KernelTables& tables) const final {
    return tables.get<LossKernels<Term>>(device, owner).add;
  }
};

}  // namespace semfield
