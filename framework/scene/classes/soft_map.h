// Class probabilities of one frame's pixels, two bytes each.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "core/half.h"

namespace semfield {

/// [H * W, C] probabilities of internal class indices as binary16. A row need not sum to 1 (the rest is "some other
/// class"); a row of zeros is unlabelled.
class SoftMap {
 public:
  SoftMap() = default;
  SoftMap(std::size_t pixels, int classes);

  bool empty() const { return values_.empty(); }
  std::size_t pixels() const { return classes_ == 0 ? 0 : values_.size() / static_cast<std::size_t>(classes_); }
  int classes() const { return classes_; }
  float at(std::size_t pixel, int cls) const {
    return float_of_half(values_[pixel * static_cast<std::size_t>(classes_) + static_cast<std::size_t>(cls)]);
  }
  /// Row of a pixel into `out` [classes].
  void row(std::size_t pixel, std::span<float> out) const;
  /// Throws Error(data) for a negative value or one that is not finite.
  void set_row(std::size_t pixel, std::span<const float> probability);
  /// Most probable class, the first of equals; kVoid for a row of zeros.
  std::int16_t argmax(std::size_t pixel) const;
  bool labelled(std::size_t pixel) const { return argmax(pixel) >= 0; }
  std::size_t bytes() const { return values_.capacity() * sizeof(std::uint16_t); }
  bool operator==(const SoftMap&) const = default;

 private:
  int classes_ = 0;
  std::vector<std::uint16_t> values_;
};

}  // namespace semfield
