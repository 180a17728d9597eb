// The dataset laws hold for the analytic room and catch each broken promise.
#include <gtest/gtest.h>

#include <atomic>
#include <set>

#include "testkit/analytic_scene.h"
#include "testkit/laws.h"
#include "tests/plugin/broken_case.h"

namespace semfield {
namespace {

enum class Break { none, mirrored, opengl_axes, depth_unit, label_range, short_depth, unsafe_read, reports_error };

/// The analytic room with one promise broken.
class BrokenRoom final : public Dataset {
 public:
  explicit BrokenRoom(Break broken) : broken_(broken), room_(testkit::make_analytic_scene()) {}
  SceneInfo open(Diagnostics& diagnostics) override {
    SceneInfo scene = room_->open(diagnostics);
    if (broken_ == Break::reports_error) diagnostics.error("test.finding.made", "view_03", "is truncated", {});
    for (FrameInfo& frame : scene.frames) {
      for (auto& row : frame.world_from_camera.r) {
        if (broken_ == Break::mirrored) row[0] = -row[0];
        if (broken_ == Break::opengl_axes) {
          row[1] = -row[1];
          row[2] = -row[2];
        }
      }
    }
    return scene;
  }
  void read(int frame, FrameBuffer& out) const override {
    room_->read(frame, out);
    const int reads = ++reads_;
    if (broken_ == Break::depth_unit && frame % 2 == 1) {
      for (float& depth : out.depth_m) depth *= 1.25F;
    }
    if (broken_ == Break::label_range) out.label[7] = 5;
    if (broken_ == Break::short_depth) out.depth_m.pop_back();
    if (broken_ == Break::unsafe_read && reads > 12) out.rgb[0] ^= 1;
  }

 private:
  Break broken_;
  std::unique_ptr<Dataset> room_;
  mutable std::atomic<int> reads_{0};
};

std::string laws_of(Break broken) {
  BrokenRoom room(broken);
  testkit::DatasetExpectation expected;
  expected.frames = 12;
  expected.depth = true;
  expected.labels = true;
  return testkit::to_text(testkit::dataset_laws(room, expected));
}

TEST(DatasetLaws, HoldForTheAnalyticRoom) { EXPECT_EQ(laws_of(Break::none), ""); }

using Case = BrokenCase<Break>;
class BrokenDataset : public testing::TestWithParam<Case> {};

TEST_P(BrokenDataset, IsCaught) {
  const std::string failures = laws_of(GetParam().broken);
  EXPECT_NE(failures.find(GetParam().law), std::string::npos) << "failures were:\n" << failures;
}

INSTANTIATE_TEST_SUITE_P(EachPromise, BrokenDataset,
                         testing::Values(Case{Break::mirrored, "left-handed"}, Case{Break::opengl_axes, "depth"},
                                         Case{Break::depth_unit, "reprojected depths agree"},
                                         Case{Break::label_range, "label 5 is outside"},
                                         Case{Break::short_depth, "depth has 1727 values"},
                                         Case{Break::unsafe_read, "parallel reading"},
                                         Case{Break::reports_error, "open: view_03: is truncated"}),
                         NameOfCase{});

TEST(AnalyticScene, ShowsEveryClassInBothSplits) {
  const std::unique_ptr<Dataset> room = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo scene = room->open(diagnostics);
  std::set<int> seen[2];
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    FrameBuffer pixels;
    room->read(static_cast<int>(i), pixels);
    for (const std::int16_t label : pixels.label) seen[scene.frames[i].split == Split::test ? 1 : 0].insert(label);
  }
  EXPECT_EQ(seen[0].size(), 5u);
  EXPECT_EQ(seen[1].size(), 5u);
  EXPECT_EQ(scene.classes.valid_count(), 5);
}

TEST(AnalyticScene, HitsLieOnTheirSurfaces) {
  const testkit::AnalyticHit floor = testkit::intersect_analytic_room({1.5, -1.2, 0}, {0, 0, -1});
  EXPECT_EQ(floor.label, 1);
  EXPECT_DOUBLE_EQ(floor.t_m, 1.0);
  const testkit::AnalyticHit ball = testkit::intersect_analytic_room({0.35, 0.3, 0.9}, {0, 0, -1});
  EXPECT_EQ(ball.label, 3);
  EXPECT_NEAR(ball.t_m, 1.1, 1e-12);
  const testkit::AnalyticHit crate = testkit::intersect_analytic_room({-0.2, 0.6, 0.9}, {0, 0, -1});
  EXPECT_EQ(crate.label, 4);
  EXPECT_NEAR(crate.t_m, 1.2, 1e-12);
}

}  // namespace
}  // namespace semfield
