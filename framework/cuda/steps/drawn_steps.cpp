// Steps whose batches are drawn on the device.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/check.h"
#include "core/error.h"
#include "cuda/stream_executor.h"

namespace semfield::cuda {

namespace {

bool has_finite_rays(const PixelPool& pool) {
  return std::all_of(pool.frames.begin(), pool.frames.end(), [](const PixelPool::Frame& frame) {
    const Pose& pose = frame.world_from_camera;
    bool finite = frame.camera.has_finite_lens();
    for (int i = 0; i < 3; ++i) {
      finite = finite && std::isfinite(pose.t[i]);
      for (int axis = 0; axis < 3; ++axis) finite = finite && std::isfinite(pose.axis(axis)[i]);
    }
    return finite;
  });
}

}  // namespace

// Several ranks have rank 0's pixels, and steps come from it.
bool StreamExecutor::hold(const PixelPool& pool) {
  SEMFIELD_CHECK(queued_.empty(), "pixels are taken in between steps");
  if (sums_->ranks() > 1 || !options_.trainable || pool.tile_rays != tile_rays(pool.rays)) return false;
  if (!has_finite_rays(pool)) return false;  // the host says which
  const LaunchScope scope(step_launch());
  try {
    if (drawer_ && drawer_->relabel(pool)) return true;
    drawer_.reset();
    const std::size_t bytes = BatchDrawer::bytes_of(pool, kSlots), most = free_bytes() / 2;
    if (bytes > most) {
      if (std::exchange(told_of_pixels_, true)) return false;
      notes_.push_back(
          fmt::format("pixels stay in the host's memory, which makes the batches of steps: they take {:.1f} GB "
                      "of the device's, where {:.1f} GB are left for them",
                      static_cast<double>(bytes) * 1e-9, static_cast<double>(most) * 1e-9));
      return false;
    }
    drawer_ = std::make_unique<BatchDrawer>(pool, kSlots);
  } catch (const Error&) {  // of a label, or of memory: a step that the host draws says it where it counts
    drawer_.reset();
    return false;
  }
  return true;
}

std::vector<std::string> StreamExecutor::take_notes() {
  std::vector<std::string> notes = sums_->take_notes();
  notes.insert(notes.end(), notes_.begin(), notes_.end());
  notes_.clear();
  return notes;
}

void StreamExecutor::queue_drawn(std::int64_t step, std::uint32_t terms, const AdamStep& update) {
  const LaunchScope scope(step_launch());
  drawer_->draw(step);
  RayBatch batch = drawer_->seen(step);
  batch.terms = terms;
  queue_batch(step, batch, update, drawer_->batch(step));
}

}  // namespace semfield::cuda
