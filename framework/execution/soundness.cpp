#include "execution/soundness.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <vector>

#include "core/error.h"
#include "model/optim/adam.h"
#include "model/stages.h"

namespace semfield {

namespace {

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

template <class Real>
std::int64_t checked_rows(const Tensor<Real>& t, std::int64_t step) {
  return t.learned() ? t.spec.rows : state_window(t, step).count;
}

// Of the checked rows [row, row + rows).
template <class Real>
Unsound<Real> unsound_of(const Tensor<Real>& t, std::int64_t step, std::int64_t row, std::int64_t rows) {
  if (t.learned()) return unsound_of_learned(t, step, row, rows);
  const std::int64_t begin = state_window(t, step).begin + row;
  const std::int64_t at = first_non_finite<Real>(View<const Real>(t.value.data() + begin, rows, 1));
  return at < 0 ? Unsound<Real>() : Unsound<Real>{"value", begin + at, t.value.data()[begin + at]};
}

// Of all tensors at once; which one it is, require_sound says.
template <class Real>
bool all_sound(const std::vector<Tensor<Real>>& tensors, std::int64_t step) {
  std::atomic<bool> sound{true};
  const auto tensor = [&](int i) -> const Tensor<Real>& { return tensors[static_cast<std::size_t>(i)]; };
  for_ranges(
      static_cast<int>(tensors.size()), [&](int i) { return checked_rows(tensor(i), step); },
      [&](int i) { return tensor(i).learned() ? tensor(i).spec.cols : 1; },
      [&](int i, std::int64_t row, std::int64_t rows) {
        if (unsound_of(tensor(i), step, row, rows).element >= 0) sound = false;
      });
  return sound;
}

}  // namespace

template <class Real>
std::string element_text(const Tensor<Real>& tensor, std::int64_t element) {
  return fmt::format("row {}, column {}", element / tensor.spec.cols, element % tensor.spec.cols);
}

template <class Real>
void require_sound(const ParamStore<Real>& store, std::int64_t step, const StepLosses& losses, const LossList& terms) {
  const bool sound = all_sound(store.all(), step);
  for (const Tensor<Real>& t : store.all()) {
    if (sound || !t.learned()) continue;
    const Unsound<Real> bad = unsound_of(t, step, 0, checked_rows(t, step));
    if (bad.element < 0) continue;
    throw Error(ErrorKind::failure, "train.gradient.not_finite",
                fmt::format("the {} of '{}' at {} is {:.6g} (loss {:.6g})", bad.array, t.name,
                            element_text(t, bad.element), bad.found, losses.total),
                std::string(fault_remedy()));
  }
  if (!std::isfinite(losses.total)) {
    std::string listed;
    const std::vector<LossEntry>& entries = terms.entries();
    for (std::size_t i = 0; i < entries.size(); ++i) listed += fmt::format(", {} {}", entries[i].type, losses.terms[i]);
    throw Error(
        ErrorKind::failure, "train.loss.not_finite",
        fmt::format("the loss is {} (colour {}, semantic {}{})", losses.total, losses.color, losses.semantic, listed),
        std::string(fault_remedy()));
  }
  for (const Tensor<Real>& t : store.all()) {
    if (sound || t.learned()) continue;
    const Unsound<Real> bad = unsound_of(t, step, 0, checked_rows(t, step));
    if (bad.element < 0) continue;
    throw Error(ErrorKind::failure, "train.tensor.not_finite",
                fmt::format("'{}' holds {} at {}", t.name, bad.found, element_text(t, bad.element)),
                std::string(fault_remedy()));
  }
}

std::string suspect_tensor(const ParamStore<float>& store) {
  constexpr float kProportion = 1e10F;
  float largest = kProportion;
  std::string text;
  for (const Tensor<float>& t : store.all()) {
    if (t.spec.role == TensorRole::rearranged) continue;
    const std::int64_t bad = first_non_finite<float>(t.view(t.value));
    if (bad >= 0) return fmt::format("'{}' holds {} at {}", t.name, t.value.data()[bad], element_text(t, bad));
    for (std::int64_t i = 0; i < t.size() && t.spec.role != TensorRole::state; ++i) {
      const float value = t.value.data()[i];
      if (!(std::abs(value) > largest)) continue;
      largest = std::abs(value);
      text = fmt::format("the largest value is {:.6g} in '{}' at {}", value, t.name, element_text(t, i));
    }
  }
  return text;
}

template std::string element_text(const Tensor<float>&, std::int64_t);
template std::string element_text(const Tensor<double>&, std::int64_t);
template void require_sound(const ParamStore<float>&, std::int64_t, const StepLosses&, const LossList&);
template void require_sound(const ParamStore<double>&, std::int64_t, const StepLosses&, const LossList&);

}  // namespace semfield
