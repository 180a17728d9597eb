// Renders whole frames and scores them against what the scene knows.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "eval/entropy_groups.h"
#include "eval/metrics.h"
#include "eval/rays.h"
#include "execution/pipeline.h"
#include "labels/training_labels.h"
#include "scene/stored_frame.h"

namespace semfield {

/// Pixels that met something, and those of them whose opacity came in too few, too long steps
/// (model/opacity_resolution.h).
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
  std::int32_t stride = 1;               ///< of the frame's pixels (pixel_stride.h)
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
  std::int32_t stride = 1;               ///< pixels taken (pixel_stride.h); maps are smaller by it
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
  explicit SplitScore(int classes, double far_m) : confusion(classes), depth(far_m) {}
  ConfusionMatrix confusion;
  ColorError color;
  ColorError fitted_color;  ///< EvalJob::fit_colors
  DepthError depth;
  Calibration calibration;
  PredictedEntropy entropy;
  GivenEntropy given;  ///< of EvalJob::given
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
  bool fit_colors = false;                ///< score colours once more under maps of half frames (color_fit.h)
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

}  // namespace semfield
