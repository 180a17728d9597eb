#include "app/serve/page_photos.h"

#include <algorithm>

#include "core/error.h"

namespace semfield::app {

Image<std::uint8_t> PagePhotos::read(int frame, std::int32_t most_px) {
  const auto f = static_cast<std::size_t>(frame);
  const StoredFrame& trained = session_.scene.frames.at(f);
  if (most_px > 0 && most_px <= std::max(trained.width_px, trained.height_px))
    return {trained.width_px, trained.height_px, 3, trained.rgb};
  const std::lock_guard lock(mutex_);
  if (!dataset_) open();
  if (kept_frame_ == frame) return kept_;
  FrameBuffer buffer;
  dataset_->read(frame, buffer);
  kept_ = {buffer.width_px, buffer.height_px, 3, std::move(buffer.rgb)};
  kept_frame_ = frame;
  return kept_;
}

void PagePhotos::open() {
  const RunConfig& config = session_.config;
  DatasetBuild build;
  build.config_dir = config.base_dir;
  std::unique_ptr<Dataset> dataset = config.dataset.entry->dataset(*config.dataset.params, build);
  Diagnostics found;
  info_ = dataset->open(found);
  found.throw_if_errors(ErrorKind::data, "the photographs cannot be read any more:");
  const std::vector<FrameInfo>& loaded = session_.scene.info.frames;
  if (!std::equal(info_.frames.begin(), info_.frames.end(), loaded.begin(), loaded.end(),
                  [](const FrameInfo& a, const FrameInfo& b) { return a.name == b.name; }))
    throw Error(ErrorKind::data, "scene.frames.changed", "the scene's files list other frames than were loaded",
                "start semfield serve again");
  dataset_ = std::move(dataset);
}

}  // namespace semfield::app
