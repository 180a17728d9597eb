// The pixels of a training split in device memory, and batches of steps drawn from them ahead.
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "cuda/kernels/kernels.h"
#include "cuda/launch.h"
#include "execution/executor.h"
#include "execution/train_rays.h"

namespace semfield::cuda {

// Batches of steps drawn on the device from pixels that lie there: the bits of RaySource::fill.

struct HeldFrame {
  double fx = 1, fy = 1, cx = 0, cy = 0;
  Pose world_from_camera;
  std::int32_t width_px = 0;
  RayLens lens;
  bool has_alpha = false;
  const double* direction = nullptr;  ///< [H * W, 3] in camera axes, of a lens with distortion; null: a pinhole's
};

inline constexpr std::int16_t kNoLabel = -1;

/// Device memory; pixels are numbered through all frames.
struct HeldPixels {
  const HeldFrame* frames = nullptr;
  const std::int64_t* offsets = nullptr;  ///< [frames + 1]
  std::int32_t frame_count = 0;
  const std::uint8_t* rgb = nullptr;    ///< [pixels, 3]
  const std::int16_t* label = nullptr;  ///< [pixels] logits; null: the run has no semantics
  const float* depth_m = nullptr;       ///< [pixels] z-depth; null: no term reads it
  const std::uint8_t* alpha = nullptr;  ///< [pixels] 255 is 1; null: likewise
  const std::int64_t* block_offsets = nullptr;
  const std::uint32_t* ranks_before = nullptr;
  std::int64_t blocks = 0;
  /// Pixels that are not masked, in the same way; null: no frame has a mask.
  const std::uint64_t* used_words = nullptr;  ///< [used_blocks], a block's pixels
  const std::int64_t* used_block_offsets = nullptr;
  const std::uint32_t* used_before = nullptr;
  std::int64_t used_blocks = 0;
};

/// A ray's pixel, and its row in the batch.
struct DrawnRay {
  std::int64_t pixel = 0;
  std::int32_t frame = 0, row = 0;
  std::int16_t label = 0;
  std::uint8_t group = 0;  ///< as RayGroup
};

/// Arrays of a batch on the device; those of the next step lie `stride` bytes behind.
struct DrawnBatches {
  double *origin = nullptr, *direction = nullptr, *near_far = nullptr;
  float* target = nullptr;
  std::int16_t* label = nullptr;  ///< null: not wanted
  float* depth = nullptr;         ///< likewise
  float* alpha = nullptr;         ///< likewise
  float* camera = nullptr;        ///< likewise
  std::int64_t stride = 0;
};

/// Queues the batches of steps [first, first + count) on launch().stream; scratch [count, rays].
void draw_rays(const HeldPixels& pixels, const DrawRule& rule, std::int64_t first, int count, DrawnRay* scratch,
               const DrawnBatches& batches);

inline constexpr int kMostPasses = 4;

/// What a step of this process leaves, of each pass: read back as one block.
struct StepSums {
  FaultKey fault = kNoFault;
  LossSums pass[kMostPasses];
};

/// Batches of steps on their way to the device: of each its StepCell and its rays, which may lie there already.
class Staging {
 public:
  /// For batches of the shape of `like`.
  Staging(int slots, const RayBatch& like);

  bool fits(const RayBatch& batch) const { return layout_.fits(batch); }
  /// Copies cell and batch into the slot and queues its way to the device.
  void send(int slot, const StepCell& cell, const RayBatch& batch);
  /// The same with a batch in device memory, laid out as BatchLayout says.
  void send(int slot, const StepCell& cell, const std::byte* drawn);
  /// Queues the slot's way to the device once more; drawn: as it was sent, else null.
  void send_again(int slot, const std::byte* drawn);
  /// Queues the copy of the device's sums into the slot.
  void fetch(int slot);
  /// Of the first `slots`.
  std::span<const StepSums> sums(std::size_t slots) const { return {host_sums_.get(), slots}; }

