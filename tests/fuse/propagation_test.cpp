// Labels spread over surfaces: cells and normals, a painted wall, the analytic room, pooled votes by hand, refusals.
#include "surface/fuse/propagation.h"

#include <algorithm>

#include "compute/parallel.h"
#include "core/rng.h"
#include "eval/metrics.h"
#include "surface/seen_surface.h"
#include "surface/surface_graph.h"
#include "testkit/analytic_scene.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

TEST(SurfaceCells, TouchingCellsAreNeighboursOnce) {
  SurfaceCells cells(0.5);
  EXPECT_EQ(cells.add(Vec3d{0.1, 0.1, 0.1}), 0);
  EXPECT_EQ(cells.add(Vec3d{-0.1, 0.1, 0.1}), 1);  // the other side of 0 is another cell
  EXPECT_EQ(cells.add(Vec3d{0.4, 0.4, 0.4}), 0);
  EXPECT_EQ(cells.add(Vec3d{0.6, 0.6, 0.6}), 2);     // touches 0 in a corner
  EXPECT_EQ(cells.add(Vec3d{-0.6, -0.1, -0.1}), 3);  // touches 1 in a corner; two cells from 0
  EXPECT_EQ(cells.add(Vec3d{5, 5, 5}), 4);           // alone
  EXPECT_EQ(cells.add(Vec3d{1e7, 0, 0}), -1);
  EXPECT_EQ(cells.add(Vec3d{0, std::numeric_limits<double>::quiet_NaN(), 0}), -1);
  EXPECT_EQ(cells.count(), 5);
  std::vector<std::pair<int, int>> pairs;
  for (const CellPair& pair : cells.neighbours())
    pairs.emplace_back(std::min(pair.a, pair.b), std::max(pair.a, pair.b));
  std::sort(pairs.begin(), pairs.end());
  EXPECT_EQ(pairs, (std::vector<std::pair<int, int>>{{0, 1}, {0, 2}, {1, 3}}));
}

TEST(SurfaceCells, ManyKeepTheirNumbers) {
  SurfaceCells cells(1);
  std::vector<SurfaceCell> places;
  for (std::int32_t i = 0; i < 20000; ++i) places.push_back({i % 31 - 15, i / 31 % 29 - 14, i / 899 * 40000 - 400000});
  for (std::size_t i = 0; i < places.size(); ++i) ASSERT_EQ(cells.add(places[i]), static_cast<std::int32_t>(i));
  for (std::size_t i = 0; i < places.size(); ++i) {
    ASSERT_EQ(cells.add(places[i]), static_cast<std::int32_t>(i));
    ASSERT_EQ(cells.near({places[i][0] + 0.5, places[i][1] + 0.5, places[i][2] + 0.5}), static_cast<std::int32_t>(i));
  }
  EXPECT_EQ(cells.near({0.5, 0.5, 1000.5}), -1);
}

TEST(SurfaceCells, ABlockHasEveryPair) {
  SurfaceCells cells(1);
  for (int i = 0; i < 27; ++i) cells.add(Vec3d{i / 9 + 0.5, i / 3 % 3 + 0.5, i % 3 + 0.5});
  // Of 3 x 3 x 3 cells: 3 directions with 2 x 9 pairs each, 6 with 2 x 2 x 3, 4 with 2 x 2 x 2.
  EXPECT_EQ(cells.neighbours().size(), 54u + 72u + 32u);
}

TEST(SurfaceCells, NormalsOfTheAnalyticRoom) {
  Diagnostics diagnostics;
  const LoadedScene scene = load_scene(*testkit::make_analytic_scene(), {}, diagnostics);
  const FrameInfo& info = scene.info.frames[1];
  const std::vector<float> depth = scene.frames[1].depth_m.expand();
  const PosedDepth view{info.camera, info.world_from_camera, depth};
  const SeenSurface seen = seen_surface(surface_points(view), info.camera.width_px, info.world_from_camera.t);
  int near = 0, asked = 0;
  for (std::int32_t row = 0; row < info.camera.height_px; ++row) {
    for (std::int32_t column = 0; column < info.camera.width_px; ++column) {
      const Vec3d ray = normalized(info.world_from_camera.rotate(info.camera.direction(column + 0.5, row + 0.5)));
      const testkit::AnalyticHit hit = testkit::intersect_analytic_room(info.world_from_camera.t, ray);
      ++asked;
      near += dot(hit.normal, seen.normal[view.pixel(column, row)]) > 0.95 ? 1 : 0;
    }
  }
  EXPECT_GT(near, asked * 9 / 10) << "of " << asked;
}

