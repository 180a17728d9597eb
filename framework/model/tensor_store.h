// Where a component's tensors lie: declared once, borrowed in every call.
#pragma once

#include <string>

#include "plugin/parametric.h"

namespace semfield {

/// How a component's learned tensors differ from the run's rule.
struct LearningRule {
  double rate = 1;   ///< factor to the learning rate
  double decay = 0;  ///< a step takes (learning rate) * decay of each value, beside Adam's [Loshchilov19]
};

/// Where the gradients of a call go.
inline constexpr int kMainGradient = -1;

template <class Real>
class TensorStore {
 public:
  virtual ~TensorStore() = default;
  /// Declares `part` under `prefix`; returns the component's number.
  virtual int add(const std::string& prefix, const Parametric<Real>& part, const LearningRule& rule = {}) = 0;
  /// lane: a gradient lane of the store, or kMainGradient. A store without lanes has the main gradient alone.
  virtual Tensors<Real> tensors(int component, int lane = kMainGradient) const = 0;
};

}  // namespace semfield
