// Pixels that clicks and strokes name: those that the labels of training get, the clicked one first.
#include "serve/mark_pixels.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

#include "core/rng.h"
#include "labels/outline_fill.h"

namespace semfield {
namespace {

constexpr std::int32_t kWidth = 23, kHeight = 17;

std::set<std::pair<int, int>> set_of(const std::vector<PixelPlace>& pixels) {
  std::set<std::pair<int, int>> out;
  for (const PixelPlace& p : pixels) out.emplace(p.column, p.row);
  EXPECT_EQ(out.size(), pixels.size()) << "a pixel is named twice";
  return out;
}

Annotations::Mark mark_of(std::vector<PixelPoint> points, double radius) {
  Annotations::Mark mark;
  mark.points = std::move(points);
  mark.radius_px = radius;
  mark.class_index = 2;
  return mark;
}

double distance(PixelPoint p, PixelPoint a, PixelPoint b) {
  const double dx = b.x - a.x, dy = b.y - a.y, square = dx * dx + dy * dy;
  const double t = square > 0 ? std::clamp(((p.x - a.x) * dx + (p.y - a.y) * dy) / square, 0.0, 1.0) : 0.0;
  return std::hypot(a.x + t * dx - p.x, a.y + t * dy - p.y);
}

// Whether a way passes through a pixel: the shares of it that lie between the pixel's sides have one in common.
bool passes(PixelPoint a, PixelPoint b, int column, int row) {
  double from = 0, to = 1;
  for (const auto& [start, way, side] : {std::tuple{a.x, b.x - a.x, column}, {a.y, b.y - a.y, row}}) {
    if (way == 0) {
      if (start < side || start >= side + 1) return false;
      continue;
    }
    const double t0 = (side - start) / way, t1 = (side + 1 - start) / way;
    from = std::max(from, std::min(t0, t1));
    to = std::min(to, std::max(t0, t1));
  }
  return from <= to;
}

TEST(MarkPixels, ClicksAndStrokesAreThoseOfABruteForce) {
  const RandomAddress random{7, 0, stream_id("mark_pixels_test")};
  std::uint64_t n = 0;
  const auto any = [&](double most) { return static_cast<double>(uniform01(random, n++)) * most; };
  for (int round = 0; round < 40; ++round) {
    std::vector<PixelPoint> points;
    for (int k = 0; k <= round % 4; ++k) points.push_back({any(kWidth), any(kHeight)});
    const double radius = round % 3 == 0 ? 0 : any(5);
    SCOPED_TRACE(testing::Message() << "round " << round << ", radius " << radius);
    const std::set<std::pair<int, int>> named = set_of(pixels_of(mark_of(points, radius), kWidth, kHeight));
    for (int y = 0; y < kHeight; ++y) {
      for (int x = 0; x < kWidth; ++x) {
        bool wanted = false;
        for (std::size_t k = 0; k < points.size(); ++k) {
          const PixelPoint a = points[k], b = points[std::min(k + 1, points.size() - 1)];
          wanted = wanted || distance({x + 0.5, y + 0.5}, a, b) <= radius || passes(a, b, x, y);
        }
        EXPECT_EQ(named.contains({x, y}), wanted) << x << ", " << y;
      }
    }
  }
}

TEST(MarkPixels, TheClickedPixelComesFirst) {
  for (const double radius : {0.0, 0.7, 6.0}) {
    const std::vector<PixelPlace> pixels = pixels_of(mark_of({{10.2, 9.9}, {3.5, 4.5}}, radius), kWidth, kHeight);
    ASSERT_FALSE(pixels.empty());
    EXPECT_EQ(pixels.front().column, 10);
    EXPECT_EQ(pixels.front().row, 9);
  }
}

// The far corner of the image is a place of its last pixel.
TEST(MarkPixels, BordersBelongToTheImage) {
  const std::vector<PixelPlace> pixels = pixels_of(mark_of({{kWidth, kHeight}}, 0), kWidth, kHeight);
  ASSERT_EQ(pixels.size(), 1u);
  EXPECT_EQ(pixels[0].column, kWidth - 1);
  EXPECT_EQ(pixels[0].row, kHeight - 1);
  EXPECT_EQ(pixels_of(mark_of({{0, 0}}, 1e6), kWidth, kHeight).size(), static_cast<std::size_t>(kWidth * kHeight));
  EXPECT_TRUE(pixels_of(mark_of({}, 3), kWidth, kHeight).empty());
}

TEST(MarkPixels, WhatALaterClickPaintedOverIsLeftOut) {
  std::vector<std::int16_t> painted(kWidth * kHeight, 2);
  const std::vector<PixelPlace> all = pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight, painted);
  EXPECT_EQ(set_of(all), set_of(pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight)));
  for (int y = 0; y < kHeight; ++y)
    for (int x = 9; x < kWidth; ++x) painted[static_cast<std::size_t>(y * kWidth + x)] = 1;
  const std::vector<PixelPlace> left = pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight, painted);
  EXPECT_EQ(left.front().column, 8);
  std::set<std::pair<int, int>> expected;
  for (const PixelPlace& p : all)
    if (p.column < 9) expected.emplace(p.column, p.row);
  EXPECT_EQ(set_of(left), expected);
  EXPECT_LT(left.size(), all.size());
}

}  // namespace
}  // namespace semfield
