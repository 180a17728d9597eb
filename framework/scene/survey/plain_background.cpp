#include "scene/survey/plain_background.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "compute/parallel.h"

namespace semfield {

namespace {

constexpr int kTolerance = 6;                  // of 255: what compression leaves of one colour
constexpr double kLeastBorder = 0.75;          // of the border's pixels show the background
constexpr double kLeastShare = 0.25;           // of all pixels; less is the rim of images that were undistorted
constexpr double kMostBackgroundViews = 0.05;  // of the frames that see a voxel of the object: highlights, bad poses
constexpr double kLeastViews = 0.4;     // of all frames must tell of a voxel: few look past the object at what it hides
constexpr double kCleanBorder = 0.005;  // foreground on the border of a frame that shows the object whole, at most
constexpr std::size_t kMostFrames = 128;

using Color = std::array<std::uint8_t, 3>;

bool near_color(const std::uint8_t* pixel, const Color& color) {
  for (std::size_t c = 0; c < 3; ++c) {
    if (std::abs(static_cast<int>(pixel[c]) - static_cast<int>(color[c])) > kTolerance) return false;
  }
  return true;
}

template <class Look>
void each_border_pixel(const StoredFrame& frame, const Look& look) {
  const auto look_at = [&](std::int64_t x, std::int64_t y) {
    const auto pixel = static_cast<std::size_t>(y * frame.width_px + x);
    if (frame.mask.uses(pixel)) look(&frame.rgb[3 * pixel]);
  };
  for (std::int64_t x = 0; x < frame.width_px; ++x) {
    look_at(x, 0);
    look_at(x, frame.height_px - 1);
  }
  for (std::int64_t y = 1; y + 1 < frame.height_px; ++y) {
    look_at(0, y);
    look_at(frame.width_px - 1, y);
  }
}

// The median of each channel over all borders.
Color border_color(const std::vector<const StoredFrame*>& frames) {
  std::array<std::array<std::int64_t, 256>, 3> histogram{};
  std::int64_t count = 0;
  for (const StoredFrame* frame : frames) {
    each_border_pixel(*frame, [&](const std::uint8_t* pixel) {
      for (std::size_t c = 0; c < 3; ++c) ++histogram[c][pixel[c]];
      ++count;
    });
  }
  Color color{};
  for (std::size_t c = 0; c < 3; ++c) {
    std::int64_t below = 0;
    std::size_t value = 0;
    while (value < 255 && (below += histogram[c][value]) * 2 < count) ++value;
    color[c] = static_cast<std::uint8_t>(value);
  }
  return color;
}

// Sums of foreground pixels over rectangles from the top left corner.
class ForegroundSums {
 public:
  ForegroundSums(const StoredFrame& frame, const Color& background)
      : columns_(static_cast<std::size_t>(frame.width_px) + 1),
        rows_(static_cast<std::size_t>(frame.height_px) + 1),
        sums_(columns_ * rows_) {
    for (std::size_t y = 1; y < rows_; ++y) {
      std::uint32_t row = 0;
      for (std::size_t x = 1; x < columns_; ++x) {
        // What a mask hides may be the object.
        const std::size_t pixel = (y - 1) * (columns_ - 1) + x - 1;
        row += frame.mask.uses(pixel) && near_color(&frame.rgb[3 * pixel], background) ? 0 : 1;
        sums_[y * columns_ + x] = sums_[(y - 1) * columns_ + x] + row;
      }
    }
  }
  /// Any foreground within `radius` pixels of (u, v), as a square.
  bool any(double u, double v, double radius) const {
    const auto clamped = [](double at, std::size_t count) {
      return static_cast<std::size_t>(std::clamp(at, 0.0, static_cast<double>(count - 1)));
    };
    const std::size_t x0 = clamped(std::floor(u - radius), columns_), x1 = clamped(std::ceil(u + radius), columns_);
    const std::size_t y0 = clamped(std::floor(v - radius), rows_), y1 = clamped(std::ceil(v + radius), rows_);
    return sums_[y1 * columns_ + x1] + sums_[y0 * columns_ + x0] !=
           sums_[y0 * columns_ + x1] + sums_[y1 * columns_ + x0];
  }
  std::int64_t total() const { return sums_.back(); }

 private:
  std::size_t columns_, rows_;
  std::vector<std::uint32_t> sums_;
};

struct Silhouettes {
  Cameras cameras;
  std::vector<ForegroundSums> sums;
  std::vector<bool> whole;  ///< by frame: its border is background

  // Box of the voxels of `region` that the frames take for the object.
  Box hull(const Box& region) const {
    const Vec3d size = region.size();
    const double radius_m = 0.5 * length(size) / 48;  // of a voxel
    return box_of_voxels(region, [&](Vec3d center) {
      double seen = 0, background = 0;
      for (std::size_t i = 0; i < cameras.size(); ++i) {
        double u = 0, v = 0;
        const bool in_image = project_into(*cameras[i], center, u, v);
        if (!in_image && !whole[i]) continue;
        seen += 1;
        const double depth = cameras[i]->camera.depth_of(cameras[i]->world_from_camera.apply_inverse(center));
        // A frame that shows the object whole tells of what is beside it too.
        background += in_image && sums[i].any(u, v, radius_m * cameras[i]->camera.fx / depth) ? 0 : 1;
        if (background > kMostBackgroundViews * static_cast<double>(cameras.size())) return false;
      }
      return seen >= kLeastViews * static_cast<double>(cameras.size()) && background <= kMostBackgroundViews * seen;
    });
  }
};

}  // namespace

std::optional<PlainBackground> find_plain_background(const Cameras& cameras,
                                                     const std::vector<const StoredFrame*>& pixels,
                                                     const CameraRig& rig) {
  if (!rig.inward) return std::nullopt;
  std::vector<const StoredFrame*> frames;
  Silhouettes silhouettes;
  const std::size_t count = std::min(cameras.size(), kMostFrames);
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t at = i * cameras.size() / count;
    if (pixels[at]->rgb.empty()) continue;
    frames.push_back(pixels[at]);
    silhouettes.cameras.push_back(cameras[at]);
  }
  if (frames.empty()) return std::nullopt;
  PlainBackground out;
  out.color = border_color(frames);
  std::int64_t border = 0, plain = 0;
  for (const StoredFrame* frame : frames) {
    std::int64_t around = 0, alike = 0;
    each_border_pixel(*frame, [&](const std::uint8_t* pixel) {
      ++around;
      alike += near_color(pixel, out.color) ? 1 : 0;
    });
    border += around;
    plain += alike;
    silhouettes.whole.push_back(static_cast<double>(around - alike) <= kCleanBorder * static_cast<double>(around));
  }
  if (border == 0 || static_cast<double>(plain) < kLeastBorder * static_cast<double>(border)) return std::nullopt;
  std::int64_t all = 0, foreground = 0;
  for (const StoredFrame* frame : frames) {
    silhouettes.sums.emplace_back(*frame, out.color);
    all += std::int64_t{frame->width_px} * frame->height_px;
    foreground += silhouettes.sums.back().total();
  }
  if (static_cast<double>(foreground) > (1 - kLeastShare) * static_cast<double>(all)) return std::nullopt;
  const Vec3d half{rig.distance_m, rig.distance_m, rig.distance_m};
  const Box coarse = silhouettes.hull({rig.focus - half, rig.focus + half});
  if (coarse.empty()) return std::nullopt;
  out.object = silhouettes.hull(coarse);  // the same number of voxels over less space
  if (out.object.empty()) return std::nullopt;
  return out;
}

}  // namespace semfield
