// The pixels that a step trains on: addressed by (seed, step, ray), never consumed from a generator.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "config/settings/run_config.h"
#include "eval/evaluator.h"
#include "execution/executor.h"
#include "execution/pipeline.h"
#include "labels/training_labels.h"
#include "scene/scene.h"

namespace semfield {

/// One training frame as the source needs it; pixels are borrowed.
struct TrainFrame {
  RayCamera camera;
  const StoredFrame* pixels = nullptr;
  const TrainingLabels::Frame* labels = nullptr;  ///< borrowed; null: unlabelled
  std::string name = {};                          ///< for messages
  const LabelMap* added = nullptr;                ///< borrowed; hard labels of pixels that `labels` has none of
};

/// In the order in which rays stand in a tile.
enum class RayGroup : std::uint8_t { label_only, labelled, other };

/// Buffers of one batch; view() borrows them.
struct BatchBuffers {
  std::vector<double> origin, direction, near_far;
  std::vector<float> target;
  std::vector<std::int16_t> label;  ///< the most probable class where labels are soft
  struct Channel {
    std::string name;
    std::int32_t cols = 0;
    std::vector<float> values;  ///< [rays * cols]
  };
  std::vector<Channel> more;             ///< RayTargets::more
  std::vector<std::int64_t> label_only;  ///< RayBatch::label_only, of tiles of tile_rays
  std::int64_t tile_rays = 0;
  std::uint32_t terms = ~0U;  ///< RayBatch::terms
  struct Choice {
    TrainPixel pixel;
    std::int16_t label = 0;
    RayGroup group = RayGroup::other;
    std::int64_t row = 0;  ///< of the batch
  };
  std::vector<Choice> choices;  ///< scratch of RaySource::fill: of the rays in the order of their numbers
  /// Values of the channel, which must be there.
  std::vector<float>& of(std::string_view name);
  RayBatch view(bool with_labels) const;
};

struct RaySourceOptions {
  TrainParams train;             ///< rays per step, and where they come from
  bool labels_may_come = false;  ///< label_balanced draws from all pixels as long as none has a label; else an error
  std::vector<std::string> targets;  ///< channels that batches carry beside colour and labels, as the losses read them
  std::uint64_t seed = 1;
  std::int64_t tile_rays = 32;
};

/// How many of the rays [begin, end) of a step are drawn for their labels: every ray whose running share crosses an
/// integer, so that the count of a batch does not depend on its tiles.
std::int64_t label_only_rays(double share, std::int64_t begin, std::int64_t end);

class RaySource {
 public:
  /// `logit_of_class` maps a frame's class to the head's logit, kVoid for a class without one. Throws Error(data) when
  /// there is no training pixel, or no labelled one for label_balanced unless labels_may_come. Every frame has a pixel
  /// that is not masked.
  RaySource(std::vector<TrainFrame> frames, std::vector<std::int16_t> logit_of_class, const RayLimits& limits,
            const RaySourceOptions& options);

  /// Fills the batch of `step`. Within a tile labelled rays come first (their order is otherwise kept), so the head's
  /// samples are contiguous. The same for any thread count. A label that is no class is an Error(data) that names
  /// frame, pixel and value.
  void fill(std::int64_t step, BatchBuffers& batch) const;

  /// Labels for pixels that have none of their own, one map a frame in the order of the frames, borrowed; they take the
  /// place of those given before. A label that is no class is refused where it is met.
  void add_labels(const std::vector<LabelMap>& labels);

  /// To be called after the maps behind TrainFrame::labels have changed. Throws Error(data) as the constructor does;
  /// the source then needs the labels of before, and another call.
  void relabel();

  /// For executors that draw batches on a device; none where batches carry more than colour, hard labels, depth and
  /// alpha.
  std::optional<PixelPool> pool() const;
  /// Changes with the labels.
  std::uint64_t version() const { return version_; }

  std::int64_t pixel_count() const { return offsets_.back(); }
  /// Frame and pixel of ray i of a step, before the tile's reordering; for messages and tests.
  using Pixel = TrainPixel;
  Pixel choose(std::int64_t step, std::int64_t ray) const;
  /// The pixel behind row `row` of the batch that fill made: "frame 'rgb_12', pixel x 3, y 4".
  std::string place_of_row(std::int64_t step, std::int64_t row) const;

 private:
  /// Whether label_balanced draws the ray for its label.
  bool for_its_label(std::int64_t ray) const;
  RayGroup group_of(std::int64_t ray, std::int16_t label) const;
  /// The logit of the label, a pixel's own or an added one; kVoid without both. Throws Error(data) naming frame, pixel
  /// and value for a label that is no class.
  std::int16_t label_of(const Pixel& pixel) const;
  std::string place_of(const Pixel& pixel) const;
  void soft_label_of(const Pixel& pixel, std::span<float> out) const;
  float depth_of(const BatchBuffers::Choice& choice, double cosine, const double* near_far) const;
  void write_row(const BatchBuffers::Choice& choice, BatchBuffers& batch) const;

  std::vector<TrainFrame> frames_;
  std::vector<std::int16_t> logit_of_class_;
  std::int32_t soft_logits_ = 0;  // logits a soft label spreads over; 0: every label is hard
  struct Target {
    std::string name;
    std::int32_t cols = 0;
    enum class From : std::uint8_t { soft_label, depth, alpha, camera, frame } from = From::frame;
  };
  std::vector<Target> targets_;  // that batches carry beside colour and labels
  RayLimits limits_;
  RaySourceOptions options_;
  PixelRanks labelled_;  // for label_balanced alone
  PixelRanks used_;      // those that are not masked; empty where no frame has a mask
  void index_labels();
  bool balanced() const { return labelled_.count() > 0; }
  bool uses(const Pixel& pixel) const;
  Pixel used_pixel(std::uint32_t rank) const;

  std::uint64_t version_ = 0;
  std::vector<std::int64_t> offsets_;  // first global pixel of each frame, and the total
};

/// What label_balanced says of a training split without a labelled pixel.
Error no_labelled_pixel();

}  // namespace semfield
