// One pass over a tile or batch of rays: sample, encode, field, semantic head, composite; and the same backward.
// Written on the stages of a device (model/stages.h).
#pragma once

#include <algorithm>
#include <array>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/workspace.h"
#include "model/branched_head.h"
#include "model/compositor.h"
#include "model/param_store.h"
#include "model/render_rules.h"
#include "model/stages.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/loss.h"
#include "plugin/sampler.h"

namespace semfield {

/// Axes of a channel [source, width]: a state that no step changes.
template <class Real>
class ChannelAxes final : public Parametric<Real> {
 public:
  ChannelAxes(std::int32_t source, std::int32_t width) : source_(source), width_(width) {}
  void declare(ParamDeclarer& declarer) const override {
    declarer.tensor({"axes", source_, width_, {}, TensorRole::state});
  }

 private:
  std::int32_t source_, width_;
};

/// A head beside that of class logits.
template <class Real>
struct HeadParts {
  std::string channel;            ///< that it makes
  std::int32_t source_width = 0;  ///< columns of the dataset's channel, of which it makes principal axes; 0: the same
  std::unique_ptr<Head<Real>> head;
  std::unique_ptr<BranchParts<Real>> branch;
};

template <class Real>
struct PassParts {
  std::string name;
  std::uint32_t number = 0;  ///< in the configuration: addresses its random values, whichever passes are left out
  std::unique_ptr<Sampler<Real>> sampler;
  std::unique_ptr<Encoder<Real>> position;
  std::unique_ptr<Encoder<Real>> direction;  ///< null: the view branch is left out
  std::unique_ptr<Field<Real>> field;
  std::unique_ptr<Head<Real>> head;           ///< of class logits; null: no semantics
  std::unique_ptr<BranchParts<Real>> branch;  ///< null: that head reads the field's feature
  std::vector<HeadParts<Real>> heads;         ///< others
  DomainMap domain;
  const Stages<Real>* stages = &cpu_stages<Real>();  ///< of the device that all parts were built for
};

/// What forward leaves for backward and for the next pass; lives in the tile's workspace.
template <class Real>
struct PassTrace {
  Samples<Real> samples;
  Samples<Real> drawn;   ///< of which these are; the same, unless rendering.training_stop left some out
  View<double> x;        ///< [M, 3] encoder coordinates
  View<Real> encoded;    ///< [M, Dp]
  View<Real> direction;  ///< [R, Dd]
  FieldOut<Real> out;    ///< sigma is raw
  View<Real> sigma;      ///< [M, 1] after activation, 1/m
  View<Real> weight;     ///< [M, 1]
  Saved saved;
  std::int64_t semantic_rays = 0;     ///< rays 0..n-1 carry semantics
  std::int64_t semantic_samples = 0;  ///< their samples come first
  bool with_heads = false;            ///< PassRequest::heads
  /// Of class logits, the rows; without a branch its samples are the semantic samples.
  HeadTrace<Real> semantic;
  View<Bf16> rounded_hidden;  ///< semantic.hidden in bf16, in its place, where head and field exchange such numbers
  std::array<HeadTrace<Real>, kMostHeads> heads;  ///< of PassParts::heads, where they are wanted
  // Results per ray.
  View<Real> color;    ///< [R, 3]
  View<Real> depth;    ///< [R, 1] metres along the ray
  View<Real> opacity;  ///< [R, 1]
};

/// What Pass::point_forward leaves for point_backward.
template <class Real>
struct PointTrace {
  BranchTrace<Real> branch;  ///< of a pass with a branch
  View<const Real> feature;  ///< [N, F] that the head read
  View<Real> hidden;         ///< [N, H]
};

/// Coordinates and gradients at encoder outputs that a lane's tiles leave for the scatter after them.
template <class Real>
struct EncoderInbox {
  std::vector<double> x;
  std::vector<Real> dy;
  std::int64_t rows = 0;

