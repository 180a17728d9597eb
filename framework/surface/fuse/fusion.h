// Labels of posed views fused in each view's pixels: what the views that see a pixel's surface point predict there.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "config/settings/run_config.h"
#include "labels/training_labels.h"
#include "surface/surface_graph.h"
#include "train/session.h"

namespace semfield {

/// What a prediction without probabilities says: `confidence` for its label, the rest spread evenly over the other
/// classes.
struct HardLikelihood {
  double hit = 1, miss = 0;
  /// Throws Error(config) where the label would not be the most probable class: confidence <= 1 / classes.
  HardLikelihood(double confidence, int classes);
};

/// Sums over the views that see one point; clear() starts the next point. Both fusions are kept at once, since finding
/// the views costs more than adding.
class ClassVotes {
 public:
  /// `floor`: least probability of a class in one view, so that no view can rule out a class for all others.
  ClassVotes(int classes, double floor, HardLikelihood hard);

  void clear();
  /// Probabilities of a view [classes], some above 0. They need not sum to 1: what is missing belongs to no class of
  /// the table.
  void add(std::span<const double> probability);
  /// A label of a view, in [0, classes).
  void add(std::int16_t label);
  int views() const { return views_; }

  /// Product of the views' probabilities, renormalised: p_c = exp(s_c) / sum exp(s), s_c = sum over views of
  /// ln max(p_c(view), floor). Zeros without views. [classes]
  void bayesian(std::span<double> out) const;
  /// Mean of the views' probabilities; zeros without views. [classes]
  void average(std::span<double> out) const;

  /// Most probable class. `preferred` (or kVoid) wins where it is as probable up to rounding, then the least index;
  /// kVoid without views.
  std::int16_t bayesian_label(std::int16_t preferred) const;
  std::int16_t average_label(std::int16_t preferred) const;

 private:
  // Up to a term that all classes share.
  double log_sum(std::size_t c) const { return log_sum_[c] + label_views_[c] * log_hit_less_miss_; }
  double sum(std::size_t c) const { return sum_[c] + label_views_[c] * hit_less_miss_ + hard_views_ * hard_.miss; }
  template <class Score>
  std::int16_t best(std::int16_t preferred, double tie, Score&& score) const;

  double floor_;
  HardLikelihood hard_;
  double log_hit_less_miss_, hit_less_miss_;
  std::vector<double> log_sum_, sum_;  // of probabilities
  // Labels are counted, not summed: equal votes are equal numbers, whatever the order of views.
  std::vector<int> label_views_;
  int hard_views_ = 0, views_ = 0;
};

// Where a pixel of one view lies in another, and whether that view sees the same surface there.

/// Whether the surface in a pixel of `view` is the one at z-depth `z_m` there (FusionParams::agree). False without
/// depth: what the pixel sees is then unknown.
bool same_surface(const PosedDepth& view, std::size_t pixel, double z_m, const FusionParams& params);

/// The pixel of `view` that sees `point`: project_point and same_surface.
std::optional<PixelHit> seen_at(const PosedDepth& view, Vec3d point, const FusionParams& params);

/// Which of `others` (ascending, without the target) are asked for `target`, ascending. `views` 0: all. `even`: ranks
/// floor((k + 1/2) n / views). `nearest`: the least |c - c'| + |g - g'|, c a camera's centre and g the point on its
/// axis at the median depth of the target (1 without depth), so that turning counts like moving; of equals the earlier
/// one.
std::vector<int> choose_views(std::span<const PosedDepth> views, int target, std::vector<int> others,
                              const FusionParams& params);

/// A view and its prediction; borrowed.
struct FusionView {
  PosedDepth seen;
  const TrainingLabels::Frame* prediction = nullptr;
};

/// Pixels of one or several fused frames.
struct FusionCounts {
  std::int64_t pixels = 0;
  std::int64_t without_depth = 0;  ///< keep their own prediction
  std::int64_t unlabelled = 0;     ///< no prediction of their own, void
  std::int64_t filled = 0;         ///< of those, labelled by other views
  std::int64_t votes = 0;          ///< predictions of all pixels with depth, the own one included

  void merge(const FusionCounts& other);
  /// Predictions per pixel with depth; 0 without such pixels.
  double views_mean() const;
  bool operator==(const FusionCounts&) const = default;
};

struct FusedFrame {
  /// By FusionMethod: [H * W] class index, kVoid = void.
  std::array<std::vector<std::int16_t>, 3> label;
  FusionCounts counts;
};

/// For each pixel of a view: its surface point by depth, every chosen view that sees the point (seen_at), their
/// predictions there and the pixel's own, multiplied (`bayesian`) or averaged (`average`) [Zhi21, section 4.4]. A pixel
/// without depth keeps its own prediction. Where classes are equally probable the pixel's own label wins.
class LabelFusion {
 public:
  /// Views stay the caller's. Throws Error(config) for a hard_confidence that says nothing among `classes`,
  /// Error(internal) for maps of another size than their camera, Error(data) for a label outside the classes.
  LabelFusion(std::span<const FusionView> views, int classes, const FusionParams& params);

