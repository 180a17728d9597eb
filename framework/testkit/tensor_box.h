// A component's tensors for a test: allocated as declared, filled reproducibly, with gradients.
#pragma once

#include <cstdint>
#include <vector>

#include "plugin/parametric.h"

namespace semfield::testkit {

/// Allocates what `component` declares. Values are drawn in fp32 from (seed, tensor name, element), so that a float box
/// and a double box of one component hold the same numbers.
template <class Real>
class TensorBox {
 public:
  /// Learned tensors start as declared plus uniform noise of +-`noise`, so that zero-initialised layers are exercised
  /// too.
  TensorBox(const Parametric<Real>& component, std::uint64_t seed, double noise = 0.1);
  TensorBox(const TensorBox&) = delete;
  TensorBox& operator=(const TensorBox&) = delete;

  const Tensors<Real>& tensors() const { return tensors_; }
  /// The same without gradients, as a renderer passes them.
  Tensors<Real> values_only() const { return {value_views_, {}}; }
  const std::vector<TensorSpec>& specs() const { return specs_; }
  std::size_t count() const { return specs_.size(); }
  View<Real> value(std::size_t index) const { return value_views_[index]; }
  View<Real> grad(std::size_t index) const { return grad_views_[index]; }
  /// Learned: trained by the optimiser (dense or sparse).
  bool learned(std::size_t index) const {
    return specs_[index].role == TensorRole::dense || specs_[index].role == TensorRole::sparse;
  }
  void fill_grads(Real value);

 private:
  std::vector<TensorSpec> specs_;
  std::vector<std::vector<Real>> values_, grads_;
  std::vector<View<Real>> value_views_, grad_views_;
  Tensors<Real> tensors_;
};

extern template class TensorBox<float>;
extern template class TensorBox<double>;

}  // namespace semfield::testkit
