// Metrics of a split.
#include "eval/metrics.h"

#include <fmt/format.h>

#include <Eigen/Dense>
#include <algorithm>
#include <bit>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "labels/mask_outlines.h"
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

// Mean of what `value` gives of the classes; none when it gives none.
template <class Value>
std::optional<double> mean_of(const std::vector<ClassScore>& scores, const Value& value) {
  double sum = 0;
  int count = 0;
  for (const ClassScore& score : scores) {
    const std::optional<double> found = value(score);
    if (!found) continue;
    sum += *found;
    ++count;
  }
  return count > 0 ? std::optional(sum / count) : std::nullopt;
}

}  // namespace

std::optional<double> ConfusionMatrix::total_accuracy() const {
  const std::int64_t all = scored_px();
  if (all == 0) return std::nullopt;
  std::int64_t correct = 0;
  for (int c = 0; c < classes_; ++c) correct += count(c, c);
  return static_cast<double>(correct) / static_cast<double>(all);
}

std::optional<double> ConfusionMatrix::average_accuracy() const {
  return mean_of(per_class(), [](const ClassScore& score) { return score.recall; });
}

std::optional<double> ConfusionMatrix::miou() const {
  return mean_of(per_class(), [](const ClassScore& score) { return score.iou; });
}

std::optional<double> ConfusionMatrix::miou_present() const {
  return mean_of(per_class(), [](const ClassScore& score) { return score.truth_px > 0 ? score.iou : std::nullopt; });
}

std::vector<std::uint8_t> beside_borders(std::span<const std::int16_t> truth, std::int32_t width_px) {
  const std::int32_t height_px = static_cast<std::int32_t>(std::ssize(truth)) / width_px;
  const auto at = [&](std::int32_t x, std::int32_t y) {
    return static_cast<std::size_t>(std::int64_t{y} * width_px + x);
  };
  // Classes grow into void until they meet.
  std::vector<std::int16_t> grown(truth.begin(), truth.end()), before;
  for (std::int32_t round = 0; round < LabelDetail::kGap_px; ++round) {
    before = grown;
    for (std::int32_t y = 0; y < height_px; ++y) {
      for (std::int32_t x = 0; x < width_px; ++x) {
        std::int16_t& own = grown[at(x, y)];
        if (own == kVoid && x > 0) own = before[at(x - 1, y)];
        if (own == kVoid && x + 1 < width_px) own = before[at(x + 1, y)];
        if (own == kVoid && y > 0) own = before[at(x, y - 1)];
        if (own == kVoid && y + 1 < height_px) own = before[at(x, y + 1)];
      }
    }
  }
  std::vector<std::uint8_t> beside(truth.size(), 0);
  constexpr std::int32_t kReach = LabelDetail::kBorder_px;
  const auto mark = [&](std::int32_t column, std::int32_t row) {
    for (std::int32_t y = std::max(0, row - kReach); y <= std::min(height_px - 1, row + kReach); ++y) {
      const std::int32_t dy = y - row;
      const auto dx = static_cast<std::int32_t>(std::sqrt(kReach * kReach - dy * dy));
      std::fill(beside.begin() + static_cast<std::ptrdiff_t>(at(std::max(0, column - dx), y)),
                beside.begin() + static_cast<std::ptrdiff_t>(at(std::min(width_px - 1, column + dx), y)) + 1, 1);
    }
  };
  for (std::int32_t y = 0; y < height_px; ++y) {
    for (std::int32_t x = 0; x < width_px; ++x) {
      const std::int16_t own = grown[at(x, y)];
      const auto differs = [&](std::int32_t column, std::int32_t row) {
        const std::int16_t other = grown[at(column, row)];
        return own != kVoid && other != kVoid && own != other;
      };
      if ((x + 1 < width_px && differs(x + 1, y)) || (y + 1 < height_px && differs(x, y + 1))) mark(x, y);
    }
  }
  return beside;
}

void LabelDetail::add(std::span<const std::int16_t> truth, std::span<const std::int16_t> predicted,
                      std::int32_t width_px) {
  SEMFIELD_CHECK(truth.size() == predicted.size() && std::ssize(truth) % width_px == 0, "whole maps of one size");
  const std::vector<std::uint8_t> beside = beside_borders(truth, width_px);
  std::vector<std::int16_t> near(truth.begin(), truth.end());
  for (std::size_t i = 0; i < near.size(); ++i)
    if (beside[i] == 0) near[i] = kVoid;
  border.add(near, predicted);
  const std::vector<std::int16_t> label(predicted.begin(), predicted.end());
  const PixelRegions pieces = regions_of(label, width_px, static_cast<std::int32_t>(std::ssize(label) / width_px));
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) continue;
    ++labelled_;
    const bool small = pieces.pixels[pieces.of_pixel[i]] * kSpecksOfImage < std::ssize(truth);
    in_specks_ += small && predicted[i] != truth[i] ? 1 : 0;
  }
}

