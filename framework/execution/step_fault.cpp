// Which ray or tensor is behind a step that failed.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "compute/float_mode.h"
#include "compute/math_functions.h"
#include "execution/lane_executor.h"

namespace semfield {

namespace {

template <class Real>
std::string element_text(const Tensor<Real>& t, std::int64_t element) {
  return fmt::format("row {}, column {}", element / t.spec.cols, element % t.spec.cols);
}

// Of a table the whole gradient, and values and moments of the touched rows of one window: the moments of every touched
// row would cost as much memory traffic as the update. From sound numbers comes nothing else, so what this finds was
// written from outside; a value that is not finite is seen in the encoder's output in any case.
template <class Real>
Unsound<Real> unsound_of_table(const Tensor<Real>& t, std::int64_t step) {
  Unsound<Real> bad = first_unsound<Real>({}, t.view(t.grad), {}, {}, false);
  if (bad.element >= 0) return bad;
  const std::int64_t rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  const std::int64_t begin = std::min(step % kTableWindows * rows, t.spec.rows);
  const std::int64_t count = std::min(rows, t.spec.rows - begin);
  if (count == 0) return {};
  const auto window = [&](const AlignedBuffer<Real>& buffer) { return t.view(buffer).row_range(begin, count); };
  bad = first_unsound<Real>(window(t.value), window(t.grad), window(t.moment1), window(t.moment2), true);
  if (bad.element >= 0) bad.element += begin * t.spec.cols;
  return bad;
}

template <class Real>
void check_learned(const Tensor<Real>& t, std::int64_t step, const StepLosses& losses) {
  const Unsound<Real> bad =
      t.spec.role == TensorRole::sparse
          ? unsound_of_table(t, step)
          : first_unsound<Real>(t.view(t.value), t.view(t.grad), t.view(t.moment1), t.view(t.moment2), false);
  if (bad.element < 0) return;
  throw Error(ErrorKind::failure,
              fmt::format("the {} of '{}' at {} is {:.6g} (loss {:.6g})", bad.array, t.name,
                          element_text(t, bad.element), bad.found, losses.total),
              std::string(fault_remedy()));
}

// A derived or state tensor. Of a large one (the cells of a fine occupancy grid) a window is looked at in each step, so
// that the check costs the same for any grid; the sampler itself refuses what it would write.
template <class Real>
void check_state(const Tensor<Real>& t, std::int64_t step) {
  constexpr std::int64_t kWindow = std::int64_t{1} << 18;
  const std::int64_t windows = (t.size() + kWindow - 1) / kWindow;
  const std::int64_t begin = step % windows * kWindow, count = std::min(kWindow, t.size() - begin);
  const std::int64_t at = first_non_finite<Real>(View<const Real>(t.value.data() + begin, count, 1));
  if (at < 0) return;
  throw Error(ErrorKind::failure,
              fmt::format("'{}' holds {} at {}", t.name, t.value.data()[begin + at], element_text(t, begin + at)),
              std::string(fault_remedy()));
}

}  // namespace

template <class Real>
StepLosses LaneExecutor<Real>::checked_gradients(std::int64_t step, const RayBatch& batch) {
  ParamStore<Real>& store = pipeline_.store();
  store.zero_gradients();
  const StepLosses losses = gradients(step, batch);
  if (hook_) hook_({step, store.learned_gradients(), nullptr});
  for (const Tensor<Real>& t : store.all()) {
    if (t.learned()) check_learned(t, step, losses);
  }
  if (!std::isfinite(losses.total)) {
    std::string terms;
    const std::vector<LossEntry>& entries = options().losses.entries();
    for (std::size_t i = 0; i < entries.size(); ++i) terms += fmt::format(", {} {}", entries[i].type, losses.terms[i]);
    throw Error(
        ErrorKind::failure,
        fmt::format("the loss is {} (colour {}, semantic {}{})", losses.total, losses.color, losses.semantic, terms),
        std::string(fault_remedy()));
  }
  for (const Tensor<Real>& t : store.all()) {
    if (!t.learned()) check_state(t, step);
  }
  return losses;
}

template <class Real>
std::optional<RayFault> LaneExecutor<Real>::find_fault(std::int64_t step, const RayBatch& batch) {
  const WorkScope scope(options().work);
  const ComputeFloatMode mode;
  std::optional<RayFault> fault;
  BatchScales scales;
  scales.color = color_normaliser(batch);
  scales.semantic = 1;
  try {
    scales = pipeline_.scales_of(step, batch);
  } catch (const Error&) {
    // A label of some ray: that ray throws again below.
  }
  pipeline_.store().clear_gradients();
  for (std::int64_t ray = 0; ray < batch.origin.rows && !fault; ++ray) {
    try {
      guard_rays<Real>(
          {batch.origin.row_range(ray, 1), batch.direction.row_range(ray, 1), batch.near_far.row_range(ray, 1)},
          batch.target.row_range(ray, 1), ray);
      train_tile(context(step, true, ray, arenas_.own()), 0, batch, {ray, 1, kAlone}, scales);
    } catch (const RayFault& found) {
      fault = found;
    } catch (const Error& error) {
      fault.emplace(ray, error.kind(), error.message(), error.remedy());
    }
    for (const Tensor<Real>& t : pipeline_.store().all()) {
      if (fault || t.lanes.size() == 0) continue;
      const Real* const lane = t.lanes.data();
      if (all_finite(lane, t.size())) continue;
      std::int64_t at = 0;
      while (all_finite(lane + at, 1)) ++at;
      fault.emplace(ray, ErrorKind::failure,
                    "the gradient of '" + t.name + "' at " + element_text(t, at) + " that ray " + std::to_string(ray) +
                        " gives is " + std::to_string(lane[at]),
                    std::string(fault_remedy()));
    }
  }
  pipeline_.store().clear_gradients();
  return fault;
}

#define SEMFIELD_INSTANTIATE(Real)                                                          \
  template StepLosses LaneExecutor<Real>::checked_gradients(std::int64_t, const RayBatch&); \
  template std::optional<RayFault> LaneExecutor<Real>::find_fault(std::int64_t, const RayBatch&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