// A wall 2.1 m before one camera of 16 x 8 pixels, focal length 16.8: a pixel is 0.125 m, and no face of a cell lies in
// the wall. The left half is dark, the right half bright.
struct PaintedWall {
  LoadedScene scene;
  TrainingLabels labels;
  FrameMaps maps;
  PropagationParams params;

  static constexpr std::size_t kWidth = 16, kHeight = 8, kPixels = kWidth * kHeight;
  PaintedWall() {
    FrameInfo info{.name = "wall",
                   .camera = {.width_px = kWidth, .height_px = kHeight, .fx = 16.8, .fy = 16.8, .cx = 8, .cy = 4},
                   .split = Split::train};
    scene.info.frames = {info};
    scene.info.classes = ClassTable({{1, "dark", {}, false}, {2, "bright", {}, false}, {3, "other", {}, false}});
    StoredFrame frame;
    frame.width_px = kWidth;
    frame.height_px = kHeight;
    frame.rgb.assign(3 * kPixels, 40);
    for (std::size_t p = 0; p < kPixels; ++p) {
      if (p % kWidth >= kWidth / 2) std::fill_n(frame.rgb.begin() + static_cast<std::ptrdiff_t>(3 * p), 3, 200);
    }
    scene.frames.push_back(std::move(frame));
    maps.frames = {0};
    maps.depth_m = {std::vector<float>(kPixels, 2.1F)};
    maps.label.resize(1);
    params.cell_m = 0.125;
    give(std::vector<std::int16_t>(kPixels, kVoid));
  }
  void give(std::vector<std::int16_t> given) {
    labels.class_pixels = {std::vector<std::int64_t>(4)};
    for (const std::int16_t c : given) ++labels.class_pixels[0][c < 0 ? 3 : static_cast<std::size_t>(c)];
    labels.frames = {{LabelMap(std::move(given)), {}}};
  }
  TrainingLabels spread() const { return propagate_labels(scene, labels, maps, params, {}); }
};

std::string fact(const TrainingLabels& labels, const std::string& name) {
  for (const auto& [key, value] : labels.steps.back().facts) {
    if (key == name) return value;
  }
  return "no fact '" + name + "'";
}

TEST(Propagation, ColourDrawsTheBorderBetweenTwoClicks) {
  PaintedWall wall;
  std::vector<std::int16_t> clicks(PaintedWall::kPixels, kVoid);
  clicks[3 * 16 + 7] = 0;   // dark, at the border
  clicks[4 * 16 + 15] = 1;  // bright, at the far end
  wall.give(clicks);
  TrainingLabels out = wall.spread();
  ASSERT_TRUE(out.soft);
  for (std::size_t p = 0; p < PaintedWall::kPixels; ++p) {
    EXPECT_EQ(out.frames[0][p], p % 16 < 8 ? 0 : 1) << p;
    EXPECT_EQ(out.frames[0].soft.at(p, 2), 0) << "nobody voted for the third class";
  }
  EXPECT_EQ(fact(out, "cells"), "128");
  EXPECT_EQ(fact(out, "cells with votes"), "2");
  EXPECT_EQ(fact(out, "connected parts"), "1");
  EXPECT_EQ(out.steps.back().type, "propagate surface");
  // Without colour the border lies between the clicks: the click beside it takes the bright pixels next to it.
  wall.params.color_sigma = 1000;
  out = wall.spread();
  EXPECT_EQ(out.frames[0][3 * 16 + 8], 0);
}

