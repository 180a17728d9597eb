// Metrics of a split.
#include "eval/metrics.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "scene/classes/class_table.h"

namespace semfield {

ConfusionMatrix::ConfusionMatrix(int classes) : classes_(classes) {
  SEMFIELD_CHECK(classes >= 0, "a confusion matrix cannot have fewer classes than none");
  counts_.assign(static_cast<std::size_t>(classes) * static_cast<std::size_t>(classes), 0);
}

void ConfusionMatrix::add(std::span<const std::int16_t> truth, std::span<const std::int16_t> predicted) {
  SEMFIELD_CHECK(truth.size() == predicted.size(), "truth and prediction have one length");
  const auto check = [&](const char* what, std::int16_t label, std::size_t pixel) {
    if (label == kVoid || (label >= 0 && label < classes_)) return;
    throw Error(
        ErrorKind::data, "labels.class.range",
        fmt::format("pixel {}: {} label {} lies outside [0, {})", pixel, what, static_cast<int>(label), classes_),
        "check that the labels and the model use one class table");
  };
  for (std::size_t i = 0; i < truth.size(); ++i) {
    check("true", truth[i], i);
    check("predicted", predicted[i], i);
  }
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) {
      ++void_truth_;
    } else if (predicted[i] == kVoid) {
      ++void_predicted_;
    } else {
      ++counts_[static_cast<std::size_t>(truth[i]) * static_cast<std::size_t>(classes_) +
                static_cast<std::size_t>(predicted[i])];
    }
  }
}

void ConfusionMatrix::merge(const ConfusionMatrix& other) {
  SEMFIELD_CHECK(classes_ == other.classes_, "both matrices count the same classes");
  for (std::size_t i = 0; i < counts_.size(); ++i) counts_[i] += other.counts_[i];
  void_truth_ += other.void_truth_;
  void_predicted_ += other.void_predicted_;
}

std::int64_t ConfusionMatrix::count(int truth, int predicted) const {
  SEMFIELD_CHECK(truth >= 0 && truth < classes_ && predicted >= 0 && predicted < classes_, "class out of range");
  return counts_[static_cast<std::size_t>(truth) * static_cast<std::size_t>(classes_) +
                 static_cast<std::size_t>(predicted)];
}

std::int64_t ConfusionMatrix::scored_px() const {
  std::int64_t sum = 0;
  for (std::int64_t n : counts_) sum += n;
  return sum;
}

std::vector<ClassScore> ConfusionMatrix::per_class() const {
  std::vector<ClassScore> scores(static_cast<std::size_t>(classes_));
  for (int c = 0; c < classes_; ++c) {
    ClassScore& score = scores[static_cast<std::size_t>(c)];
    for (int k = 0; k < classes_; ++k) {
      score.truth_px += count(c, k);
      score.predicted_px += count(k, c);
    }
    const auto correct = static_cast<double>(count(c, c));
    const std::int64_t joined = score.truth_px + score.predicted_px - count(c, c);
    if (joined > 0) score.iou = correct / static_cast<double>(joined);
    if (score.truth_px > 0) score.recall = correct / static_cast<double>(score.truth_px);
  }
  return scores;
}

namespace {

// Mean of the values that exist; none when there is none.
struct Mean {
  double sum = 0;
  int count = 0;
  void add(double value) {
    sum += value;
    ++count;
  }
  std::optional<double> get() const { return count > 0 ? std::optional(sum / count) : std::nullopt; }
};

}  // namespace

std::optional<double> ConfusionMatrix::total_accuracy() const {
  const std::int64_t all = scored_px();
  if (all == 0) return std::nullopt;
  std::int64_t correct = 0;
  for (int c = 0; c < classes_; ++c) correct += count(c, c);
  return static_cast<double>(correct) / static_cast<double>(all);
}

std::optional<double> ConfusionMatrix::average_accuracy() const {
  Mean mean;
  for (const ClassScore& score : per_class()) {
    if (score.recall) mean.add(*score.recall);
  }
  return mean.get();
}

