#include "model/param_store.h"

#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"

namespace semfield {

namespace {

class Collector final : public ParamDeclarer {
 public:
  int tensor(TensorSpec spec) override {
    SEMFIELD_CHECK(spec.rows > 0 && spec.cols > 0, "tensor '" + spec.name + "' has an empty shape");
    for (const TensorSpec& other : specs)
      SEMFIELD_CHECK(other.name != spec.name, "tensor '" + spec.name + "' declared twice");
    specs.push_back(std::move(spec));
    return static_cast<int>(specs.size()) - 1;
  }
  std::vector<TensorSpec> specs;
};

constexpr std::int64_t kChunk = 1 << 10;  // elements a parallel task; sums are per element, so it changes no bits

}  // namespace

template <class Real>
std::vector<TensorSpec> specs_of(const Parametric<Real>& part) {
  Collector collector;
  part.declare(collector);
  return std::move(collector.specs);
}

template <class Real>
void ParamStore<Real>::restart(Tensor<Real>& tensor) const {
  const Init init = tensor.spec.init;
  const RandomAddress address{seed_, 0, stream_id(tensor.name)};
  for (std::size_t i = 0; i < tensor.value.size(); ++i) {
    tensor.value.data()[i] =
        init.low == init.high
            ? static_cast<Real>(init.low)
            : static_cast<Real>(init.low + (init.high - init.low) * static_cast<double>(uniform01(address, i)));
  }
  std::fill_n(tensor.moment1.data(), tensor.moment1.size(), Real(0));
  std::fill_n(tensor.moment2.data(), tensor.moment2.size(), Real(0));
}

template <class Real>
int ParamStore<Real>::add(const std::string& prefix, const Parametric<Real>& part, const LearningRule& rule) {
  typename TensorStore<Real>::Component component;
  component.grads.resize(static_cast<std::size_t>(lanes_) + 1);
  for (TensorSpec& spec : specs_of(part)) {
    Tensor<Real> tensor;
    tensor.name = prefix + "/" + spec.name;
    SEMFIELD_CHECK(find(tensor.name) == nullptr, "tensor '" + tensor.name + "' exists already");
    tensor.spec = std::move(spec);
    tensor.rule = rule;
    const auto count = static_cast<std::size_t>(tensor.size());
    tensor.value = AlignedBuffer<Real>(count);
    restart(tensor);
    if (trainable_ && has_gradient(tensor.spec.role)) {
      tensor.grad = AlignedBuffer<Real>(count);
      if (tensor.learned()) {
        tensor.moment1 = AlignedBuffer<Real>(count);
        tensor.moment2 = AlignedBuffer<Real>(count);
        learned_.push_back(this->learn(tensor.view(tensor.value), tensor.view(tensor.grad), tensor.view(tensor.moment1),
                                       tensor.view(tensor.moment2), tensor.spec.role, rule));
      }
      if (tensor.spec.role != TensorRole::sparse) {
        tensor.lanes = AlignedBuffer<Real>(count * static_cast<std::size_t>(lanes_));
        for (std::int64_t i = 0; i < tensor.size(); i += kChunk) {
          lane_sums_.push_back(
              {tensor.grad.data(), tensor.lanes.data(), tensor.size(), i, std::min(i + kChunk, tensor.size())});
        }
      }
    }
    component.values.push_back(tensor.view(tensor.value));
    component.grads[0].push_back(tensor.view(tensor.grad));
    for (int lane = 0; lane < lanes_; ++lane) {
      component.grads[static_cast<std::size_t>(lane) + 1].push_back(
          tensor.lanes.size() == 0 ? View<Real>()
                                   : View<Real>(tensor.lanes.data() + static_cast<std::size_t>(lane) * count,
                                                tensor.spec.rows, tensor.spec.cols));
    }
    tensors_.push_back(std::move(tensor));
  }
  return this->keep(std::move(component));
}

template <class Real>
void ParamStore<Real>::reduce_lanes(int first, int end) {
  parallel_for(std::ssize(lane_sums_), [&, this](std::int64_t index) {
    const LaneSum& task = lane_sums_[static_cast<std::size_t>(index)];
    Real* const sum = task.grad;
    for (int lane = first; lane < end; ++lane) {
      Real* const part = task.lanes + static_cast<std::int64_t>(lane) * task.size;
      for (std::int64_t i = task.begin; i < task.end; ++i) {
        sum[i] += part[i];
        part[i] = 0;
      }
    }
  });
}

template std::vector<TensorSpec> specs_of<float>(const Parametric<float>&);
template std::vector<TensorSpec> specs_of<double>(const Parametric<double>&);
template class ParamStore<float>;
template class ParamStore<double>;

}  // namespace semfield
