// A head behind a branch of its own: rows of its channel for the first rays of a call, and their gradients. Weights are
// constants to it, and nothing flows back into the field: what it learns changes no bit of the rest of the pass.
#pragma once

#include <string>

#include "model/head_branch.h"
#include "plugin/head/head.h"

namespace semfield {

/// What forward leaves for backward; lives in the tile's workspace.
template <class Real>
struct HeadTrace {
  BranchTrace<Real> branch;  ///< its K kept samples are the rows of `hidden`
  View<Real> hidden;         ///< [K, H]
  View<Real> sample_rows;    ///< [K, C]; only with the deferral switched off
  View<Real> ray_hidden;     ///< [R, H]
  View<Real> rows;           ///< [R, C] the channel
};

template <class Real>
class BranchedHead {
 public:
  /// Adds the tensors of head and branch to `store` under `prefix`, "PASS/semantic" or "PASS/heads/CHANNEL". Throws
  /// Error(config) where the branch's encoder learns. Borrows all. `deferred`: the output layer once per ray.
  BranchedHead(const Head<Real>& head, const BranchParts<Real>& branch, const BranchPlace& place, bool deferred,
               TensorStore<Real>& store, const Stages<Real>& stages);

  const HeadBranch<Real>& branch() const { return branch_; }
  Tensors<Real> tensors(int lane) const { return store_->tensors(component_, lane); }

  /// All of it in ctx.workspace. Neither call touches what the pass's own do, so both may run beside them.
  HeadTrace<Real> forward(const StepContext& ctx, int lane, const BranchCall<Real>& call) const;
  /// Gradients from d_rows [R, C] into the lane's.
  void backward(const StepContext& ctx, int lane, const HeadTrace<Real>& trace, View<const Real> d_rows) const;

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;

 private:
  const Head<Real>* head_;
  TensorStore<Real>* store_;
  const Stages<Real>* stages_;
  std::string pass_;
  Guarded guarded_;  // what its rows are
  bool deferred_;
  int component_;
  HeadBranch<Real> branch_;
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

extern template class BranchedHead<float>;
extern template class BranchedHead<double>;

}  // namespace semfield
