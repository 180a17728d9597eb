// A labelling session: events from several threads, labels that follow, undo, what a run's folder holds and goes on
// with, and what happens when training fails.
#include <future>
#include <stdexcept>

#include "labels/clicks/click_log.h"
#include "report/report.h"
#include "run/run_folder.h"
#include "run/run_scores.h"
#include "system/files.h"
#include "tests/label_loop/running_session.h"

namespace semfield {
namespace {

using namespace testing_loop;

PictureRequest labels_of(int view) { return PictureRequest{.client = "test", .view = view}; }

std::string refusal(LabelSession& session, const LabelEvent& event) {
  return error_of(ErrorKind::data, [&] { session.apply(event); });
}

std::size_t lines_of(const std::string& path) {
  const std::string text = read_text_file(path);
  return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
}

TEST(LabelSession, BeginsWithoutLabelsAndWithoutClasses) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  const auto first = run.session.state();
  ASSERT_EQ(first->views.size(), 12u);
  for (std::size_t v = 0; v < first->views.size(); ++v) EXPECT_EQ(first->views[v].held_out, v >= 9) << v;
  EXPECT_TRUE(first->classes.empty());
  EXPECT_EQ(first->named, 0);
  EXPECT_EQ(first->room, 6);
  EXPECT_EQ(first->events, 0u);
  EXPECT_FALSE(first->geometry_ready);
  EXPECT_FALSE(first->proposal.has_value());
  EXPECT_EQ(first->phase, "learning colour and geometry");
  EXPECT_EQ(run.session.view_of(run.session.frame_of(3)), 3);
  const LoadedScene& scene = run.session.opened().scene;
  EXPECT_EQ(run.session.view_of(scene.frames_of(Split::test).front()), 9);
  EXPECT_EQ(run.session.view_of(scene.frames_of(Split::train).at(2)), 2);
  run.start();
  const auto ready = run.wait_until([](const LabelState& s) { return s.geometry_ready && s.proposal; });
  EXPECT_EQ(ready->proposal->why, "unseen");
  EXPECT_EQ(ready->proposal->class_guess, -1);
  EXPECT_EQ(run.session.picture(labels_of(0)).label, std::vector<std::int16_t>(48 * 36, kVoid));
}

// A page shows views where the files put them.
TEST(LabelSession, PosesOfAPhoneStayAsGivenUnlessAskedFor) {
  for (const bool asked : {false, true}) {
    const TempDir dir;
    std::string yaml = session_config("analytic_room, with_labels: false, with_classes: false, tracked: true");
    yaml.replace(yaml.find("train: {"), 8,
                 asked ? "train: {cameras: {poses: learned}, " : "train: {cameras: {poses: auto}, ");
    RunningSession run(yaml, dir / "run");
    EXPECT_EQ(run.session.opened().config.cameras.poses == CameraTrust::learned, asked);
  }
}

// They have labels as the others, and take no clicks.
TEST(LabelSession, TestFramesAreLookedAt) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.start();
  run.wait_until([](const LabelState& s) { return s.geometry_ready; });
  ASSERT_TRUE(run.session.apply(run.add("1", "wall")));
  ASSERT_TRUE(run.session.apply(run.click("2", 0, "wall", {20, 10})));
  const auto state = run.settled();
  EXPECT_TRUE(state->views[9].ready);
  const std::vector<std::int16_t> label = run.session.picture(labels_of(9)).label;
  EXPECT_GT(std::count(label.begin(), label.end(), 0), 48 * 36 / 2);
  EXPECT_THROW(run.session.apply(run.click("3", 9, "wall", {20, 10})), Error);
  EXPECT_LT(state->proposal->view, 9);
}

// Also when no surface is made anew after the last step, as here: 150, 290 and 514 steps are when they are due.
TEST(LabelSession, TheEndOfTrainingIsTold) {
  const TempDir dir;
  std::string yaml = session_config();
  yaml.replace(yaml.find("steps: 60"), 9, "steps: 500");
  RunningSession run(yaml, dir / "run");
  run.start();
  const auto trained = run.wait_until([](const LabelState& s) { return s.phase.find("trained") == 0; });
  EXPECT_GE(trained->step, 500);
  EXPECT_FALSE(trained->history.empty());
  EXPECT_TRUE(trained->failure.empty());
}

