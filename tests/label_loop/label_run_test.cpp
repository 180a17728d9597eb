// What the training thread of a labelling session makes of events that come together: clicks, skips, undos.
#include "serve/label_run.h"

#include "tests/label_loop/running_session.h"

namespace semfield {
namespace {

using namespace testing_loop;

// A run that has a surface, and whose events a test applies by itself.
struct PreparedRun {
  TempDir dir;
  RunListener nobody;
  LabelRun run;
  Annotations annotations;

  PreparedRun() : run(opened(), RunningSession::registry(), nullptr), annotations(*run.session().config.labels.clicks) {
    for (int turn = 0; !run.loop().ready() && turn < 1000; ++turn) {
      run.train(0.05);
      run.tend(false, false, false);
    }
    run.take(annotations);
  }
  OpenedForTraining opened() {
    const std::string yaml =
        session_config("analytic_room, with_labels: false, with_classes: false, labels: {class_room: 4}");
    TrainRequest request{.out_dir = dir / "run"};
    return open_for_training(run_config_of(parse_config_text(yaml, "test.yaml"), RunningSession::registry()),
                             RunningSession::registry(), request, nobody);
  }
  LabelState state() const {
    LabelState out;
    out.views.resize(run.loop().pooled().size());
    run.describe(out);
    return out;
  }
  LabelEvent event(const std::string& id, LabelEventKind kind, int view = 0, PixelPoint at = {}) const {
    const int frame = run.loop().views()[view].frame;
    return LabelEvent{.id = id,
                      .kind = kind,
                      .frame = run.session().scene.info.frames[frame].name,
                      .width_px = 48,
                      .height_px = 36,
                      .points = {at}};
  }
  LabelEvent undo(const std::string& id, const std::string& of) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
  }
  Vec3d place_of(const ProposalState& proposal) const {
    const PixelPlace pixel{static_cast<std::int32_t>(proposal.at.x), static_cast<std::int32_t>(proposal.at.y)};
    const PoolView& view = run.loop().views()[proposal.view];
    return point_at(view.camera, run.session().limits, pixel,
                    static_cast<double>(view.map.at(pixel.column, pixel.row)));
  }
};

// Undoing a skip and skipping something else leaves as many as before; they are others all the same.
TEST(LabelRun, ASkipInTheSteadOfAnotherCounts) {
  PreparedRun room;
  for (int k = 0; k < 10; ++k) {
    const LabelState asked = room.state();
    ASSERT_TRUE(asked.proposal.has_value());
    const std::string own = "skip-" + std::to_string(k);
    if (k > 0) room.annotations.apply(room.undo("undo-" + std::to_string(k), "skip-" + std::to_string(k - 1)));
    room.annotations.apply(room.event(own, LabelEventKind::skip, asked.proposal->view, asked.proposal->at));
    ASSERT_EQ(room.annotations.skips().size(), 1u);
    room.run.take(room.annotations);
    const LabelState next = room.state();
    ASSERT_TRUE(next.proposal.has_value());
    EXPECT_NE(next.proposal->id, asked.proposal->id);
    EXPECT_GT(length(room.place_of(*next.proposal) - room.place_of(*asked.proposal)), room.run.loop().pool().cell_m())
        << "round " << k;
  }
}

// A region that nobody should label has no label and is not proposed; undone, it is as before.
TEST(LabelRun, WhatIsIgnoredIsNotAskedAbout) {
  PreparedRun room;
  room.annotations.apply([&] {
    LabelEvent add = room.undo("add", "");
    add.kind = LabelEventKind::add_class;
    add.class_name = "wall";
    return add;
  }());
  LabelEvent wall = room.event("wall", LabelEventKind::click, 3, {24.5, 5.5});
  wall.class_name = "wall";
  room.annotations.apply(wall);
  const auto learn = [&] {
    room.run.take(room.annotations);
    for (int turn = 0; !room.run.knows_all() && turn < 10'000; ++turn) room.run.tend(false, false, false);
    ASSERT_TRUE(room.run.knows_all());
  };
  for (int view = 0; view < std::ssize(room.run.loop().pooled()); ++view) {  // but for view 3
    if (view == 3) continue;
    LabelEvent ignore = room.event("i" + std::to_string(view), LabelEventKind::click, view, {0, 0});
    ignore.points = {{0, 0}, {48, 0}, {48, 36}, {0, 36}};
    ignore.fill = true;
    ignore.class_name = "void";
    room.annotations.apply(ignore);
  }
  learn();
  for (int k = 0; k < 5; ++k) {
    const LabelState asked = room.state();
    ASSERT_TRUE(asked.proposal.has_value());
    EXPECT_EQ(asked.proposal->view, 3);
    room.annotations.apply(room.event("s" + std::to_string(k), LabelEventKind::skip, 3, asked.proposal->at));
    room.run.take(room.annotations);
  }
  const auto labelled = [&](int view) {
    room.run.pictures().begin([&] { return PictureRequest{.view = view}; }());
    const Picture picture = *room.run.pictures().work(1e9);
    return picture.label.size() -
           static_cast<std::size_t>(std::count(picture.label.begin(), picture.label.end(), kVoid));
  };
  EXPECT_EQ(labelled(1), 0u);
  EXPECT_GT(labelled(3), 48u * 36 / 2);
  room.annotations.apply(room.undo("back", "i1"));
  learn();
  EXPECT_GT(labelled(1), 48u * 36 / 2);
}

TEST(LabelRun, ClicksGiveTheStateItsNumbers) {
  PreparedRun room;
  LabelState state = room.state();
  EXPECT_TRUE(state.geometry_ready);
  EXPECT_EQ(state.temperature, 1);
  for (const ViewState& view : state.views) {
    EXPECT_TRUE(view.ready);
    EXPECT_EQ(view.entropy, 1) << "nothing is known";
  }
  for (const char* name : {"wall", "floor"}) {
    LabelEvent add = room.undo(name, "");
    add.kind = LabelEventKind::add_class;
    add.class_name = name;
    room.annotations.apply(add);
  }
  LabelEvent wall = room.event("a", LabelEventKind::click, 0, {24.5, 5.5}),
             floor = room.event("b", LabelEventKind::click, 0, {24.5, 33.5});
  wall.class_name = "wall";
  floor.class_name = "floor";
  room.annotations.apply(wall);
  room.annotations.apply(floor);
  room.run.take(room.annotations);
  state.classes = {{0, 1, "wall", {}, 1, 0, 0}, {1, 2, "floor", {}, 1, 0, 0}};
  room.run.describe(state);
  double area = 0;
  for (const ClassState& cls : state.classes) {
    area += cls.area_share;
    EXPECT_GT(cls.confidence, 0.5);
    EXPECT_LE(cls.confidence, 1);
  }
  EXPECT_NEAR(area, 1, 1e-9);
  for (const ViewState& view : state.views) {
    EXPECT_LT(view.entropy, 1);
    EXPECT_GE(view.entropy, 0);
  }
  EXPECT_GE(state.proposal->class_guess, 0);
  EXPECT_LE(state.proposal->class_guess, 1);
  // A click of a void class takes labels away and names nothing.
  LabelEvent none = room.event("c", LabelEventKind::click, 0, {24.5, 5.5});
  none.class_name = "void";
  none.radius_px = 5;
  room.annotations.apply(none);
  room.run.take(room.annotations);
  EXPECT_EQ(room.run.loop().live(), (std::vector<bool>{false, true, false, false})) << "wall's click is painted over";
}

// A further stroke costs its own places alone, however many there are, and the others are found in pieces between steps
// of training.
TEST(LabelRun, AFurtherStrokeDoesNotPayForThoseBeforeIt) {
  PreparedRun room;
  LabelEvent add = room.undo("wall", "");
  add.kind = LabelEventKind::add_class;
  add.class_name = "wall";
  room.annotations.apply(add);
  const auto stroke = [&](int k) {
    LabelEvent made = room.event("s" + std::to_string(k), LabelEventKind::click, k % 9, {2.0 + k % 40, 3.0});
    for (int p = 0; p < 60; ++p) made.points.push_back({2.0 + (k + p) % 44, 3.0 + (7 * k + p) % 30});
    made.radius_px = 1;
    made.class_name = "wall";
    room.annotations.apply(made);
  };
  for (int k = 0; k < 300; ++k) stroke(k);
  room.run.take(room.annotations);
  for (int turn = 0; !room.run.knows_all() && turn < 10'000; ++turn) {
    room.run.train(0.001);
    room.run.tend(false, false, false);
  }
  ASSERT_TRUE(room.run.knows_all());
  EXPECT_TRUE(room.run.loop().learned());
  const std::int64_t found = room.run.loop().places_found();
  stroke(300);
  room.run.take(room.annotations);
  EXPECT_TRUE(room.run.knows_all()) << "at once";
  EXPECT_LE(room.run.loop().places_found() - found, 60) << "its own, and those of strokes that it has painted over";
  EXPECT_LE(room.run.loop().learned_points(), room.run.loop().pool().points.size() + 301);
}

TEST(LabelRun, ATurnOfTrainingEndsWhenSomebodyWaits) {
  PreparedRun room;
  LabelEvent add = room.undo("wall", "");
  add.kind = LabelEventKind::add_class;
  add.class_name = "wall";
  room.annotations.apply(add);
  LabelEvent click = room.event("c", LabelEventKind::click, 0, {5, 5});
  click.class_name = "wall";
  room.annotations.apply(click);
  room.run.take(room.annotations);  // a change, after which training goes on
  const std::int64_t before = room.state().step;
  int looks = 0;
  EXPECT_TRUE(room.run.train(5, [&] { return ++looks == 2; }));
  EXPECT_EQ(looks, 2);
  EXPECT_EQ(room.state().step, before + 2) << "a step at a time on a CPU";
}

}  // namespace
}  // namespace semfield
