// A labelling session of the analytic room whose training runs in a thread of its own.

#include "labels/serve/label_session.h"

#include <sys/stat.h>

#include <cstdlib>
#include <future>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <thread>

#include "eval/report/report.h"
#include "labels/clicks.h"
#include "labels/labelling_record.h"
#include "labels/serve/view_pictures.h"
#include "scene/loading/packed_scene.h"
#include "tests/label_loop/labelled_room.h"
#include "tests/scene/tiny_scene.h"
#include "train/metrics_log.h"
#include "train/opened_run.h"
#include "train/run_folder.h"

namespace semfield::testing_loop {
namespace {

inline constexpr int kSteps = 60;

inline std::string session_config(const std::string& scene = "analytic_room, with_labels: false, with_classes: false") {
  return testing_train::replaced(room_config(scene), "steps: 200", "steps: " + std::to_string(kSteps));
}

/// run() in a thread from start() on; what it throws is in `ended_with`. Stopped at the end.
class RunningSession : NonCopyable {
 public:
  RunningSession(const std::string& yaml, const std::string& run_dir, RunListener* listener = nullptr,
                 int class_room = 6)
      : RunningSession(run_config_of(parse_config_text(yaml, "test.yaml"), testing_train::all_plugins()), run_dir,
                       listener, class_room) {}
  RunningSession(RunConfig config, const std::string& run_dir, RunListener* listener = nullptr, int class_room = 6)
      : session(std::move(config), testing_train::all_plugins(), {run_dir, class_room}, listener) {}
  ~RunningSession() { stop(); }

  RunningSession& start() {
    thread_ = std::thread([this] {
      try {
        session.run();
      } catch (const std::exception& error) {
        ended_with = error.what();
      }
    });
    return *this;
  }
  void stop() {
    session.stop();
    if (thread_.joinable()) thread_.join();
  }

  /// The first state that is as wanted. Far more time than it takes; a test that needs it has failed.
  std::shared_ptr<const LabelState> wait_until(const std::function<bool(const LabelState&)>& wanted) const {
    std::shared_ptr<const LabelState> state = session.state();
    for (int turn = 0; !wanted(*state) && turn < 100; ++turn)
      state = session.wait_state(state->revision, std::chrono::milliseconds(300));
    EXPECT_TRUE(wanted(*state)) << state->phase << ", step " << state->step << ", failure: " << state->failure;
    return state;
  }
  /// Labels know every event and all views have some.
  std::shared_ptr<const LabelState> settled() const {
    return wait_until([](const LabelState& s) { return s.geometry_ready && s.overlay_events == s.events; });
  }

  /// All of them are taken.
  void apply(const std::vector<LabelEvent>& events) {
    for (const LabelEvent& event : events) EXPECT_TRUE(session.apply(event)) << event.id;
  }
  LabelEvent add(const std::string& id, const std::string& name) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
  }
  LabelEvent undo(const std::string& id, const std::string& of) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
  }
  LabelEvent click(const std::string& id, int view, const std::string& name, PixelPoint at, double radius = 1) const {
    const ViewState& shown = session.state()->views.at(static_cast<std::size_t>(view));
    return LabelEvent{.id = id,
                      .frame = shown.frame,
                      .width_px = shown.width_px,
                      .height_px = shown.height_px,
                      .points = {at},
                      .radius_px = radius,
                      .class_name = name};
  }

  LabelSession session;
  std::string ended_with;

 private:
  std::thread thread_;
};

}  // namespace
}  // namespace semfield::testing_loop

