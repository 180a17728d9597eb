#include "cuda/steps/sample_room.h"

#include <algorithm>
#include <bit>

namespace semfield::cuda {

namespace {

constexpr std::int64_t kLeast = 8192;  // fewer rows make no step faster
constexpr double kSpare = 1.25, kTight = 1.06;
constexpr double kWorth = 0.75;  // of the room before: each change costs two steps without a graph

// Up to 16 sizes an octave, so that few graphs are made.
std::int64_t rounded_up(std::int64_t rows) {
  const int bits = std::bit_width(static_cast<std::uint64_t>(rows));
  const std::int64_t unit = std::int64_t{1} << std::max(0, bits - 4);
  return (rows + unit - 1) / unit * unit;
}

}  // namespace

bool SampleRoom::saw(std::int64_t samples) {
  if (most_ == 0) return false;
  const std::int64_t now = rows_ == 0 ? most_ : rows_;
  const double used = static_cast<double>(samples);
  std::int64_t wanted = std::max(kLeast, rounded_up(static_cast<std::int64_t>(used * kSpare)));
  if (static_cast<double>(wanted) > kWorth * static_cast<double>(most_)) wanted = most_;
  const bool tight = used * kTight > static_cast<double>(now);
  if (wanted == now || (!tight && static_cast<double>(wanted) > kWorth * static_cast<double>(now))) return false;
  rows_ = wanted == most_ ? 0 : wanted;
  return true;
}

}  // namespace semfield::cuda
