// The pixels of a training split in device memory, and batches of steps drawn from them ahead.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "cuda/memory.h"
#include "cuda/steps/draw_rays.h"
#include "cuda/steps/staging.h"
#include "execution/pixel_pool.h"

namespace semfield::cuda {

/// Launches are those of launch(). Colours take 3 B per pixel, labels 2 B, depth 4 B and alpha 1 B where a term reads
/// it, and a lens with distortion 24 B per pixel of its images.
class BatchDrawer {
 public:
  /// Steps that are drawn at once: `ahead`. Throws Error(unavailable) where memory is short.
  BatchDrawer(const PixelPool& pool, int ahead);
  ~BatchDrawer();
  BatchDrawer(const BatchDrawer&) = delete;
  BatchDrawer& operator=(const BatchDrawer&) = delete;

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
  Buffer<std::byte> frame_table_, rgb_, alpha_, scratch_, batches_, offsets_, block_offsets_, ranks_;
  Buffer<std::byte> used_words_, used_block_offsets_, used_before_;
  Buffer<std::int16_t> label_;
  Buffer<float> depth_;
  std::vector<Buffer<double>> directions_;
  std::int16_t* seen_label_ = nullptr;  // pinned [ahead, rays]
  float *seen_depth_ = nullptr, *seen_alpha_ = nullptr;
};

}  // namespace semfield::cuda
