// Outlines, discs and strokes as runs of pixels, by the pixel-centre rule.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "labels/label_steps.h"
#include "labels/pixel_point.h"

namespace semfield {

using Outline = std::vector<PixelPoint>;

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
std::vector<PixelRun> disc_runs(PixelPoint center, double radius_px, std::int32_t width, std::int32_t height);

/// Pixels that a disc of `radius_px` covers by its centre rule on its way along the polyline `points` (one: the disc at
/// rest), and those that the line itself passes through, so that a thin stroke has no gaps; rows ascending, runs of a
/// row apart and ascending. A point on the right or lower border of the image counts for the last pixel.
std::vector<PixelRun> stroke_runs(std::span<const PixelPoint> points, double radius_px, std::int32_t width,
                                  std::int32_t height);

/// Pixels in all runs.
std::int64_t area_of(const std::vector<PixelRun>& runs);

/// A raster of void.
LabelRaster void_raster(std::int32_t width, std::int32_t height);
/// `index` into the pixels of `runs`.
void paint(const std::vector<PixelRun>& runs, std::int16_t index, LabelRaster& raster);

}  // namespace semfield
