#include "scene/classes/soft_map.h"

#include <bit>
#include <cmath>
#include <string>

#include "core/check.h"
#include "core/error.h"
#include "scene/classes/class_table.h"

namespace semfield {

SoftMap::SoftMap(std::size_t pixels, int classes)
    : classes_(classes), values_(pixels * static_cast<std::size_t>(classes)) {}

void SoftMap::row(std::size_t pixel, std::span<float> out) const {
  const auto width = static_cast<std::size_t>(classes_);
  SEMFIELD_CHECK(out.size() == width, "row of another width");
  for (std::size_t c = 0; c < width; ++c) out[c] = float_of_half(values_[pixel * width + c]);
}

void SoftMap::set_row(std::size_t pixel, std::span<const float> probability) {
  const auto width = static_cast<std::size_t>(classes_);
  SEMFIELD_CHECK(probability.size() == width, "row of another width");
  for (std::size_t c = 0; c < width; ++c) {
    if (!(probability[c] >= 0) || !std::isfinite(probability[c])) {
      throw Error(ErrorKind::data, "labels.probability.invalid",
                  "probability of class " + std::to_string(c) + " at pixel " + std::to_string(pixel) + " is " +
                      std::to_string(probability[c]),
                  "probabilities are finite and not negative");
    }
    values_[pixel * width + c] = half_of(probability[c]);
  }
}

std::int16_t SoftMap::argmax(std::size_t pixel) const {
  // Halves of non-negative values are ordered as their bits.
  const auto width = static_cast<std::size_t>(classes_);
  std::int16_t best = kVoid;
  std::uint16_t most = 0;
  for (std::size_t c = 0; c < width; ++c) {
    const std::uint16_t value = values_[pixel * width + c];
    if (value > most && value <= 0x7C00u) {
      most = value;
      best = static_cast<std::int16_t>(c);
    }
  }
  return best;
}

}  // namespace semfield