std::optional<double> ConfusionMatrix::miou() const {
  Mean mean;
  for (const ClassScore& score : per_class()) {
    if (score.iou) mean.add(*score.iou);
  }
  return mean.get();
}

std::optional<double> ConfusionMatrix::miou_present() const {
  Mean mean;
  for (const ClassScore& score : per_class()) {
    if (score.truth_px > 0) mean.add(*score.iou);
  }
  return mean.get();
}

void ColorError::add(std::span<const float> truth, std::span<const float> predicted) {
  SEMFIELD_CHECK(truth.size() == predicted.size(), "truth and prediction have one length");
  double sum = 0;  // one partial sum a call: a frame's result does not depend on what came before it
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const double difference = static_cast<double>(predicted[i]) - static_cast<double>(truth[i]);
    if (std::isfinite(difference)) {
      sum += difference * difference;
    } else {
      ++nonfinite_;
    }
  }
  squared_ += sum;
  values_ += static_cast<std::int64_t>(truth.size());
}

void ColorError::merge(const ColorError& other) {
  squared_ += other.squared_;
  values_ += other.values_;
  nonfinite_ += other.nonfinite_;
}

std::optional<double> ColorError::mse() const {
  if (values_ == 0 || nonfinite_ > 0) return std::nullopt;
  return squared_ / static_cast<double>(values_);
}

std::optional<double> ColorError::psnr_db() const {
  const std::optional<double> error = mse();
  if (!error) return std::nullopt;
  if (*error == 0) return std::numeric_limits<double>::infinity();
  return -10.0 * std::log10(*error);
}

void DepthError::add(std::span<const float> truth_m, std::span<const float> predicted_m) {
  SEMFIELD_CHECK(truth_m.size() == predicted_m.size(), "truth and prediction have one length");
  DepthError sums(far_m_);
  for (std::size_t i = 0; i < truth_m.size(); ++i) {
    const double t = truth_m[i];
    const double p = predicted_m[i];
    if (!(t > 0 && t < far_m_)) continue;  // NaN fails both
    ++sums.valid_truth_;
    if (!std::isfinite(p)) {
      ++sums.nonfinite_;
      continue;
    }
    if (p <= 0) continue;
    const double error = p - t;
    ++sums.scored_;
    sums.abs_rel_ += std::abs(error) / t;
    sums.abs_diff_ += std::abs(error);
    sums.sq_rel_ += error * error / t;
    sums.squared_ += error * error;
    const double ratio = p > t ? p / t : t / p;
    double limit = 1.25;
    for (std::int64_t& within : sums.within_) {
      if (ratio < limit) ++within;
      limit *= 1.25;
    }
  }
  merge(sums);
}

void DepthError::merge(const DepthError& other) {
  abs_rel_ += other.abs_rel_;
  abs_diff_ += other.abs_diff_;
  sq_rel_ += other.sq_rel_;
  squared_ += other.squared_;
  for (std::size_t i = 0; i < within_.size(); ++i) within_[i] += other.within_[i];
  scored_ += other.scored_;
  valid_truth_ += other.valid_truth_;
  nonfinite_ += other.nonfinite_;
}

std::optional<double> DepthError::mean(double sum) const {
  if (scored_ == 0 || nonfinite_ > 0) return std::nullopt;
  return sum / static_cast<double>(scored_);
}

std::optional<double> DepthError::abs_rel() const { return mean(abs_rel_); }
std::optional<double> DepthError::abs_diff() const { return mean(abs_diff_); }
std::optional<double> DepthError::sq_rel() const { return mean(sq_rel_); }

std::optional<double> DepthError::rmse() const {
  const std::optional<double> squared = mean(squared_);
  return squared ? std::optional(std::sqrt(*squared)) : std::nullopt;
}

std::optional<double> DepthError::delta(int power) const {
  SEMFIELD_CHECK(power >= 1 && power <= 3, "thresholds are 1.25, 1.25^2 and 1.25^3");
  return mean(static_cast<double>(within_[static_cast<std::size_t>(power - 1)]));
}

