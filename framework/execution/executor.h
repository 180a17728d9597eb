// Where a pipeline's steps and rendering run: lanes of the CPU, or a stream of a device.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "compute/parallel.h"
#include "core/error.h"
#include "core/view.h"
#include "execution/render_rays.h"
#include "execution/train_rays.h"
#include "model/optim/adam.h"
#include "scene/camera.h"
#include "scene/pixel_rays.h"
#include "scene/scene.h"

namespace semfield {

/// How a pixel of a step is chosen, from (seed, step, ray) alone.
enum class PixelChoice : std::uint8_t { all_images, one_image, label_balanced };

/// What of a PixelPool is no array.
struct DrawRule {
  std::uint64_t seed = 1;
  std::int64_t rays = 0, tile_rays = 0;  ///< of a step; tiles within which rays with a label come first
  PixelChoice choice = PixelChoice::all_images;
  double labelled_share = 0;  ///< of the rays of label_balanced, drawn for their labels
  bool labels_apart = false;  ///< those rays come first of all and have no part in the colour loss
  std::int64_t block = 1;     ///< pixels of a block of label_balanced
  RayLimits limits;
};

/// Everything of a step's batch but the step: whoever draws from it gives the bits of RaySource::fill. Borrowed; valid
/// while the source and its frames are.
struct PixelPool : DrawRule {
  struct Frame {
    Camera camera;
    Pose world_from_camera;
    bool undistort = true;
    const StoredFrame* pixels = nullptr;
    bool has_labels = false;
  };
  std::vector<Frame> frames;
  std::span<const std::int64_t> offsets;  ///< first pixel of each frame among all, and the total
  bool with_labels = false, with_depth = false, with_alpha = false, with_camera = false;
  /// Labelled pixels by rank, for label_balanced: blocks of `block` pixels of the labelled frames, the first one of
  /// each frame, and how many labelled pixels lie before each; the last entry counts all.
  std::span<const std::size_t> block_offsets;
  std::span<const std::uint32_t> ranks_before;
  /// Pixels that are not masked by rank, in the same way, blocks of PixelMask::kWordPixels of every frame; empty where
  /// no frame has a mask.
  std::span<const std::size_t> used_block_offsets;
  std::span<const std::uint32_t> used_before;
  /// Logits of a frame's pixels, kVoid for those without a label. Throws Error(data) for a label that is no class.
  std::function<void(std::size_t frame, std::span<std::int16_t> logit)> read_labels;
  std::vector<std::int64_t> label_only;  ///< RayBatch::label_only, the same in every step
};

/// Steps that were queued and are done.
struct StepResults {
  std::span<const StepLosses> losses;  ///< of the steps that were made, in order; valid until the next call of queue
  /// The step that met a value that is not finite, of which the executor knows no more; nothing changed in it or since.
  std::optional<std::int64_t> failed;
  std::optional<Error> afterwards;  ///< samplers could not refresh their state after the last of these steps
};

/// The tensors of a pipeline's store are what checkpoints hold; an executor may keep copies of its own. Throws Error.
template <class Real>
class Executor {
 public:
  virtual ~Executor() = default;
  virtual DeviceId device() const = 0;
  /// "cpu", or the device's own name and size.
  virtual std::string description() const = 0;
  /// Who computes matrix products.
  virtual std::string matrix_products() const = 0;
  /// The store's values, moments and states were written from outside, as those after `step` steps: the executor takes
  /// them over and makes derived tensors of them.
  virtual void upload(std::int64_t step) = 0;
  /// Brings the store up to date, derived tensors too; before any of it is read.
  virtual void download(std::int64_t step) = 0;
  /// Rays that are walked together, of a step of `rays` rays: those with a label come first in each such tile.
  virtual std::int64_t tile_rays(std::int64_t rays) const = 0;

