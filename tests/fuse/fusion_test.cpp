// Whole frames fused: two views by hand, a box in front, windows, noise, threads.
#include "surface/fuse/fusion.h"

#include <algorithm>

#include "compute/parallel.h"
#include "core/rng.h"
#include "eval/metrics.h"
#include "loading/frame_source.h"
#include "testkit/analytic_scene.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

constexpr auto kMonocular = static_cast<std::size_t>(FusionMethod::monocular);
constexpr auto kBayesian = static_cast<std::size_t>(FusionMethod::bayesian);
constexpr auto kAverage = static_cast<std::size_t>(FusionMethod::average);

TrainingLabels::Frame hard(std::vector<std::int16_t> labels) { return {LabelMap(std::move(labels)), {}}; }

/// Views 8 pixels wide and 1 high, focal length 8: at 2 m a pixel is 0.25 m.
struct Row {
  Camera camera;
  std::vector<std::vector<float>> depth;
  std::vector<TrainingLabels::Frame> prediction;
  std::vector<double> x;

  Row() {
    camera.width_px = 8;
    camera.height_px = 1;
    camera.fx = camera.fy = 8;
    camera.cx = 4;
    camera.cy = 0.5;
  }
  void add(double x_m, std::vector<float> depth_m, TrainingLabels::Frame labels) {
    x.push_back(x_m);
    depth.push_back(std::move(depth_m));
    prediction.push_back(std::move(labels));
  }
  FusedFrame fuse(int target, int classes, const FusionParams& params = {.tolerance = 0.01}) const {
    std::vector<FusionView> views;
    for (std::size_t i = 0; i < x.size(); ++i) {
      Pose pose{.t = {x[i], 0, 0}};
      views.push_back({{camera, pose, depth[i]}, &prediction[i]});
    }
    return LabelFusion(views, classes, params).fuse(target);
  }
};

std::vector<float> wall(float z = 2) { return std::vector<float>(8, z); }
using Labels = std::vector<std::int16_t>;

SoftMap soft(const std::vector<std::array<float, 3>>& rows) {
  SoftMap map(rows.size(), 3);
  for (std::size_t i = 0; i < rows.size(); ++i) map.set_row(i, rows[i]);
  return map;
}

TEST(LabelFusion, TwoViewsOfAWallByHand) {
  Row row;
  // Column i of view 0 is column i - 2 of view 1. Probabilities are whole 256ths, exact in binary16.
  row.add(0, wall(),
          {{},
           soft({{0.5F, 0.25F, 0.25F},
                 {0.5F, 0.25F, 0.25F},
                 {0.5F, 0.25F, 0.25F},
                 {0.5F, 0.25F, 0.25F},
                 {0.5F, 0.5F, 0},
                 {0.25F, 0.5F, 0.25F},
                 {0, 0, 0},
                 {1, 0, 0}})});
  row.add(0.5, wall(),
          {{},
           soft({{0.125F, 0.75F, 0.125F},
                 {0.5F, 0.25F, 0.25F},
                 {0, 0.25F, 0.75F},
                 {0, 0, 0},
                 {0.125F, 0.125F, 0.75F},
                 {0, 1, 0},
                 {0, 0, 1},
                 {0, 0, 1}})});
  const FusedFrame out = row.fuse(0, 3);
  EXPECT_EQ(out.label[kMonocular], (Labels{0, 0, 0, 0, 0, 1, kVoid, 0}));
  // 2: 0.0625, 0.1875, 0.03125 and means 0.3125, 0.5, 0.1875 | 3: agrees | 4: (0, 0.125, 0) and (0.25, 0.375, 0.375)
  // | 5: own alone | 6: the other alone | 7: floor, floor against 1 * 0 and 0 * 1: 0 and 1 equal, own wins; means 0.5.
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 0, 1, 1, 2, 0}));
  EXPECT_EQ(out.label[kAverage], (Labels{0, 0, 1, 0, 1, 1, 2, 0}));
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 1, 1, 7 + 5}));
}

TEST(LabelFusion, HardLabelsVote) {
  Row row;
  row.add(0, wall(), hard({0, 0, 0, 0, 0, 0, kVoid, kVoid}));
  row.add(0.5, wall(), hard({1, 1, 1, 1, 1, 1, kVoid, kVoid}));
  row.add(1.0, wall(), hard({1, 0, 1, kVoid, 1, 1, 1, 1}));
  const FusedFrame out = row.fuse(0, 2);
  // Columns 2, 3: one against one, the own label stays; 4 and 6: the third view decides; 7: nobody knows but view 1.
  const Labels expected{0, 0, 0, 0, 1, 0, 1, 1};
  EXPECT_EQ(out.label[kBayesian], expected);
  EXPECT_EQ(out.label[kAverage], expected);
  EXPECT_EQ(out.counts.filled, 2);
}

