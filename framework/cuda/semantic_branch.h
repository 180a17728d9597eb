// The semantic branch of a pass on the device, twin of model/semantic_branch.
#pragma once

#include "cuda/store.h"
#include "model/semantic_branch.h"

namespace semfield::cuda {

class Branch {
 public:
  /// Borrows the parts, which were built for the device; their tensors must follow in `store`.
  Branch(const SemanticBranchParts<float>& parts, Store& store);

  /// As SemanticBranch::forward. The trace's views have `most` rows; samples.first tells how many are kept.
  SemanticBranchTrace<float> forward(const StepContext& ctx, const Rays<float>& rays, const Samples<float>& samples,
                                     View<const float> weight, View<const float> feature, std::int64_t semantic_rays,
                                     std::int64_t most) const;
  /// d_feature [most, B] is changed; its rows behind those kept are 0.
  void backward(const StepContext& ctx, const SemanticBranchTrace<float>& trace, View<float> d_feature) const;

  void derive(const StepContext& ctx) const;
  void derive_backward(const StepContext& ctx) const;

 private:
  const SemanticBranchParts<float>& parts_;
  Store* store_;
  int position_ = 0, field_ = 0;
};

/// The launch of stages that work on the rows of kept samples.
Launch kept_rows(const Samples<float>& kept);

/// Samples of the first kept.first.rows - 1 rays with weight >= least and > 0, in order: kept.first, kept.t, delta and
/// ray_of_sample, source, weight, and a ray's sum of weights into share. Rows behind them get t = delta = weight =
/// source = 0 and the last ray's number.
void keep_samples(const Samples<float>& samples, View<const float> weight, float least,
                  const SemanticBranchTrace<float>& kept);
/// trace.input = [position, row `source` of feature]; feature may be empty. Rows behind those kept are 0.
void join_inputs(const SemanticBranchTrace<float>& trace, View<const float> position, View<const float> feature);
/// to = from with a share of its values set to 0 and the others divided by 1 - share, the values that SemanticBranch
/// drops.
struct Dropout {
  RandomAddress random;
  std::int64_t first_ray = 0;
  double share = 0;
};
void drop_out(const Dropout& rule, const Samples<float>& samples, View<const float> from, View<float> to);

}  // namespace semfield::cuda
