// Outlines and discs as runs of pixels, by the pixel-centre rule.
#pragma once

#include <cstdint>
#include <vector>

#include "labels/label_steps.h"

namespace semfield {

/// Image point in pixels: the centre of pixel (i, j) is (i + 0.5, j + 0.5).
struct ImagePoint {
  double x = 0, y = 0;
};
using Outline = std::vector<ImagePoint>;

/// Pixels x0 <= x < x1 of row y.
struct PixelRun {
  std::int32_t y = 0, x0 = 0, x1 = 0;
};

/// Largest coordinate (positive or negative) and number of points that outline_runs takes.
inline constexpr double kMaxCoordinate = 1e6;
inline constexpr std::size_t kMaxOutlinePoints = 1'000'000;

/// Pixels whose centre lies inside the closed outline (the last point is joined with the first) by the even-odd rule,
/// rows ascending, runs of a row apart and ascending. A centre on an edge belongs to the side that lies to the right of
/// or below it, so outlines that share an edge share no pixel and leave none out. The part outside the image is cut
/// off. The caller has checked coordinates and number of points.
std::vector<PixelRun> outline_runs(const Outline& outline, std::int32_t width, std::int32_t height);

/// Pixels whose centre is at most `radius_px` away from `center`.
std::vector<PixelRun> disc_runs(ImagePoint center, double radius_px, std::int32_t width, std::int32_t height);

/// Pixels in all runs.
std::int64_t area_of(const std::vector<PixelRun>& runs);

/// A raster of void.
LabelRaster void_raster(std::int32_t width, std::int32_t height);
/// `index` into the pixels of `runs`.
void paint(const std::vector<PixelRun>& runs, std::int16_t index, LabelRaster& raster);

}  // namespace semfield