void LabelDetail::merge(const LabelDetail& other) {
  border.merge(other.border);
  in_specks_ += other.in_specks_;
  labelled_ += other.labelled_;
}

std::optional<double> LabelDetail::specks() const {
  if (labelled_ == 0) return std::nullopt;
  return static_cast<double>(in_specks_) / static_cast<double>(labelled_);
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

// Structural similarity of one image pair.

namespace {

constexpr int kWindow = 11;
constexpr double kSigma = 1.5;
constexpr double kC1 = 0.01 * 0.01;  // (K1 L)^2 with dynamic range L = 1
constexpr double kC2 = 0.03 * 0.03;

std::array<double, kWindow> window_weights() {
  std::array<double, kWindow> w{};
  double sum = 0;
  for (int i = 0; i < kWindow; ++i) {
    const double x = i - kWindow / 2;
    w[static_cast<std::size_t>(i)] = std::exp(-x * x / (2 * kSigma * kSigma));
    sum += w[static_cast<std::size_t>(i)];
  }
  for (double& value : w) value /= sum;
  return w;
}

// Weighted moments of a window: means and raw second moments of both images.
struct Moments {
  double x = 0, y = 0, xx = 0, yy = 0, xy = 0;
  void add(double w, const Moments& m) {
    x += w * m.x;
    y += w * m.y;
    xx += w * m.xx;
    yy += w * m.yy;
    xy += w * m.xy;
  }
};

// SSIM = (2 mu_x mu_y + C1)(2 s_xy + C2) / ((mu_x^2 + mu_y^2 + C1)(s_x^2 + s_y^2 + C2)) [Wang04, Eq. 13]
double similarity(const Moments& m) {
  const double vx = std::max(0.0, m.xx - m.x * m.x);
  const double vy = std::max(0.0, m.yy - m.y * m.y);
  const double vxy = m.xy - m.x * m.y;
  return (2 * m.x * m.y + kC1) * (2 * vxy + kC2) / ((m.x * m.x + m.y * m.y + kC1) * (vx + vy + kC2));
}

}  // namespace

std::optional<double> ssim(std::span<const float> truth, std::span<const float> predicted, std::int32_t width_px,
                           std::int32_t height_px, std::int32_t channels, std::span<const std::uint8_t> used) {
  SEMFIELD_CHECK(width_px >= 0 && height_px >= 0 && channels >= 1, "image size");
  const std::size_t row_values = static_cast<std::size_t>(width_px) * static_cast<std::size_t>(channels);
  SEMFIELD_CHECK(truth.size() == row_values * static_cast<std::size_t>(height_px) && predicted.size() == truth.size(),
                 "images have width * height * channels values");
  const std::int64_t out_rows = height_px - kWindow + 1;
  const std::int64_t out_cols = width_px - kWindow + 1;
  if (out_rows < 1 || out_cols < 1) return std::nullopt;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (!std::isfinite(truth[i]) || !std::isfinite(predicted[i])) return std::nullopt;
  }
  const std::array<double, kWindow> w = window_weights();
  // Masked pixels above and to the left of each pixel, to tell the windows that hold one.
  const auto side = static_cast<std::size_t>(width_px) + 1;
  std::vector<std::int64_t> masked(used.empty() ? 0 : side * (static_cast<std::size_t>(height_px) + 1));
  for (std::size_t i = side; i < masked.size(); ++i) {
    if (i % side == 0) continue;
    const std::size_t pixel = (i / side - 1) * (side - 1) + i % side - 1;
    masked[i] = masked[i - 1] + masked[i - side] - masked[i - side - 1] + (used[pixel] == 0 ? 1 : 0);
  }
  const auto counts = [&](std::int64_t row, std::int64_t column) {
    if (masked.empty()) return true;
    const std::size_t top = static_cast<std::size_t>(row) * side + static_cast<std::size_t>(column);
    const std::size_t bottom = top + kWindow * side;
    return masked[bottom + kWindow] - masked[bottom] == masked[top + kWindow] - masked[top];
  };
  // One sum a row, added in row order: the same bits for any number of threads.
  std::vector<double> row_sum(static_cast<std::size_t>(out_rows), 0.0);
  std::vector<std::int64_t> row_windows(row_sum.size());
  parallel_for(out_rows, [&](std::int64_t r) {
    std::vector<Moments> column(row_values);  // vertical pass
    for (int k = 0; k < kWindow; ++k) {
      const std::size_t base = static_cast<std::size_t>(r + k) * row_values;
      for (std::size_t i = 0; i < row_values; ++i) {
        const double x = truth[base + i];
        const double y = predicted[base + i];
        column[i].add(w[static_cast<std::size_t>(k)], {x, y, x * x, y * y, x * y});
      }
    }
    double sum = 0;
    const std::size_t outputs = static_cast<std::size_t>(out_cols) * static_cast<std::size_t>(channels);
    for (std::size_t i = 0; i < outputs; ++i) {
      if (!counts(r, static_cast<std::int64_t>(i) / channels)) continue;
      ++row_windows[static_cast<std::size_t>(r)];
      Moments m;
      for (int k = 0; k < kWindow; ++k) {
        m.add(w[static_cast<std::size_t>(k)],
              column[i + static_cast<std::size_t>(k) * static_cast<std::size_t>(channels)]);
      }
      sum += similarity(m);
    }
    row_sum[static_cast<std::size_t>(r)] = sum;
  });
  double total = 0;
  for (double sum : row_sum) total += sum;
  std::int64_t windows = 0;
  for (const std::int64_t n : row_windows) windows += n;
  if (windows == 0) return std::nullopt;
  return total / static_cast<double>(windows);
}

