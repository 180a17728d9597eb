// Renders whole frames and scores them against what the scene knows.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"
#include "core/view.h"
#include "eval/metrics.h"
#include "execution/pipeline.h"
#include "labels/training_labels.h"
#include "scene/camera.h"
#include "scene/pixel_rays.h"
#include "scene/scene.h"

namespace semfield {

/// Camera at a pose, ready to cast. `undistort` false: the caller knows that there is no distortion.
struct RayCamera {
  Camera camera;
  Pose world_from_camera;
  bool undistort = true;
};

/// Ray through the centre of pixel (column, row): origin [3], unit direction [3] in world axes, near_far [2] in metres
/// along the ray. A pixel without an inverse distortion, or a ray that misses the bounds, gets near = far = 0: an empty
/// ray. Returns the cosine between the ray and the optical axis, 1 of a wide lens: depth = cosine * distance (0 for a
/// pixel without direction).
double cast_ray(const RayCamera& camera, const RayLimits& limits, std::int32_t column, std::int32_t row, double* origin,
                double* direction, double* near_far);

/// Pixels that met something, and those of them whose opacity came in too few, too long steps
/// (model/compositor.h).
struct OpacityCounts {
  std::int64_t opaque_px = 0, under_resolved_px = 0;
  /// Above this share a run is told so.
  static constexpr double kTold = 0.1;
  std::optional<double> share() const {
    if (opaque_px == 0) return std::nullopt;
    return static_cast<double>(under_resolved_px) / static_cast<double>(opaque_px);
  }
  /// A sentence with a remedy when the share is above kTold, else "".
  std::string warning() const;
};

/// Maps of one frame, row-major. Label, entropy and confidence are empty without semantics.
struct RenderedFrame {
  std::int32_t width_px = 0, height_px = 0;
  std::int32_t stride = 1;               ///< of the frame's pixels
  std::vector<float> rgb;                ///< [H * W * 3] in [0, 1]
  std::vector<float> depth_m;            ///< [H * W] z-depth, expected depth sum w t (not divided by opacity)
  std::vector<float> opacity;            ///< [H * W]
  std::vector<std::int16_t> label;       ///< [H * W] class index (not logit)
  std::vector<float> entropy;            ///< [H * W] nats
  std::vector<float> confidence;         ///< [H * W]
  std::vector<float> truth_probability;  ///< [H * W], when truth was given
  std::vector<float> probability;        ///< [H * W * C] by class index, 0 without a logit; FrameOptions::probability
  std::vector<FrameChannel> channels;    ///< FrameOptions::channels, in their order
  OpacityCounts resolution;
};

/// Which class each logit stands for; empty without semantics.
using ClassOfLogit = std::vector<int>;

struct FrameOptions {
  std::int32_t stride = 1;               ///< pixels taken; maps are smaller by it
  std::function<void(double)> progress;  ///< share of the pixels that are done, 0 to 1; may be null
  bool probability = false;              ///< fill RenderedFrame::probability, 4 C bytes per pixel
  int classes = 0;                       ///< C of the scene; read for `probability` alone
  std::vector<std::string> channels{};   ///< of heads in addition to that of class logits, which the pipeline has
  bool color = true;                     ///< fill RenderedFrame::rgb; without it colour is not computed
};

/// `truth` [H * W] class indices of the pixels rendered, or empty. A value that is not finite is an Error that names
/// the pixel.
RenderedFrame render_frame(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                           const ClassOfLogit& class_of_logit, const std::vector<std::int16_t>& truth = {},
                           const FrameOptions& options = {});
/// The same; an Error names the frame too.
RenderedFrame render_named_frame(Pipeline<float>& pipeline, const std::string& name, const RayCamera& camera,
                                 const RayLimits& limits, const ClassOfLogit& class_of_logit,
                                 const std::vector<std::int16_t>& truth = {}, const FrameOptions& options = {});

struct FrameScore {
  int frame = 0;
  std::string name;
  std::optional<double> psnr_db, miou_present, absrel;
  /// By mIoU where both have one, else by PSNR; a frame without either is not worse than any.
  bool worse_than(const FrameScore& other) const;
};

/// Scores of a set of frames: every metric pooled over all pixels.
struct SplitScore {
  explicit SplitScore(int classes, double far_m)
      : confusion(classes), detail(classes), photo_confusion(classes), photo_detail(classes), depth(far_m) {}
  ConfusionMatrix confusion;
  LabelDetail detail;  ///< with stride 1
  // Labels that cling to the view's photograph (eval/photo_edges.h), with stride 1.
  ConfusionMatrix photo_confusion;
  LabelDetail photo_detail;
  Calibration photo_calibration;
  ColorError color;
  ColorError fitted_color;  ///< EvalJob::fit_colors
  DepthError depth;
  Calibration calibration;
  LabelEntropy entropy;  ///< of predicted labels
  LabelEntropy given;    ///< of EvalJob::given
  double ssim_sum = 0;
  std::int64_t ssim_frames = 0;
  OpacityCounts resolution;
  std::int64_t pixels = 0;  ///< rendered, masked ones too
  std::vector<FrameScore> frames;