  /// Device memory.
  const StepCell* cell() const { return reinterpret_cast<const StepCell*>(device_.data()); }
  StepSums* device_sums() const { return device_sums_.data(); }
  /// The batch on the device.
  RayBatch batch() const { return layout_.in(device_.data() + kCellBytes, Device::cuda); }

 private:
  static constexpr std::size_t kCellBytes = 256;
  static_assert(sizeof(StepCell) <= kCellBytes);
  std::byte* slot_at(int slot) const {
    return host_.get() + static_cast<std::size_t>(slot) * (kCellBytes + layout_.bytes());
  }

  BatchLayout layout_;
  Pinned<std::byte> host_;  // [slots, kCellBytes + layout_.bytes()]
  Pinned<StepSums> host_sums_;
  Buffer<std::byte> device_;
  Buffer<StepSums> device_sums_;
};

/// Launches are those of launch(). Colours take 3 B per pixel, labels 2 B, depth 4 B and alpha 1 B where a term reads
/// it, and a lens with distortion 24 B per pixel of its images.
class BatchDrawer {
 public:
  /// Steps that are drawn at once: `ahead`. Throws Error(unavailable) where memory is short.
  BatchDrawer(const PixelPool& pool, int ahead);

  /// Bytes of device memory that a pool takes.
  static std::size_t bytes_of(const PixelPool& pool, int ahead);
  /// Takes new labels of the same pixels; false: these are other pixels.
  bool relabel(const PixelPool& pool);

  /// Draws the step unless it is there, with those behind it. It stays until a step is drawn that is not there.
  void draw(std::int64_t step);
  /// Of a step that was drawn: its batch in device memory, laid out as BatchLayout says.
  const std::byte* batch(std::int64_t step) const;
  /// What the host looks at: labels, depth and alpha, in host memory, and the number of rays.
  RayBatch seen(std::int64_t step) const;

 private:
  void send_pixels(const PixelPool& pool);
  void send_labels(const PixelPool& pool);
  void send_masks(const PixelPool& pool);
  void send_lenses(const PixelPool& pool, std::vector<HeldFrame>& frames);

  DrawRule rule_;
  HeldPixels held_;
  bool with_labels_, with_depth_, with_alpha_, with_camera_;
  BatchLayout layout_;
  int ahead_;
  std::int64_t first_ = 0;  // step, of those that were drawn
  bool any_ = false;
  std::vector<const StoredFrame*> frames_;  // whose pixels are held
  std::vector<bool> labelled_;
  Buffer<HeldFrame> frame_table_;
  Buffer<std::uint8_t> rgb_, alpha_;
  Buffer<DrawnRay> scratch_;
  Buffer<std::byte> batches_;
  Buffer<std::int64_t> offsets_, block_offsets_, used_block_offsets_;
  Buffer<std::uint32_t> ranks_, used_before_;
  Buffer<std::uint64_t> used_words_;
  Buffer<std::int16_t> label_;
  Buffer<float> depth_;
  std::vector<Buffer<double>> directions_;
  Pinned<std::int16_t> seen_label_;  // [ahead, rays]
  Pinned<float> seen_depth_, seen_alpha_;
};

// Room for the samples of a step, where a sampler leaves most of what there can be unused.

/// A step's arrays have a row for every sample that there can be, and every kernel passes over all of them. So steps
/// get room for a quarter more samples than those before them had. A step that had more is made again with room for all
/// (Stage::room).
class SampleRoom {
 public:
  /// most: samples that there can be; 0: room is never less than that.
  void begin(std::int64_t most) { most_ = most, rows_ = 0; }
  /// 0: for all.
  std::int64_t rows() const { return rows_; }
  void give_all() { rows_ = 0; }
  /// From the next step whose graph is not captured yet; for tests.
  void give(std::int64_t rows) { rows_ = rows; }
  /// What steps used at most. Returns whether the room is another one now.
  bool saw(std::int64_t samples);

 private:
  std::int64_t most_ = 0, rows_ = 0;
};

}  // namespace semfield::cuda
