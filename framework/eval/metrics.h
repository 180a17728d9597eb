// Metrics of a split: segmentation, colour, depth and calibration, each an accumulator that is merged in frame order.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

namespace semfield {

// Every accumulator adds its pixels one after the other. For results that do not depend on the number of threads, fill
// one accumulator a frame and merge them in frame order.

/// Scores of one class; none where the ratio is 0/0.
struct ClassScore {
  std::int64_t truth_px = 0;      ///< scored pixels of this class in truth
  std::int64_t predicted_px = 0;  ///< scored pixels predicted as this class
  std::optional<double> iou;      ///< intersection over union; none when the union is empty
  std::optional<double> recall;   ///< correct / truth_px; none when the class is not in truth
};

/// One confusion matrix over all pixels of a split. Pixels with void truth are dropped; void predictions under valid
/// truth are dropped from scoring and counted. Labels are internal class indices in [0, classes) or kVoid (-1).
class ConfusionMatrix {
 public:
  /// classes >= 0; without classes nothing can be scored and every figure is "no data".
  explicit ConfusionMatrix(int classes);

  /// Adds pixels; both spans have one length. Throws Error(data) naming pixel and value for a label out of range; the
  /// matrix is then unchanged.
  void add(std::span<const std::int16_t> truth, std::span<const std::int16_t> predicted);
  void merge(const ConfusionMatrix& other);

  int classes() const { return classes_; }
  std::int64_t count(int truth, int predicted) const;
  std::int64_t scored_px() const;
  std::int64_t void_truth_px() const { return void_truth_; }
  std::int64_t void_predicted_px() const { return void_predicted_; }

  // Each is none ("no data") when no pixel was scored.
  std::optional<double> total_accuracy() const;    ///< trace / sum
  std::optional<double> average_accuracy() const;  ///< mean recall over classes present in truth
  std::optional<double> miou() const;              ///< mean IoU over classes with a non-empty union
  std::optional<double> miou_present() const;      ///< mean IoU over classes present in truth
  std::vector<ClassScore> per_class() const;

 private:
  int classes_;
  std::vector<std::int64_t> counts_;  // [classes, classes], row = truth
  std::int64_t void_truth_ = 0;
  std::int64_t void_predicted_ = 0;
};

/// Where labels are hardest: beside borders between classes, and in specks.
class LabelDetail {
 public:
  static constexpr std::int32_t kBorder_px = 8;        ///< counts as beside a border
  static constexpr std::int32_t kGap_px = 4;           ///< void between two classes up to twice as wide is a border too
  static constexpr std::int64_t kSpecksOfImage = 100;  ///< a connected piece below this part of the image is a speck
  explicit LabelDetail(int classes) : border(classes) {}
  /// Whole maps, row by row, of one image `width_px` wide.
  void add(std::span<const std::int16_t> truth, std::span<const std::int16_t> predicted, std::int32_t width_px);
  void merge(const LabelDetail& other);
  /// Wrong pixels in specks of the predicted labels, as a share of those with a true label.
  std::optional<double> specks() const;

  ConfusionMatrix border;  ///< of the pixels beside borders

 private:
  std::int64_t in_specks_ = 0, labelled_ = 0;
};

/// [H * W] 1 beside a border of the truth (LabelDetail).
std::vector<std::uint8_t> beside_borders(std::span<const std::int16_t> truth, std::int32_t width_px);

/// Pooled squared colour error: PSNR = -10 log10(MSE over all values of the split), colours in [0, 1].
class ColorError {
 public:
  /// Values of equal length (channels interleaved). Non-finite values are counted and make the metric invalid.
  void add(std::span<const float> truth, std::span<const float> predicted);
  void merge(const ColorError& other);
  std::int64_t values() const { return values_; }
  std::int64_t nonfinite() const { return nonfinite_; }
  std::optional<double> mse() const;      ///< none without values, or when a value was not finite
  std::optional<double> psnr_db() const;  ///< +infinity for equal images

 private:
  double squared_ = 0;
  std::int64_t values_ = 0;
  std::int64_t nonfinite_ = 0;
};

/// Structural similarity of one image pair, mean over windows and channels [Wang04, Eq. 13]: 11 x 11 Gaussian window of
/// sigma 1.5 pixels, K1 = 0.01, K2 = 0.03, dynamic range 1, windows that lie wholly inside the image. Layout [H, W,
/// channels]. None when the image is smaller than a window or a value is not finite. Average the results over images.
/// `used` [H, W], 0 = masked: windows that hold a masked pixel do not count, and without any other there is no value.
std::optional<double> ssim(std::span<const float> truth, std::span<const float> predicted, std::int32_t width_px,
                           std::int32_t height_px, std::int32_t channels, std::span<const std::uint8_t> used = {});

/// Depth errors over pixels with 0 < truth < far and prediction > 0 [Eigen14, Sec. 4.1], metres.
class DepthError {
 public:
  explicit DepthError(double far_m = 1e30) : far_m_(far_m) {}
  void add(std::span<const float> truth_m, std::span<const float> predicted_m);
  void merge(const DepthError& other);