  std::optional<double> ssim() const;
  /// Name and value of every metric that has data, in a fixed order: psnr, ssim, miou, miou_present, total_accuracy,
  /// ...
  std::vector<std::pair<std::string, std::optional<double>>> values() const;
};

struct EvalJob {
  const std::vector<FrameInfo>* infos = nullptr;
  const std::vector<StoredFrame>* buffers = nullptr;
  std::vector<int> frames;
  int classes = 0;
  bool undistort = true;
  std::int32_t stride = 1;                ///< above 1 SSIM has no value: it needs neighbours
  bool fit_colors = false;                ///< score colours once more under maps of half frames (fitted_by_halves)
  const TrainingLabels* given = nullptr;  ///< of the frames scored; null: entropy is not grouped by them
  /// Called with the number of frames that are done, parts of one included; may be null.
  std::function<void(double)> progress;
  /// Called after each frame with its scores and maps; may be null.
  std::function<void(const FrameScore&, const RenderedFrame&)> on_frame;
  /// Asked between frames; true ends the evaluation early.
  std::function<bool()> stop;
};

/// An evaluation that is under way.
struct ScoreProgress {
  const char* split = "";  ///< "test" or "train"
  double done = 0;         ///< frames; parts of one included
  std::int64_t frames = 0;
};

SplitScore evaluate(Pipeline<float>& pipeline, const EvalJob& job, const RayLimits& limits,
                    const ClassOfLogit& class_of_logit);

/// Up to `count` of `all`, evenly spaced, always the same ones.
std::vector<int> evenly_spaced(const std::vector<int>& all, int count);

// How much of a run's time its evaluations may take, and what fits into that.

/// Evaluations while training get half of `share` of the seconds trained, the last one what is then left of
/// (1 + share) times the time that the run was asked for. A share of 0 bounds nothing; without a time the last one is
/// not bounded.
class EvalBudget {
 public:
  EvalBudget(double share, double time_s) : share_(share), time_s_(time_s) {}

  /// An evaluation of so many pixels took so long.
  void spend(double seconds, double pixels);
  bool knows_cost() const { return s_per_px_ >= 0; }
  bool bounds_samples() const { return share_ > 0; }
  bool bounds_last() const { return share_ > 0 && time_s_ > 0; }

  /// Pixels of a sample that is scored every `every_s` seconds, so that it keeps to its share.
  std::int32_t sample_stride(double pixels, double every_s, std::int32_t most) const;
  /// Whether the samples so far kept to their share of `trained_s` seconds of training.
  bool has_time_for_sample(double trained_s) const { return !bounds_samples() || spent_s_ <= share_ / 2 * trained_s; }
  /// Seconds that the last evaluation may take after `train_s` seconds of training; infinite where nothing bounds it.
  double left_s(double train_s) const;
  /// The least stride with which `pixels` fit into `budget_s`, at most `most`; 1 where the cost is not known.
  std::int32_t stride_within(double budget_s, double pixels, std::int32_t most) const;

