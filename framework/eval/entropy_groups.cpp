// Histograms of entropy and the ranks that they tell.
#include "eval/entropy_groups.h"

#include <algorithm>
#include <bit>
#include <cmath>

#include "core/check.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

constexpr float kLeast_nats = 0x1p-24F;
constexpr int kDroppedBits = 12;  // of a float's 23 bits of mantissa: 11 stay

// The upper bits of a positive float count up with its value.
int bin_of(float entropy_nats) {
  if (!(entropy_nats >= kLeast_nats)) return 0;
  const std::uint32_t above = std::bit_cast<std::uint32_t>(entropy_nats) - std::bit_cast<std::uint32_t>(kLeast_nats);
  return std::min(EntropyHistogram::kBins - 1, 1 + static_cast<int>(above >> kDroppedBits));
}

}  // namespace

void EntropyHistogram::add(float entropy_nats) {
  if (!std::isfinite(entropy_nats)) {
    ++nonfinite_;
    return;
  }
  if (counts_.empty()) counts_.assign(kBins, 0);
  ++counts_[static_cast<std::size_t>(bin_of(entropy_nats))];
  ++pixels_;
  sum_ += static_cast<double>(entropy_nats);
}

void EntropyHistogram::merge(const EntropyHistogram& other) {
  if (counts_.empty()) {
    counts_ = other.counts_;
  } else if (!other.counts_.empty()) {
    for (std::size_t b = 0; b < counts_.size(); ++b) counts_[b] += other.counts_[b];
  }
  sum_ += other.sum_;
  pixels_ += other.pixels_;
  nonfinite_ += other.nonfinite_;
}

std::optional<double> EntropyHistogram::mean() const {
  if (pixels_ == 0 || nonfinite_ > 0) return std::nullopt;
  return sum_ / static_cast<double>(pixels_);
}

std::optional<Auroc> auroc(const EntropyHistogram& low, const EntropyHistogram& high) {
  if (low.pixels() == 0 || high.pixels() == 0 || low.nonfinite() > 0 || high.nonfinite() > 0) return std::nullopt;
  double won = 0, tied = 0, below = 0;  // pairs; `below`: pixels of `low` in lower bins
  for (int b = 0; b < EntropyHistogram::kBins; ++b) {
    const auto l = static_cast<double>(low.bin(b)), h = static_cast<double>(high.bin(b));
    won += h * below;
    tied += h * l;
    below += l;
  }
  const double pairs = static_cast<double>(low.pixels()) * static_cast<double>(high.pixels());
  return Auroc{(won + tied / 2) / pairs, tied / 2 / pairs};
}

void PredictedEntropy::add(std::span<const float> entropy_nats, std::span<const std::int16_t> predicted,
                           std::span<const std::int16_t> truth) {
  SEMFIELD_CHECK(entropy_nats.size() == truth.size() && predicted.size() == truth.size(), "one value a pixel");
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid || predicted[i] == kVoid) continue;
    (predicted[i] == truth[i] ? right : wrong).add(entropy_nats[i]);
  }
}

void PredictedEntropy::merge(const PredictedEntropy& other) {
  right.merge(other.right);
  wrong.merge(other.wrong);
}

void GivenEntropy::add(std::span<const float> entropy_nats, std::span<const std::int16_t> given,
                       std::span<const std::int16_t> truth) {
  SEMFIELD_CHECK(entropy_nats.size() == truth.size() && (given.empty() || given.size() == truth.size()),
                 "one value a pixel");
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) continue;
    const std::int16_t label = given.empty() ? std::int16_t{kVoid} : given[i];
    (label == kVoid ? none : label == truth[i] ? right : wrong).add(entropy_nats[i]);
  }
}

void GivenEntropy::merge(const GivenEntropy& other) {
  right.merge(other.right);
  wrong.merge(other.wrong);
  none.merge(other.none);
}

std::optional<Auroc> GivenEntropy::detects_none() const {
  EntropyHistogram labelled = right;
  labelled.merge(wrong);
  return auroc(labelled, none);
}

}  // namespace semfield