namespace semfield {
namespace {

// A session of the plain configuration in a folder of its own.
struct PlainSession : ::testing::Test {
  const TempDir dir;
  testing_loop::RunningSession run{testing_loop::session_config(), dir / "run"};
};

// A labelling session: events from several threads, labels that follow, undo, what a run's folder holds and goes on
// with, and what happens when training fails.

using namespace testing_loop;

PictureRequest labels_of(int view) { return PictureRequest{.client = "test", .view = view}; }

std::string refusal(LabelSession& session, const LabelEvent& event) {
  return error_of(ErrorKind::data, [&] { session.apply(event); });
}

std::size_t lines_of(const std::string& path) {
  const std::string text = read_text_file(path);
  return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
}

TEST_F(PlainSession, BeginsWithoutLabelsAndWithoutClasses) {
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
    std::string yaml = testing_train::replaced(
        session_config("analytic_room, with_labels: false, with_classes: false, tracked: true"), "train: {",
        asked ? "train: {cameras: {poses: learned}, " : "train: {cameras: {poses: auto}, ");
    RunningSession run(yaml, dir / "run");
    EXPECT_EQ(run.session.opened().config.cameras.poses == CameraTrust::learned, asked);
  }
}

// They have labels as the others, and take no clicks.
TEST_F(PlainSession, TestFramesAreLookedAt) {
  run.start();
  run.wait_until([](const LabelState& s) { return s.geometry_ready; });
  run.apply({run.add("1", "wall"), run.click("2", 0, "wall", {20, 10})});
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
  RunningSession run(testing_train::replaced(session_config(), "steps: 60", "steps: 500"), dir / "run");
  run.start();
  const auto trained = run.wait_until([](const LabelState& s) { return s.phase.find("trained") == 0; });
  EXPECT_GE(trained->step, 500);
  EXPECT_TRUE(trained->failure.empty());
}

TEST_F(PlainSession, ClicksMakeLabelsAndUndoTakesThemBack) {
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

TEST_F(PlainSession, ThreadsThatClickAtOnceLoseNothing) {
  run.apply({run.add("a", "wall"), run.add("b", "floor")});
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
    run.apply({run.add("1", "wall"), run.click("2", 2, "wall", {24.5, 5.5}), run.click("2b", 2, "wall", {10.5, 5.5}),
               run.click("2c", 4, "wall", {24.5, 5.5})});
    run.start();
    run.settled();
    run.session.save();
    EXPECT_TRUE(std::filesystem::exists(folder + "/checkpoints/latest"));
    Diagnostics findings;
    const OpenedRun meanwhile = open_run(folder, {}, testing_train::all_plugins(), findings);
    EXPECT_GT(meanwhile.step, 0);
    run.apply({run.add("3", "floor"), run.click("4", 2, "floor", {24.5, 33.5})});
    run.stop();
    EXPECT_EQ(run.ended_with, "");
    step = run.session.state()->step;
  }
  Diagnostics findings;
  const OpenedRun opened = open_run(folder, {}, testing_train::all_plugins(), findings);
  EXPECT_GE(opened.step, step);
  EXPECT_EQ(opened.session.scene.info.classes.valid(0).name, "wall");
  EXPECT_EQ(opened.session.scene.info.classes.valid(1).name, "floor");
  ASSERT_TRUE(opened.session.pipeline->has_semantics());

  RunConfig config = load_run_config(RunFolder::read(folder).config_path(), {}, testing_train::all_plugins());
  RunningSession again(std::move(config), folder);
  const auto state = again.session.state();
  EXPECT_EQ(state->step, opened.step);
  EXPECT_EQ(state->events, 6u);
  EXPECT_EQ(state->marks.size(), 4u);
  EXPECT_EQ(state->named, 2);
  EXPECT_EQ(state->classes.at(1).name, "floor");
  EXPECT_EQ(state->room, 6);
  EXPECT_GT(state->classes.at(0).area_share, 0) << "what it knew, before the surface is found again";
  EXPECT_FALSE(again.session.apply(again.click("4", 2, "floor", {24.5, 33.5})));
  again.start();
  EXPECT_EQ(again.settled()->overlay_events, 6u);
  const std::vector<std::int16_t> label = again.session.picture(labels_of(2)).label;
  EXPECT_GT(std::count(label.begin(), label.end(), 0), 100);
  EXPECT_GT(std::count(label.begin(), label.end(), 1), 100);
  again.stop();

  // The report lists the clicks, without a scene or a checkpoint being opened.
  const nlohmann::json input = nlohmann::json::parse(read_report({folder}));
  const LabellingRecord record = parse_labelling_record(input["runs"][0]["clicked"].dump(), "labelling.json");
  EXPECT_EQ(record.clicks, 4);
  EXPECT_EQ(record.clicked_frames, 2);
  ASSERT_EQ(record.classes.size(), 2u);
  EXPECT_EQ(record.classes[0].name, "wall");
  EXPECT_EQ(record.classes[0].clicks, 3);
  EXPECT_GT(record.classes[0].area_share, 0.05);
  ASSERT_EQ(input["clicked"].size(), 2u);
  EXPECT_EQ(input["clicked"][0]["note"], "3 clicks");
  EXPECT_EQ(input["clicked"][1]["note"], "1 click");
  for (const auto& strip : input["clicked"]) EXPECT_EQ(strip["images"].size(), 3u) << "photograph, labels, entropy";
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
  run.apply({run.add("1", "poster"), run.click("2", 0, "poster", {24.5, 8.5}, 3)});
  EXPECT_EQ(run.settled()->named, 6);
  const std::vector<std::int16_t> after = run.session.picture(labels_of(0)).label;
  EXPECT_EQ(after[8 * 48 + 24], 5);
}

// --- failures ---

// Whatever a training throws: whoever waits gets a response.
TEST(LabelSession, AfterAFailurePicturesAndEventsGoOn) {
  for (const bool is_ours : {true, false}) {
    const TempDir dir;
    testing_train::HookListener thrower;
    thrower.on_step = [&](std::int64_t step) {
      if (step >= 20 && is_ours) throw Error(ErrorKind::unavailable, "test.error.made", "out of everything");
      if (step >= 20) throw std::runtime_error("out of everything");
    };
    RunningSession run(session_config(), dir / "run", &thrower);
    run.start();
    run.session.apply(run.add("1", "wall"));
    const auto state = run.wait_until([](const LabelState& s) { return !s.failure.empty(); });
    EXPECT_EQ(state->failure,
              is_ours ? "out of everything [test.error.made]" : "out of everything [internal.exception]");
    auto picture = std::async(std::launch::async, [&] { return run.session.picture(labels_of(1)); });
    EXPECT_EQ(picture.wait_for(std::chrono::seconds(20)), std::future_status::ready) << "a picture waits for ever";
    EXPECT_TRUE(run.session.apply(run.click("3", 2, "wall", {30.5, 5.5})));
    run.stop();
    EXPECT_EQ(run.session.state()->phase, "training has ended with an error; labels are stored");
    EXPECT_EQ(lines_of(dir / "run/clicks.jsonl"), 2u);
    ASSERT_TRUE(run.session.failure().has_value());
    EXPECT_TRUE(!is_ours || run.session.failure()->kind() == ErrorKind::unavailable) << "the program's exit code";
  }
}

// The folder of a labelling session: files that cannot be written for a while, a folder that is moved or copied, clicks
// that are lost, and a scene that has changed.

// A file stands where the folder of checkpoints was, as if a disk had no room.
TEST(LabelSession, FilesThatCannotBeWrittenForAWhileEndNothing) {
  const TempDir dir;
  const std::string folder = dir / "run";
  std::string yaml = session_config();
  yaml += "report: {eval_every_s: 0, checkpoint_every_s: 0.05, log_every_steps: 5}\n";
  yaml = testing_train::replaced(yaml, "steps: 60", "steps: 1000000");
  std::int64_t step = 0;
  {
    RunningSession run(yaml, folder);
    run.start();
    run.wait_until([&](const LabelState&) { return std::filesystem::exists(folder + "/checkpoints/latest"); });
    std::filesystem::rename(folder + "/checkpoints", dir / "aside");
    testing_room::plain_write(folder + "/checkpoints", "");
    const auto troubled = run.wait_until([](const LabelState& s) { return !s.trouble.empty(); });
    EXPECT_HAS(troubled->trouble, "checkpoints");
    EXPECT_EQ(troubled->failure, "");
    EXPECT_TRUE(run.session.apply(run.add("1", "wall")));
    run.wait_until([&](const LabelState& s) { return s.step > troubled->step + 20 && s.overlay_events == 1; });
    std::filesystem::remove(folder + "/checkpoints");
    std::filesystem::rename(dir / "aside", folder + "/checkpoints");
    run.wait_until([](const LabelState& s) { return s.trouble.empty(); });
    run.stop();
    EXPECT_EQ(run.ended_with, "");
    EXPECT_FALSE(run.session.failure().has_value());
    step = run.session.state()->step;
  }
  Diagnostics findings;
  EXPECT_GE(open_run(folder, {}, testing_train::all_plugins(), findings).step, step);
  std::int64_t last = 0;  // no row is lost, none is torn
  for (const MetricsRow& row : read_metrics(folder + "/metrics.jsonl")) {
    EXPECT_EQ(row.step, last + 5);
    last = row.step;
  }
  EXPECT_GT(last, 0);
}

TEST_F(PlainSession, ARunWhoseLastCheckpointCannotBeWrittenEndsWithThatError) {
  run.start();
  run.session.apply(run.add("1", "wall"));
  run.wait_until([](const LabelState& s) { return s.step > 10; });
  std::filesystem::remove_all(dir / "run/checkpoints");
  testing_room::plain_write(dir / "run/checkpoints", "");
  run.stop();
  EXPECT_HAS(run.ended_with, "checkpoints");
}

ino_t inode_of(const std::string& path) {
  struct stat facts {};
  EXPECT_EQ(stat(path.c_str(), &facts), 0) << path;
  return facts.st_ino;
}

TEST(LabelSession, TheTableOfClassesIsWrittenWhenItChangesAlone) {
  const TempDir dir;
  const std::string table = dir / "run/classes.yaml";
  RunningSession run(session_config(), dir / "run");
  run.start();
  run.session.apply(run.add("1", "wall"));
  run.settled();
  run.session.save();
  EXPECT_HAS(read_text_file(table), "wall");
  const ino_t before = inode_of(table);
  for (const char* id : {"2", "3", "4"}) run.session.apply(run.click(id, 2, "wall", {24.5, 5.5}));
  run.settled();
  run.session.save();
  EXPECT_EQ(inode_of(table), before) << "clicks change no class";
  run.session.apply(run.add("5", "floor"));
  run.settled();
  run.session.save();
  EXPECT_NE(inode_of(table), before);
  EXPECT_HAS(read_text_file(table), "floor");
}

// --- a folder that is moved, copied, or lacks its clicks ---

std::string resume_refusal(const std::string& folder) {
  return error_of([&] {
    RunConfig config = load_run_config(folder + "/run.yaml", {}, testing_train::all_plugins());
    const RunningSession run(std::move(config), folder);
  });
}

std::vector<std::string> classes_of(const LabelSession& session) {
  std::vector<std::string> names;
  for (const ClassState& cls : session.state()->classes) names.push_back(cls.name);
  return names;
}

TEST(LabelSession, AFolderThatWasMovedOrCopiedHasItsOwnClicks) {
  const TempDir dir;
  const std::string here = dir / "run", moved = dir / "moved", copied = dir / "copied", earlier = dir / "earlier";
  const auto resumed = [](const std::string& folder) {
    return load_run_config(folder + "/run.yaml", {}, testing_train::all_plugins());
  };
  {
    RunningSession run(session_config(), here);
    run.apply({run.add("1", "wall"), run.click("2", 2, "wall", {24.5, 5.5})});
    run.start();
    run.settled();
    run.stop();
    ASSERT_EQ(run.ended_with, "");
  }
  EXPECT_HAS(read_text_file(here + "/run.yaml"), "clicks: clicks.jsonl");
  fs::copy(here, copied, fs::copy_options::recursive);
  fs::rename(here, moved);
  {  // another run of the old name
    RunningSession other(session_config(), here);
    EXPECT_TRUE(classes_of(other.session).empty());
    other.session.apply(other.add("o", "door"));
  }
  const std::string theirs = read_text_file(here + "/clicks.jsonl");
  // Earlier versions wrote the place that the file had.
  fs::copy(copied, earlier, fs::copy_options::recursive);
  std::string yaml = testing_train::replaced(read_text_file(earlier + "/run.yaml"), "clicks: clicks.jsonl",
                                             "clicks: " + here + "/clicks.jsonl");
  write_file_atomic(earlier + "/run.yaml", yaml);
  for (const std::string& folder : {moved, copied, earlier}) {
    RunningSession run(resumed(folder), folder);
    EXPECT_EQ(classes_of(run.session), std::vector<std::string>{"wall"}) << folder;
    EXPECT_EQ(run.session.state()->marks.size(), 1u) << folder;
    EXPECT_TRUE(run.session.apply(run.click("3", 2, "wall", {24.5, 8.5})));
    EXPECT_EQ(lines_of(folder + "/clicks.jsonl"), 3u);
  }
  EXPECT_EQ(read_text_file(here + "/clicks.jsonl"), theirs);
  for (const std::string& folder : {moved, copied}) {
    fs::remove(folder + "/clicks.jsonl");
    const std::string said = "the run '" + folder + "' has learned from 2 events of clicks, and '" + folder +
                             "/clicks.jsonl' is not there; put the file back, or say where it is: --set "
                             "scene.labels.clicks=FILE";
    EXPECT_EQ(resume_refusal(folder), said);
    Diagnostics findings;
    EXPECT_EQ(error_of([&] { (void)open_run(folder, {}, testing_train::all_plugins(), findings); }), said);
    TrainRequest request{.out_dir = folder, .resume = true};
    EXPECT_EQ(
        error_of([&] { (void)testing_train::run_training(resumed(folder), testing_train::all_plugins(), request); }),
        said);
    EXPECT_FALSE(fs::exists(folder + "/clicks.jsonl")) << "nothing is made in its place";
  }
}

// The page shows the warnings of a changed scene that the terminal shows.
TEST(LabelSession, WarningsReachThePage) {
  const TempDir dir;
  {
    RunningSession run(
        load_run_config(testing_train::write_packed_config(dir, 20, 0), {}, testing_train::all_plugins()), dir / "run");
    EXPECT_TRUE(run.session.state()->notes.empty());
    run.start();
    run.wait_until([](const LabelState& s) { return s.step >= 20; });
    run.stop();
  }
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics ignored;
  const SceneInfo info = scene->open(ignored);
  write_packed_scene(dir / "room.sfpack", info, [&](int frame, FrameBuffer& buffer) {
    scene->read(frame, buffer);
    for (std::uint8_t& value : buffer.rgb) value = static_cast<std::uint8_t>(value / 2);
  });
  RunningSession again(load_run_config(dir / "run/run.yaml", {}, testing_train::all_plugins()), dir / "run");
  const std::vector<std::string> notes = again.session.state()->notes;
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_HAS(notes.front(), "other images");
}

// Pictures that a labelling session makes between its steps, for several who look.

PictureRequest rendered(int view, const std::string& client) {
  return PictureRequest{.client = client, .view = view, .color = true};
}

TEST_F(PlainSession, ViewsAreDrawnWhileItTrains) {
  run.apply({run.add("1", "wall"), run.click("2", 0, "wall", {24.5, 5.5})});
  run.start();
  const std::uint64_t overlay = run.settled()->overlay_revision;
  const Picture labels = run.session.picture({.client = "a", .view = 3, .entropy = true});
  EXPECT_FALSE(labels.stale);
  EXPECT_EQ(labels.label.size(), 48u * 36u);
  EXPECT_EQ(labels.entropy.size(), labels.label.size());
  EXPECT_TRUE(labels.rgb.empty());
  EXPECT_GE(labels.overlay_revision, overlay);
  const Picture seen = run.session.picture(rendered(3, "a"));
  EXPECT_EQ(seen.width_px, 48);
  EXPECT_EQ(seen.height_px, 36);
  EXPECT_EQ(seen.rgb.size(), 3u * 48 * 36);
  EXPECT_EQ(seen.label.size(), 48u * 36u);
  // It is what the photograph shows.
  const StoredFrame& photo = run.session.opened().scene.frames[run.session.frame_of(3)];
  double wrong = 0;
  for (std::size_t i = 0; i < seen.rgb.size(); ++i) wrong += std::abs(int{seen.rgb[i]} - int{photo.rgb[i]});
  EXPECT_LT(wrong / static_cast<double>(seen.rgb.size()), 40);
}

TEST_F(PlainSession, ALaterRequestOfTheSameClientTakesThePlace) {
  const auto ask = [&](const std::string& client) {
    return std::async(std::launch::async, [this, client] { return run.session.picture(rendered(0, client)); });
  };
  // Nobody trains yet, so both wait: the earlier one gets its response when the later one comes.
  std::future<Picture> one = ask("a"), two = ask("a"), other = ask("b");
  bool one_first = false, answered = false;
  for (int turn = 0; !answered && turn < 2000; ++turn) {
    one_first = one.wait_for(std::chrono::milliseconds(5)) == std::future_status::ready;
    answered = one_first || two.wait_for(std::chrono::milliseconds(5)) == std::future_status::ready;
  }
  if (!answered) run.start();  // there would never be a response
  ASSERT_TRUE(answered);
  const Picture stale = (one_first ? one : two).get();
  EXPECT_TRUE(stale.stale);
  EXPECT_TRUE(stale.rgb.empty());
  run.start();
  const Picture made = (one_first ? two : one).get();
  EXPECT_FALSE(made.stale);
  EXPECT_FALSE(made.rgb.empty());
  EXPECT_FALSE(other.get().stale) << "another client's has nothing to do with it";
}

// Nobody trains in these two, so whoever gets a response did not wait for a picture.
TEST_F(PlainSession, OneThatNobodyWantsAnyMoreIsGivenUp) {
  std::atomic<int> looks{0};
  const Picture none = run.session.picture(rendered(0, "a"), [&] { return ++looks == 3; });
  EXPECT_TRUE(none.stale);
  EXPECT_EQ(looks, 3);
}

TEST_F(PlainSession, OfTooManyThatWaitTheOldestIsStale) {
  std::vector<std::future<Picture>> waiting;
  std::atomic<int> answered{0};
  for (int k = 0; k < 40; ++k)
    waiting.push_back(std::async(std::launch::async, [&, k] {
      const Picture picture = run.session.picture(rendered(0, "c" + std::to_string(k)));
      ++answered;
      return picture;
    }));
  for (int turn = 0; answered < 24 && turn < 2000; ++turn) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_EQ(answered, 24) << "16 wait";
  run.session.stop();
  run.start();
  for (std::future<Picture>& picture : waiting) EXPECT_TRUE(picture.get().stale);
}

TEST_F(PlainSession, AWrongRequestIsRefusedAndTheSessionGoesOn) {
  run.start();
  EXPECT_HAS(error_of([&] { run.session.picture({.client = "a", .view = 1000}); }), "view 1000 is none of the 12");
  EXPECT_FALSE(run.session.picture(rendered(0, "a")).stale);
  EXPECT_TRUE(run.session.state()->failure.empty());
}

TEST_F(PlainSession, AfterTheEndTheyAreStale) {
  std::future<Picture> waits = std::async(std::launch::async, [&] { return run.session.picture(rendered(0, "a")); });
  run.session.stop();
  run.start();
  EXPECT_TRUE(waits.get().stale);
  run.stop();
  EXPECT_TRUE(run.session.picture(rendered(0, "b")).stale);
  EXPECT_EQ(run.ended_with, "");
}

// What the training thread of a labelling session makes of events that come together: clicks, skips, undos.

// A run that has a surface, and whose events a test applies by itself.
struct PreparedRun : ::testing::Test {
  TempDir dir;
  RunListener nobody;
  LabelSession run;
  Annotations annotations;

