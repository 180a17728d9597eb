// What a labelling session does between steps of training: surfaces of the views, semantics learned anew from clicks
// while colour and geometry stand, labels of whole views, and the next question.
#pragma once

#include <array>
#include <chrono>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "core/small_math.h"
#include "execution/pipeline.h"
#include "formats/image_io.h"
#include "labels/clicks.h"
#include "labels/segments.h"
#include "labels/serve/proposals.h"
#include "surface/surface_graph.h"
#include "train/trainer.h"

namespace semfield {

/// Points with what the network reads of them, [N, dims], row by row.
struct PointRows {
  std::int32_t dims = 0;
  std::vector<float> values;

  std::int64_t count() const { return dims == 0 ? 0 : std::ssize(values) / dims; }
  View<float> view() { return {values.data(), count(), dims}; }
  View<const float> view() const { return {values.data(), count(), dims}; }
};

struct PointLearning {
  std::int64_t steps = 200;
  std::int64_t batch = 512;
  double learning_rate = 5e-3;  ///< falls to a tenth along half a cosine
  double weight_decay = 1e-2;   ///< fraction of a value times the learning rate [Loshchilov19]
  double class_power = 0.75;    ///< a class is drawn as often as the weight of its points to this power says
  std::uint64_t seed = 1;       ///< of the order of points and of dropout
};

// Points are learned by the semantic tensors of the pipeline's last pass where its executor runs
// (execution/render_rays.h). The pipeline must have semantics, to learn be trainable, and nothing else of it may run
// meanwhile.

/// Columns of logits.
std::int32_t point_classes(const Pipeline<float>& pipeline);

/// What the network reads at world positions. Valid while the geometry stays.
PointRows point_rows(Pipeline<float>& pipeline, std::span<const Vec3d> positions);

/// Puts the semantic tensors back to where the run began and learns the points: rows, and a logit each. A class is
/// drawn by PointLearning::class_power, a point of it by `weight` (empty: all alike). The moments of the optimiser are
/// zero afterwards. The same bits for any number of threads.
void learn_points(Pipeline<float>& pipeline, const PointRows& rows, std::span<const std::int16_t> logit,
                  std::span<const float> weight, const PointLearning& options);

/// The semantic tensors with their moments, to be put back as they were.
using KeptSemantics = std::vector<std::vector<float>>;
KeptSemantics keep_semantics(Pipeline<float>& pipeline);
void put_back(Pipeline<float>& pipeline, const KeptSemantics& kept);

/// [N, point_classes] of points.
std::vector<float> point_logits(Pipeline<float>& pipeline, const PointRows& rows);

/// Probabilities from logits, in place: [N, classes].
void softmax_live(std::span<float> logits, std::int32_t classes, const std::vector<bool>& live);

// The temperature of a labelling session's class probabilities, by clicks that were held back [Guo17, Sec. 4.2].

inline constexpr int kCalibrationFolds = 5;

/// A click that was held back: its class probabilities by what was learned from the other clicks, and how much of the
/// surface it stands for.
struct HeldBack {
  std::vector<float> probability;
  std::size_t truth = 0;
  double counts = 0;
};

/// The fold of each click, by the classes of the clicks: those of a class are dealt out in turn. -1: the class has too
/// few clicks, so that without one it is learned from hardly any, and what is found then says nothing of what is
/// learned from all.
std::vector<int> calibration_folds(std::span<const std::int16_t> classes);

/// The temperature of the largest posterior: the likelihood of the clicks, each counted for its surface and a tenth of
/// them taken for wrong, and a prior around 1. None where they do not settle one: too few of them, or an optimum at a
/// bound.
std::optional<double> fit_temperature(std::span<const HeldBack> held);

/// A checksum with one more value, to tell apart what is held in memory; no file has it.
inline std::uint64_t mix(std::uint64_t sum, std::uint64_t value) {
  sum = (sum ^ value) * 0x100000001B3ull;
  return sum ^ sum >> 29;
}

inline double seconds_since(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

/// Pixels of a view that somebody has named: a click or a stroke.
struct LabelledPixels {
  int view = 0;
  std::int16_t class_index = 0;
  std::vector<PixelPlace> pixels;
  double weight = 1;  ///< below 1: given by the configuration, and a click may say otherwise
};

/// Pixels of a view of this size that the mark paints (runs_of); the first point's own comes first, or one in the
/// middle of an outline. With `painted`
/// [height * width], those alone that still have the mark's class.
std::vector<PixelPlace> pixels_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px,
                                  std::span<const std::int16_t> painted = {});

/// A stroke says itself what it covers; a click, which has fewer pixels, names what looks alike around it too.
inline constexpr std::size_t kMostClickPixels = 9;
inline bool is_stroke(const LabelledPixels& named) { return named.pixels.size() > kMostClickPixels; }

/// Labels of a view, as large as the photograph that they cling to.
struct ViewLabels {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::int16_t> label;    ///< class indices, kVoid where the view meets nothing
  std::vector<std::uint8_t> entropy;  ///< 0 to 255: a fraction of the largest there can be
};

/// One thread at a time, and no step of the training meanwhile.
class LabelLoop {
 public:
  /// `frames`: the views, numbers in SceneInfo::frames; `held_out`: views behind them that are only looked at, so
  /// neither surface nor questions come from them; `segments`: of the frames of SceneInfo, where some have any, whose
  /// borders part the surface. Borrows the training, which must have semantics.
  LabelLoop(Trainer& training, std::span<const int> frames, const PointLearning& learning,
            std::span<const int> held_out = {}, std::vector<FrameSegments> segments = {});