TEST(LabelFusion, ABoxInFrontHidesTheWall) {
  // View 1 sees a box 1 m away in its columns 2 to 5; view 0 sees the wall alone. In both the wall is 2 m away.
  Row row;
  row.add(0, wall(), hard({0, 0, 0, 0, 0, 0, 0, 0}));
  std::vector<float> boxed = wall();
  std::fill(boxed.begin() + 2, boxed.begin() + 6, 1.0F);
  for (int k = 0; k < 2; ++k) row.add(0.5, boxed, hard({1, 1, 1, 1, 1, 1, 1, 1}));
  FusedFrame out = row.fuse(0, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 1, 0, 0, 0, 0}));  // wall columns 4..7 lie behind the box
  EXPECT_EQ(out.counts.votes, 8 + 2 * 2);
  // The box's own pixels (x = 0.5 - 0.1875 m and on) fall on columns 6.. of view 0, which sees the wall there.
  out = row.fuse(1, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{1, 1, 1, 1, 1, 1, 1, 1}));
  FusionParams loose{.tolerance = 1.5};
  out = row.fuse(0, 2, loose);
  EXPECT_EQ(out.label[kBayesian], (Labels{0, 0, 1, 1, 1, 1, 1, 1}));
}

TEST(LabelFusion, PixelsWithoutDepthKeepTheirLabel) {
  Row row;
  std::vector<float> holes = wall();
  holes[3] = 0;
  holes[4] = NAN;
  row.add(0, holes, hard({0, 0, 0, 0, 0, 0, kVoid, 0}));
  for (int k = 0; k < 2; ++k) row.add(0, wall(), hard(Labels(8, 1)));
  const FusedFrame out = row.fuse(0, 2);
  EXPECT_EQ(out.label[kBayesian], (Labels{1, 1, 1, 0, 0, 1, 1, 1}));
  EXPECT_EQ(out.label[kAverage], out.label[kBayesian]);
  EXPECT_EQ(out.counts, (FusionCounts{8, 2, 1, 1, 5 * 3 + 2}));
  EXPECT_DOUBLE_EQ(out.counts.views_mean(), 17.0 / 6);
  // Nor can a view without depth be used.
  EXPECT_EQ(row.fuse(1, 2).label[kBayesian], (Labels(8, 1)));
  EXPECT_EQ(row.fuse(1, 2).counts.votes, 8 + 8 + 5);
}

TEST(LabelFusion, OneViewIsTheIdentityAndVoidStaysVoid) {
  Row row;
  row.add(0, wall(),
          {{},
           soft({{0.5F, 0.25F, 0.25F},
                 {0, 0, 0},
                 {0.25F, 0.25F, 0.25F},
                 {0, 0, 0.5F},
                 {0, 1, 0},
                 {0.25F, 0.5F, 0.125F},
                 {0, 0, 1},
                 {1, 0, 0}})});
  FusedFrame out = row.fuse(0, 3);
  EXPECT_EQ(out.label[kMonocular], (Labels{0, kVoid, 0, 2, 1, 1, 2, 0}));
  EXPECT_EQ(out.label[kBayesian], out.label[kMonocular]);
  EXPECT_EQ(out.label[kAverage], out.label[kMonocular]);
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 1, 0, 7}));
  Row empty;
  for (int k = 0; k < 3; ++k) empty.add(0.5 * k, wall(), hard(Labels(8, kVoid)));
  empty.add(0, wall(), {});
  out = empty.fuse(1, 3);
  for (const Labels& label : out.label) EXPECT_EQ(label, Labels(8, kVoid));
  EXPECT_EQ(out.counts, (FusionCounts{8, 0, 8, 0, 0}));
}

TEST(LabelFusion, AWindowAveragesOneSurface) {
  Row row;
  row.add(0, wall(), hard(Labels(8, kVoid)));
  std::vector<float> step = wall();
  for (std::size_t i = 5; i < 8; ++i) step[i] = 3;
  row.add(0, step, hard({2, 0, 0, 2, 1, 1, 1, 1}));
  FusionParams params{.tolerance = 0.01, .neighbourhood = 3, .hard_confidence = 0.8};
  // 0: {2, 0} equal, the first | 1: {2, 0, 0} | 2: {0, 0, 2} | 3: {0, 2, 1} equal | 4: {2, 1}, column 5 is another
  // surface | 5..7: seen by nobody.
  const FusedFrame out = row.fuse(0, 3, params);
  EXPECT_EQ(out.label[kAverage], (Labels{0, 0, 0, 0, 1, kVoid, kVoid, kVoid}));
  EXPECT_EQ(out.label[kBayesian], out.label[kAverage]);
  EXPECT_EQ(out.counts.votes, 5);
}

TEST(LabelFusion, WrongInputsAreRefused) {
  Row row;
  row.add(0, wall(), hard(Labels(8, 3)));
  EXPECT_EQ(error_of([&] { row.fuse(0, 3); }),
            "view 0: pixel 0 has class index 3, there are 3; predict with the scene's class table");
  Row small;
  small.add(0, wall(), hard(Labels(7, 0)));
  EXPECT_HAS(error_of([&] { small.fuse(0, 3); }), "size of its camera");
}