std::optional<double> DepthError::coverage() const {
  if (valid_truth_ == 0) return std::nullopt;
  return static_cast<double>(scored_) / static_cast<double>(valid_truth_);
}

void Calibration::add(std::span<const float> probabilities, int classes, std::span<const std::int16_t> truth) {
  SEMFIELD_CHECK(classes >= 1 && probabilities.size() == truth.size() * static_cast<std::size_t>(classes),
                 "one row of probabilities a pixel");
  Calibration sums;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) continue;
    if (truth[i] < 0 || truth[i] >= classes) {
      throw Error(ErrorKind::data, "labels.class.range",
                  fmt::format("pixel {}: true label {} lies outside [0, {})", i, static_cast<int>(truth[i]), classes),
                  "check that the labels and the model use one class table");
    }
    const std::span<const float> row =
        probabilities.subspan(i * static_cast<std::size_t>(classes), static_cast<std::size_t>(classes));
    std::size_t best = 0;
    bool finite = true;
    for (std::size_t c = 0; c < row.size(); ++c) {
      finite = finite && std::isfinite(row[c]);
      if (row[c] > row[best]) best = c;
    }
    if (!finite) {
      ++sums.scored_;
      ++sums.nonfinite_;
      continue;
    }
    sums.add_pixel(row[best], best == static_cast<std::size_t>(truth[i]), row[static_cast<std::size_t>(truth[i])]);
  }
  merge(sums);
}

void Calibration::add(std::span<const float> confidence, std::span<const float> truth_probability,
                      std::span<const std::int16_t> predicted, std::span<const std::int16_t> truth) {
  SEMFIELD_CHECK(
      confidence.size() == truth.size() && truth_probability.size() == truth.size() && predicted.size() == truth.size(),
      "one value a pixel");
  Calibration sums;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) continue;
    if (std::isfinite(confidence[i]) && std::isfinite(truth_probability[i])) {
      sums.add_pixel(confidence[i], predicted[i] == truth[i], truth_probability[i]);
    } else {
      ++sums.scored_;
      ++sums.nonfinite_;
    }
  }
  merge(sums);
}

void Calibration::add_pixel(double confidence, bool correct, double truth_probability) {
  const int index = std::min(kBins - 1, std::max(0, static_cast<int>(std::ceil(confidence * kBins)) - 1));
  Bin& bin = bins_[static_cast<std::size_t>(index)];
  ++scored_;
  ++bin.pixels;
  bin.correct += correct ? 1 : 0;
  bin.confidence += confidence;
  nll_ -= std::log(std::max(truth_probability, static_cast<double>(std::numeric_limits<float>::min())));
}

void Calibration::merge(const Calibration& other) {
  for (std::size_t b = 0; b < bins_.size(); ++b) {
    bins_[b].pixels += other.bins_[b].pixels;
    bins_[b].correct += other.bins_[b].correct;
    bins_[b].confidence += other.bins_[b].confidence;
  }
  nll_ += other.nll_;
  scored_ += other.scored_;
  nonfinite_ += other.nonfinite_;
}

std::optional<double> Calibration::ece() const {
  if (scored_ == 0 || nonfinite_ > 0) return std::nullopt;
  double sum = 0;  // sum over bins of (n_b / n) |accuracy_b - confidence_b|
  for (const Bin& bin : bins_) sum += std::abs(static_cast<double>(bin.correct) - bin.confidence);
  return sum / static_cast<double>(scored_);
}

std::optional<double> Calibration::nll() const {
  if (scored_ == 0 || nonfinite_ > 0) return std::nullopt;
  return nll_ / static_cast<double>(scored_);
}

double entropy_nats(std::span<const float> probabilities) {
  double h = 0;
  for (float p : probabilities) {
    if (p > 0) h -= static_cast<double>(p) * std::log(static_cast<double>(p));
  }
  return h;
}

}  // namespace semfield
