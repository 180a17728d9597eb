// Allocation and filling of test tensors.
#include "testkit/tensor_box.h"

#include <algorithm>

#include "core/rng.h"

namespace semfield::testkit {

namespace {

class Collector final : public ParamDeclarer {
 public:
  explicit Collector(std::vector<TensorSpec>& specs) : specs_(specs) {}
  int tensor(TensorSpec spec) override {
    specs_.push_back(std::move(spec));
    return static_cast<int>(specs_.size()) - 1;
  }

 private:
  std::vector<TensorSpec>& specs_;
};

float initial_value(const TensorSpec& spec, std::uint64_t seed, double noise, std::uint64_t element) {
  const RandomAddress address{seed, 0, stream_id(spec.name)};
  const double declared = spec.init.low + (spec.init.high - spec.init.low) * uniform01(address, 2 * element);
  return static_cast<float>(declared + noise * (2.0 * uniform01(address, 2 * element + 1) - 1.0));
}

}  // namespace

template <class Real>
TensorBox<Real>::TensorBox(const Parametric<Real>& component, std::uint64_t seed, double noise) {
  Collector collector(specs_);
  component.declare(collector);
  for (std::size_t i = 0; i < specs_.size(); ++i) {
    const TensorSpec& spec = specs_[i];
    const auto size = static_cast<std::size_t>(spec.rows * spec.cols);
    std::vector<Real> value(size);
    for (std::size_t e = 0; e < size; ++e) {
      value[e] = static_cast<Real>(initial_value(spec, seed, learned(i) ? noise : 0.0, e));
    }
    values_.push_back(std::move(value));
    grads_.emplace_back(has_gradient(spec.role) ? size : 0, Real(0));
  }
  for (std::size_t i = 0; i < specs_.size(); ++i) {
    value_views_.emplace_back(values_[i].data(), specs_[i].rows, specs_[i].cols);
    grad_views_.push_back(grads_[i].empty() ? View<Real>()
                                            : View<Real>(grads_[i].data(), specs_[i].rows, specs_[i].cols));
  }
  tensors_ = {value_views_, grad_views_};
}

template <class Real>
void TensorBox<Real>::fill_grads(Real value) {
  for (std::vector<Real>& grad : grads_) std::fill(grad.begin(), grad.end(), value);
}

template class TensorBox<float>;
template class TensorBox<double>;

}  // namespace semfield::testkit
