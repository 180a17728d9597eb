// A head behind a branch of its own: rows of its channel for the first rays of a call, and their gradients. Weights are
// constants to it, and nothing flows back into the field: what it learns changes no bit of the rest of the pass.
#pragma once

#include <memory>
#include <string>

#include "core/workspace.h"
#include "model/param_store.h"
#include "model/render_rules.h"
#include "model/stages.h"
#include "plugin/encoder.h"
#include "plugin/field.h"
#include "plugin/head.h"
#include "plugin/sampler.h"

namespace semfield {

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
  void encode_points(const StepContext& ctx, View<const double> positions, View<Real> input) const {
    Workspace& arena = *ctx.workspace;
    const Workspace::Scope scope(arena);
    const View<double> x = arena.take<double>(positions.rows, 3);
    stages_->map_positions(positions, branch_->domain, x);
    branch_->position->forward(ctx, store_->tensors(position_), x,
                               input.col_range(0, branch_->position->traits().out_dims));
  }
  /// The branch at single samples, whose inputs are known: input [K, input_dims], one sample per ray.
  BranchTrace<Real> forward_points(const StepContext& ctx, int lane, View<const Real> input) const;
  /// d_feature [K, B] of trace.feature; it is changed (dropout). Gradients go into the lane's.
  void branch_backward(const StepContext& ctx, int lane, const BranchTrace<Real>& trace, View<Real> d_feature) const;

  void derive(const StepContext& ctx) const {
    head_->derive(ctx, store_->tensors(head_tensors_));
    branch_->position->derive(ctx, store_->tensors(position_));
    branch_->field->derive(ctx, store_->tensors(field_));
  }
  void derive_backward(const StepContext& ctx) const {
    head_->derive_backward(ctx, store_->tensors(head_tensors_));
    branch_->position->derive_backward(ctx, store_->tensors(position_));
    branch_->field->derive_backward(ctx, store_->tensors(field_));
  }

 private:
  static FieldIn<Real> field_in(const BranchTrace<Real>& trace) {
    return {.position = trace.input, .ray_of_sample = trace.samples.ray_of_sample};
  }
  BranchTrace<Real> branch_forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const;
  void run_network(const StepContext& ctx, int lane, BranchTrace<Real>& trace) const {
    branch_->field->forward(ctx, store_->tensors(field_, lane), field_in(trace), trace.out, trace.saved);
    if (drops_out(trace)) stages_->drop_out(dropout(ctx), trace.samples, trace.out.feature, trace.feature);
  }
  void take_outputs(const StepContext& ctx, std::int64_t rows, std::int64_t rays, BranchTrace<Real>& trace) const;
  bool drops_out(const BranchTrace<Real>& trace) const { return trace.feature.data != trace.out.feature.data; }
  Dropout dropout(const StepContext& ctx) const {
    const std::string name = place_.semantic ? kBranchDropout : place_.prefix + "/" + kBranchDropout;
    return {ctx.random(name), ctx.first_ray, branch_->rules.dropout};
  }

  const Head<Real>* head_;
  const BranchParts<Real>* branch_;
  BranchPlace place_;
  bool deferred_;
  TensorStore<Real>* store_;
  const Stages<Real>* stages_;
  int head_tensors_, position_, field_;
};

}  // namespace semfield