  std::int64_t scored_px() const { return scored_; }
  std::int64_t valid_truth_px() const { return valid_truth_; }
  std::int64_t nonfinite() const { return nonfinite_; }  ///< predictions that are NaN or infinite under valid truth
  // None without scored pixels, or when a prediction was not finite.
  std::optional<double> abs_rel() const { return mean(abs_rel_); }    ///< mean |p - t| / t
  std::optional<double> abs_diff() const { return mean(abs_diff_); }  ///< mean |p - t|, m
  std::optional<double> sq_rel() const { return mean(sq_rel_); }      ///< mean (p - t)^2 / t, m
  std::optional<double> rmse() const;                                 ///< m
  std::optional<double> delta(int power) const;  ///< share with max(p / t, t / p) < 1.25^power, power 1..3
  std::optional<double> coverage() const;        ///< scored / valid truth; none without valid truth

 private:
  std::optional<double> mean(double sum) const;
  double far_m_;
  double abs_rel_ = 0, abs_diff_ = 0, sq_rel_ = 0, squared_ = 0;
  std::array<std::int64_t, 3> within_{};
  std::int64_t scored_ = 0, valid_truth_ = 0, nonfinite_ = 0;
};

/// Calibration of class probabilities: expected calibration error over 15 equal bins of confidence [Guo17, Eq. 3] and
/// mean negative log likelihood.
class Calibration {
 public:
  static constexpr int kBins = 15;
  /// Bin b holds confidences in (b / 15, (b + 1) / 15].
  struct Bin {
    std::int64_t pixels = 0, correct = 0;
    double confidence = 0;  ///< sum over its pixels
  };
  /// What a renderer kept of each pixel: the largest probability, its class, and the probability of the true class, of
  /// which p < 1.2e-38 counts as that. Void truth is dropped.
  void add(std::span<const float> confidence, std::span<const float> truth_probability,
           std::span<const std::int16_t> predicted, std::span<const std::int16_t> truth);
  void merge(const Calibration& other);
  std::int64_t scored_px() const { return scored_; }
  std::int64_t nonfinite() const { return nonfinite_; }
  const std::array<Bin, kBins>& bins() const { return bins_; }  ///< pixels that were not finite are in none
  std::optional<double> ece() const;
  std::optional<double> nll() const;  ///< nats per pixel

 private:
  void add_pixel(double confidence, bool correct, double truth_probability);
  std::array<Bin, kBins> bins_{};
  double nll_ = 0;
  std::int64_t scored_ = 0, nonfinite_ = 0;
};

/// H = -sum p ln p in nats, with 0 ln 0 = 0.
double entropy_nats(std::span<const float> probabilities);

// Colours of a view under an affine map of its own: cameras change exposure and white balance, which a field knows of
// the cameras it was trained on alone.

/// `predicted` [H, W, 3] with its left half under the 3 x 4 map of colours that fits the right half to `truth` best in
/// squared error, and the other way round, so that no pixel is scored by a map that has seen it. Values that are not
/// finite stay, and are left out of the fits, and so are those of masked pixels (`used` [H, W] is 0; empty: none).
std::vector<float> fitted_by_halves(std::span<const float> truth, std::span<const float> predicted,
                                    std::int32_t width_px, std::span<const std::uint8_t> used = {});

// Entropy of groups of pixels: means, and how well it tells one group from the other.

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

/// Entropy of pixels by a label of theirs, predicted or given for training: the true one, a wrong one, none. Void truth
/// is dropped.
struct LabelEntropy {
  EntropyHistogram right, wrong, none;
  /// `label` and `truth` class indices or kVoid; an empty `label` is a frame without labels.
  void add(std::span<const float> entropy_nats, std::span<const std::int16_t> label,
           std::span<const std::int16_t> truth);
  void merge(const LabelEntropy& other);
  std::int64_t pixels() const { return right.pixels() + wrong.pixels() + none.pixels(); }
  /// Of entropy as a detector of wrong labels among those that are there.
  std::optional<Auroc> detects_wrong() const { return auroc(right, wrong); }
  /// Of entropy as a detector of pixels without a label.
  std::optional<Auroc> detects_none() const;
};

// Numbers in the JSON files of a run: "inf", "-inf" and "nan" as texts, null for a value without data.

/// Whole numbers are written as integers. `Json` is a type of nlohmann-json, which no header names.
template <class Json>
Json number_json(std::optional<double> value) {
  if (!value) return nullptr;
  if (std::isnan(*value)) return "nan";
  if (std::isinf(*value)) return *value > 0 ? "inf" : "-inf";
  if (std::abs(*value) < 1e15 && *value == std::floor(*value)) return static_cast<std::int64_t>(*value);
  return *value;
}

/// False when `json` is none of what number_json writes.
template <class Json>
bool read_number_json(const Json& json, std::optional<double>& value) {
  value.reset();
  if (json.is_null()) return true;
  if (json.is_number()) {
    value = json.template get<double>();
    return true;
  }
  if (json == "nan") value = std::numeric_limits<double>::quiet_NaN();
  if (json == "inf") value = std::numeric_limits<double>::infinity();
  if (json == "-inf") value = -std::numeric_limits<double>::infinity();
  return value.has_value();
}

}  // namespace semfield