 private:
  double share_, time_s_;
  double spent_s_ = 0, s_per_px_ = -1;
};

// The pixels that a frame is scored at: every s-th of every s-th row.

struct PixelPlace {
  std::int32_t column = 0, row = 0;
};

/// Pixels that a stride takes of a side; the stride is at most its length.
inline std::int32_t strided_px(std::int32_t length_px, std::int32_t stride) { return length_px / stride; }

/// Where pixel `index` of the smaller map, `map_width_px` wide, lies in the frame.
inline PixelPlace strided_place(std::int64_t index, std::int32_t map_width_px, std::int32_t stride) {
  return {static_cast<std::int32_t>(index % map_width_px) * stride + stride / 2,
          static_cast<std::int32_t>(index / map_width_px) * stride + stride / 2};
}

/// The values [height * width * channels] that a stride takes; an empty map stays empty.
template <class Value>
std::vector<Value> strided(std::vector<Value> whole, std::int32_t width_px, std::int32_t height_px,
                           std::int32_t channels, std::int32_t stride) {
  if (stride == 1 || whole.empty()) return whole;
  const std::int32_t width = strided_px(width_px, stride), height = strided_px(height_px, stride);
  std::vector<Value> out;
  out.reserve(static_cast<std::size_t>(std::int64_t{width} * height * channels));
  for (std::int64_t i = 0; i < std::int64_t{width} * height; ++i) {
    const PixelPlace at = strided_place(i, width, stride);
    const auto first = whole.begin() + (std::int64_t{at.row} * width_px + at.column) * channels;
    out.insert(out.end(), first, first + channels);
  }
  return out;
}

// Figures by the rules of published evaluations: which frames and classes count, and what is void.

/// What a protocol says. All pool the pixels of the held-out frames into one confusion matrix and take the mean of IoU
/// and of recall over the classes present in truth.
struct Protocol {
  std::string name;
  std::string cites;                 ///< keys of references.bib
  std::vector<std::string> classes;  ///< names that count; empty: every class of the scene that is not void
  std::string void_rule;             ///< a sentence
};
/// semantic_nerf [Zhi21], panoptic_lifting [Siddiqui23], nyu40 [Gupta13], scannet20 [Dai17]. Throws Error(usage) for
/// another name.
Protocol protocol_named(const std::string& name);
std::vector<std::string> protocol_names();

struct ProtocolClass {
  std::string name;
  std::int64_t truth_px = 0;
  std::optional<double> iou;  ///< none where the class is not in truth
};

struct ProtocolScore {
  Protocol protocol;
  std::vector<ProtocolClass> classes;     ///< those of the scene's table that count, in its order
  std::vector<std::string> void_classes;  ///< of the scene's table that do not: their truth is void
  std::int64_t scored_px = 0;
  std::optional<double> miou, total_accuracy, average_accuracy;  ///< none without scored pixels
};

/// From a confusion matrix of the scene's classes. Names are compared in small letters, '-' and '_' as blanks. A
/// prediction of a class that does not count is wrong. Throws Error(data) where no class of the table counts.
ProtocolScore protocol_score(const Protocol& protocol, const ConfusionMatrix& confusion, const ClassTable& classes);

/// CRC-32C of names, sizes and class ids of the truth of frames, in hexadecimal digits: equal where the truth is.
std::string truth_hash(std::span<const int> frames, const std::vector<FrameInfo>& infos,
                       const std::vector<StoredFrame>& stored, const ClassTable& classes);

// The field at points of space: density, colour, class probabilities, label and entropy.

/// Row by row; what was not asked for, or what a field without semantics does not know, is empty.
struct FieldPoints {
  std::vector<float> sigma;         ///< [N] density, 1/m; 0 outside the bounds that rays are clipped to
  std::vector<float> rgb;           ///< [N * 3] in [0, 1]
  std::vector<std::int16_t> label;  ///< [N] class index (not logit)
  std::vector<float> probability;   ///< [N * C] of classes; 0 for classes without a logit
  std::vector<float> entropy;       ///< [N] nats
};

/// Semantics are those of a sample of weight 1: what a ray would tell that met nothing but this point. `directions`
/// [N] unit vectors that the points are seen along, or empty: no colour is made. Throws Error(data) for a position or
/// direction that is not finite. As query_points (execution/render_rays.h).
FieldPoints field_at(Pipeline<float>& pipeline, std::span<const Vec3d> positions, std::span<const Vec3d> directions,
                     const RayLimits& limits, const ClassOfLogit& class_of_logit, int classes);

}  // namespace semfield
