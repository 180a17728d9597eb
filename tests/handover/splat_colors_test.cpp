// Splats drawn as viewers draw them, and colours that make up for it.
#include <gtest/gtest.h>

#include <cmath>

#include "compute/parallel.h"
#include "eval/image_output.h"
#include "handover/splats.h"

namespace semfield {
namespace {

constexpr std::array<double, 3> kBlack{0, 0, 0}, kGreen{0, 1, 0};

// Looks along z from the origin; the middle of pixel (4, 4) is its axis.
RayCamera camera(LensKind lens = LensKind::perspective) {
  RayCamera out;
  out.camera.width_px = out.camera.height_px = 9;
  out.camera.fx = out.camera.fy = 10;
  out.camera.cx = out.camera.cy = 4.5;
  out.camera.lens = lens;
  return out;
}

void add(Splats& splats, Vec3d place, float opacity, std::array<std::uint8_t, 3> color) {
  splats.points.positions.push_back(place);
  splats.opacity.push_back(opacity);
  splats.points.attributes.color.push_back(color);
}

// A wall of squares in two colours, finer than pixels, seen by all of the camera.
Splats wall() {
  Splats out;
  out.deviation = 0.05;
  for (int y = -12; y <= 12; ++y)
    for (int x = -12; x <= 12; ++x) {
      const bool light = (x / 4 + y / 4 + 20) % 2 == 0;
      const auto shade = static_cast<std::uint8_t>(light ? 200 : 60);
      add(out, {0.1 * x, 0.1 * y, 2}, 0.9F, {shade, static_cast<std::uint8_t>(255 - shade), 90});
    }
  return out;
}

double error(const Splats& splats, const SplatView& view) {
  const std::vector<float> drawn = draw_splats(splats, view.camera, kBlack);
  double sum = 0;
  for (std::size_t i = 0; i < drawn.size(); ++i)
    sum += std::pow(static_cast<double>(drawn[i]) - view.rgb[i] / 255.0, 2) / static_cast<double>(drawn.size());
  return sum;
}

TEST(SplatColors, NearOnesCoverFarOnesAndWhatIsLeftIsBackground) {
  Splats splats;
  splats.deviation = 0.1;
  add(splats, {0, 0, 4}, 0.8F, {0, 0, 255});
  add(splats, {0, 0, 2}, 0.5F, {255, 0, 0});
  add(splats, {0, 0, -2}, 0.9F, {255, 255, 255});  // behind the camera
  const std::vector<float> rgb = draw_splats(splats, camera(), kGreen);
  const std::size_t middle = 3 * (4 * 9 + 4);
  EXPECT_NEAR(rgb[middle], 0.5, 1e-5);
  EXPECT_NEAR(rgb[middle + 2], 0.5 * 0.8, 1e-5);
  EXPECT_NEAR(rgb[middle + 1], 0.5 * 0.2, 1e-5);
  EXPECT_NEAR(rgb[1], 1, 1e-5) << "no splat reaches the corner";
}

TEST(SplatColors, AFootprintIsTheDeviationOnTheImageAndPartOfAPixel) {
  Splats splats;
  splats.deviation = 0.2;
  add(splats, {0, 0, 2}, 0.5F, {255, 255, 255});
  const std::vector<float> rgb = draw_splats(splats, camera(), kBlack);
  for (int away = 0; away <= 2; ++away)
    EXPECT_NEAR(rgb[static_cast<std::size_t>(3 * (4 * 9 + 4 + away))], 0.5 * std::exp(-away * away / (2 * (1 + 0.3))),
                1e-5)
        << away;
}

TEST(SplatColors, AFitMakesPicturesOfTheViews) {
  const SplatView view{camera(), to_bytes(draw_splats(wall(), camera(), kBlack))};
  Splats grey = wall();
  for (auto& color : grey.points.attributes.color) color = {128, 128, 128};
  const double before = error(grey, view);
  Splats fitted = grey;
  fit_colors(fitted, {&view, 1}, kBlack);
  EXPECT_LT(error(fitted, view), 0.1 * before);
  set_thread_count(3);
  Splats again = grey;
  fit_colors(again, {&view, 1}, kBlack);
  set_thread_count(1);
  Splats alone = grey;
  fit_colors(alone, {&view, 1}, kBlack);
  set_thread_count(0);
  EXPECT_EQ(again.points.attributes.color, alone.points.attributes.color);
}

TEST(SplatColors, WhatNoViewShowsKeepsItsColor) {
  Splats splats = wall();
  const auto before = splats.points.attributes.color;
  const SplatView wide{camera(LensKind::fisheye), std::vector<std::uint8_t>(3 * 81, 0)};
  fit_colors(splats, {&wide, 1}, kBlack);
  EXPECT_EQ(splats.points.attributes.color, before);
  EXPECT_TRUE(draw_splats(splats, wide.camera, kBlack).empty());
  splats.points.positions[0] = {0, 0, -5};
  SplatView dark{camera(), std::vector<std::uint8_t>(3 * 81, 0)};
  fit_colors(splats, {&dark, 1}, kBlack);
  EXPECT_EQ(splats.points.attributes.color[0], before[0]);
  EXPECT_NE(splats.points.attributes.color[300], before[300]);
}

}  // namespace
}  // namespace semfield