  /// One training step: gradients, checks, Adam, derived tensors, samplers' observe. The batch is copied or used
  /// before it returns. Nothing of the step may be relied on before finish(); at most most_queued() steps wait. An
  /// Error means that the step was not made, and no step may be queued behind it before finish().
  virtual void queue(std::int64_t step, const RayBatch& batch, const AdamStep& update) = 0;
  /// Takes the pixels in, so that queue_drawn can draw steps from them; again after labels have changed. false: it does
  /// not (take_notes may say why), and batches are to be given. Between steps.
  virtual bool hold(const PixelPool&) { return false; }
  /// As queue, of the batch that RaySource::fill makes of the held pixels; `terms`: RayBatch::terms.
  virtual void queue_drawn(std::int64_t, std::uint32_t, const AdamStep&) {
    throw Error(ErrorKind::internal, "internal.executor.batches", "this executor draws no batches");
  }
  virtual int most_queued() const = 0;
  /// Waits for all queued steps.
  virtual StepResults finish() = 0;
  /// What users should know of the steps made so far, a sentence each; told once.
  virtual std::vector<std::string> take_notes() { return {}; }

  /// Renders without jitter or noise; the same bits for any grouping of rays into calls.
  virtual void render(const RenderJob<Real>& job) = 0;
  /// sigma [N, 1] of the last pass, after activation, 1/m, at world positions [N, 3]; the same bits for any grouping of
  /// positions into calls. Not beside another call.
  virtual void density(View<const double> positions, View<Real> sigma) = 0;
  /// The semantic part at points (execution/render_rays.h), which lives as long as the executor.
  virtual PointNetwork<Real>& points() {
    throw Error(ErrorKind::internal, "internal.executor.points", "this executor has no network at points");
  }
};

// Some of the pixels of many frames by their rank: counts of blocks, in place of a list that outweighs the pixels.

/// A training pixel: frame by its place in the training split, row * width + column.
struct TrainPixel {
  std::int32_t frame = 0;
  std::int32_t index = 0;
};

struct PixelRanks {
  static constexpr std::int64_t kBlock = 64;  ///< pixels; a block lies in one frame
  std::vector<std::size_t> block_offsets;     ///< first block of each frame, and the total
  std::vector<std::uint32_t> before;          ///< [blocks + 1] chosen pixels before each block; the last counts all

  std::uint32_t count() const { return before.empty() ? 0 : before.back(); }
  /// Of a frame: the rank of its first pixel that is chosen, and of the next frame's.
  std::uint32_t first_of(std::size_t frame) const { return before[block_offsets[frame]]; }

  /// `pixels` of each frame, 0 for one that has none; `chosen(TrainPixel)` is asked once for every pixel, from any
  /// thread.
  template <class Chosen>
  void index(const std::vector<std::int64_t>& pixels, const Chosen& chosen) {
    block_offsets.assign(1, 0);
    for (const std::int64_t n : pixels)
      block_offsets.push_back(block_offsets.back() + static_cast<std::size_t>((n + kBlock - 1) / kBlock));
    before.assign(block_offsets.back() + 1, 0);
    parallel_for(std::ssize(pixels), [&](std::int64_t frame) {
      const auto f = static_cast<std::size_t>(frame);
      for (std::size_t b = block_offsets[f]; b < block_offsets[f + 1]; ++b) {
        const std::int64_t begin = static_cast<std::int64_t>(b - block_offsets[f]) * kBlock;
        for (std::int64_t p = begin; p < std::min(begin + kBlock, pixels[f]); ++p)
          before[b + 1] += chosen(TrainPixel{static_cast<std::int32_t>(f), static_cast<std::int32_t>(p)}) ? 1 : 0;
      }
    });
    for (std::size_t b = 1; b < before.size(); ++b) before[b] += before[b - 1];
  }

  /// The pixel of a rank below count(); `chosen` as it was indexed.
  template <class Chosen>
  TrainPixel at(std::uint32_t rank, const Chosen& chosen) const {
    const auto after = std::upper_bound(before.begin(), before.end(), rank);
    const auto block = static_cast<std::size_t>(after - before.begin()) - 1;
    const auto next_frame = std::upper_bound(block_offsets.begin(), block_offsets.end(), block);
    const auto frame = static_cast<std::size_t>(next_frame - block_offsets.begin()) - 1;
    TrainPixel pixel{static_cast<std::int32_t>(frame),
                     static_cast<std::int32_t>(static_cast<std::int64_t>(block - block_offsets[frame]) * kBlock)};
    for (std::uint32_t left = rank - before[block];; ++pixel.index) {
      if (!chosen(pixel)) continue;
      if (left-- == 0) return pixel;
    }
  }
};

}  // namespace semfield
