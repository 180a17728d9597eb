// The tensors of a pipeline on the device: the same names and shapes as the host's, in four blocks of memory.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "cuda/launch.h"
#include "model/param_store.h"

namespace semfield::cuda {

/// Mirrors `host`, which it borrows. Gradients are zero between steps.
class Store final : public TensorStore<float> {
 public:
  Store(ParamStore<float>& host, bool trainable);

  /// The next component's tensors, in the order in which parts were added to the host's store; throws Error(internal)
  /// where `part` declares others.
  int add(const std::string& prefix, const Parametric<float>& part, const LearningRule& rule = {}) override;

  /// All values, tensor behind tensor with gaps; stores of the same tensors have them at the same places.
  std::span<float> values() const { return {values_.data(), values_.size()}; }
  /// Gradients of all learned tensors, tensor behind tensor with gaps of zeros, and how many of these numbers the
  /// components have that were added until now.
  std::span<float> gradients() const { return {grads_.data(), grads_.size()}; }
  std::size_t gradients_added() const { return gradients_added_; }

  /// Values and moments to the device and back, of all tensors or of those that labels shape alone.
  void upload(bool semantic = false);
  void download(bool semantic = false) const;
  /// Gradients that no update clears: those of derived tensors.
  void zero_derived_gradients() const;
  /// All of them, after a step that failed.
  void clear_gradients() const;

  /// Those that labels shape, with a decay of their weights in place of their own rules. Valid until the next call.
  AdamTable<float> semantic(double weight_decay);
  /// Learned tensors, in device memory.
  AdamTable<float> learned() const {
    return {learned_table_.data(), static_cast<int>(learned_table_.size()), host_.learned_count()};
  }

 private:
  struct Place {
    std::int64_t value = 0;    // offset in values_
    std::int64_t learned = 0;  // offset in grads_, moment1_ and moment2_; of derived tensors in derived_grads_
  };
  void send(std::size_t tensor);
  void fetch(std::size_t tensor) const;
  View<float> value_of(std::size_t tensor) const;
  View<float> grad_of(std::size_t tensor) const;
  View<float> moment_of(const Buffer<float>& moments, std::size_t tensor) const;

  ParamStore<float>& host_;
  bool trainable_;
  std::vector<Place> places_;
  Buffer<float> values_, grads_, derived_grads_, moment1_, moment2_;
  Buffer<AdamTensor<float>> learned_table_, semantic_table_;
  std::size_t gradients_added_ = 0;
  std::size_t next_ = 0;  // tensor of the host's store that the next component begins with
};

}  // namespace semfield::cuda
