// Batches of steps drawn on the device from pixels that lie there: the bits of RaySource::fill.
#pragma once

#include <cstdint>

#include "core/rng.h"
#include "execution/executor.h"
#include "execution/train_rays.h"

namespace semfield::cuda {

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

/// What of a PixelPool is no array.
struct DrawRule {
  std::uint64_t seed = 1;
  std::int64_t rays = 0, tile_rays = 0;
  PixelChoice choice = PixelChoice::all_images;
  double labelled_share = 0;
  bool labels_apart = false;
  std::int64_t block = 1;
  RayLimits limits;
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

}  // namespace semfield::cuda
