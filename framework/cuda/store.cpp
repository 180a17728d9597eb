#include "cuda/store.h"

#include "core/check.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kAlign = 64;  // elements: a tensor starts on a 256-byte boundary

std::int64_t padded(std::int64_t count) { return (count + kAlign - 1) / kAlign * kAlign; }

// Compares what a part declares with the host's tensors.
class Matcher final : public ParamDeclarer {
 public:
  Matcher(const std::vector<Tensor<float>>& tensors, std::size_t begin) : tensors_(tensors), begin_(begin) {}
  int tensor(TensorSpec spec) override {
    const std::size_t at = begin_ + static_cast<std::size_t>(count);
    SEMFIELD_CHECK(at < tensors_.size(), "the device's part declares more tensors than the host's");
    const TensorSpec& host = tensors_[at].spec;
    SEMFIELD_CHECK(host.name == spec.name && host.rows == spec.rows && host.cols == spec.cols && host.role == spec.role,
                   "tensor '" + spec.name + "' differs on host and device");
    return count++;
  }
  int count = 0;

 private:
  const std::vector<Tensor<float>>& tensors_;
  std::size_t begin_;
};

}  // namespace

Store::Store(Pipeline<float>& host, bool trainable) : host_(host), trainable_(trainable) {
  std::int64_t values = 0, learned = 0, derived = 0;
  for (const Tensor<float>& t : host.store().all()) {
    Place place;
    place.value = values;
    values += padded(t.size());
    if (t.learned()) {
      place.learned = learned;
      learned += padded(t.size());
    } else if (t.spec.role == TensorRole::derived) {
      place.learned = derived;
      derived += padded(t.size());
    }
    places_.push_back(place);
  }
  values_ = Buffer<float>(static_cast<std::size_t>(values), "parameters");
  if (!trainable) return;
  const auto count = static_cast<std::size_t>(learned);
  grads_ = Buffer<float>(count, "gradients");
  derived_grads_ = Buffer<float>(static_cast<std::size_t>(derived), "gradients of derived tensors");
  moment1_ = Buffer<float>(count, "first moments");
  moment2_ = Buffer<float>(count, "second moments");
  std::vector<AdamTensor> table;
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Tensor<float>& t = host.store().all()[i];
    if (!t.learned()) continue;
    const std::int64_t at = places_[i].learned;
    table.push_back({value_of(i).data, grads_.data() + at, moment1_.data() + at, moment2_.data() + at, t.spec.rows,
                     t.spec.cols, t.spec.role == TensorRole::sparse, host.is_semantic(t), t.rule.rate,
                     t.rule.rate * t.rule.decay});
    learned_elements_ += t.size();
  }
  learned_count_ = static_cast<int>(table.size());
  learned_table_ = Buffer<std::byte>(table.size() * sizeof(AdamTensor), "table of tensors");
  cuda::upload<std::byte>(std::as_bytes(std::span<const AdamTensor>(table)), learned_table_.data());
  synchronize();
}

View<float> Store::value_of(std::size_t tensor) const {
  const TensorSpec& spec = host_.store().all()[tensor].spec;
  return {values_.data() + places_[tensor].value, spec.rows, spec.cols, spec.cols, Device::cuda};
}

View<float> Store::grad_of(std::size_t tensor) const {
  const TensorSpec& spec = host_.store().all()[tensor].spec;
  if (!trainable_ || spec.role == TensorRole::state) return {};
  float* const block = spec.role == TensorRole::derived ? derived_grads_.data() : grads_.data();
  return {block + places_[tensor].learned, spec.rows, spec.cols, spec.cols, Device::cuda};
}

int Store::add(const std::string&, const Parametric<float>& part, const LearningRule&) {
  Matcher matcher(host_.store().all(), next_);
  part.declare(matcher);
  Component component;
  for (int i = 0; i < matcher.count; ++i, ++next_) {
    component.values.push_back(value_of(next_));
    component.grads.push_back(grad_of(next_));
  }
  components_.push_back(std::move(component));
  return static_cast<int>(components_.size()) - 1;
}

Tensors<float> Store::tensors(int component, int) const {
  const Component& c = components_[static_cast<std::size_t>(component)];
  return {c.values, c.grads};
}

void Store::upload() {
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Tensor<float>& t = host_.store().all()[i];
    if (t.spec.role == TensorRole::derived) continue;
    const auto count = static_cast<std::size_t>(t.size());
    cuda::upload<float>({t.value.data(), count}, value_of(i).data);
    if (!trainable_ || !t.learned()) continue;
    cuda::upload<float>({t.moment1.data(), count}, moment1_.data() + places_[i].learned);
    cuda::upload<float>({t.moment2.data(), count}, moment2_.data() + places_[i].learned);
  }
  synchronize();
}

void Store::download() const {
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Tensor<float>& t = host_.store().all()[i];
    if (t.spec.role == TensorRole::derived) continue;
    const auto count = static_cast<std::size_t>(t.size());
    cuda::download<float>(value_of(i).data, {t.value.data(), count});
    if (!trainable_ || !t.learned()) continue;
    cuda::download<float>(moment1_.data() + places_[i].learned, {t.moment1.data(), count});
    cuda::download<float>(moment2_.data() + places_[i].learned, {t.moment2.data(), count});
  }
  synchronize();
}

void Store::zero_derived_gradients() const {
  if (derived_grads_.size() == 0) return;
  check(cudaMemsetAsync(derived_grads_.data(), 0, derived_grads_.size() * sizeof(float), launch().stream),
        "clearing gradients");
}

void Store::clear_gradients() const {
  zero_derived_gradients();
  if (grads_.size() == 0) return;
  check(cudaMemsetAsync(grads_.data(), 0, grads_.size() * sizeof(float), launch().stream), "clearing gradients");
}

std::size_t Store::bytes() const {
  return (values_.size() + grads_.size() + derived_grads_.size() + moment1_.size() + moment2_.size()) * sizeof(float);
}

}  // namespace semfield::cuda
