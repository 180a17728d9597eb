// Matrix products of a network, as its field tells them: what a step costs, and what there is to probe.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace semfield {

/// How often a product is made: for all samples, for all rays, or once per step (of weights with each other).
enum class LayerRows : std::uint8_t { sample, ray, step };

/// What it multiplies: inputs of the network have a gradient only where somebody wants it.
enum class LayerInput : std::uint8_t { activation, position, direction };

/// A product of forward or derive: rows through a weight [in, out].
struct LayerShape {
  std::string name;  ///< as its weight's tensor, "trunk_0"; a concatenated input makes two products of one weight
  std::int64_t in = 0, out = 0;
  LayerRows per = LayerRows::sample;
  LayerInput input = LayerInput::activation;
  std::int64_t rows = 1;  ///< for each sample, for each ray, or in all

  std::int64_t rows_of(std::int64_t samples, std::int64_t rays) const {
    return rows * (per == LayerRows::sample ? samples : per == LayerRows::ray ? rays : 1);
  }
  std::int64_t multiply_adds(std::int64_t samples, std::int64_t rays) const {
    return rows_of(samples, rays) * in * out;
  }
};

}  // namespace semfield
