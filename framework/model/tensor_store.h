// Where a component's tensors lie: declared once, borrowed in every call.
#pragma once

#include <span>
#include <string>
#include <utility>
#include <vector>

#include "model/optim/adam.h"
#include "plugin/parametric.h"

namespace semfield {

/// How a component's learned tensors differ from the run's rule.
struct LearningRule {
  double rate = 1;        ///< factor to the learning rate
  double decay = 0;       ///< a step takes (learning rate) * decay of each value, beside Adam's [Loshchilov19]
  bool semantic = false;  ///< left alone in a step without labels
  bool fades = false;     ///< AdamStep::fade is one more factor
};

/// Where the gradients of a call go.
inline constexpr int kMainGradient = -1;

/// A component is what one Parametric declared. A store of each device says where its tensors lie.
template <class Real>
class TensorStore {
 public:
  virtual ~TensorStore() = default;
  /// Declares `part` under `prefix`; returns the component's number.
  virtual int add(const std::string& prefix, const Parametric<Real>& part, const LearningRule& rule = {}) = 0;
  /// lane: a gradient lane of the store, or kMainGradient. A store without lanes has the main gradient alone.
  Tensors<Real> tensors(int component, int lane = kMainGradient) const {
    const Component& c = components_[static_cast<std::size_t>(component)];
    return {c.values, c.grads[static_cast<std::size_t>(lane + 1)]};
  }
  /// Whether updates leave the tensors as they are that are added from now on.
  void freeze(bool frozen) { frozen_ = frozen; }
  /// Main gradients of all learned tensors, in the order of checkpoints.
  std::span<const View<Real>> learned_gradients() const { return learned_gradients_; }

 protected:
  struct Component {
    std::vector<View<Real>> values;
    std::vector<std::vector<View<Real>>> grads;  // [0] main, [1 + lane]
  };
  int keep(Component component) {
    components_.push_back(std::move(component));
    return static_cast<int>(components_.size()) - 1;
  }
  /// One more learned tensor, as updates see it.
  AdamTensor<Real> learn(View<Real> value, View<Real> grad, View<Real> moment1, View<Real> moment2, TensorRole role,
                         const LearningRule& rule) {
    learned_gradients_.push_back(grad);
    return {value.data,
            grad.data,
            moment1.data,
            moment2.data,
            value.rows,
            value.cols,
            role == TensorRole::sparse,
            rule.semantic,
            frozen_ ? 0 : rule.rate,
            frozen_ ? 0 : rule.rate * rule.decay,
            rule.fades};
  }

 private:
  bool frozen_ = false;
  std::vector<Component> components_;
  std::vector<View<Real>> learned_gradients_;
};

}  // namespace semfield
