// The pixels that steps are drawn from, for executors that draw them on a device.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "scene/camera.h"
#include "scene/pixel_rays.h"
#include "scene/stored_frame.h"

namespace semfield {

/// How a pixel of a step is chosen, from (seed, step, ray) alone.
enum class PixelChoice : std::uint8_t { all_images, one_image, label_balanced };

/// Everything of a step's batch but the step: whoever draws from it gives the bits of RaySource::fill. Borrowed; valid
/// while the source and its frames are.
struct PixelPool {
  struct Frame {
    Camera camera;
    Pose world_from_camera;
    bool undistort = true;
    const StoredFrame* pixels = nullptr;
    bool has_labels = false;
  };
  std::vector<Frame> frames;
  std::span<const std::int64_t> offsets;  ///< first pixel of each frame among all, and the total
  RayLimits limits;
  std::uint64_t seed = 1;
  std::int64_t rays = 0, tile_rays = 0;  ///< of a step; tiles within which rays with a label come first
  PixelChoice choice = PixelChoice::all_images;
  double labelled_share = 0;  ///< of the rays of label_balanced, drawn for their labels
  bool labels_apart = false;  ///< those rays come first of all and have no part in the colour loss
  bool with_labels = false, with_depth = false, with_alpha = false, with_camera = false;
  /// Labelled pixels by rank, for label_balanced: blocks of `block` pixels of the labelled frames, the first one of
  /// each frame, and how many labelled pixels lie before each; the last entry counts all.
  std::int64_t block = 1;
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

}  // namespace semfield
