// Entropy of groups of pixels: means, and how well it tells one group from the other.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <vector>

namespace semfield {

/// Counts of pixels by entropy, fine enough to compare ranks. Counts are integers, so they are the same in whatever
/// order frames and tiles are merged; the mean is summed in that order.
class EntropyHistogram {
 public:
  /// 2,048 bins an octave from 2^-24 nats, about what float probabilities resolve, to 8 nats, above the ln of 1,024
  /// classes. Entropies of one bin differ by less than 1/2,048 of themselves; all below 2^-24 are one bin.
  static constexpr int kBins = 1 + 27 * 2048;
  /// A value that is not finite is counted and takes the figures away.
  void add(float entropy_nats);
  void merge(const EntropyHistogram& other);
  std::int64_t pixels() const { return pixels_; }        ///< in bins
  std::int64_t nonfinite() const { return nonfinite_; }  ///< in none
  std::int64_t bin(int index) const { return counts_.empty() ? 0 : counts_[static_cast<std::size_t>(index)]; }
  std::optional<double> mean() const;  ///< nats; none without pixels, or when a value was not finite

 private:
  std::vector<std::int64_t> counts_;  // empty until the first pixel
  double sum_ = 0;
  std::int64_t pixels_ = 0, nonfinite_ = 0;
};

/// Area under the ROC curve.
struct Auroc {
  double value = 0;
  /// What binning may have changed at most: half of the share of pairs whose pixels lie in one bin.
  double error = 0;
};

/// The chance that a pixel of `high` has a higher entropy than one of `low` [Hanley82]: 1 tells them apart, 0.5 is
/// chance. Pixels of one bin are ties and count one half. None when a group has no pixel, or one that is not finite.
std::optional<Auroc> auroc(const EntropyHistogram& low, const EntropyHistogram& high);

/// Entropy of pixels whose predicted label is right, and wrong: those that the confusion matrix scores.
struct PredictedEntropy {
  EntropyHistogram right, wrong;
  void add(std::span<const float> entropy_nats, std::span<const std::int16_t> predicted,
           std::span<const std::int16_t> truth);
  void merge(const PredictedEntropy& other);
  /// Of entropy as a detector of wrong labels.
  std::optional<Auroc> detects_wrong() const { return auroc(right, wrong); }
};

/// Entropy of training pixels by the label that they were given: the true one, a wrong one, none. Void truth is
/// dropped.
struct GivenEntropy {
  EntropyHistogram right, wrong, none;
  /// `given` and `truth` class indices or kVoid; an empty `given` is a frame without labels.
  void add(std::span<const float> entropy_nats, std::span<const std::int16_t> given,
           std::span<const std::int16_t> truth);
  void merge(const GivenEntropy& other);
  std::int64_t pixels() const { return right.pixels() + wrong.pixels() + none.pixels(); }
  /// Of entropy as a detector of wrong labels among those given.
  std::optional<Auroc> detects_wrong() const { return auroc(right, wrong); }
  /// Of entropy as a detector of pixels that were given none.
  std::optional<Auroc> detects_none() const;
};

}  // namespace semfield