  PreparedRun() : run({opened(), {}}), annotations(*run.opened().config.labels.clicks) {
    for (int turn = 0; !run.loop().ready() && turn < 1000; ++turn) {
      run.train(0.05);
      run.tend(false, false, false);
    }
    run.take(annotations);
  }
  std::unique_ptr<semfield::Run> opened() {
    const std::string yaml =
        session_config("analytic_room, with_labels: false, with_classes: false, labels: {class_room: 4}");
    Registry& registry = testing_train::all_plugins();
    return std::make_unique<semfield::Run>(run_config_of(parse_config_text(yaml, "test.yaml"), registry), registry,
                                           TrainRequest{.out_dir = dir / "run", .driver = Driver::page}, &nobody);
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
                      .frame = run.opened().scene.info.frames[frame].name,
                      .width_px = 48,
                      .height_px = 36,
                      .points = {at}};
  }
  LabelEvent click(const std::string& id, const std::string& name, int view = 0, PixelPoint at = {}) const {
    LabelEvent made = event(id, LabelEventKind::click, view, at);
    made.class_name = name;
    return made;
  }
  LabelEvent undo(const std::string& id, const std::string& of) const {
    return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
  }
  void add_class(const std::string& name) {
    annotations.apply({.id = "add-" + name, .kind = LabelEventKind::add_class, .class_name = name});
  }
  Vec3d place_of(const ProposalState& proposal) const {
    const PixelPlace pixel{static_cast<std::int32_t>(proposal.at.x), static_cast<std::int32_t>(proposal.at.y)};
    const PoolView& view = run.loop().views()[proposal.view];
    return point_at(view.camera, run.opened().limits, pixel, static_cast<double>(view.map.at(pixel.column, pixel.row)));
  }
};

