#include "loading/capture/sharpness.h"

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "formats/image_io.h"

namespace semfield {

double sharpness(std::span<const std::uint8_t> grey, std::int32_t width) {
  const auto w = static_cast<std::size_t>(width), rows = grey.size() / w;
  if (w < 3 || rows < 3) return 0;
  double sum = 0, squares = 0, of_laplacian = 0, squares_of_laplacian = 0;
  for (std::size_t y = 1; y + 1 < rows; ++y) {
    for (std::size_t x = 1; x + 1 < w; ++x) {
      const std::uint8_t* p = grey.data() + y * w + x;
      const double here = *p, laplacian = 4.0 * here - p[-1] - p[1] - *(p - w) - *(p + w);
      sum += here;
      squares += here * here;
      of_laplacian += laplacian;
      squares_of_laplacian += laplacian * laplacian;
    }
  }
  const double count = static_cast<double>((w - 2) * (rows - 2));
  const double variance = squares / count - sum / count * (sum / count);
  const double of_edges = squares_of_laplacian / count - of_laplacian / count * (of_laplacian / count);
  return variance > 0 ? of_edges / variance : 0;
}

double sharpness_of(const std::string& photograph) {
  Image<std::uint8_t> image = read_rgb(photograph);
  constexpr std::int32_t kLongest = 1024;
  const std::int32_t longest = std::max(image.width_px, image.height_px);
  if (longest > kLongest) {
    image = resize_area(image, std::max(1, image.width_px * kLongest / longest),
                        std::max(1, image.height_px * kLongest / longest));
  }
  std::vector<std::uint8_t> grey;
  grey.reserve(image.pixels.size() / 3);
  for (std::size_t i = 0; i + 2 < image.pixels.size(); i += 3)
    grey.push_back(static_cast<std::uint8_t>((image.pixels[i] + 2 * image.pixels[i + 1] + image.pixels[i + 2]) / 4));
  return sharpness(grey, image.width_px);
}

double median_of(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

FrameChoice choose_frames(std::span<const std::uint8_t> frames, std::size_t pixels, std::int32_t width,
                          std::size_t intervals) {
  constexpr double kStill = 2;
  const std::size_t count = frames.size() / pixels;
  std::vector<double> sharp(count);
  parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
    sharp[static_cast<std::size_t>(i)] = sharpness(frames.subspan(static_cast<std::size_t>(i) * pixels, pixels), width);
  });
  std::vector<std::size_t> best;
  std::vector<double> of_best;
  const std::size_t parts = std::min(intervals, count);
  for (std::size_t k = 0; k < parts; ++k) {
    const auto first = sharp.begin() + static_cast<std::ptrdiff_t>(k * count / parts);
    const auto last = sharp.begin() + static_cast<std::ptrdiff_t>((k + 1) * count / parts);
    const auto top = std::max_element(first, last);
    best.push_back(static_cast<std::size_t>(top - sharp.begin()));
    of_best.push_back(*top);
  }
  const double least = kBlurredShare * median_of(of_best);
  FrameChoice out;
  for (const std::size_t frame : best) {
    if (sharp[frame] < least) {
      ++out.blurred;
      continue;
    }
    if (!out.kept.empty()) {
      double off = 0;
      for (std::size_t p = 0; p < pixels; ++p)
        off += std::abs(frames[frame * pixels + p] - frames[out.kept.back() * pixels + p]);
      if (off < kStill * static_cast<double>(pixels)) {
        ++out.still;
        continue;
      }
    }
    out.kept.push_back(frame);
  }
  return out;
}

}  // namespace semfield