  const std::vector<PoolView>& views() const { return views_; }
  const PoolView& view(int number) const { return views_[static_cast<std::size_t>(number)]; }
  /// Those that are not held out.
  std::span<const PoolView> pooled() const { return {views_.data(), pooled_}; }
  const SurfacePool& pool() const { return pool_; }
  const SurfaceGraph& graph() const { return graph_; }
  /// Every view has a map, and there is a pool.
  bool ready() const { return !pool_.points.empty(); }

  /// Maps that are missing or much younger than training is now are made, for about this long; the pool is made anew
  /// when none is due any more. True when the pool has changed.
  bool update_surfaces(double budget_s);

  /// Finds where on the surface `clicks` lie, those of which that is not known yet, for about this long and at least of
  /// one; true when it is known of all. They take the place of those of the last call. learn() finds what is missing.
  bool find_places(std::span<const LabelledPixels> clicks, double budget_s);
  /// The surface has moved: what is known stays until refresh_places() has found it anew.
  void renew_places() { ++age_; }
  /// Old places of the same clicks are found anew, for about this long.
  void refresh_places(std::span<const LabelledPixels> clicks, double budget_s);
  /// Of click `i` of the last find_places(): its places, its first pixel's first where that meets a surface; empty
  /// where nothing is met or nothing is known yet. A stroke has one in each cell of the pool.
  std::span<const Vec3d> places_of(std::size_t i) const { return known_.at(keys_.at(i)).places; }
  /// Clicks whose places have been looked for so far, each time counted.
  std::int64_t places_found() const { return found_; }

  /// Learns the semantic part anew from these; with none there is nothing to state any more. A click names the pixels
  /// around it too that lie on the same surface and have its colour.
  /// `quickly`: in fewer steps, for labels that are to be seen at once.
  void learn(std::span<const LabelledPixels> clicks, bool quickly = false);
  /// Something has been learned since the labels were last empty.
  bool learned() const { return learned_; }
  /// Points of clicks and strokes that were learned last; what they spread to is not counted.
  std::size_t learned_points() const { return seeds_.size(); }
  /// Class indices that have labels, as logits.
  const std::vector<bool>& live() const { return live_; }
  /// The largest entropy that there can be, nats; of two classes where fewer have labels.
  double most_entropy() const;

  /// [N, classes()] of the pool's points; empty while nothing is learned.
  const std::vector<float>& pool_probability() const { return pool_probability_; }
  std::int32_t classes() const { return point_classes(pipeline_); }

