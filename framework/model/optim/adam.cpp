// Adam updates, cut into ranges of rows; the loops are in adam_kernels.cpp.
#include "model/optim/adam.h"

#include <atomic>
#include <cmath>
#include <limits>

#include "compute/isa.h"
#include "core/check.h"
#include "isa_list.h"

namespace semfield {

SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE_VARIANT, adam_kernels, AdamKernels<float>)
SEMFIELD_FOR_EACH_ISA(SEMFIELD_DECLARE_VARIANT, adam_kernels, AdamKernels<double>)

namespace {

// Of the instruction set in use.
template <class Real>
const AdamKernels<Real>& kernels() {
  static constexpr IsaVariant<void (*)(AdamKernels<Real>&)> kVariants[] = {
      SEMFIELD_FOR_EACH_ISA(SEMFIELD_VARIANT, adam_kernels)};
  static const AdamKernels<Real> chosen = [] {
    AdamKernels<Real> filled{};
    best_variant(kVariants)(filled);
    return filled;
  }();
  return chosen;
}

// Rows [begin, begin + count). The kernels' gradient is writable; `dense` only reads it.
template <class Real>
AdamRange<Real> range_of(View<Real> value, View<const Real> grad, View<Real> m, View<Real> v, std::int64_t begin,
                         std::int64_t count) {
  return {value.row(begin), const_cast<Real*>(grad.row(begin)), m.row(begin), v.row(begin), count, value.cols};
}

// First range of kRangeElements of `size` elements that good(begin, count) denies, whichever thread finds one first; or
// -1.
template <class Good>
std::int64_t first_bad_range(std::int64_t size, const Good& good) {
  constexpr std::int64_t kNone = std::numeric_limits<std::int64_t>::max();
  std::atomic<std::int64_t> first_bad = kNone;
  parallel_for((size + kRangeElements - 1) / kRangeElements, [&](std::int64_t i) {
    const std::int64_t begin = i * kRangeElements;
    if (good(begin, std::min(kRangeElements, size - begin))) return;
    std::int64_t known = first_bad;
    while (i < known && !first_bad.compare_exchange_weak(known, i)) {
    }
  });
  return first_bad == kNone ? -1 : first_bad.load();
}

template <class Real>
std::int64_t first_outside(View<const Real> values, Real low, Real high) {
  SEMFIELD_CHECK(values.empty() || values.contiguous(), "the finite check needs contiguous tensors");
  const std::int64_t range =
      first_bad_range(values.empty() ? 0 : values.size(), [&](std::int64_t begin, std::int64_t count) {
        return kernels<Real>().all_within(values.data + begin, count, low, high);
      });
  if (range < 0) return -1;
  std::int64_t at = range * kRangeElements;
  while (values.data[at] >= low && values.data[at] <= high) ++at;
  return at;
}

// Of the way from `from` to `factor`.
double fallen(ScheduleKind kind, double from, double factor, double progress) {
  constexpr double kPi = 3.14159265358979323846;
  if (kind == ScheduleKind::exponential) return from > 0 ? from * std::pow(factor / from, progress) : factor;
  if (kind == ScheduleKind::cosine) return factor + (from - factor) * 0.5 * (1 + std::cos(kPi * progress));
  return from;
}

}  // namespace

void describe(ParamVisitor& visit, AdamParams& params) {
  SEMFIELD_PARAM(visit, params, learning_rate, "Step size of the first update [Kingma15 alpha]", {0, 1});
  SEMFIELD_PARAM(visit, params, beta1, "Decay of the gradient's mean per step [Kingma15]", {0, 0.999999});
  SEMFIELD_PARAM(visit, params, beta2, "Decay of the squared gradient's mean per step [Kingma15]", {0, 0.99999999});
  SEMFIELD_PARAM(visit, params, epsilon, "Added to the root of the squared mean, against division by zero [Kingma15]",
                 {1e-30, 1});
}

AdamStep adam_step(const AdamParams& params, double learning_rate, std::int64_t step) {
  const double t = static_cast<double>(step) + 1;
  // 1 - beta^t; expm1 keeps its digits where beta^t is near 1, and log(0) = -inf gives 1.
  const double correction1 = -std::expm1(t * std::log(params.beta1));
  const double correction2 = -std::expm1(t * std::log(params.beta2));
  return {params.beta1, params.beta2, params.epsilon, learning_rate / correction1, 1.0 / std::sqrt(correction2),
          learning_rate};
}

template <class Real>
void adam_dense(const AdamStep& step, View<Real> value, View<const Real> grad, View<Real> m, View<Real> v,
                std::int64_t begin, std::int64_t count) {
  if (step.decay != 0) {
    const auto kept = static_cast<Real>(1 - step.decay);
    Real* const values = value.row(begin);
    for (std::int64_t i = 0; i < count * value.cols; ++i) values[i] *= kept;
  }
  kernels<Real>().dense(step, range_of<Real>(value, grad, m, v, begin, count));
}

template <class Real>
std::int64_t adam_touched(const AdamStep& step, View<Real> value, View<Real> grad, View<Real> m, View<Real> v,
                          std::int64_t begin, std::int64_t count) {
  return kernels<Real>().touched(step, range_of<Real>(value, grad, m, v, begin, count));
}

