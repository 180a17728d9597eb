#include "eval/eval_budget.h"

#include <algorithm>
#include <limits>

#include "core/check.h"

namespace semfield {

void EvalBudget::spend(double seconds, double pixels) {
  SEMFIELD_CHECK(seconds >= 0 && pixels > 0, "an evaluation has pixels");
  spent_s_ += seconds;
  s_per_px_ = seconds / pixels;
}

std::int32_t EvalBudget::sample_stride(double pixels, double every_s, std::int32_t most) const {
  return bounds_samples() ? stride_within(share_ / 2 * every_s, pixels, most) : 1;
}

double EvalBudget::left_s(double train_s) const {
  if (!bounds_last()) return std::numeric_limits<double>::infinity();
  // A step that runs over the time, or samples that did, still leave it half of the share.
  return std::max((1 + share_) * time_s_ - train_s - spent_s_, share_ / 2 * time_s_);
}

std::int32_t EvalBudget::stride_within(double budget_s, double pixels, std::int32_t most) const {
  const double cost_s = pixels * s_per_px_;
  std::int32_t stride = 1;
  while (stride < most && cost_s / (static_cast<double>(stride) * stride) > budget_s) ++stride;
  return stride;
}

}  // namespace semfield
