// Every tensor of a run by name: values, gradients, Adam moments, and the gradient lanes that make sums independent of
// threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <new>
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
};

/// 64-byte aligned, zero-initialised array.
template <class Real>
class AlignedBuffer {
 public:
  AlignedBuffer() = default;
  explicit AlignedBuffer(std::size_t count)
      : data_(new (std::align_val_t{64}) Real[std::max<std::size_t>(count, 1)]()), size_(count) {}
  Real* data() const { return data_.get(); }
  std::size_t size() const { return size_; }

 private:
  struct Free {
    void operator()(Real* p) const { ::operator delete[](p, std::align_val_t{64}); }
  };
  std::unique_ptr<Real[], Free> data_;
  std::size_t size_ = 0;
};

template <class Real>
struct Tensor {
  std::string name;  ///< full: "fine/field/trunk_0/weight"
  TensorSpec spec;
  LearningRule rule;
  AlignedBuffer<Real> value;
  AlignedBuffer<Real> grad;              ///< the step's gradient; empty for state tensors and copies
  AlignedBuffer<Real> moment1, moment2;  ///< Adam; learned tensors only
  AlignedBuffer<Real> lanes;             ///< [lane_count, size]; dense and derived tensors only

  bool learned() const { return is_learned(spec.role); }
  std::int64_t size() const { return spec.rows * spec.cols; }
  View<Real> view(const AlignedBuffer<Real>& buffer) const {
    return buffer.size() == 0 ? View<Real>() : View<Real>(buffer.data(), spec.rows, spec.cols);
  }
};

/// What a part declares, in order.
template <class Real>
std::vector<TensorSpec> specs_of(const Parametric<Real>& part);
/// Whether any of it is learned.
template <class Real>
bool learns(const Parametric<Real>& part) {
  const std::vector<TensorSpec> specs = specs_of(part);
  return std::any_of(specs.begin(), specs.end(), [](const TensorSpec& spec) { return is_learned(spec.role); });
}
/// Numbers of a gradient lane of the part.
template <class Real>
std::int64_t lane_size(const Parametric<Real>& part) {
  std::int64_t sum = 0;
  for (const TensorSpec& spec : specs_of(part))
    if (has_gradient(spec.role) && spec.role != TensorRole::sparse) sum += std::int64_t{spec.rows} * spec.cols;
  return sum;
}

/// Owns the tensors of a pipeline on the CPU.
///
/// Gradients of dense tensors are summed in `lanes` fixed slots (tile t belongs to lane t mod lanes, a lane's tiles run
/// in order, lanes are added in order), so the sum's tree depends on the tile numbering alone. Sparse tensors have one
/// gradient, written outside parallel regions by their owner.
template <class Real>
class ParamStore final : public TensorStore<Real> {
 public:
  ParamStore(std::uint64_t seed, int lanes, bool trainable) : seed_(seed), lanes_(lanes), trainable_(trainable) {}

  /// Declares `part` under `prefix`, allocates and initialises; returns the component's number.
  int add(const std::string& prefix, const Parametric<Real>& part, const LearningRule& rule = {}) override;

  /// The tensor's values as they were when it was added, and moments of zero.
  void restart(Tensor<Real>& tensor) const;

  /// All learned tensors, as updates see them.
  AdamTable<Real> learned() const { return {learned_.data(), static_cast<int>(learned_.size()), learned_count()}; }

  /// grad += sum over lanes, in lane order; lanes are zero afterwards.
  void reduce_lanes() { reduce_lanes(0, lanes_); }
  /// The same for lanes [first, end).
  void reduce_lanes(int first, int end);
  /// Zeroes gradients of every tensor but sparse ones, which the optimiser clears row by row as it visits them.
  void zero_gradients() {
    for (Tensor<Real>& t : tensors_) {
      if (t.spec.role != TensorRole::sparse) std::fill_n(t.grad.data(), t.grad.size(), Real(0));
    }
  }
  /// Zeroes every gradient and lane, sparse ones too: after a step that failed halfway.
  void clear_gradients() {
    for (Tensor<Real>& t : tensors_) {
      std::fill_n(t.grad.data(), t.grad.size(), Real(0));
      std::fill_n(t.lanes.data(), t.lanes.size(), Real(0));
    }
  }

  std::vector<Tensor<Real>>& all() { return tensors_; }
  const std::vector<Tensor<Real>>& all() const { return tensors_; }
  Tensor<Real>* find(const std::string& name) {
    for (Tensor<Real>& t : tensors_) {
      if (t.name == name) return &t;
    }
    return nullptr;
  }
  int lanes() const { return lanes_; }
  /// Learned scalars.
  std::int64_t learned_count() const {
    std::int64_t sum = 0;
    for (const Tensor<Real>& t : tensors_) sum += t.learned() ? t.size() : 0;
    return sum;
  }

 private:
  struct LaneSum {  // elements of a tensor whose lanes one task adds
    Real *grad, *lanes;
    std::int64_t size, begin, end;
  };
  std::uint64_t seed_;
  int lanes_;
  bool trainable_;
  std::vector<Tensor<Real>> tensors_;
  std::vector<AdamTensor<Real>> learned_;
  std::vector<LaneSum> lane_sums_;
};

}  // namespace semfield