TEST(LabelSession, ClicksMakeLabelsAndUndoTakesThemBack) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.start();
  LabelSession& session = run.session;
  EXPECT_TRUE(session.apply(run.add("1", "wall")));
  EXPECT_EQ(session.state()->events, 1u) << "seen at once";
  EXPECT_EQ(session.state()->classes.at(0).name, "wall");
  EXPECT_TRUE(session.apply(run.click("2", 0, "wall", {24.5, 5.5})));
  EXPECT_FALSE(session.apply(run.click("2", 0, "wall", {24.5, 5.5}))) << "known already";
  auto state = run.settled();
  EXPECT_EQ(state->overlay_events, 2u);
  EXPECT_EQ(state->marks.size(), 1u);
  EXPECT_EQ(state->views[0].clicks, 1);
  EXPECT_EQ(state->classes.at(0).clicks, 1);
  EXPECT_NEAR(state->classes.at(0).area_share, 1, 1e-9) << "there is no other class";
  std::vector<std::int16_t> label = session.picture(labels_of(4)).label;
  EXPECT_GT(std::count(label.begin(), label.end(), 0), 48 * 36 / 2);
  EXPECT_EQ(std::count(label.begin(), label.end(), 0) + std::count(label.begin(), label.end(), kVoid), 48 * 36);

  EXPECT_TRUE(session.apply(run.add("3", "floor")));
  EXPECT_TRUE(session.apply(run.click("4", 0, "floor", {24.5, 33.5})));
  state = run.settled();
  EXPECT_EQ(state->named, 2);
  EXPECT_GT(state->classes.at(1).area_share, 0.02);
  EXPECT_LT(state->classes.at(1).area_share, 0.98);
  EXPECT_NEAR(state->classes.at(0).area_share + state->classes.at(1).area_share, 1, 1e-9);

  EXPECT_TRUE(session.apply(run.undo("5", "4")));
  state = run.settled();
  EXPECT_EQ(state->marks.size(), 1u);
  EXPECT_EQ(state->classes.at(1).clicks, 0);
  EXPECT_NEAR(state->classes.at(0).area_share, 1, 1e-9);
  EXPECT_TRUE(session.apply(run.undo("6", "2")));
  state = run.settled();
  EXPECT_TRUE(state->marks.empty());
  EXPECT_EQ(session.picture(labels_of(4)).label, std::vector<std::int16_t>(48 * 36, kVoid));
  EXPECT_TRUE(session.apply(run.undo("7", "6"))) << "and back again";
  EXPECT_EQ(run.settled()->marks.size(), 1u);
  label = session.picture(labels_of(4)).label;
  EXPECT_GT(std::count(label.begin(), label.end(), 0), 48 * 36 / 2);
  EXPECT_EQ(lines_of(dir / "run/clicks.jsonl"), 7u) << "each event once";
}

TEST(LabelSession, WrongEventsChangeNothing) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run", nullptr, 2);
  LabelSession& session = run.session;
  EXPECT_TRUE(session.apply(run.add("1", std::string(kMostClassNameBytes, 'x'))));
  EXPECT_TRUE(session.apply(run.add("2", "floor")));
  const auto before = session.state();
  EXPECT_HAS(refusal(session, run.add("3", "one more")), "room");
  EXPECT_HAS(refusal(session, run.click("4", 0, "door", {1, 1})), "door");
  EXPECT_NE(refusal(session, run.click("5", 0, "floor", {48.5, 1})), "");
  EXPECT_NE(refusal(session, run.undo("6", "99")), "");
  LabelEvent stranger = run.click("7", 0, "floor", {1, 1});
  const LoadedScene& scene = session.opened().scene;
  stranger.frame = scene.info.frames[scene.frames_of(Split::test).front()].name;
  EXPECT_HAS(refusal(session, stranger), stranger.frame) << "a test frame";
  EXPECT_EQ(session.state()->revision, before->revision);
  EXPECT_EQ(lines_of(dir / "run/clicks.jsonl"), 2u);
  // Every number at its bound.
  LabelEvent largest = run.click("8", 8, "floor", {0, 0}, kMostEventRadius);
  for (std::size_t i = 1; i < kMostEventPoints; ++i)
    largest.points.push_back(i % 2 == 0 ? PixelPoint{0, 36} : PixelPoint{48, 0});
  EXPECT_TRUE(session.apply(largest));
  EXPECT_TRUE(session.apply(run.click(std::string(64, 'i'), 8, "floor", {48, 36}, 0)));
  run.start();
  EXPECT_EQ(run.settled()->overlay_events, 4u);
  EXPECT_GT(session.picture(labels_of(8)).label.size(), 0u);
}

