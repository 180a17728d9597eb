// Connected regions of a label map as closed outlines that give the same pixels back.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "labels/label_files.h"

namespace semfield {

/// Pixels, continuous: (0, 0) is the upper left corner of the image, the centre of pixel (i, j) is (i + 0.5, j + 0.5).
struct PixelPoint {
  double x = 0, y = 0;
  bool operator==(const PixelPoint&) const = default;
};

// Outlines, discs and strokes as runs of pixels, by the pixel-centre rule.

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

/// A region of one class, connected through pixel edges.
struct MaskRegion {
  std::int16_t index = 0;  ///< internal class index
  std::int64_t area_px = 0;
  Outline outline;  ///< along pixel edges, clockwise; corners only
};

/// Regions of all classes of `label` [height * width], in the order of their first pixels; void has none. A hole is
/// joined to the rest of the outline by a horizontal cut without width, so one outline says all of a region and
/// outline_runs of it gives exactly its pixels, by the even-odd and by the non-zero rule.
std::vector<MaskRegion> mask_regions(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height);

/// Pixels of one label (void too) that are connected through pixel edges, numbered in the order of their first pixels.
struct PixelRegions {
  std::vector<std::uint32_t> of_pixel;
  std::vector<std::size_t> first;    ///< of each region
  std::vector<std::int64_t> pixels;  ///< how many it has
};
PixelRegions regions_of(const std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height);

// COCO's run lengths of a mask [Lin14]: column by column from the top left, beginning with the pixels outside.

/// Counts of a text, 5 bits a character from '0' on, low bits first: 0x20 marks that more follow, 0x10 of the last one
/// the sign; from the fourth count on differences to the count two before. Throws Error(data) with the cause for a
/// character out of range, a text that ends within a number, and a negative count.
std::vector<std::int64_t> counts_of_text(std::string_view text);
std::string text_of_counts(const std::vector<std::int64_t>& counts);

/// Pixels of the mask as runs of rows, rows ascending. Throws Error(data) for a negative count and for counts that do
/// not add up to width * height - before anything of that size is allocated.
std::vector<PixelRun> runs_of_counts(const std::vector<std::int64_t>& counts, std::int32_t width, std::int32_t height);

/// Counts of the pixels of `label` [height * width] that equal `index`.
std::vector<std::int64_t> counts_of_class(const std::vector<std::int16_t>& label, std::int16_t index,
                                          std::int32_t width, std::int32_t height);

// Speckles of a label map: small connected regions given to what surrounds them.

struct SmallRegions {
  std::int64_t regions = 0, pixels = 0;  ///< that changed class
};

/// Pixels of regions (connected through pixel edges, void too) with fewer than `min_area_px` pixels take the class of
/// the nearest larger region, in steps from pixel to pixel through small regions. Pixels of larger regions keep their
/// class, and no smaller region is left. A map of small regions alone stays as it is.
SmallRegions fill_small_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                                std::int64_t min_area_px);
/// The same for the regions that `weak` [regions] marks.
SmallRegions fill_regions(std::vector<std::int16_t>& label, std::int32_t width, std::int32_t height,
                          const PixelRegions& regions, const std::vector<bool>& weak);

}  // namespace semfield