  /// Rows for a tile's gradients [x.rows, dims] behind the lane's earlier tiles; vectors keep their capacity, so a
  /// steady state allocates nothing. Valid until the next append.
  View<Real> append(View<const double> tile_x, std::int32_t dims);
};

/// Samples of rays, with the encoder's output for them where that was made ahead (empty views: made by forward).
template <class Real>
struct SampledTile {
  Samples<Real> samples;
  View<double> x;            ///< [M, 3] encoder coordinates
  View<Real> encoded;        ///< [M, Dp]
  std::int64_t per_ray = 0;  ///< most samples of a ray
  bool reached = false;      ///< what training leaves out is left out
};

/// What a call of Pass::forward is asked for.
struct PassRequest {
  std::int64_t semantic_rays = 0;  ///< the first rays of the call, which get logits
  bool colors = true;              ///< false: weights alone are wanted, for a later pass
  bool heads = false;              ///< channels of PassParts::heads are wanted, of every ray
  std::int64_t room = 0;  ///< for samples, on a device (SamplerTraits::keeps_to_room); 0: for as many as there can be
  std::int64_t reached_room = 0;  ///< the same for samples that light reaches
};

/// Samples that a ray advances in rendering before early stop is tested.
inline constexpr std::int64_t kRoundSamples = 8;

template <class Real>
class Pass {
 public:
  /// Adds the parts' tensors to `store`, which it borrows, under the pass's name.
  Pass(PassParts<Real> parts, const RenderRules& rules, TensorStore<Real>& store);

  const PassParts<Real>& parts() const { return parts_; }
  const RenderRules& rules() const { return rules_; }
  /// Most samples per ray.
  std::int64_t capacity_per_ray(std::int64_t previous_per_ray, bool training) const {
    return parts_.sampler->capacity(1, previous_per_ray, training);
  }
  bool scatters() const { return encoder_learns_; }
  bool has_branch() const { return branched_.has_value(); }
  /// What losses see of it; channels of heads are those that were computed.
  RayValues<Real> values_of(View<const double> near_far, const PassTrace<Real>& trace) const;

  /// Everything of the rays, in ctx.workspace (the caller's scope keeps it until backward is done). A value of a stage
  /// that is not finite is a fault: RayFault on a CPU (model/stages.h). In training a pass leaves what stands behind
  /// branches to branch_forward and heads_forward.
  PassTrace<Real> forward(const StepContext& ctx, int lane, const Rays<Real>& rays, const Proposal<Real>* previous,
                          std::int64_t previous_per_ray, const PassRequest& request) const;

  /// The two steps that forward begins with, for callers that take them ahead: samples of `rays` into `out`, and
  /// encoder coordinates x [samples.count, 3].
  void sample(const StepContext& ctx, const Rays<Real>& rays, const Proposal<Real>* previous,
              Samples<Real>& out) const {
    parts_.sampler->sample(ctx, store_->tensors(sampler_), rays, previous, out);
  }
  void locate(const StepContext& ctx, const Rays<Real>& rays, const Samples<Real>& samples, View<double> x) const {
    stages_->locate(place(ctx, samples), rays, parts_.domain, x);
  }
  /// encoded [N, Dp] from x [N, 3].
  void encode(const StepContext& ctx, int lane, View<const double> x, View<Real> encoded) const {
    parts_.position->forward(ctx, store_->tensors(position_, lane), x, encoded);
  }
  std::int32_t encoded_dims() const { return parts_.position->traits().out_dims; }
  /// The samples of a tile that light reaches, with their coordinates, where training leaves out the others
  /// (rendering.training_stop); else the tile. At most `room` of them on a device, 0: all.
  SampledTile<Real> reached(const StepContext& ctx, int lane, const Rays<Real>& rays, const SampledTile<Real>& tile,
                            std::int64_t room) const;
  /// The rest of forward.
  PassTrace<Real> forward(const StepContext& ctx, int lane, const Rays<Real>& rays, const SampledTile<Real>& tile,
                          const PassRequest& request) const;