/// The analytic room with predictions made from its truth: each pixel of each frame is wrong with probability `noise`,
/// independently.
struct NoisyRoom {
  LoadedScene scene;
  std::vector<std::vector<float>> depth;
  std::vector<TrainingLabels::Frame> prediction;
  std::vector<FusionView> views;

  explicit NoisyRoom(float noise, bool probabilities) {
    Diagnostics diagnostics;
    testkit::AnalyticSceneOptions options{.frames = 24};
    scene = load_scene(*testkit::make_analytic_scene(options), {}, diagnostics);
    const int classes = scene.info.classes.valid_count();
    const std::size_t frames = scene.frames.size();
    for (std::size_t f = 0; f < frames; ++f) {
      depth.push_back(scene.frames[f].depth_m.expand());
      std::vector<std::int16_t> labels = scene.frames[f].label.expand();
      const RandomAddress address{1, f, stream_id("test/noise")};
      SoftMap map(labels.size(), classes);
      for (std::size_t i = 0; i < labels.size(); ++i) {
        const bool wrong = uniform01(address, 3 * i) < noise;
        if (wrong) {
          const auto other = uniform_below(address, 3 * i + 1, static_cast<std::uint64_t>(classes - 1));
          labels[i] = static_cast<std::int16_t>((labels[i] + 1 + static_cast<int>(other)) % classes);
        }
        std::vector<float> row(static_cast<std::size_t>(classes), 0.3F / static_cast<float>(classes));
        row[labels[i]] += wrong ? 0.4F : 0.7F;
        map.set_row(i, row);
      }
      prediction.push_back(probabilities ? TrainingLabels::Frame{{}, map} : hard(labels));
    }
    for (std::size_t f = 0; f < frames; ++f) {
      const FrameInfo& info = scene.info.frames[f];
      views.push_back({{info.camera, info.world_from_camera, depth[f]}, &prediction[f]});
    }
  }
  int classes() const { return scene.info.classes.valid_count(); }
  double accuracy(FusionParams params, std::size_t method) const {
    params.tolerance = 0.01;
    params.relative_tolerance = 0.03;  // a pixel of these small images is 3 % of the depth
    const LabelFusion fusion(views, classes(), params);
    ConfusionMatrix all(classes());
    for (std::size_t f = 0; f < views.size(); ++f)
      all.add(scene.frames[f].label.expand(), fusion.fuse(static_cast<int>(f)).label[method]);
    return *all.total_accuracy();
  }
};

TEST(LabelFusion, IndependentNoiseGoesAwayWithViews) {
  for (const bool probabilities : {false, true}) {
    const NoisyRoom room(0.4F, probabilities);
    FusionParams params;
    const double alone = room.accuracy(params, kMonocular);
    EXPECT_NEAR(alone, 0.6, 0.01);
    for (const std::size_t method : {kBayesian, kAverage}) {
      params.views = 4;
      const double some = room.accuracy(params, method);
      params.views = 0;
      const double all = room.accuracy(params, method);
      EXPECT_GT(some, alone + 0.1);
      EXPECT_GT(all, some);
      EXPECT_GT(all, 0.9);
    }
  }
}

TEST(LabelFusion, CleanLabelsStayCleanButAtEdges) {
  const NoisyRoom room(0, false);
  EXPECT_EQ(room.accuracy({}, kMonocular), 1);
  EXPECT_GT(room.accuracy({}, kBayesian), 0.98);
}

TEST(LabelFusion, SameBitsForAnyThreads) {
  const NoisyRoom room(0.4F, true);
  FusionParams params{.tolerance = 0.01, .neighbourhood = 3};
  const LabelFusion fusion(room.views, room.classes(), params);
  const int before = thread_count();
  std::vector<FusedFrame> frames;
  for (const int threads : {1, 2, 5}) {
    set_thread_count(threads);
    frames.push_back(fusion.fuse(3));
  }
  set_thread_count(before);
  for (const FusedFrame& frame : frames) {
    EXPECT_EQ(frame.label, frames[0].label);
    EXPECT_EQ(frame.counts, frames[0].counts);
  }
}

TEST(FusionParams, MethodsAndWindowsAreChecked) {
  EXPECT_EQ(fusion_methods({"average", "bayesian", "average"}),
            (std::vector<FusionMethod>{FusionMethod::average, FusionMethod::bayesian}));
  EXPECT_EQ(error_of([] { (void)fusion_methods({"bayesan"}); }),
            "fuse.methods: there is no method 'bayesan'; did you mean 'bayesian'?");
  FusionParams params{.methods = {"mean"}, .neighbourhood = 4};
  Diagnostics d;
  validate(params, d);
  ASSERT_EQ(d.error_count(), 2);
  EXPECT_EQ(d.all()[0].text(), "fuse.neighbourhood: a window of 4 pixels has no centre; write an odd number");
  EXPECT_EQ(d.all()[1].message, "fuse.methods: there is no method 'mean'");
}

}  // namespace
}  // namespace semfield
