#include "eval/photo_edges.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/files.h"
#include "eval/evaluator.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/mask_outlines.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

constexpr double kReach = 0.15;         // of the longer side: how far a label spreads where nothing is in its way
constexpr double kColorStep = 0.17;     // a step of this sum over channels (0 to 3) is a way of kReach
constexpr std::int32_t kFine_px = 400;  // longer side from which a pixel is finer than what is in the picture
constexpr int kRounds = 3;              // of rows and columns; each reaches half as far, which leaves no stripes
constexpr float kLeastWeight = 1e-9F;
constexpr std::size_t kSteps = 3 * 255 * 16 + 1;  // of colour, in 1/16
// A connected piece of a class takes the class around it where it is a smaller part of the picture than the first, or
// than the second where it is half as sure as the picture's middle pixel.
constexpr std::int64_t kSpeck = 4096, kDoubtfulSpeck = 100;
constexpr double kDoubtful = 0.5;
constexpr double kSameShape = 0.02;  // of the ratio of the sides: sizes are rounded to pixels
constexpr float kHeard = 0.004F;     // a class that is nowhere more probable in a picture is left out

// Where a photograph whose pixels are not fine would change few labels, those are small and thin things, which rays see
// and its edges miss: up to the first share of the pixels the two count alike, from the second on the photograph alone.
constexpr double kFewChange = 0.015, kManyChange = 0.03, kRays = 0.5;

// Times 16, and by the binomial filter of 3 x 3 pixels where pixels are fine: noise of single ones is no edge then.
std::vector<std::uint16_t> smoothed(std::span<const std::uint8_t> rgb, std::int32_t width, std::int32_t height) {
  const int side =
      std::max(width, height) >= kFine_px ? 1 : 2;  // weight of a neighbour: 2 - |distance| * side, at least 0
  std::vector<std::uint16_t> out(rgb.size());
  const auto at = [&](std::int32_t x, std::int32_t y, int c) {
    x = std::clamp(x, 0, width - 1);
    y = std::clamp(y, 0, height - 1);
    return int{rgb[3 * static_cast<std::size_t>(std::int64_t{y} * width + x) + static_cast<std::size_t>(c)]};
  };
  const int scale = side == 1 ? 1 : 4;
  parallel_for(height, [&](std::int64_t row) {
    const auto y = static_cast<std::int32_t>(row);
    for (std::int32_t x = 0; x < width; ++x) {
      for (int c = 0; c < 3; ++c) {
        int sum = 0;
        for (int dy = -1; dy <= 1; ++dy)
          for (int dx = -1; dx <= 1; ++dx)
            sum += (2 - std::abs(dx) * side) * (2 - std::abs(dy) * side) * at(x + dx, y + dy, c);
        out[3 * static_cast<std::size_t>(row * width + x) + static_cast<std::size_t>(c)] =
            static_cast<std::uint16_t>(sum * scale);
      }
    }
  });
  return out;
}

// Weight of the neighbour by the step of colour to it.
std::vector<float> weights_of(double sigma, double reach) {
  std::vector<float> out(kSteps);
  for (std::size_t step = 0; step < kSteps; ++step) {
    const double color = static_cast<double>(step) / (16 * 255);
    const double way = 1 + reach / kColorStep * color;
    out[step] = std::max(kLeastWeight, static_cast<float>(std::exp(-std::sqrt(2.0) / sigma * way)));
  }
  return out;
}

constexpr auto kWide = static_cast<std::size_t>(PhotoEdges::kColumns);

void take_from(float* own, const float* other, float weight) {
  for (std::size_t c = 0; c < kWide; ++c) own[c] += weight * (other[c] - own[c]);
}

void clear_specks(PhotoLabels& found, std::int32_t width_px, std::int32_t height_px) {
  const PixelRegions regions = regions_of(found.label, width_px, height_px);
  std::vector<double> sure(regions.pixels.size(), 0);
  for (std::size_t i = 0; i < found.label.size(); ++i)
    sure[regions.of_pixel[i]] += static_cast<double>(found.confidence[i]);
  std::vector<float> sorted = found.confidence;
  const auto middle = sorted.begin() + static_cast<std::ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end());
  const double doubtful = kDoubtful * static_cast<double>(*middle);
  std::vector<bool> weak;
  for (std::size_t r = 0; r < sure.size(); ++r) {
    const std::int64_t pixels = regions.pixels[r], all = std::ssize(found.label);
    weak.push_back(pixels * kSpeck < all ||
                   (pixels * kDoubtfulSpeck < all && sure[r] < doubtful * static_cast<double>(pixels)));
  }
  (void)fill_regions(found.label, width_px, height_px, regions, weak);
}

}  // namespace