  /// Gradients from d (an empty view but for color: zero) and d_logits [semantic_rays, C] (empty: zero, and with a
  /// branch) into the lane's gradients, and into d_encoded [M, Dp] (empty: not wanted), which the position encoder must
  /// scatter.
  void backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace, const RayGradients<Real>& d,
                View<const Real> d_logits, View<Real> d_encoded) const;

  /// Logits of the semantic rays by way of the branch, and its gradients from them. Neither touches what backward does,
  /// so both may run beside it, with a workspace of their own.
  void branch_forward(const StepContext& ctx, int lane, const Rays<Real>& rays, PassTrace<Real>& trace) const {
    trace.semantic = branched_->forward(ctx, lane, branch_call(rays, trace, trace.semantic_rays));
  }
  void branch_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                       View<const Real> d_logits) const {
    branched_->backward(ctx, lane, trace.semantic, d_logits);
  }
  /// The same of the other heads, of every ray: d_heads has a view [R, C] per head, by its channel.
  void heads_forward(const StepContext& ctx, int lane, const Rays<Real>& rays, PassTrace<Real>& trace) const {
    for (std::size_t i = 0; i < heads_.size(); ++i)
      trace.heads[i] = heads_[i].forward(ctx, lane, branch_call(rays, trace, rays.origin.rows));
  }
  void heads_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace,
                      const ChannelTable<const Real>& d_heads) const {
    for (std::size_t i = 0; i < heads_.size(); ++i)
      heads_[i].backward(ctx, lane, trace.heads[i], d_heads[parts_.heads[i].channel]);
  }

  /// [source_width, C] of a head that makes principal axes of a channel: state, which the framework fills; else empty.
  View<Real> axes(std::string_view channel) const {
    for (std::size_t i = 0; i < heads_.size(); ++i)
      if (parts_.heads[i].channel == channel && axes_[i] >= 0) return store_->tensors(axes_[i]).value[0];
    return {};
  }

  /// d_ray [R, 6] += gradients of the rays' origins and directions by way of the samples' positions, from the d_encoded
  /// that backward left. What colour owes to the direction alone is not in it.
  void ray_gradient(const StepContext& ctx, const Rays<Real>& rays, const PassTrace<Real>& trace,
                    View<const Real> d_encoded, View<Real> d_ray) const;

  /// Encoder scatter of gradients dy [N, Dp] at coordinates x [N, 3]; outside parallel regions.
  void scatter(const StepContext& ctx, View<const double> x, View<const Real> dy) const {
    if (x.rows == 0) return;
    parts_.position->backward(ctx, store_->tensors(position_), x, dy, {});
  }

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;
  /// After a step: the sampler may ask `query` for densities.
  void observe(const StepContext& ctx, const DensityQuery<Real>& query) const {
    if (parts_.sampler->traits().observes) parts_.sampler->observe(ctx, store_->tensors(sampler_), query);
  }
  /// The same with densities of this pass, one query after the other.
  void observe(const StepContext& ctx) const {
    observe(ctx, [&](View<const double> positions, View<Real> sigma) { density(ctx, positions, sigma); });
  }

  /// sigma [N, 1] after activation at world positions [N, 3].
  void density(const StepContext& ctx, View<const double> positions, View<Real> sigma) const;

  /// color [N, 3] of samples at world positions [N, 3] seen along unit directions [N, 3]. Host memory.
  void point_colors(const StepContext& ctx, View<const double> positions, View<const double> directions,
                    View<Real> color) const;

  /// Semantics of points of the last pass, apart from rays; only where parts().head stands.
  /// Numbers of a point that labels do not shape where the pass has a branch: its encoded position and what it reads of
  /// the field. Without a branch the field's feature.
  std::int32_t point_dims() const {
    const std::int32_t feature = parts_.field->traits().feature_dims;
    return branched_ ? branched_->input_dims(feature) : feature;
  }
  /// rows [N, point_dims()] at world positions [N, 3].
  void point_rows(const StepContext& ctx, View<const double> positions, View<Real> rows) const;
  /// logits [N, C] of a sample of weight 1 with these rows; the trace lies in ctx.workspace and borrows `rows`.
  PointTrace<Real> point_forward(const StepContext& ctx, int lane, View<const Real> rows, View<Real> logits) const;
  /// Gradients from d_logits [N, C] into the lane's, of head and branch alone.
  void point_backward(const StepContext& ctx, int lane, const PointTrace<Real>& trace, View<const Real> d_logits) const;

 private:
  PassTrace<Real> forward_all(const StepContext& ctx, int lane, const Rays<Real>& rays, const SampledTile<Real>& tile,
                              const PassRequest& request) const;
  void evaluate(const StepContext& ctx, int lane, PassTrace<Real>& trace, bool colors) const;
  void evaluate_in_rounds(const StepContext& ctx, int lane, PassTrace<Real>& trace, bool colors) const;
  void composite(const StepContext& ctx, int lane, PassTrace<Real>& trace) const;
  void hidden_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace, View<Real> d_hidden,
                       FieldGrad<Real>& grad) const;
  void rounded_backward(const StepContext& ctx, int lane, const PassTrace<Real>& trace, View<const Real> d_ray_hidden,
                        View<Real> dots, FieldGrad<Real>& grad) const;
  /// True when the field's feature is wanted of every sample of the rays with semantics, or of all rays.
  bool wants_feature() const { return parts_.head && (!branched_ || branched_->rules().reads_feature); }
  bool heads_want_feature() const {
    return std::any_of(heads_.begin(), heads_.end(), [](const auto& head) { return head.rules().reads_feature; });
  }
  bool wants_feature(const PassTrace<Real>& trace) const {
    return (trace.semantic_rays > 0 && wants_feature()) || (trace.with_heads && heads_want_feature());
  }
  /// [N, Dp] in ctx.workspace at world positions [N, 3].
  View<Real> encoded_at(const StepContext& ctx, View<const double> positions) const;
  BranchCall<Real> branch_call(const Rays<Real>& rays, const PassTrace<Real>& trace, std::int64_t count) const {
    const std::int64_t most = count == trace.semantic_rays ? trace.semantic_samples : trace.samples.count;
    return {&rays, &trace.samples, trace.weight, trace.out.feature, count, most};
  }
  /// How field and head exchange it in training and rendering, without a branch.
  FeatureForm feature_form(const PassTrace<Real>& trace) const;
  CompositeIn<Real> composite_in(const PassTrace<Real>& trace) const {
    return {.samples = &trace.samples,
            .sigma = trace.sigma,
            .rgb = trace.out.rgb,
            .far = rules_.rendering.far,
            .background = rules_.background()};
  }
  DensityRule density_rule(const StepContext& ctx) const {
    DensityRule rule{.activation = rules_.rendering.density_activation,
                     .per_m = 1 / rules_.unit_m,
                     .bias = rules_.rendering.density_bias,
                     .first_ray = ctx.first_ray};
    if (!ctx.training || rules_.rendering.density_noise <= 0) return rule;
    rule.deviation = rules_.rendering.density_noise;
    rule.random = ctx.random("density_noise");
    return rule;
  }
  GuardPlace<Real> place(const StepContext& ctx, const Samples<Real>& samples) const {
    return {parts_.name, ctx.first_ray, &samples};
  }
  Tensors<Real> head_tensors(int lane) const {
    return branched_ ? branched_->tensors(lane) : store_->tensors(head_, lane);
  }

  PassParts<Real> parts_;
  std::optional<BranchedHead<Real>> branched_;  // of class logits
  std::vector<BranchedHead<Real>> heads_;       // of PassParts::heads, in their order
  std::vector<int> axes_;                       // of each; -1: none
  RenderRules rules_;
  TensorStore<Real>* store_;
  const Stages<Real>* stages_;
  int sampler_ = 0, position_ = 0, direction_ = -1, field_ = 0, head_ = -1;
  bool encoder_learns_ = false;
};

}  // namespace semfield
