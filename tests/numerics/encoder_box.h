// An encoder of the registry with its own tensors, and numbers for its inputs.
#pragma once

#include "core/rng.h"
#include "named_case.h"
#include "tests/encoder_box.h"

namespace semfield::numerics {

using testkit::EncoderBox;
using testkit::make_encoder;

/// Uniform numbers for inputs, by address; float64 with all 53 bits.
class Numbers {
 public:
  explicit Numbers(std::uint64_t seed) : seed_(seed) {}
  double in(double low, double high) { return low + (high - low) * uniform(); }
  double uniform() {
    const PhiloxBlock b = random_block({seed_, 0, stream_id("stiff cases")}, next_++);
    return static_cast<double>((std::uint64_t{b.v[0]} << 21) ^ (b.v[1] >> 11)) * 0x1p-53;
  }

 private:
  std::uint64_t seed_, next_ = 0;
};

}  // namespace semfield::numerics