  /// By the view's map, or by `fine` where it is given, along the edges of the photograph that trains, or of `photo` of
  /// another size (eval/photo_edges.h). Pixels that somebody has named are what they were named.
  ViewLabels labels_of(int view, const SurfaceMap* fine = nullptr, const Image<std::uint8_t>* photo = nullptr);
  /// Of a view at another stride than that of its own map.
  SurfaceMap map_of(int view, std::int32_t stride);

  std::optional<Asked> propose(std::uint64_t seed, std::uint64_t round) const;
  /// Clicks that were passed over count as done, for the next proposal.
  void set_skipped(std::vector<LabelledPixels> skipped);

  /// The clicks of a fold by what is learned from the others, for a temperature. What was learned
  /// stays as it was.
  std::vector<HeldBack> hold_back(std::span<const LabelledPixels> clicks, int fold);
  /// Class probabilities [N, classes()] of places on the surface, with what the network reads there: the network's, and
  /// how much farther a class is by way of the surface.
  std::vector<float> probabilities(const PointRows& rows, std::span<const Vec3d> places, double temperature);
  void set_temperature(double temperature);
  double temperature() const { return temperature_; }

  /// Pixels [height * width] of a view that have no label and are not proposed; empty: none of it.
  void set_ignored(int view, std::vector<bool> pixels) { ignored_[static_cast<std::size_t>(view)] = std::move(pixels); }

 private:
  struct Named {
    PointRows rows;
    std::vector<std::int16_t> logit;
    std::vector<float> weight;
    std::vector<std::int32_t> click;  // that a point belongs to
    std::vector<Vec3d> position;
  };
  // Points of the surface to which clicks spread, behind those of the clicks.
  void add_spread(Named& named);
  // Lets ways begin at the named places; their points are found anew, for the pool may have been made anew.
  void settle_seeds();
  void learn_from(Named named, std::int64_t steps);
  void weigh_by_way(std::span<const std::int32_t> points, double temperature, std::span<float> probability) const;
  // Of the surface that lies nearer to a click than to any other.
  std::vector<double> areas_of(std::size_t clicks, const Named& named) const;
  // `left_out`: those clicks are not there; empty: all are.
  Named named_points(std::span<const LabelledPixels> clicks, const std::vector<bool>& left_out = {});
  // Places of a click.
  struct Known {
    std::vector<Vec3d> places;
    std::uint64_t age = 0;   // when they were found; 0: not yet
    std::uint64_t turn = 0;  // find_places() that wanted them last
  };
  std::vector<PixelPlace> one_a_cell(const LabelledPixels& stroke) const;
  std::vector<PixelPlace> pixels_of(const LabelledPixels& click) const;
  void look_for(Known& known, const LabelledPixels& click);
  std::vector<float> network_probabilities(const PointRows& rows) const;
  void predict_pool();
  void make_pool();
  bool due(const PoolView& view) const;

  Trainer& training_;
  Pipeline<float>& pipeline_;
  PointLearning learning_;
  std::vector<FrameSegments> segments_;
  std::vector<PoolView> views_;
  std::size_t pooled_ = 0;
  std::vector<std::vector<bool>> ignored_;  // of each view
  std::int32_t stride_ = 1;
  SurfacePool pool_;
  SurfaceGraph graph_;
  PointRows pool_rows_;
  std::int64_t pool_step_ = 0;
  std::uint64_t age_ = 1, turn_ = 0;
  std::int64_t found_ = 0;
  std::unordered_map<std::uint64_t, Known> known_;  // by a checksum of view and pixels
  std::vector<std::uint64_t> keys_;                 // of the clicks
  std::vector<std::int16_t> logit_of_class_;
  struct Seed {
    Vec3d position;
    std::int16_t logit = 0;
  };
  std::vector<Seed> seeds_;
  std::vector<LabelledPixels> clicks_;  // of the last learn(), without given labels
  bool learned_ = false;
  std::vector<bool> live_;
  std::vector<float> pool_probability_;
  double temperature_ = 1;
  std::vector<Vec3d> skipped_;
};

}  // namespace semfield