template <class Real>
void adam_update(const AdamStep* step, const AdamTable<Real>& table) {
  const auto rows = [&](int i) {
    const AdamTensor<Real>& t = table.tensors[i];
    return t.semantic && !step->labelled ? 0 : t.rows;
  };
  const auto cols = [&](int i) { return table.tensors[i].cols; };
  for_ranges(table.count, rows, cols, [&](int i, std::int64_t begin, std::int64_t count) {
    const AdamTensor<Real>& t = table.tensors[i];
    AdamStep rule = *step;
    rule.step_size *= t.fades ? t.rate * step->fade : t.rate;
    rule.decay = step->learning_rate * t.decay;
    const auto view = [&t](Real* data) { return View<Real>(data, t.rows, t.cols); };
    if (t.touched_only) {
      adam_touched<Real>(rule, view(t.value), view(t.grad), view(t.moment1), view(t.moment2), begin, count);
    } else {
      adam_dense<Real>(rule, view(t.value), view(t.grad), view(t.moment1), view(t.moment2), begin, count);
    }
  });
}

template <class Real>
std::int64_t first_non_finite(View<const Real> values) {
  constexpr Real kMost = std::numeric_limits<Real>::max();
  return first_outside(values, -kMost, kMost);
}

template <class Real>
Unsound<Real> first_unsound(View<const Real> value, View<const Real> grad, View<const Real> m, View<const Real> v,
                            bool touched_only) {
  constexpr Real kMost = kLargestSound<Real>;
  if (touched_only) {
    const std::int64_t bad = first_bad_range(value.size(), [&](std::int64_t begin, std::int64_t count) {
      const auto at = [begin](const View<const Real>& view) { return const_cast<Real*>(view.data) + begin; };
      return kernels<Real>().touched_sound({at(value), at(grad), at(m), at(v), count, 1});
    });
    if (bad < 0) return {};
  }
  const struct {
    const char* name;
    View<const Real> values;
    Real low, high;
  } arrays[] = {{"value", value, -kMost, kMost},
                {"gradient", grad, -kMost, kMost},
                {"first moment", m, -kMost, kMost},
                {"second moment", v, 0, kMost * kMost}};
  for (const auto& array : arrays) {
    const std::int64_t at = first_outside(array.values, array.low, array.high);
    if (at >= 0) return {array.name, at, array.values.data[at]};
  }
  return {};
}

#define SEMFIELD_INSTANTIATE(Real)                                                                                    \
  template void adam_dense<Real>(const AdamStep&, View<Real>, View<const Real>, View<Real>, View<Real>, std::int64_t, \
                                 std::int64_t);                                                                       \
  template std::int64_t adam_touched<Real>(const AdamStep&, View<Real>, View<Real>, View<Real>, View<Real>,           \
                                           std::int64_t, std::int64_t);                                               \
  template void adam_update<Real>(const AdamStep*, const AdamTable<Real>&);                                           \
  template std::int64_t first_non_finite<Real>(View<const Real>);                                                     \
  template Unsound<Real> first_unsound<Real>(View<const Real>, View<const Real>, View<const Real>, View<const Real>,  \
                                             bool);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

// Learning-rate schedules in closed form: a function of the step alone, so a resumed run needs no state.

void describe(ParamVisitor& visit, ScheduleLeg& leg) {
  SEMFIELD_PARAM(visit, leg, start, "first step of the leg, counted from 0", {0, 1e12});
  SEMFIELD_PARAM(visit, leg, rate, "multiplier of the learning rate that it begins with", {0, 1});
  SEMFIELD_PARAM(visit, leg, hold_until, "step until which that rate is held", {0, 1e12});
  SEMFIELD_PARAM(visit, leg, end,
                 "steps of the run at the leg's end, where the multiplier is `factor`; 0: settled by until_s",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, leg, until_s,
                 "seconds of training of the whole run at the leg's end; 0: it was asked for in steps", {0, 1e9});
}

void describe(ParamVisitor& visit, ScheduleParams& params) {
  SEMFIELD_PARAM(visit, params, kind, "how the learning rate falls");
  SEMFIELD_PARAM(visit, params, factor, "multiplier of the learning rate from decay_steps on", {0, 1});
  SEMFIELD_PARAM(visit, params, decay_steps,
                 "steps until the multiplier is `factor`, where it stays; 0: train.steps, and run.yaml has the number",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, params, hold_steps,
                 "steps before the rate begins to fall; train.time_s settles them with train.steps", {0, 1e12});
  SEMFIELD_PARAM(visit, params, warmup_steps, "steps of linear rise at the start; 0 = none", {0, 1e12});
}

double schedule_factor(const ScheduleParams& params, std::int64_t step) {
  ScheduleLeg leg{0, 1, params.hold_steps, params.decay_steps, 0};
  for (const ScheduleLeg& later : params.legs)
    if (step >= later.start) leg = later;
  double factor = leg.rate;
  if (leg.end > 0 && step > leg.hold_until) {
    const double progress =
        step < leg.end ? static_cast<double>(step - leg.hold_until) / static_cast<double>(leg.end - leg.hold_until) : 1;
    factor = fallen(params.kind, leg.rate, params.factor, progress);
  }
  if (step < params.warmup_steps) factor *= static_cast<double>(step + 1) / static_cast<double>(params.warmup_steps);
  return factor;
}

std::int64_t step_of_share(double share, std::int64_t steps, const ScheduleParams& params) {
  if (share <= 0) return 0;
  if (steps <= 0) return std::numeric_limits<std::int64_t>::max();
  return std::max(params.hold_steps, static_cast<std::int64_t>(std::ceil(share * static_cast<double>(steps))));
}

}  // namespace semfield
