#include "cuda/store.h"

#include <algorithm>

#include "core/check.h"

namespace semfield::cuda {

namespace {

constexpr std::int64_t kAlignElements = 64;  // elements: a tensor starts on a 256-byte boundary

std::int64_t padded(std::int64_t count) { return (count + kAlignElements - 1) / kAlignElements * kAlignElements; }

}  // namespace

Store::Store(ParamStore<float>& host, bool trainable) : host_(host), trainable_(trainable) {
  std::int64_t values = 0, learned = 0, derived = 0;
  for (const Tensor<float>& t : host.all()) {
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
  std::vector<AdamTensor<float>> table;
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Tensor<float>& t = host.all()[i];
    if (!t.learned()) continue;
    table.push_back(
        learn(value_of(i), grad_of(i), moment_of(moment1_, i), moment_of(moment2_, i), t.spec.role, t.rule));
  }
  learned_table_ = Buffer<AdamTensor<float>>(table.size(), "table of tensors");
  cuda::upload<AdamTensor<float>>(table, learned_table_.data());
  synchronize();
}

View<float> Store::value_of(std::size_t tensor) const {
  const TensorSpec& spec = host_.all()[tensor].spec;
  return {values_.data() + places_[tensor].value, spec.rows, spec.cols, spec.cols, Device::cuda};
}

View<float> Store::grad_of(std::size_t tensor) const {
  const TensorSpec& spec = host_.all()[tensor].spec;
  if (!trainable_ || !has_gradient(spec.role)) return {};
  float* const block = spec.role == TensorRole::derived ? derived_grads_.data() : grads_.data();
  return {block + places_[tensor].learned, spec.rows, spec.cols, spec.cols, Device::cuda};
}

View<float> Store::moment_of(const Buffer<float>& moments, std::size_t tensor) const {
  const TensorSpec& spec = host_.all()[tensor].spec;
  return {moments.data() + places_[tensor].learned, spec.rows, spec.cols, spec.cols, Device::cuda};
}

int Store::add(const std::string&, const Parametric<float>& part, const LearningRule&) {
  Component component;
  component.grads.resize(1);
  for (const TensorSpec& spec : specs_of(part)) {
    // What a CPU's kernels read in another order no device has.
    while (next_ < host_.all().size() && host_.all()[next_].spec.role == TensorRole::rearranged &&
           host_.all()[next_].spec.name != spec.name)
      ++next_;
    SEMFIELD_CHECK(next_ < host_.all().size(), "the device's part declares more tensors than the host's");
    const TensorSpec& host = host_.all()[next_].spec;
    SEMFIELD_CHECK(host.name == spec.name && host.rows == spec.rows && host.cols == spec.cols && host.role == spec.role,
                   "tensor '" + spec.name + "' differs on host and device");
    component.values.push_back(value_of(next_));
    component.grads[0].push_back(grad_of(next_));
    if (trainable_ && host_.all()[next_].learned())
      gradients_added_ = static_cast<std::size_t>(places_[next_].learned + padded(host_.all()[next_].size()));
    ++next_;
  }
  return keep(std::move(component));
}

// What is made of others is not sent.
void Store::send(std::size_t i) {
  const Tensor<float>& t = host_.all()[i];
  if (!is_stored(t.spec.role)) return;
  const auto count = static_cast<std::size_t>(t.size());
  cuda::upload<float>({t.value.data(), count}, value_of(i).data);
  if (!trainable_ || !t.learned()) return;
  cuda::upload<float>({t.moment1.data(), count}, moment_of(moment1_, i).data);
  cuda::upload<float>({t.moment2.data(), count}, moment_of(moment2_, i).data);
}

void Store::fetch(std::size_t i) const {
  const Tensor<float>& t = host_.all()[i];
  if (!is_stored(t.spec.role)) return;
  const auto count = static_cast<std::size_t>(t.size());
  cuda::download<float>(value_of(i).data, {t.value.data(), count});
  if (!trainable_ || !t.learned()) return;
  cuda::download<float>(moment_of(moment1_, i).data, {t.moment1.data(), count});
  cuda::download<float>(moment_of(moment2_, i).data, {t.moment2.data(), count});
}

void Store::upload(bool semantic) {
  for (std::size_t i = 0; i < places_.size(); ++i)
    if (!semantic || host_.all()[i].rule.semantic) send(i);
  synchronize();
}

void Store::download(bool semantic) const {
  for (std::size_t i = 0; i < places_.size(); ++i)
    if (!semantic || host_.all()[i].rule.semantic) fetch(i);
  synchronize();
}

AdamTable<float> Store::semantic(double weight_decay) {
  std::vector<AdamTensor<float>> table;
  std::int64_t elements = 0;
  for (std::size_t i = 0; i < places_.size(); ++i) {
    const Tensor<float>& t = host_.all()[i];
    if (!t.learned() || !t.rule.semantic) continue;
    AdamTensor<float>& one = table.emplace_back();
    one.value = value_of(i).data;
    one.grad = grad_of(i).data;
    one.moment1 = moment_of(moment1_, i).data;
    one.moment2 = moment_of(moment2_, i).data;
    one.rows = t.spec.rows;
    one.cols = t.spec.cols;
    one.decay = t.spec.rows > 1 ? weight_decay : 0;  // not of biases
    elements += t.size();
  }
  if (semantic_table_.size() < table.size())
    semantic_table_ = Buffer<AdamTensor<float>>(table.size(), "table of semantic tensors");
  cuda::upload<AdamTensor<float>>(table, semantic_table_.data());
  synchronize();
  return {semantic_table_.data(), static_cast<int>(table.size()), elements};
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

}  // namespace semfield::cuda