  /// Rows in parallel; the bits do not depend on threads.
  FusedFrame fuse(int target) const;

 private:
  struct Scratch;
  void fuse_pixel(int target, std::span<const int> others, std::int32_t column, std::int32_t row, Scratch& scratch,
                  FusedFrame& out) const;
  void add_prediction(const FusionView& view, const PixelHit& hit, Scratch& scratch) const;
  bool prediction_at(const FusionView& view, std::size_t pixel, Scratch& scratch) const;

  std::span<const FusionView> views_;
  int classes_;
  FusionParams params_;
  HardLikelihood hard_;
  std::vector<PosedDepth> seen_;
};

// Fusion of a scene's training frames: depth of every frame, fused maps, and their scores against the true labels.

/// One entry per frame of `frames`.
struct FrameMaps {
  std::vector<int> frames;                       ///< indices into LoadedScene::info.frames
  std::vector<std::vector<float>> depth_m;       ///< [H * W] z-depth, 0 = none
  std::vector<std::vector<std::int16_t>> label;  ///< the run's own labels; empty where there are none
};

/// Depth of the training frames as the scene has it. Throws Error(data) where no frame has any.
FrameMaps true_depth(const LoadedScene& scene);

/// The session of a run, and where it lies.
struct TrainedField {
  const Session& session;
  const std::string& run_dir;
};

/// Depth of the same frames rendered from a run's field - expected depth divided by opacity, 0 below `min_opacity` -
/// and its labels, when the run has semantics and the class table of `scene`. Throws Error(data) naming a frame that
/// the run does not know or that stands elsewhere in it. `done` gets the number of frames rendered; may be null.
FrameMaps learned_depth(const TrainedField& run, const LoadedScene& scene, double min_opacity,
                        const std::function<void(int done)>& done);

/// What one method made of all frames.
struct FusionScore {
  std::string method;  ///< monocular, bayesian, average, or field: the run's own rendering
  ConfusionMatrix confusion;
  std::optional<double> views_mean;  ///< predictions per pixel with depth; none for field
};

struct SceneFusion {
  std::vector<FusionScore> scores;  ///< in the order of the methods, then field where the maps have labels
  FusionCounts counts;
};

/// Called for each frame and method in order with the labels of its pixels; `frame` indexes LoadedScene::info.frames.
using OnFused = std::function<void(const std::string& method, int frame, const std::vector<std::int16_t>& label)>;

/// With the tolerance of the scene where `params` leave it open.
FusionParams settled(const FusionParams& params, const LoadedScene& scene);

/// Fuses every frame of `maps`, with settled() parameters. Frames without true labels are fused and not scored.
SceneFusion fuse_scene(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                       const FusionParams& params, const OnFused& on_fused);

// Training labels spread over the surface.

/// Edge of a cell that PropagationParams::cell_m leaves open: three pixels at the scene's middle depth, at least 1/500
/// of the bounds' longest side. 0 where the scene states neither.
double default_cell_m(const LoadedScene& scene);

/// How far the work is: classes solved (surface), or sizes of cells pooled (vote), of all.
using PropagationProgress = std::function<void(int done, int of)>;

/// New labels, soft, of every frame of `maps`; one step is added to `labels`' own, with the facts of what was done.
///
/// `surface`: pixels with depth fall into cells of edge cell_m. A cell has the mean colour and the mean normal of its
/// pixels and the sum of their labels, probabilities where labels are soft. Cells that touch are joined with the weight
/// exp(-|dc|^2 / (2 color_sigma^2)) exp(-|dn|^2 / (2 normal_sigma^2)), at least 1e-4, and diffuse_votes spreads the
/// votes. Every pixel of a cell that a vote reaches takes the cell's distribution.
///
/// `vote`: every labelled pixel with depth takes the fractions of the votes in its cell of the first edge of
/// vote_cells_m that holds least_votes, else of the last one. Other pixels stay void.
///
/// A labelled pixel without depth keeps its label. A pixel whose largest probability is below min_confidence becomes
/// void. class_pixels of the result is empty. The bits do not depend on threads. `done` may be null. Throws Error(data)
/// when no frame has labels or no pixel has depth, Error(config) where cell_m is open and the scene has no size.
TrainingLabels propagate_labels(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                                const PropagationParams& params, const PropagationProgress& done);

}  // namespace semfield
