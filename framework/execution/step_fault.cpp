// Which ray or tensor is behind a step that failed.
#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <string>

#include "compute/float_mode.h"
#include "compute/math_functions.h"
#include "execution/lane_executor.h"
#include "model/optim/tensor_ranges.h"

namespace semfield {

namespace {

template <class Real>
std::string element_text(const Tensor<Real>& t, std::int64_t element) {
  return fmt::format("row {}, column {}", element / t.spec.cols, element % t.spec.cols);
}

// Of a table the whole gradient, and values and moments of the touched rows of one window: the moments of every touched
// row would cost as much memory traffic as the update. From sound numbers comes nothing else, so what this finds was
// written from outside; a value that is not finite is seen in the encoder's output in any case.
//
// Of rows [row, row + rows).
template <class Real>
Unsound<Real> unsound_of_table(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  Unsound<Real> bad = first_unsound<Real>({}, t.view(t.grad).row_range(row, rows), {}, {}, false);
  if (bad.element >= 0) {
    bad.element += row * t.spec.cols;
    return bad;
  }
  const std::int64_t window_rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  const std::int64_t begin = std::max(row, step % kTableWindows * window_rows);
  const std::int64_t count = std::min(row + rows, (step % kTableWindows + 1) * window_rows) - begin;
  if (count <= 0) return {};
  const auto window = [&](const AlignedBuffer<Real>& buffer) { return t.view(buffer).row_range(begin, count); };
  bad = first_unsound<Real>(window(t.value), window(t.grad), window(t.moment1), window(t.moment2), true);
  if (bad.element >= 0) bad.element += begin * t.spec.cols;
  return bad;
}

template <class Real>
Unsound<Real> unsound_of_learned(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  if (t.spec.role == TensorRole::sparse) return unsound_of_table(t, step, row, rows);
  const auto part = [&](const AlignedBuffer<Real>& buffer) { return t.view(buffer).row_range(row, rows); };
  Unsound<Real> bad = first_unsound<Real>(part(t.value), part(t.grad), part(t.moment1), part(t.moment2), false);
  if (bad.element >= 0) bad.element += row * t.spec.cols;
  return bad;
}

// The elements of a derived or state tensor that a step looks at, as a column; none of a rearranged one, which comes
// anew from learned ones. Of a large one (the cells of a fine occupancy grid) they are a window, so that the check
// costs the same for any grid; the sampler itself refuses what it would write.
struct StateWindow {
  std::int64_t begin, count;
};
template <class Real>
StateWindow state_window(const Tensor<Real>& t, std::int64_t step) {
  constexpr std::int64_t kWindow = std::int64_t{1} << 18;
  if (t.spec.role == TensorRole::rearranged) return {0, 0};
  const std::int64_t begin = step % ((t.size() + kWindow - 1) / kWindow) * kWindow;
  return {begin, std::min(kWindow, t.size() - begin)};
}

// Of all tensors at once; which one it is, check_learned and check_state say.
template <class Real>
bool all_sound(const std::vector<Tensor<Real>>& tensors, std::int64_t step) {
  std::atomic<bool> sound{true};
  const auto tensor = [&](int i) -> const Tensor<Real>& { return tensors[static_cast<std::size_t>(i)]; };
  for_ranges(
      static_cast<int>(tensors.size()),
      [&](int i) { return tensor(i).learned() ? tensor(i).spec.rows : state_window(tensor(i), step).count; },
      [&](int i) { return tensor(i).learned() ? tensor(i).spec.cols : 1; },
      [&](int i, std::int64_t row, std::int64_t rows) {
        const Tensor<Real>& t = tensor(i);
        const bool good = t.learned() ? unsound_of_learned(t, step, row, rows).element < 0
                                      : all_finite(t.value.data() + state_window(t, step).begin + row, rows);
        if (!good) sound = false;
      });
  return sound;
}

template <class Real>
void check_learned(const Tensor<Real>& t, std::int64_t step, const StepLosses& losses) {
  const Unsound<Real> bad = unsound_of_learned(t, step, 0, t.spec.rows);
  if (bad.element < 0) return;
  throw Error(ErrorKind::failure, "train.gradient.not_finite",
              fmt::format("the {} of '{}' at {} is {:.6g} (loss {:.6g})", bad.array, t.name,
                          element_text(t, bad.element), bad.found, losses.total),
              std::string(fault_remedy()));
}

template <class Real>
void check_state(const Tensor<Real>& t, std::int64_t step) {
  const auto [begin, count] = state_window(t, step);
  const std::int64_t at = first_non_finite<Real>(View<const Real>(t.value.data() + begin, count, 1));
  if (at < 0) return;
  throw Error(ErrorKind::failure, "train.tensor.not_finite",
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
  const bool sound = all_sound(store.all(), step);
  for (const Tensor<Real>& t : store.all()) {
    if (!sound && t.learned()) check_learned(t, step, losses);
  }
  if (!std::isfinite(losses.total)) {
    std::string terms;
    const std::vector<LossEntry>& entries = options().losses.entries();
    for (std::size_t i = 0; i < entries.size(); ++i) terms += fmt::format(", {} {}", entries[i].type, losses.terms[i]);
    throw Error(
        ErrorKind::failure, "train.loss.not_finite",
        fmt::format("the loss is {} (colour {}, semantic {}{})", losses.total, losses.color, losses.semantic, terms),
        std::string(fault_remedy()));
  }
  for (const Tensor<Real>& t : store.all()) {
    if (!sound && !t.learned()) check_state(t, step);
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
    scales = pipeline_.scales_of(batch);
  } catch (const Error&) {
    // A label of some ray: that ray throws again below.
  }
  pipeline_.store().clear_gradients();
  const RayBatch seen = moved(batch);
  for (std::int64_t ray = 0; ray < batch.origin.rows && !fault; ++ray) {
    try {
      guard_rays<Real>(
          {batch.origin.row_range(ray, 1), batch.direction.row_range(ray, 1), batch.near_far.row_range(ray, 1)},
          batch.targets.color.row_range(ray, 1), ray);
      train_tile(context(step, true, ray, arenas_.own()), 0, seen, {ray, 1, kAlone}, scales);
    } catch (const RayFault& found) {
      fault = found;
    } catch (const Error& error) {
      fault.emplace(ray, error.kind(), error.code(), error.message(), error.remedy());
    }
    for (const Tensor<Real>& t : pipeline_.store().all()) {
      if (fault || t.lanes.size() == 0) continue;
      const Real* const lane = t.lanes.data();
      if (all_finite(lane, t.size())) continue;
      std::int64_t at = 0;
      while (all_finite(lane + at, 1)) ++at;
      fault.emplace(ray, ErrorKind::failure, Code("train.gradient.not_finite"),
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