TEST(Propagation, DepthThatIsMissingAndPartsWithoutAVote) {
  PaintedWall wall;
  std::vector<std::int16_t> clicks(PaintedWall::kPixels, kVoid);
  clicks[0] = 2;
  clicks[7] = 1;  // on a pixel that will have no depth
  wall.give(clicks);
  std::vector<float>& depth = wall.maps.depth_m[0];
  for (std::size_t row = 0; row < 8; ++row) {
    depth[row * 16 + 6] = depth[row * 16 + 7] = 0;
    for (std::size_t column = 8; column < 16; ++column) depth[row * 16 + column] = 3;  // out of touch
  }
  const TrainingLabels out = wall.spread();
  for (std::size_t p = 0; p < PaintedWall::kPixels; ++p)
    EXPECT_EQ(out.frames[0][p], p == 7 ? 1 : p % 16 < 6 ? 2 : kVoid) << p;
  EXPECT_EQ(fact(out, "pixels without depth"), "16");
  EXPECT_NE(fact(out, "parts without a vote"), "0");
}

TEST(Propagation, SureEnoughOnly) {
  PaintedWall wall;
  std::vector<std::int16_t> clicks(PaintedWall::kPixels, kVoid);
  clicks[0] = 0;
  clicks[15] = 1;
  wall.give(clicks);
  wall.params.color_sigma = 1000;
  wall.params.min_confidence = 0.6;
  const TrainingLabels out = wall.spread();
  EXPECT_EQ(out.frames[0][0], 0);
  EXPECT_EQ(out.frames[0][4 * 16 + 8], kVoid) << "half-way nothing is sure";
}

TEST(Propagation, VotesPooledByHand) {
  PaintedWall wall;
  wall.params.method = PropagationMethod::vote;
  wall.params.vote_cells_m = {0.25, 0.5};  // 2 x 2 pixels, 4 x 4 pixels; the wall's borders are multiples of both
  wall.params.least_votes = 3;
  std::vector<std::int16_t> given(PaintedWall::kPixels, kVoid);
  given[0] = given[1] = 0;
  given[16] = 1;  // three votes in the first small cell
  given[2] = 2;   // alone in the second one: its large cell has four votes
  given[15] = 1;  // alone in the last ones of both sizes
  wall.give(given);
  const TrainingLabels out = wall.spread();
  const auto row = [&](std::size_t pixel) {
    return std::array<float, 3>{out.frames[0].soft.at(pixel, 0), out.frames[0].soft.at(pixel, 1),
                                out.frames[0].soft.at(pixel, 2)};
  };
  const float third = float_of_half(half_of(1 / 3.0F)), two = float_of_half(half_of(2 / 3.0F));
  EXPECT_EQ(row(0), (std::array<float, 3>{two, third, 0}));
  EXPECT_EQ(row(16), row(0));
  EXPECT_EQ(row(2), (std::array<float, 3>{0.5F, 0.25F, 0.25F}));
  EXPECT_EQ(row(15), (std::array<float, 3>{0, 1, 0}));
  EXPECT_EQ(row(17), (std::array<float, 3>{0, 0, 0})) << "a pixel without a label gets none";
  EXPECT_EQ(fact(out, "pixels by cells of 0.25 m"), "3");
  EXPECT_EQ(fact(out, "pixels by cells of 0.5 m"), "2");
  EXPECT_EQ(out.steps.back().type, "propagate vote");
}

// The analytic room with a fraction of its labels, of which some are wrong.
struct Room {
  LoadedScene scene;
  TrainingLabels labels;
  FrameMaps maps;
  Room(double kept, float wrong) {
    Diagnostics diagnostics;
    testkit::AnalyticSceneOptions options{.frames = 16};
    scene = load_scene(*testkit::make_analytic_scene(options), {}, diagnostics);
    maps = true_depth(scene);
    labels.frames.resize(scene.frames.size());
    labels.class_pixels.resize(scene.frames.size());
    for (const int f : maps.frames) {
      const auto frame = static_cast<std::size_t>(f);
      std::vector<std::int16_t> given = scene.frames[frame].label.expand();
      const RandomAddress address{3, frame, stream_id("test/room")};
      for (std::size_t p = 0; p < given.size(); ++p) {
        if (static_cast<double>(uniform01(address, 2 * p)) >= kept) {
          given[p] = kVoid;
        } else if (uniform01(address, 2 * p + 1) < wrong) {
          given[p] = static_cast<std::int16_t>(uniform_below(address, 3 * p + 100000, 5));
        }
      }
      labels.class_pixels[frame] = {1, 1, 1, 1, 1, 0};
      labels.frames[frame].hard = LabelMap(std::move(given));
    }
  }
  TrainingLabels spread(const PropagationParams& params) const {
    return propagate_labels(scene, labels, maps, params, {});
  }
  ConfusionMatrix score(const TrainingLabels& of) const {
    ConfusionMatrix out(scene.info.classes.valid_count());
    for (const int f : maps.frames) {
      const TrainingLabels::Frame& frame = of.frames[f];
      std::vector<std::int16_t> given(frame.size());
      for (std::size_t p = 0; p < given.size(); ++p) given[p] = frame[p];
      out.add(scene.frames[f].label.expand(), given);
    }
    return out;
  }
};

