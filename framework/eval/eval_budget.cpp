#include "eval/eval_budget.h"

#include <algorithm>

#include "core/check.h"

namespace semfield {

namespace {
// The least stride with which `cost_s` of all pixels comes to `budget_s`.
std::int32_t stride_for(double cost_s, double budget_s, std::int32_t most) {
  std::int32_t stride = 1;
  while (stride < most && cost_s / (static_cast<double>(stride) * stride) > budget_s) ++stride;
  return stride;
}
}  // namespace

void EvalBudget::spend(double seconds, double pixels) {
  SEMFIELD_CHECK(seconds >= 0 && pixels > 0, "an evaluation has pixels");
  spent_s_ += seconds;
  s_per_px_ = seconds / pixels;
}

std::int32_t EvalBudget::sample_stride(double pixels, double every_s, std::int32_t most) const {
  return bounds_samples() ? stride_for(pixels * s_per_px_, share_ / 2 * every_s, most) : 1;
}

EvalCut EvalBudget::last(double pixels, std::int64_t frames, double train_s, std::int32_t most_stride) const {
  if (!bounds_last()) return {};
  // A step that runs over the time, or samples that did, still leave it half of the share.
  const double budget_s = std::max((1 + share_) * time_s_ - train_s - spent_s_, share_ / 2 * time_s_);
  const double cost_s = pixels * s_per_px_;
  if (cost_s <= budget_s) return {};
  const double frame_s = cost_s / static_cast<double>(frames);
  return {budget_s / cost_s, stride_for(frame_s, budget_s, most_stride)};
}

}  // namespace semfield
