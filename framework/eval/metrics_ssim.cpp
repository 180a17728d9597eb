// Structural similarity of one image pair.
#include <algorithm>
#include <array>
#include <cmath>

#include "compute/parallel.h"
#include "core/check.h"
#include "eval/metrics.h"

namespace semfield {

namespace {

constexpr int kWindow = 11;
constexpr double kSigma = 1.5;
constexpr double kC1 = 0.01 * 0.01;  // (K1 L)^2 with dynamic range L = 1
constexpr double kC2 = 0.03 * 0.03;

std::array<double, kWindow> window_weights() {
  std::array<double, kWindow> w{};
  double sum = 0;
  for (int i = 0; i < kWindow; ++i) {
    const double x = i - kWindow / 2;
    w[static_cast<std::size_t>(i)] = std::exp(-x * x / (2 * kSigma * kSigma));
    sum += w[static_cast<std::size_t>(i)];
  }
  for (double& value : w) value /= sum;
  return w;
}

// Weighted moments of a window: means and raw second moments of both images.
struct Moments {
  double x = 0, y = 0, xx = 0, yy = 0, xy = 0;
  void add(double w, const Moments& m) {
    x += w * m.x;
    y += w * m.y;
    xx += w * m.xx;
    yy += w * m.yy;
    xy += w * m.xy;
  }
};

// SSIM = (2 mu_x mu_y + C1)(2 s_xy + C2) / ((mu_x^2 + mu_y^2 + C1)(s_x^2 + s_y^2 + C2)) [Wang04, Eq. 13]
double similarity(const Moments& m) {
  const double vx = std::max(0.0, m.xx - m.x * m.x);
  const double vy = std::max(0.0, m.yy - m.y * m.y);
  const double vxy = m.xy - m.x * m.y;
  return (2 * m.x * m.y + kC1) * (2 * vxy + kC2) / ((m.x * m.x + m.y * m.y + kC1) * (vx + vy + kC2));
}

}  // namespace

std::optional<double> ssim(std::span<const float> truth, std::span<const float> predicted, std::int32_t width_px,
                           std::int32_t height_px, std::int32_t channels, std::span<const std::uint8_t> used) {
  SEMFIELD_CHECK(width_px >= 0 && height_px >= 0 && channels >= 1, "image size");
  const std::size_t row_values = static_cast<std::size_t>(width_px) * static_cast<std::size_t>(channels);
  SEMFIELD_CHECK(truth.size() == row_values * static_cast<std::size_t>(height_px) && predicted.size() == truth.size(),
                 "images have width * height * channels values");
  const std::int64_t out_rows = height_px - kWindow + 1;
  const std::int64_t out_cols = width_px - kWindow + 1;
  if (out_rows < 1 || out_cols < 1) return std::nullopt;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (!std::isfinite(truth[i]) || !std::isfinite(predicted[i])) return std::nullopt;
  }
  const std::array<double, kWindow> w = window_weights();
  // Masked pixels above and to the left of each pixel, to tell the windows that hold one.
  const auto side = static_cast<std::size_t>(width_px) + 1;
  std::vector<std::int64_t> masked(used.empty() ? 0 : side * (static_cast<std::size_t>(height_px) + 1));
  for (std::size_t i = side; i < masked.size(); ++i) {
    if (i % side == 0) continue;
    const std::size_t pixel = (i / side - 1) * (side - 1) + i % side - 1;
    masked[i] = masked[i - 1] + masked[i - side] - masked[i - side - 1] + (used[pixel] == 0 ? 1 : 0);
  }
  const auto counts = [&](std::int64_t row, std::int64_t column) {
    if (masked.empty()) return true;
    const std::size_t top = static_cast<std::size_t>(row) * side + static_cast<std::size_t>(column);
    const std::size_t bottom = top + kWindow * side;
    return masked[bottom + kWindow] - masked[bottom] == masked[top + kWindow] - masked[top];
  };
  // One sum a row, added in row order: the same bits for any number of threads.
  std::vector<double> row_sum(static_cast<std::size_t>(out_rows), 0.0);
  std::vector<std::int64_t> row_windows(row_sum.size());
  parallel_for(out_rows, [&](std::int64_t r) {
    std::vector<Moments> column(row_values);  // vertical pass
    for (int k = 0; k < kWindow; ++k) {
      const std::size_t base = static_cast<std::size_t>(r + k) * row_values;
      for (std::size_t i = 0; i < row_values; ++i) {
        const double x = truth[base + i];
        const double y = predicted[base + i];
        column[i].add(w[static_cast<std::size_t>(k)], {x, y, x * x, y * y, x * y});
      }
    }
    double sum = 0;
    const std::size_t outputs = static_cast<std::size_t>(out_cols) * static_cast<std::size_t>(channels);
    for (std::size_t i = 0; i < outputs; ++i) {
      if (!counts(r, static_cast<std::int64_t>(i) / channels)) continue;
      ++row_windows[static_cast<std::size_t>(r)];
      Moments m;
      for (int k = 0; k < kWindow; ++k) {
        m.add(w[static_cast<std::size_t>(k)],
              column[i + static_cast<std::size_t>(k) * static_cast<std::size_t>(channels)]);
      }
      sum += similarity(m);
    }
    row_sum[static_cast<std::size_t>(r)] = sum;
  });
  double total = 0;
  for (double sum : row_sum) total += sum;
  std::int64_t windows = 0;
  for (const std::int64_t n : row_windows) windows += n;
  if (windows == 0) return std::nullopt;
  return total / static_cast<double>(windows);
}

}  // namespace semfield
