// Whether the numbers of a step are sound: finite, and not too large for an update.
#pragma once

#include <cstdint>
#include <string>

#include "execution/train_rays.h"
#include "model/losses/loss_list.h"
#include "model/param_store.h"

namespace semfield {

/// "row 3, column 1".
template <class Real>
std::string element_text(const Tensor<Real>& tensor, std::int64_t element);

/// Throws Error(failure) naming the first loss, or element of a gradient, value, moment or state, that is not sound. Of
/// tables and large states a step looks at a window.
template <class Real>
void require_sound(const ParamStore<Real>& store, std::int64_t step, const StepLosses& losses, const LossList& terms);

/// The tensor behind a value that is not finite: one that holds such a value, else the largest value of all if it is
/// out of all proportion; "": none.
std::string suspect_tensor(const ParamStore<float>& store);

}  // namespace semfield
