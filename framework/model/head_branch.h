// A network of its own for what a head reads: smooth where the pass's field is sharp, and run on the samples that weigh
// alone.
#pragma once

#include <memory>
#include <string>
#include <string_view>

#include "core/host_device.h"
#include "core/rng.h"
#include "model/param_store.h"
#include "model/render_rules.h"
#include "model/stages.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/sampler.h"

namespace semfield {

struct BranchRules {
  bool reads_feature = true;   ///< the field's feature beside the position; no gradient goes back into the field
  double least_weight = 1e-3;  ///< samples of a smaller compositing weight are left out
  double dropout = 0;          ///< share of feature values that a training step sets to 0 [Srivastava14]
  double learning_rate = 1;    ///< of branch and head, as a factor to the run's
  double weight_decay = 0;     ///< of branch and head: share of a value times the learning rate [Loshchilov19]
  LearningRule learning(bool semantic) const { return {learning_rate, weight_decay, semantic}; }
};

template <class Real>
struct BranchParts {
  std::unique_ptr<Encoder<Real>> position;  ///< without learned tensors
  std::unique_ptr<Field<Real>> field;       ///< asked for its feature alone, and given no direction
  DomainMap domain;
  BranchRules rules;
};

/// Where the tensors of a branch and its head lie, and whose they are.
struct BranchPlace {
  std::string prefix;     ///< of their names: "PASS/semantic" or "PASS/heads/CHANNEL"
  std::string pass;       ///< for messages
  bool semantic = false;  ///< they stay as they are in a step without labels
};

/// The samples of a pass that a branch is to read: those of its first `count` rays, which have at most `most`.
template <class Real>
struct BranchCall {
  const Rays<Real>* rays = nullptr;
  const Samples<Real>* samples = nullptr;
  View<const Real> weight;   ///< [M, 1] compositing weights
  View<const Real> feature;  ///< [M, F] of the field; empty unless the branch reads it
  std::int64_t count = 0, most = 0;
};

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

// A head behind a branch of its own: rows of its channel for the first rays of a call, and their gradients. Weights are
// constants to it, and nothing flows back into the field: what it learns changes no bit of the rest of the pass.

/// What forward leaves for backward; lives in the tile's workspace.
template <class Real>
struct HeadTrace {
  BranchTrace<Real> branch;  ///< its K kept samples are the rows of `hidden`
  View<Real> hidden;         ///< [K, H]
  View<Real> sample_rows;    ///< [K, C]; only with the deferral switched off
  View<Real> ray_hidden;     ///< [R, H]
  View<Real> rows;           ///< [R, C] the channel
};

/// A ray's row = sum over its kept samples of weight times what the head makes of the branch's feature. Weights are
/// constants: labels do not shape density. Leaving out samples of weight below w changes a value by at most the sum of
/// the weights left out times the largest value of a sample.
template <class Real>
class BranchedHead {
 public:
  /// Adds the tensors of head and branch to `store`. Throws Error(config) where the branch's encoder learns. Borrows
  /// all. `deferred`: the output layer once per ray.
  BranchedHead(const Head<Real>& head, const BranchParts<Real>& branch, const BranchPlace& place, bool deferred,
               TensorStore<Real>& store, const Stages<Real>& stages);

  const BranchRules& rules() const { return branch_->rules; }
  /// Of the head.
  Tensors<Real> tensors(int lane) const { return store_->tensors(head_tensors_, lane); }

  /// All of it in ctx.workspace. Neither call touches what the pass's own do, so both may run beside them.
  HeadTrace<Real> forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const;
  /// Gradients from d_rows [R, C] into the lane's.
  void backward(const StepContext& ctx, int lane, const HeadTrace<Real>& trace, View<const Real> d_rows) const;

  /// Columns of the branch's input: the encoded position, and behind it `feature_dims` of the field's feature where it
  /// is read.
  std::int32_t input_dims(std::int32_t feature_dims) const {
    return branch_->position->traits().out_dims + (branch_->rules.reads_feature ? feature_dims : 0);
  }
  /// The first columns of input [N, input_dims] at world positions [N, 3].
  void encode_points(const StepContext& ctx, View<const double> positions, View<Real> input) const;
  /// The branch at single samples, whose inputs are known: input [K, input_dims], each sample a ray of its own.
  BranchTrace<Real> forward_points(const StepContext& ctx, int lane, View<const Real> input) const;
  /// d_feature [K, B] of trace.feature; it is changed (dropout). Gradients go into the lane's.
  void branch_backward(const StepContext& ctx, int lane, const BranchTrace<Real>& trace, View<Real> d_feature) const;

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;

 private:
  BranchTrace<Real> branch_forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const;
  void run_network(const StepContext& ctx, int lane, BranchTrace<Real>& trace) const;
  void take_outputs(const StepContext& ctx, std::int64_t rows, std::int64_t rays, BranchTrace<Real>& trace) const;
  bool drops_out(const BranchTrace<Real>& trace) const { return trace.feature.data != trace.out.feature.data; }
  Dropout dropout(const StepContext& ctx) const;

  const Head<Real>* head_;
  const BranchParts<Real>* branch_;
  BranchPlace place_;
  bool deferred_;
  TensorStore<Real>* store_;
  const Stages<Real>* stages_;
  int head_tensors_, position_, field_;
};

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

}  // namespace semfield