TEST(LabelSession, ThreadsThatClickAtOnceLoseNothing) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.session.apply(run.add("a", "wall"));
  run.session.apply(run.add("b", "floor"));
  run.start();
  std::vector<std::thread> people;
  std::atomic<int> applied{0}, known{0};
  for (int person = 0; person < 2; ++person) {
    people.emplace_back([&, person] {
      for (int k = 0; k < 20; ++k) {
        const std::string id = (k % 5 == 4 ? "both-" : std::to_string(person) + "-") + std::to_string(k);
        const bool fresh =
            run.session.apply(run.click(id, k % 9, k % 2 == 0 ? "wall" : "floor", {2.5 * k, k % 2 == 0 ? 5.5 : 33.5}));
        ++(fresh ? applied : known);
      }
    });
  }
  people.emplace_back([&] {
    for (int k = 0; k < 6; ++k) EXPECT_FALSE(run.session.picture(labels_of(k)).stale);
  });
  for (std::thread& person : people) person.join();
  EXPECT_EQ(applied, 36);
  EXPECT_EQ(known, 4) << "the same id from both";
  const auto state = run.settled();
  EXPECT_EQ(state->events, 38u);
  EXPECT_EQ(state->marks.size(), 36u);
  EXPECT_EQ(lines_of(dir / "run/clicks.jsonl"), 38u);
}

TEST(LabelSession, ARunIsSavedOpenedByVerbsAndGoesOn) {
  const TempDir dir;
  const std::string folder = dir / "run";
  std::int64_t step = 0;
  {
    RunningSession run(session_config(), folder);
    run.session.apply(run.add("1", "wall"));
    run.session.apply(run.click("2", 2, "wall", {24.5, 5.5}));
    run.start();
    run.settled();
    run.session.save();
    EXPECT_TRUE(std::filesystem::exists(folder + "/checkpoints/latest"));
    Diagnostics findings;
    const OpenedRun meanwhile = open_run(folder, {}, RunningSession::registry(), findings);
    EXPECT_GT(meanwhile.step, 0);
    run.session.apply(run.add("3", "floor"));
    run.session.apply(run.click("4", 2, "floor", {24.5, 33.5}));
    run.stop();
    EXPECT_EQ(run.ended_with, "");
    step = run.session.state()->step;
  }
  Diagnostics findings;
  const OpenedRun opened = open_run(folder, {}, RunningSession::registry(), findings);
  EXPECT_GE(opened.step, step);
  EXPECT_EQ(opened.session.scene.info.classes.valid(0).name, "wall");
  EXPECT_EQ(opened.session.scene.info.classes.valid(1).name, "floor");
  ASSERT_TRUE(opened.session.pipeline->has_semantics());

  RunConfig config = load_run_config(RunFolder::read(folder).config_path(), {}, RunningSession::registry());
  RunningSession again(std::move(config), folder);
  const auto state = again.session.state();
  EXPECT_EQ(state->step, opened.step);
  EXPECT_EQ(state->events, 4u);
  EXPECT_EQ(state->marks.size(), 2u);
  EXPECT_EQ(state->named, 2);
  EXPECT_EQ(state->classes.at(1).name, "floor");
  EXPECT_EQ(state->room, 6);
  EXPECT_FALSE(again.session.apply(again.click("4", 2, "floor", {24.5, 33.5})));
  again.start();
  EXPECT_EQ(again.settled()->overlay_events, 4u);
  const std::vector<std::int16_t> label = again.session.picture(labels_of(2)).label;
  EXPECT_GT(std::count(label.begin(), label.end(), 0), 100);
  EXPECT_GT(std::count(label.begin(), label.end(), 1), 100);
}

// The report of a run that was clicked lists the clicks, without a scene or a checkpoint being opened.
TEST(LabelSession, WhatWasClickedIsInTheRunsReport) {
  const TempDir dir;
  const std::string folder = dir / "run";
  {
    RunningSession run(session_config(), folder);
    run.session.apply(run.add("1", "wall"));
    run.session.apply(run.add("2", "floor"));
    for (int k = 0; k < 3; ++k) run.session.apply(run.click("w" + std::to_string(k), 2, "wall", {10.5 + 8 * k, 5.5}));
    run.session.apply(run.click("f", 4, "floor", {24.5, 33.5}));
    run.start();
    run.settled();
    run.stop();
    EXPECT_EQ(run.ended_with, "");
  }
  const ReportInput input = read_report_input({folder});
  ASSERT_TRUE(input.runs[0].clicked.has_value());
  const LabellingRecord& record = *input.runs[0].clicked;
  EXPECT_EQ(record.clicks, 4);
  EXPECT_EQ(record.clicked_frames, 2);
  ASSERT_EQ(record.classes.size(), 2u);
  EXPECT_EQ(record.classes[0].name, "wall");
  EXPECT_EQ(record.classes[0].clicks, 3);
  EXPECT_GT(record.classes[0].area_share, 0.05);
  ASSERT_EQ(input.clicked.size(), 2u);
  EXPECT_EQ(input.clicked[0].note, "3 clicks");
  EXPECT_EQ(input.clicked[1].note, "1 click");
  for (const ReportStrip& strip : input.clicked) EXPECT_EQ(strip.images.size(), 3u) << "photograph, labels, entropy";
  EXPECT_HAS(make_report(input), "4 clicks in 2 of 9 frames");
  const ClassTable table = ClassTable::load(folder + "/classes.yaml");
  EXPECT_EQ(table.valid_count(), 2) << "those that nobody has named wait outside";
}

