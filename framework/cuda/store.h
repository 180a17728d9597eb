// The tensors of a pipeline on the device: the same names and shapes as the host's, in four blocks of memory.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "cuda/memory.h"
#include "model/param_store.h"

namespace semfield::cuda {

/// Mirrors `host`, which it borrows; without lanes. Gradients are zero between steps.
class Store final : public TensorStore<float> {
 public:
  Store(ParamStore<float>& host, bool trainable);

  /// The next component's tensors, in the order in which parts were added to the host's store; throws Error(internal)
  /// where `part` declares others.
  int add(const std::string& prefix, const Parametric<float>& part, const LearningRule& rule = {}) override;

  /// Gradients of all learned tensors, tensor behind tensor with gaps of zeros, and how many of these numbers the
  /// components have that were added until now.
  std::span<float> gradients() const { return {grads_.data(), grads_.size()}; }
  std::size_t gradients_added() const { return gradients_added_; }

  void upload();
  void download() const;
  /// Gradients that no update clears: those of derived tensors.
  void zero_derived_gradients() const;
  /// All of them, after a step that failed.
  void clear_gradients() const;

  /// Learned tensors, in device memory.
  AdamTable<float> learned() const {
    return {reinterpret_cast<const AdamTensor<float>*>(learned_table_.data()),
            static_cast<int>(learned_table_.size() / sizeof(AdamTensor<float>)), host_.learned_count()};
  }

 private:
  struct Place {
    std::int64_t value = 0;    // offset in values_
    std::int64_t learned = 0;  // offset in grads_, moment1_ and moment2_; of derived tensors in derived_grads_
  };
  View<float> value_of(std::size_t tensor) const;
  View<float> grad_of(std::size_t tensor) const;
  View<float> moment_of(const Buffer<float>& moments, std::size_t tensor) const;

  ParamStore<float>& host_;
  bool trainable_;
  std::vector<Place> places_;
  Buffer<float> values_, grads_, derived_grads_, moment1_, moment2_;
  Buffer<std::byte> learned_table_;
  std::size_t gradients_added_ = 0;
  std::size_t next_ = 0;  // tensor of the host's store that the next component begins with
};

}  // namespace semfield::cuda