TEST(Propagation, FewLabelsFillTheAnalyticRoom) {
  const Room room(0.01, 0);
  const TrainingLabels out = room.spread({});
  const ConfusionMatrix before = room.score(room.labels), after = room.score(out);
  EXPECT_LT(before.scored_px(), after.scored_px() / 50);
  EXPECT_EQ(after.void_predicted_px(), 0) << "the room is one surface";
  EXPECT_GT(*after.total_accuracy(), 0.95);
  EXPECT_GT(*after.miou_present(), 0.85);
  EXPECT_EQ(fact(out, "pixels without depth"), "0");
}

TEST(Propagation, PoolingTakesNoiseOut) {
  const Room room(1, 0.8F);
  PropagationParams params{.method = PropagationMethod::vote};
  const double before = *room.score(room.labels).total_accuracy();
  const double after = *room.score(room.spread(params)).total_accuracy();
  EXPECT_LT(before, 0.45);
  EXPECT_GT(after, before + 0.25);
  params.vote_cells_m = {1e-4};  // every pixel a cell of its own: nothing is pooled
  EXPECT_EQ(*room.score(room.spread(params)).total_accuracy(), before);
}

TEST(Propagation, ThreadsDoNotChangeABit) {
  const Room room(0.05, 0.2F);
  for (const PropagationMethod method : {PropagationMethod::surface, PropagationMethod::vote}) {
    PropagationParams params{.method = method};
    set_thread_count(1);
    const TrainingLabels one = room.spread(params);
    set_thread_count(4);
    const TrainingLabels four = room.spread(params);
    set_thread_count(0);
    for (const int f : room.maps.frames) EXPECT_EQ(one.frames[f].soft, four.frames[f].soft) << f;
  }
}

TEST(Propagation, SoftLabelsVoteWithTheirProbabilities) {
  PaintedWall wall;
  SoftMap soft(PaintedWall::kPixels, 3);
  soft.set_row(0, std::array<float, 3>{0.5F, 0.25F, 0.25F});
  wall.labels.frames = {{{}, soft}};
  wall.labels.class_pixels = {{1, 1, 1, 0}};
  const TrainingLabels out = wall.spread();
  for (const std::size_t p : {std::size_t{0}, PaintedWall::kPixels - 1}) {
    EXPECT_EQ(out.frames[0].soft.at(p, 0), 0.5F);
    EXPECT_EQ(out.frames[0].soft.at(p, 2), 0.25F);
  }
}

TEST(Propagation, Refusals) {
  PaintedWall wall;
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "no training pixel carries a label");
  std::vector<std::int16_t> clicks(PaintedWall::kPixels, kVoid);
  clicks[0] = 0;
  wall.give(clicks);
  wall.params.cell_m = 0;
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "propagate.cell_m");
  wall.scene.pixel_footprint_m = 0.1;  // three of them, or 200 m / 500
  EXPECT_EQ(fact(wall.spread(), "edge of a cell, m"), "0.3");
  wall.scene.bounds = {{0, 0, 0}, {200, 1, 1}};
  EXPECT_EQ(fact(wall.spread(), "edge of a cell, m"), "0.4");
  wall.maps.depth_m[0].assign(PaintedWall::kPixels, 0);
  EXPECT_HAS(error_of([&] { (void)wall.spread(); }), "no training pixel has depth");
}

}  // namespace
}  // namespace semfield
