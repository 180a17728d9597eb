// Marks as pixels: what they paint in images of any size, and where they say to ignore labels.
#include <algorithm>
#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "core/error.h"
#include "labels/clicks/annotations.h"
#include "labels/label_files.h"

namespace semfield {

std::vector<PixelRun> runs_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px) {
  std::vector<PixelRun> inside;
  if (mark.fill) inside = outline_runs(mark.points, width_px, height_px);
  return inside.empty() ? stroke_runs(mark.points, mark.radius_px, width_px, height_px) : inside;
}

std::vector<std::int16_t> Annotations::paint(int frame, std::span<const std::int16_t> base) const {
  const Camera& camera = frames_.at(static_cast<std::size_t>(frame)).camera;
  LabelRaster raster = void_raster(camera.width_px, camera.height_px);
  if (!base.empty()) {
    if (base.size() != raster.hard.size())
      throw Error(ErrorKind::internal, "internal.labels.size", "labels to paint over have another size than the frame");
    raster.hard.assign(base.begin(), base.end());
  }
  paint_marks(frame, raster);
  return std::move(raster.hard);
}

// Over a raster of any size of the frame's shape.
void Annotations::paint_marks(int frame, LabelRaster& raster) const {
  const Camera& camera = frames_.at(static_cast<std::size_t>(frame)).camera;
  const double scale_x = static_cast<double>(raster.width_px) / camera.width_px,
               scale_y = static_cast<double>(raster.height_px) / camera.height_px;
  for (const Mark& mark : marks()) {
    if (mark.frame != frame) continue;
    Mark scaled = mark;
    scaled.radius_px *= scale_x;
    for (PixelPoint& p : scaled.points) p = {p.x * scale_x, p.y * scale_y};
    semfield::paint(runs_of(scaled, raster.width_px, raster.height_px), static_cast<std::int16_t>(mark.class_index),
                    raster);
  }
}

bool Annotations::clear_ignored(int frame, std::int32_t width_px, std::int32_t height_px,
                                std::span<std::int16_t> labels) const {
  const auto ignores = [&](const Mark& mark) { return mark.frame == frame && mark.class_index == kVoid; };
  if (std::none_of(marks().begin(), marks().end(), ignores)) return false;
  constexpr std::int16_t kUntouched = -2;
  LabelRaster raster = void_raster(width_px, height_px);
  std::fill(raster.hard.begin(), raster.hard.end(), kUntouched);
  paint_marks(frame, raster);
  for (std::size_t p = 0; p < labels.size(); ++p)
    if (raster.hard.at(p) == kVoid) labels[p] = kVoid;
  return true;
}

}  // namespace semfield
