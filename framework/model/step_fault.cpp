// Which ray is behind a step that failed.
#include <algorithm>
#include <string>

#include "compute/float_mode.h"
#include "compute/math_functions.h"
#include "model/pipeline.h"

namespace semfield {

template <class Real>
bool Pipeline<Real>::is_semantic(const Tensor<Real>& tensor) const {
  return std::any_of(passes_.begin(), passes_.end(), [&](const Pass<Real>& pass) {
    return pass.parts().head != nullptr && tensor.name.rfind(pass.parts().name + "/semantic/", 0) == 0;
  });
}

template <class Real>
double Pipeline<Real>::batch_normaliser(const RayBatch& batch) const {
  if (!has_semantics() || batch.label.empty()) return 0;
  const View<const float> weights =
      options_.class_weight.empty()
          ? View<const float>()
          : View<const float>(options_.class_weight.data(), 1, static_cast<std::int32_t>(options_.class_weight.size()));
  SemanticTargets targets;
  if (batch.soft.empty()) {
    targets.hard = batch.label;
  } else {
    targets.soft = batch.soft;
  }
  return semantic_normaliser(options_.normalisation, labelled_weight(targets, weights), batch.origin.rows);
}

template <class Real>
std::optional<RayFault> Pipeline<Real>::find_fault(std::int64_t step, const RayBatch& batch) {
  const WorkScope scope(options_.work);
  const ComputeFloatMode mode;
  std::optional<RayFault> fault;
  BatchScales scales;
  scales.semantic = 1;
  try {
    scales = scales_of(step, batch);
  } catch (const Error&) {
    // A label of some ray: that ray throws again below.
  }
  store_.clear_gradients();
  for (std::int64_t ray = 0; ray < batch.origin.rows && !fault; ++ray) {
    try {
      guard_rays<Real>(
          {batch.origin.row_range(ray, 1), batch.direction.row_range(ray, 1), batch.near_far.row_range(ray, 1)},
          batch.target.row_range(ray, 1), ray);
      train_tile(step, 0, batch, {ray, 1, kAlone}, scales);
    } catch (const RayFault& found) {
      fault = found;
    } catch (const Error& error) {
      fault.emplace(ray, error.kind(), error.message(), error.remedy());
    }
    for (const Tensor<Real>& t : store_.all()) {
      if (fault || t.lanes.size() == 0) continue;
      const Real* const lane = t.lanes.data();
      if (all_finite(lane, t.size())) continue;
      std::int64_t at = 0;
      while (all_finite(lane + at, 1)) ++at;
      fault.emplace(ray, ErrorKind::failure,
                    "the gradient of '" + t.name + "' at row " + std::to_string(at / t.spec.cols) + ", column " +
                        std::to_string(at % t.spec.cols) + " that ray " + std::to_string(ray) + " gives is " +
                        std::to_string(lane[at]),
                    std::string(fault_remedy()));
    }
  }
  store_.clear_gradients();
  return fault;
}

#define SEMFIELD_INSTANTIATE(Real)                                         \
  template bool Pipeline<Real>::is_semantic(const Tensor<Real>&) const;    \
  template double Pipeline<Real>::batch_normaliser(const RayBatch&) const; \
  template std::optional<RayFault> Pipeline<Real>::find_fault(std::int64_t, const RayBatch&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