// Undoing a skip and skipping something else leaves as many as before; they are others all the same.
TEST_F(PreparedRun, ASkipInTheSteadOfAnotherCounts) {
  for (int k = 0; k < 10; ++k) {
    const LabelState asked = state();
    ASSERT_TRUE(asked.proposal.has_value());
    const std::string own = "skip-" + std::to_string(k);
    if (k > 0) annotations.apply(undo("undo-" + std::to_string(k), "skip-" + std::to_string(k - 1)));
    annotations.apply(event(own, LabelEventKind::skip, asked.proposal->view, asked.proposal->at));
    ASSERT_EQ(annotations.skips().size(), 1u);
    run.take(annotations);
    const LabelState next = state();
    ASSERT_TRUE(next.proposal.has_value());
    EXPECT_NE(next.proposal->id, asked.proposal->id);
    EXPECT_GT(length(place_of(*next.proposal) - place_of(*asked.proposal)), run.loop().pool().cell_m())
        << "round " << k;
  }
}

// A region that nobody should label has no label and is not proposed; undone, it is as before.
TEST_F(PreparedRun, WhatIsIgnoredIsNotAskedAbout) {
  add_class("wall");
  annotations.apply(click("wall", "wall", 3, {24.5, 5.5}));
  const auto learn = [&] {
    run.take(annotations);
    for (int turn = 0; !run.knows_all() && turn < 10'000; ++turn) run.tend(false, false, false);
    ASSERT_TRUE(run.knows_all());
  };
  for (int view = 0; view < std::ssize(run.loop().pooled()); ++view) {  // but for view 3
    if (view == 3) continue;
    LabelEvent ignore = click("i" + std::to_string(view), "void", view);
    ignore.points = {{0, 0}, {48, 0}, {48, 36}, {0, 36}};
    ignore.fill = true;
    annotations.apply(ignore);
  }
  learn();
  for (int k = 0; k < 5; ++k) {
    const LabelState asked = state();
    ASSERT_TRUE(asked.proposal.has_value());
    EXPECT_EQ(asked.proposal->view, 3);
    annotations.apply(event("s" + std::to_string(k), LabelEventKind::skip, 3, asked.proposal->at));
    run.take(annotations);
  }
  const auto labelled = [&](int view) {
    const Picture picture = run.pictures().make({.view = view});
    return picture.label.size() -
           static_cast<std::size_t>(std::count(picture.label.begin(), picture.label.end(), kVoid));
  };
  EXPECT_EQ(labelled(1), 0u);
  EXPECT_GT(labelled(3), 48u * 36 / 2);
  annotations.apply(undo("back", "i1"));
  learn();
  EXPECT_GT(labelled(1), 48u * 36 / 2);
}

TEST_F(PreparedRun, ClicksGiveTheStateItsNumbers) {
  LabelState state = this->state();
  EXPECT_TRUE(state.geometry_ready);
  EXPECT_EQ(state.temperature, 1);
  for (const ViewState& view : state.views) {
    EXPECT_TRUE(view.ready);
    EXPECT_EQ(view.entropy, 1) << "nothing is known";
  }
  for (const char* name : {"wall", "floor"}) add_class(name);
  annotations.apply(click("a", "wall", 0, {24.5, 5.5}));
  annotations.apply(click("b", "floor", 0, {24.5, 33.5}));
  run.take(annotations);
  state.classes = {{0, 1, "wall", {}, 1, 0, 0}, {1, 2, "floor", {}, 1, 0, 0}};
  run.describe(state);
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
  LabelEvent none = click("c", "void", 0, {24.5, 5.5});
  none.radius_px = 5;
  annotations.apply(none);
  run.take(annotations);
  EXPECT_EQ(run.loop().live(), (std::vector<bool>{false, true, false, false})) << "wall's click is painted over";
}

// A further stroke costs its own places alone, however many there are, and the others are found in pieces between steps
// of training.
TEST_F(PreparedRun, AFurtherStrokeDoesNotPayForThoseBeforeIt) {
  add_class("wall");
  const auto stroke = [&](int k) {
    LabelEvent made = click("s" + std::to_string(k), "wall", k % 9, {2.0 + k % 40, 3.0});
    for (int p = 0; p < 60; ++p) made.points.push_back({2.0 + (k + p) % 44, 3.0 + (7 * k + p) % 30});
    made.radius_px = 1;
    annotations.apply(made);
  };
  for (int k = 0; k < 300; ++k) stroke(k);
  run.take(annotations);
  for (int turn = 0; !run.knows_all() && turn < 10'000; ++turn) {
    run.train(0.001);
    run.tend(false, false, false);
  }
  ASSERT_TRUE(run.knows_all());
  EXPECT_TRUE(run.loop().learned());
  const std::int64_t found = run.loop().places_found();
  stroke(300);
  run.take(annotations);
  EXPECT_TRUE(run.knows_all()) << "at once";
  EXPECT_LE(run.loop().places_found() - found, 60) << "its own, and those of strokes that it has painted over";
  EXPECT_LE(run.loop().learned_points(), run.loop().pool().points.size() + 301);
}

TEST_F(PreparedRun, ATurnOfTrainingEndsWhenSomebodyWaits) {
  add_class("wall");
  annotations.apply(click("c", "wall", 0, {5, 5}));
  run.take(annotations);  // a change, after which training goes on
  const std::int64_t before = state().step;
  int looks = 0;
  EXPECT_TRUE(run.train(5, [&] { return ++looks == 2; }));
  EXPECT_EQ(looks, 2);
  EXPECT_EQ(state().step, before + 2) << "a step at a time on a CPU";
}

// Pictures of views: their sizes, what they show, and requests that are refused.

struct PicturedRoom : ::testing::Test, LoopedRoom {
  explicit PicturedRoom(const std::string& scene = "analytic_room") : LoopedRoom(60, quick_learning(), scene) {}

  ViewPictures pictures{*training, *loop, [](int, std::int32_t) { return Image<std::uint8_t>(); }};
};

// Too large to be rendered soon, as far as is known at first.
struct LargeRoom : PicturedRoom {
  LargeRoom() : PicturedRoom("analytic_room, width_px: 144, height_px: 108") {}
};

PictureRequest of_view(int view) { return PictureRequest{.view = view}; }

PictureRequest rendered_view(int view, bool full = false) {
  return PictureRequest{.view = view, .color = true, .entropy = true, .full = full};
}

void expect_whole(const Picture& picture, bool rgb, bool label, bool entropy) {
  const auto pixels = static_cast<std::size_t>(picture.width_px * picture.height_px);
  EXPECT_GT(pixels, 0u);
  EXPECT_EQ(picture.rgb.size(), rgb ? 3 * pixels : 0);
  EXPECT_EQ(picture.label.size(), label ? pixels : 0);
  EXPECT_EQ(picture.entropy.size(), entropy ? pixels : 0);
}

TEST_F(PicturedRoom, AViewsLabelsAreThoseOfTheLoop) {
  EXPECT_EQ(pictures.make(of_view(2)).label, std::vector<std::int16_t>(48 * 36, kVoid)) << "nothing is learned";
  loop->learn(clicks(8));
  PictureRequest request = of_view(2);
  request.entropy = true;
  const Picture coarse = pictures.make(request);
  EXPECT_EQ(coarse.width_px, 48);
  EXPECT_EQ(coarse.height_px, 36);
  expect_whole(coarse, false, true, true);
  EXPECT_EQ(coarse.label, loop->labels_of(2).label);
  EXPECT_EQ(coarse.entropy, loop->labels_of(2).entropy);
  while (!pictures.refine(0.001)) {
  }
  const SurfaceMap fine = loop->map_of(2, 1);
  EXPECT_EQ(pictures.make(request).label, loop->labels_of(2, &fine).label) << "its own surface is finer";
  EXPECT_FALSE(pictures.refine(1)) << "it is complete";
  request.labels = false;
  expect_whole(pictures.make(request), false, false, true);
}

TEST_F(LargeRoom, AViewIsRenderedAsLargeAsItCanBeSoon) {
  loop->learn(clicks(8));
  const Picture quick = pictures.make(rendered_view(1));
  EXPECT_LT(quick.width_px, 144);
  EXPECT_GE(quick.width_px, 48);
  expect_whole(quick, true, true, true);
  const auto named = std::count_if(quick.label.begin(), quick.label.end(), [](std::int16_t l) { return l >= 0; });
  EXPECT_GT(named, quick.width_px * quick.height_px / 2);
  const Picture full = pictures.make(rendered_view(1, true));
  EXPECT_EQ(full.width_px, 144);
  EXPECT_EQ(full.height_px, 108);
  expect_whole(full, true, true, true);
  loop->learn({});
  expect_whole(pictures.make(rendered_view(1)), true, false, false);
}

// Training sees a photograph smaller than the page does: labels come at the page's size, and marks in its pixels.
TEST_F(PicturedRoom, LabelsComeAtTheSizeOfALargerPhotograph) {
  loop->learn(clicks(8));
  std::int32_t asked_px = 0;
  ViewPictures larger{*training, *loop, [&](int view, std::int32_t most_px) {
                        asked_px = most_px;
                        const std::vector<std::uint8_t>& rgb = loop->view(view).photo->rgb;
                        Image<std::uint8_t> twice{96, 72, 3, {}};
                        for (int y = 0; y < 72; ++y)
                          for (int x = 0; x < 96; ++x)
                            for (int c = 0; c < 3; ++c) twice.pixels.push_back(rgb[3 * (y / 2 * 48 + x / 2) + c]);
                        return twice;
                      }};
  pictures.set_marks({{"other", loop->views()[2].frame, {{24.5, 18.5}}, 0, 0}});
  larger.set_marks({{"other", loop->views()[2].frame, {{24.5, 18.5}}, 0, 0}});
  for (ViewPictures* of : {&pictures, &larger}) {
    EXPECT_EQ(of->make(of_view(1)).width_px, 48) << "at first";
    for (int turn = 0; turn < 3; ++turn) (void)of->refine(5);
  }
  EXPECT_GT(asked_px, 900);
  const Picture small = pictures.make(of_view(1)), large = larger.make(of_view(1));
  ASSERT_EQ(large.width_px, 96);
  ASSERT_EQ(large.height_px, 72);
  expect_whole(large, false, true, false);
  ASSERT_EQ(large.seen.size(), small.seen.size());
  ASSERT_FALSE(large.seen.empty());
  EXPECT_NEAR(large.seen[0].points[0].x, 2 * small.seen[0].points[0].x, 1e-9);
  int alike = 0;
  for (int y = 0; y < 36; ++y)
    for (int x = 0; x < 48; ++x) alike += large.label[2 * y * 96 + 2 * x] == small.label[y * 48 + x] ? 1 : 0;
  EXPECT_GT(alike, 48 * 36 * 9 / 10);
}

TEST_F(LargeRoom, ClicksOfOtherViewsAreInPixelsOfThePicture) {
  std::vector<Annotations::Mark> marks;
  for (int y = 6; y < 108; y += 12)
    for (int x = 6; x < 144; x += 12)
      marks.push_back(
          {std::to_string(x) + "_" + std::to_string(y), loop->views()[2].frame, {{x + 0.5, y + 0.5}}, 0, 0});
  pictures.set_marks(marks);
  const Picture quick = pictures.make(rendered_view(1));
  ASSERT_LT(quick.width_px, 144);
  const Picture whole = pictures.make(of_view(1));
  ASSERT_FALSE(whole.seen.empty());
  ASSERT_EQ(quick.seen.size(), whole.seen.size());
  for (std::size_t i = 0; i < whole.seen.size(); ++i)
    EXPECT_NEAR(quick.seen[i].points[0].x * 144 / quick.width_px, whole.seen[i].points[0].x, 1e-9);
}

TEST_F(PicturedRoom, ClicksOfOtherViewsAreShownWhereTheyAreSeen) {
  loop->learn(clicks(8));
  const std::vector<Annotations::Mark> marks{{"own", loop->views()[1].frame, {{24.5, 18.5}}, 0, 0},
                                             {"other", loop->views()[2].frame, {{24.5, 18.5}}, 0, 0}};
  pictures.set_marks(marks);
  const auto ids = [](const Picture& picture) {
    std::string out;
    for (const SeenMark& mark : picture.seen) out += mark.id + " ";
    return out;
  };
  EXPECT_LACKS(ids(pictures.make(of_view(2))), "other") << "a view's own clicks are in the state";
  EXPECT_LACKS(ids(pictures.make(of_view(1))), "own");
  // Rendered or not, and whatever the size: in pixels of the picture.
  for (const bool color : {false, true}) {
    const Picture picture = pictures.make({.view = 1, .color = color});
    EXPECT_LACKS(ids(picture), "own");
    for (const SeenMark& mark : picture.seen)
      for (const PixelPoint& p : mark.points) {
        EXPECT_GE(std::min(p.x, p.y), 0);
        EXPECT_LE(p.x, picture.width_px);
        EXPECT_LE(p.y, picture.height_px);
      }
  }
}

TEST_F(PicturedRoom, AThingHoldsItsPlaceAndHasTheClassOfItsSurface) {
  PictureRequest request = of_view(2);
  request.thing = ThingRequest{.also = {{24.5, 18.5}}};
  const Picture first = pictures.make(request);
  ASSERT_TRUE(first.thing);
  expect_whole(first, false, true, false);
  EXPECT_EQ(first.label[18 * 48 + 24], 0);
  const auto inside = std::count(first.label.begin(), first.label.end(), 0);
  EXPECT_NEAR(first.thing->share, static_cast<double>(inside) / (48 * 36), 1e-9);
  EXPECT_EQ(first.thing->class_guess, -1) << "nothing is learned";
  EXPECT_EQ(pictures.make(request).label, first.label);
  request.thing->level = first.thing->most;
  EXPECT_GT(pictures.make(request).thing->share, 1 / 1.2);
  request.thing = ThingRequest{.also = {{-5, 1e5}}};
  EXPECT_EQ(pictures.make(request).label[35 * 48], 0) << "what lies outside counts for the edge";
  loop->learn(clicks(8));
  request.thing = ThingRequest{.also = {{24.5, 18.5}}};
  const Picture known = pictures.make(request);
  EXPECT_EQ(known.label, first.label);
  std::map<std::int16_t, int> votes;
  const std::vector<std::int16_t> labels = loop->labels_of(2).label;
  for (std::size_t i = 0; i < labels.size(); ++i) votes[known.label[i] == 0 ? labels[i] : kVoid] += 1;
  EXPECT_GT(3 * votes[static_cast<std::int16_t>(known.thing->class_guess)], inside);
}

TEST_F(PicturedRoom, WrongRequestsAreRefusedWithASentence) {
  for (const int view : {-1, 9})
    EXPECT_HAS(error_of(ErrorKind::usage, [&] { (void)pictures.make(of_view(view)); }),
               "view " + std::to_string(view) + " is none of the 9");
}

}  // namespace
}  // namespace semfield