PhotoEdges::PhotoEdges(std::span<const std::uint8_t> rgb, std::int32_t width_px, std::int32_t height_px)
    : width_px_(width_px), height_px_(height_px) {
  SEMFIELD_CHECK(std::ssize(rgb) == std::int64_t{3} * width_px * height_px, "a photograph has three channels");
  const std::vector<std::uint16_t> smooth = smoothed(rgb, width_px, height_px);
  from_left_.resize(rgb.size() / 3);
  from_above_.resize(rgb.size() / 3);
  const auto width = static_cast<std::size_t>(width_px);
  parallel_for(height_px, [&](std::int64_t row) {
    const auto step = [&](std::size_t a, std::size_t b) {
      int sum = 0;
      for (std::size_t c = 0; c < 3; ++c) sum += std::abs(int{smooth[3 * a + c]} - int{smooth[3 * b + c]});
      return static_cast<std::uint16_t>(sum);
    };
    for (std::size_t i = static_cast<std::size_t>(row) * width, x = 0; x < width; ++x, ++i) {
      if (x > 0) from_left_[i] = step(i, i - 1);
      if (row > 0) from_above_[i] = step(i, i - width);
    }
  });
}

void PhotoEdges::spread(std::span<float> values) const {
  SEMFIELD_CHECK(values.size() == from_left_.size() * kWide, "a row of columns for every pixel");
  constexpr std::int64_t kStrip = 32;  // columns of pixels that a thread takes down and up
  const auto width = static_cast<std::size_t>(width_px_), height = static_cast<std::size_t>(height_px_);
  const double reach = kReach * std::max(width_px_, height_px_);
  for (int round = 0; round < kRounds; ++round) {
    // All rounds together reach as far as one filter of `reach` [Gastal11, Eq. 14].
    const double sigma =
        reach * std::sqrt(3.0) * std::exp2(kRounds - round - 1) / std::sqrt(std::pow(4.0, kRounds) - 1);
    const std::vector<float> weight = weights_of(sigma, reach);
    parallel_for(height_px_, [&](std::int64_t row) {
      float* const line = values.data() + static_cast<std::size_t>(row) * width * kWide;
      const std::uint16_t* const step = from_left_.data() + static_cast<std::size_t>(row) * width;
      for (std::size_t x = 1; x < width; ++x) take_from(line + x * kWide, line + (x - 1) * kWide, weight[step[x]]);
      for (std::size_t x = width - 1; x > 0; --x) take_from(line + (x - 1) * kWide, line + x * kWide, weight[step[x]]);
    });
    parallel_for((width_px_ + kStrip - 1) / kStrip, [&](std::int64_t strip) {
      const auto first = static_cast<std::size_t>(strip * kStrip), last = std::min(width, first + kStrip);
      const auto take = [&](std::size_t y, std::size_t from, std::size_t edge) {
        for (std::size_t x = first; x < last; ++x)
          take_from(values.data() + (y * width + x) * kWide, values.data() + (from * width + x) * kWide,
                    weight[from_above_[edge * width + x]]);
      };
      for (std::size_t y = 1; y < height; ++y) take(y, y - 1, y);
      for (std::size_t y = height - 1; y > 0; --y) take(y - 1, y, y);
    });
  }
}

