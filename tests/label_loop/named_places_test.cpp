// Places of clicks and strokes in the pool, the pixels that they mark, and coarse labels brought to a photograph.
#include <tuple>

#include "compute/parallel.h"
#include "core/rng.h"
#include "labels/mask_outlines.h"
#include "serve/label_loop.h"
#include "serve/view_pictures.h"
#include "tests/label_loop/looped_room.h"

namespace semfield {
namespace {

using namespace testing_loop;

// Every pixel of a view.
LabelledPixels whole_view(int view, std::int16_t class_index = 0) {
  LabelledPixels stroke{view, class_index, {}};
  for (std::int32_t i = 0; i < 48 * 36; ++i) stroke.pixels.push_back({i % 48, i / 48});
  return stroke;
}

struct Places {
  LoopedRoom room{60};
  NamedPlaces places{4};
  NamedPlaces::Surface surface{*room.training->session().pipeline, room.training->session().limits, room.loop->views(),
                               room.loop->pool()};
};

TEST(NamedPlaces, AStrokeHasOnePlaceInEachCellThatItCovers) {
  Places p;
  const std::vector<LabelledPixels> strokes{whole_view(2)};
  ASSERT_TRUE(p.places.find(strokes, p.surface, 1e9));
  std::set<std::int32_t> seen(p.surface.pool.point_of_pixel[2].begin(), p.surface.pool.point_of_pixel[2].end());
  seen.erase(-1);
  const auto nothing = static_cast<std::size_t>(
      std::count(p.surface.pool.point_of_pixel[2].begin(), p.surface.pool.point_of_pixel[2].end(), -1));
  EXPECT_GT(p.places.of(0).size(), seen.size() / 2);
  EXPECT_LE(p.places.of(0).size(), std::min<std::size_t>(256, seen.size() + nothing));
}

TEST(NamedPlaces, AClickHasItsOwnPlaceFirst) {
  Places p;
  const LabelledPixels click = p.room.click(1, {20, 18});
  const std::vector<LabelledPixels> clicks{click};
  ASSERT_TRUE(p.places.find(clicks, p.surface, 1e9));
  const RayCamera& camera = p.surface.views[1].camera;
  const double distance = surface_distances(p.surface.pipeline, camera, p.surface.limits, click.pixels).front();
  EXPECT_LT(length(p.places.of(0).front() - point_at(camera, p.surface.limits, {20, 18}, distance)), 1e-6);
  EXPECT_GT(p.places.of(0).size(), 1u) << "and what looks alike around it";
}

TEST(NamedPlaces, AreFoundOnceAndAFewAtATime) {
  Places p;
  std::vector<LabelledPixels> clicks = p.room.clicks(4);
  EXPECT_FALSE(p.places.find(clicks, p.surface, 0)) << "one at least, and no more without time";
  EXPECT_FALSE(p.places.of(0).empty());
  EXPECT_TRUE(p.places.of(1).empty());
  int turns = 1;
  while (!p.places.find(clicks, p.surface, 0)) ++turns;
  EXPECT_EQ(turns, 3);
  const std::int64_t found = p.places.found();
  EXPECT_EQ(found, 4);
  clicks.push_back(p.room.click(3, {30, 20}));
  clicks.erase(clicks.begin());
  EXPECT_TRUE(p.places.find(clicks, p.surface, 0));
  EXPECT_EQ(p.places.found(), found + 1) << "those of earlier clicks are kept";
  p.places.renew();
  EXPECT_TRUE(p.places.find(clicks, p.surface, 0));
  EXPECT_EQ(p.places.found(), found + 1) << "old ones serve meanwhile";
  p.places.refresh(clicks, p.surface, 1e9);
  EXPECT_EQ(p.places.found(), found + 5);
  p.places.refresh(clicks, p.surface, 1e9);
  EXPECT_EQ(p.places.found(), found + 5);
}

// What is learned from does not grow with the strokes over the same surface, and each weighs as it did.
TEST(NamedPlaces, ManyStrokesOverTheSameSurfaceCountItOnce) {
  LoopedRoom room;
  std::vector<LabelledPixels> strokes{whole_view(2)};
  room.loop->learn(strokes);
  const std::size_t once = room.loop->learned_points();
  EXPECT_GT(once, 50u);
  for (int i = 0; i < 20; ++i) strokes.push_back(whole_view(2));
  room.loop->learn(strokes);
  EXPECT_EQ(room.loop->learned_points(), once);
}

// Pixels that clicks and strokes name: those that the labels of training get, the clicked one first.

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

// Whether a way passes through a pixel: the fractions of it that lie between the pixel's sides have one in common.
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
    for (int x = 9; x < kWidth; ++x) painted[y * kWidth + x] = 1;
  const std::vector<PixelPlace> left = pixels_of(mark_of({{8.5, 8.5}}, 3), kWidth, kHeight, painted);
  EXPECT_EQ(left.front().column, 8);
  std::set<std::pair<int, int>> expected;
  for (const PixelPlace& p : all)
    if (p.column < 9) expected.emplace(p.column, p.row);
  EXPECT_EQ(set_of(left), expected);
  EXPECT_LT(left.size(), all.size());
}

// Labels of a coarse map brought to a photograph's size: exact at stride 1, along edges of colour elsewhere.

StoredFrame photo_of(std::int32_t width, std::int32_t height) {
  StoredFrame photo;
  photo.width_px = width;
  photo.height_px = height;
  photo.rgb.assign(static_cast<std::size_t>(3 * width * height), 128);
  return photo;
}

CoarseLabels coarse_of(const StoredFrame& photo, std::int32_t stride) {
  CoarseLabels coarse{.stride = stride,
                      .width_px = strided_px(photo.width_px, stride),
                      .height_px = strided_px(photo.height_px, stride)};
  coarse.label.assign(static_cast<std::size_t>(coarse.width_px * coarse.height_px), 0);
  coarse.entropy.assign(coarse.label.size(), 0);
  return coarse;
}

TEST(LabelUpsampling, StrideOneIsTheIdentity) {
  const StoredFrame photo = photo_of(7, 5);
  CoarseLabels coarse = coarse_of(photo, 1);
  for (std::size_t i = 0; i < coarse.label.size(); ++i) {
    coarse.label[i] = static_cast<std::int16_t>(i % 4) - 1;
    coarse.entropy[i] = static_cast<std::uint8_t>(7 * i);
  }
  const ViewLabels out = upsampled(coarse, photo);
  EXPECT_EQ(out.width_px, 7);
  EXPECT_EQ(out.height_px, 5);
  EXPECT_EQ(out.label, coarse.label);
  EXPECT_EQ(out.entropy, coarse.entropy);
}

TEST(LabelUpsampling, WithoutAMapNothingIsNamed) {
  const ViewLabels out = upsampled({}, photo_of(6, 4));
  EXPECT_EQ(out.label, std::vector<std::int16_t>(24, kVoid));
  EXPECT_EQ(out.entropy, std::vector<std::uint8_t>(24, 0));
}

// An edge of colour between two samples of the map, wherever it lies.
TEST(LabelUpsampling, LabelsFollowAnEdgeOfColour) {
  for (const std::int32_t stride : {3, 4, 6}) {
    for (std::int32_t edge = 12 + stride / 2 + 1; edge <= 12 + stride / 2 + stride; ++edge) {
      StoredFrame photo = photo_of(36, 24);
      for (std::int32_t y = 0; y < 24; ++y)
        for (std::int32_t x = edge; x < 36; ++x) photo.rgb[3 * (y * 36 + x)] = 220;
      CoarseLabels coarse = coarse_of(photo, stride);
      for (std::size_t i = 0; i < coarse.label.size(); ++i) {
        const PixelPlace at = strided_place(static_cast<std::int64_t>(i), coarse.width_px, stride);
        coarse.label[i] = at.column < edge ? 3 : 8;
      }
      const ViewLabels out = upsampled(coarse, photo);
      for (std::int32_t y = 0; y < 24; ++y)
        for (std::int32_t x = 0; x < 36; ++x)
          ASSERT_EQ(out.label[y * 36 + x], x < edge ? 3 : 8)
              << "stride " << stride << ", edge " << edge << ", pixel " << x << ", " << y;
    }
  }
}

// Sizes that no stride divides, random colours: what comes out is between what is around, for any threads.
TEST(LabelUpsampling, LabelsAndEntropyAreThoseOfTheNeighbours) {
  const RandomAddress random{3, 0, stream_id("label_upsampling_test")};
  StoredFrame photo = photo_of(29, 22);
  for (std::size_t i = 0; i < photo.rgb.size(); ++i)
    photo.rgb[i] = static_cast<std::uint8_t>(uniform_below(random, i, 256));
  CoarseLabels coarse = coarse_of(photo, 4);
  for (std::size_t i = 0; i < coarse.label.size(); ++i) {
    coarse.label[i] = static_cast<std::int16_t>(uniform_below(random, 10000 + i, 5)) - 1;
    coarse.entropy[i] = static_cast<std::uint8_t>(uniform_below(random, 20000 + i, 256));
  }
  const ViewLabels out = upsampled(coarse, photo);
  for (std::int32_t y = 0; y < 22; ++y) {
    for (std::int32_t x = 0; x < 29; ++x) {
      std::vector<std::int16_t> labels;
      std::vector<std::uint8_t> entropies;
      for (int k = 0; k < 4; ++k) {
        const auto side = [](std::int32_t at, std::int32_t count, int next) {
          return std::clamp(static_cast<std::int32_t>(std::floor((at - 2) / 4.0)) + next, 0, count - 1);
        };
        const std::int32_t cx = side(x, coarse.width_px, k % 2), cy = side(y, coarse.height_px, k / 2);
        labels.push_back(coarse.label[cy * coarse.width_px + cx]);
        entropies.push_back(coarse.entropy[cy * coarse.width_px + cx]);
      }
      const auto at = static_cast<std::size_t>(y * 29 + x);
      EXPECT_NE(std::find(labels.begin(), labels.end(), out.label[at]), labels.end()) << x << ", " << y;
      EXPECT_GE(out.entropy[at], *std::min_element(entropies.begin(), entropies.end())) << x << ", " << y;
      EXPECT_LE(out.entropy[at], *std::max_element(entropies.begin(), entropies.end())) << x << ", " << y;
      const bool sample = x % 4 == 2 && y % 4 == 2;
      if (sample && x / 4 < coarse.width_px && y / 4 < coarse.height_px) {
        EXPECT_EQ(out.label[at], labels[0]);
      }
    }
  }
  for (const int threads : {1, 3}) {
    set_thread_count(threads);
    const ViewLabels again = upsampled(coarse, photo);
    EXPECT_EQ(again.label, out.label);
    EXPECT_EQ(again.entropy, out.entropy);
  }
  set_thread_count(0);
}

}  // namespace
}  // namespace semfield