// Labels that the configuration gives are there before the first click, and a click beside them counts.
TEST(LabelSession, LabelsOfTheConfigurationCountAsGiven) {
  const TempDir dir;
  RunningSession run(session_config("analytic_room, labels: {frames: 30%}"), dir / "run", nullptr, 8);
  EXPECT_EQ(run.session.state()->named, 5);
  EXPECT_EQ(run.session.state()->room, 8);
  run.start();
  run.settled();
  const auto state = run.wait_until([](const LabelState& s) { return s.classes.at(0).area_share > 0; });
  EXPECT_TRUE(state->marks.empty());
  const int other = 4;
  const std::vector<std::int16_t> label = run.session.picture(labels_of(other)).label;
  const StoredFrame& photo = run.session.opened().scene.frames[run.session.frame_of(other)];
  const Session& opened = run.session.opened();
  const auto frame = static_cast<std::size_t>(opened.drawn_frames()[other]);
  const RayCamera camera{opened.scene.info.frames[frame].camera, opened.scene.info.frames[frame].world_from_camera,
                         false};
  int right = 0;
  for (std::int32_t i = 0; i < photo.width_px * photo.height_px; ++i)
    right += hit_at(camera, {i % 48, i / 48}).label == label[i];
  EXPECT_GT(right, 48 * 36 * 8 / 10);
  run.session.apply(run.add("1", "poster"));
  run.session.apply(run.click("2", 0, "poster", {24.5, 8.5}, 3));
  EXPECT_EQ(run.settled()->named, 6);
  const std::vector<std::int16_t> after = run.session.picture(labels_of(0)).label;
  EXPECT_EQ(after[8 * 48 + 24], 5);
}

// --- failures ---

class Thrower final : public RunListener {
 public:
  void stepped(std::int64_t step, const StepLosses&) override {
    if (step >= 20) throw Error(ErrorKind::unavailable, "test.error.made", "out of everything");
  }
};

TEST(LabelSession, AfterAFailurePicturesAndEventsGoOn) {
  const TempDir dir;
  Thrower thrower;
  RunningSession run(session_config(), dir / "run", &thrower);
  run.start();
  run.session.apply(run.add("1", "wall"));
  const auto state = run.wait_until([](const LabelState& s) { return !s.failure.empty(); });
  EXPECT_EQ(state->failure, "out of everything [test.error.made]");
  auto picture = std::async(std::launch::async, [&] { return run.session.picture(labels_of(1)); });
  EXPECT_EQ(picture.wait_for(std::chrono::seconds(20)), std::future_status::ready) << "a picture waits for ever";
  EXPECT_TRUE(run.session.apply(run.click("3", 2, "wall", {30.5, 5.5})));
  run.stop();
  EXPECT_EQ(run.session.state()->phase, "training has ended with an error; labels are stored");
  EXPECT_EQ(lines_of(dir / "run/clicks.jsonl"), 2u);
  ASSERT_TRUE(run.session.failure().has_value());
  EXPECT_EQ(run.session.failure()->kind(), ErrorKind::unavailable) << "the program ends with its exit code";
}

// Whatever a training throws: whoever waits gets a response.
TEST(LabelSession, AnyExceptionIsAFailure) {
  class Stranger final : public RunListener {
   public:
    void stepped(std::int64_t step, const StepLosses&) override {
      if (step >= 20) throw std::runtime_error("out of everything");
    }
  };
  const TempDir dir;
  Stranger thrower;
  RunningSession run(session_config(), dir / "run", &thrower);
  run.start();
  auto picture = std::async(std::launch::async, [&] {
    run.wait_until([](const LabelState& s) { return !s.failure.empty(); });
    return run.session.picture(labels_of(1));
  });
  EXPECT_EQ(picture.wait_for(std::chrono::seconds(40)), std::future_status::ready);
  EXPECT_EQ(run.session.state()->failure, "out of everything [internal.exception]");
  run.stop();
}

}  // namespace
}  // namespace semfield