PhotoLabels labels_on_photo(const ClassEvidence& evidence, std::span<const std::uint8_t> rgb, std::int32_t width_px,
                            std::int32_t height_px) {
  const std::size_t columns = evidence.label.size();
  const std::size_t known = columns == 0 ? 0 : evidence.probability.size() / columns;
  SEMFIELD_CHECK(known * columns == evidence.probability.size() &&
                     known == static_cast<std::size_t>(std::int64_t{evidence.width_px} * evidence.height_px),
                 "a row of probabilities for every pixel that is known");
  const auto size = static_cast<std::size_t>(std::int64_t{width_px} * height_px);
  PhotoLabels out;
  out.label.assign(size, kVoid);
  out.confidence.assign(size, 0);
  out.entropy.assign(size, 0);
  // How sure each known pixel is, and of what, and the columns that say anything at all.
  std::vector<float> sure(known), most(columns);
  std::vector<std::size_t> own(known);
  for (std::size_t i = 0; i < known; ++i) {
    float best = 0;
    for (std::size_t c = 0; c < columns; ++c) {
      const float p = evidence.probability[i * columns + c];
      most[c] = std::max(most[c], p);
      if (p <= best) continue;
      best = p;
      own[i] = c;
    }
    sure[i] = best * best * best * best;
  }
  std::vector<std::size_t> heard;
  for (std::size_t c = 0; c < columns; ++c)
    if (most[c] > kHeard) heard.push_back(c);
  if (heard.empty()) return out;
  std::vector<std::size_t> place;
  const std::int64_t frame_width = evidence.frame_width_px > 0 ? evidence.frame_width_px : width_px,
                     frame_height = evidence.frame_height_px > 0 ? evidence.frame_height_px : height_px;
  for (std::size_t i = 0; i < known; ++i) {
    const PixelPlace at = strided_place(static_cast<std::int64_t>(i), evidence.width_px, evidence.stride);
    const std::int64_t x = (2 * at.column + 1) * std::int64_t{width_px} / (2 * frame_width),
                       y = (2 * at.row + 1) * std::int64_t{height_px} / (2 * frame_height);
    place.push_back(static_cast<std::size_t>(y * width_px + x));
  }
  const PhotoEdges edges(rgb, width_px, height_px);
  const bool is_coarse = known == size && std::max(width_px, height_px) < kFine_px;
  std::vector<float> values(size * kWide), norm(size), own_share(is_coarse ? size : 0);
  std::vector<std::size_t> column(own_share.size());  // that was found
  // Column 0 of all is how much is known; the others follow in groups.
  for (std::size_t begin = 0; begin < heard.size() + 1; begin += kWide) {
    const std::size_t count = std::min(kWide, heard.size() + 1 - begin);
    std::fill(values.begin(), values.end(), 0.0F);
    for (std::size_t i = 0; i < known; ++i) {
      float* const row = &values[kWide * place[i]];
      for (std::size_t k = 0; k < count; ++k)
        row[k] = sure[i] * (begin + k == 0 ? 1.0F : evidence.probability[i * columns + heard[begin + k - 1]]);
    }
    edges.spread(values);
    parallel_for(height_px, [&](std::int64_t y) {
      for (std::size_t i = static_cast<std::size_t>(y * width_px); i < static_cast<std::size_t>((y + 1) * width_px);
           ++i) {
        const float* const row = &values[kWide * i];
        std::size_t k = 0;
        if (begin == 0) norm[i] = row[k++];
        if (!(norm[i] > 0)) continue;
        for (; k < count; ++k) {
          const float p = row[k] / norm[i];
          const std::size_t c = heard[begin + k - 1];
          if (p > 0) out.entropy[i] -= p * std::log(p);
          if (!own_share.empty() && c == own[i]) own_share[i] = p;
          if (p <= out.confidence[i]) continue;
          out.confidence[i] = p;
          out.label[i] = evidence.label[c];
          if (!column.empty()) column[i] = c;
        }
      }
    });
  }
  double changed = 0;
  for (std::size_t i = 0; i < column.size(); ++i) changed += column[i] != own[i] && sure[i] > 0 ? 1 : 0;
  const double rays =
      kRays * std::clamp((kManyChange - changed / static_cast<double>(size)) / (kManyChange - kFewChange), 0.0, 1.0);
  for (std::size_t i = 0; rays > 0 && i < column.size(); ++i) {
    if (column[i] == own[i] || !(sure[i] > 0)) continue;
    const float* const seen = &evidence.probability[i * columns];
    const auto both = [&](float photo, std::size_t c) {
      return static_cast<float>((1 - rays) * static_cast<double>(photo) + rays * static_cast<double>(seen[c]));
    };
    const float kept = both(own_share[i], own[i]);
    if (kept <= both(out.confidence[i], column[i])) continue;
    out.label[i] = evidence.label[own[i]];
    out.confidence[i] = kept;
  }
  clear_specks(out, width_px, height_px);
  return out;
}

PhotoLabels labels_on_photo(const RenderedFrame& frame, int classes, std::span<const std::uint8_t> rgb,
                            std::int32_t width_px, std::int32_t height_px) {
  ClassEvidence evidence{frame.stride, frame.width_px, frame.height_px, frame.probability, {}};
  for (int c = 0; c < classes; ++c) evidence.label.push_back(static_cast<std::int16_t>(c));
  return labels_on_photo(evidence, rgb, width_px, height_px);
}

std::vector<std::int16_t> clinging_labels(const FrameInfo* info, const RenderedFrame& rendered, int classes,
                                          std::int32_t width_px, std::int32_t height_px) {
  Image<std::uint8_t> photo;
  if (info != nullptr && is_file(info->source)) {
    photo = read_rgb(info->source);
    const double shape =
        static_cast<double>(photo.width_px) * height_px / (static_cast<double>(photo.height_px) * width_px);
    const bool fits = std::abs(shape - 1) <= kSameShape && photo.width_px >= width_px && photo.height_px >= height_px;
    photo = fits ? resize_area(photo, width_px, height_px) : Image<std::uint8_t>();
  }
  if (photo.pixels.empty() && !rendered.rgb.empty() && rendered.stride == 1) photo.pixels = to_bytes(rendered.rgb);
  if (photo.pixels.empty()) return rendered.label;
  return labels_on_photo(rendered, classes, photo.pixels, width_px, height_px).label;
}

}  // namespace semfield