namespace {

using Colors = Eigen::Matrix<double, 4, 3>;

// A weak pull towards the identity, for halves of one colour.
constexpr double kPull = 1e-3;

struct Fit {
  Eigen::Matrix4d square = Eigen::Matrix4d::Zero();
  Colors right = Colors::Zero();

  void add(const float* truth, const float* predicted) {
    Eigen::Vector4d from(double{predicted[0]}, double{predicted[1]}, double{predicted[2]}, 1);
    const Eigen::RowVector3d to(double{truth[0]}, double{truth[1]}, double{truth[2]});
    if (!from.allFinite() || !to.allFinite()) return;
    square += from * from.transpose();
    right += from * to;
  }
  Colors solve() const {
    const double pull = kPull * std::max(1.0, square(3, 3));
    Colors identity = Colors::Zero();
    identity.topRows<3>().setIdentity();
    const Eigen::Matrix4d damped = square + pull * Eigen::Matrix4d::Identity();
    return damped.ldlt().solve(right + pull * identity);
  }
};

}  // namespace

std::vector<float> fitted_by_halves(std::span<const float> truth, std::span<const float> predicted,
                                    std::int32_t width_px, std::span<const std::uint8_t> used) {
  SEMFIELD_CHECK(truth.size() == predicted.size(), "truth and prediction have one length");
  const std::size_t pixels = predicted.size() / 3, width = static_cast<std::size_t>(width_px);
  const auto half_of = [&](std::size_t pixel) { return pixel % width < width / 2 ? 0 : 1; };
  Fit fits[2];
  for (std::size_t p = 0; p < pixels; ++p) {
    if (used.empty() || used[p] != 0) fits[half_of(p)].add(&truth[3 * p], &predicted[3 * p]);
  }
  const Colors maps[2] = {fits[1].solve(), fits[0].solve()};  // of the other half
  std::vector<float> out(predicted.size());
  for (std::size_t p = 0; p < pixels; ++p) {
    const float* const color = &predicted[3 * p];
    const Eigen::RowVector4d from(double{color[0]}, double{color[1]}, double{color[2]}, 1);
    const Eigen::RowVector3d to = from * maps[half_of(p)];
    for (int i = 0; i < 3; ++i) out[3 * p + static_cast<std::size_t>(i)] = static_cast<float>(to[i]);
  }
  return out;
}

// Histograms of entropy and the ranks that they tell.

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

void LabelEntropy::add(std::span<const float> entropy_nats, std::span<const std::int16_t> label,
                       std::span<const std::int16_t> truth) {
  SEMFIELD_CHECK(entropy_nats.size() == truth.size() && (label.empty() || label.size() == truth.size()),
                 "one value a pixel");
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (truth[i] == kVoid) continue;
    const std::int16_t own = label.empty() ? std::int16_t{kVoid} : label[i];
    (own == kVoid ? none : own == truth[i] ? right : wrong).add(entropy_nats[i]);
  }
}

void LabelEntropy::merge(const LabelEntropy& other) {
  right.merge(other.right);
  wrong.merge(other.wrong);
  none.merge(other.none);
}

std::optional<Auroc> LabelEntropy::detects_none() const {
  EntropyHistogram labelled = right;
  labelled.merge(wrong);
  return auroc(labelled, none);
}

}  // namespace semfield
