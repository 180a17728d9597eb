// The folder of a labelling session: files that cannot be written for a while, a folder that is moved or copied, clicks
// that are lost, and a scene that has changed.
#include <sys/stat.h>

#include <cstdlib>
#include <future>

#include "loading/packed_scene.h"
#include "run/metrics_log.h"
#include "run/run_loop.h"
#include "run/run_scores.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/label_loop/running_session.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_loop;

std::size_t lines_of(const std::string& path) {
  const std::string text = read_text_file(path);
  return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n'));
}

// A file stands where the folder of checkpoints was, as if a disk had no room.
TEST(LabelSession, FilesThatCannotBeWrittenForAWhileEndNothing) {
  const TempDir dir;
  const std::string folder = dir / "run";
  std::string yaml = session_config();
  yaml += "report: {eval_every_s: 0, checkpoint_every_s: 0.05, log_every_steps: 5}\n";
  yaml.replace(yaml.find("steps: 60"), 9, "steps: 1000000");
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
  EXPECT_GE(open_run(folder, {}, RunningSession::registry(), findings).step, step);
  std::int64_t last = 0;  // no row is lost, none is torn
  for (const MetricsRow& row : read_metrics(folder + "/metrics.jsonl")) {
    EXPECT_EQ(row.step, last + 5);
    last = row.step;
  }
  EXPECT_GT(last, 0);
}

TEST(LabelSession, ARunWhoseLastCheckpointCannotBeWrittenEndsWithThatError) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
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
    RunConfig config = load_run_config(folder + "/run.yaml", {}, RunningSession::registry());
    const RunningSession run(std::move(config), folder);
  });
}

std::vector<std::string> classes_of(const LabelSession& session) {
  std::vector<std::string> names;
  for (const ClassState& cls : session.state()->classes) names.push_back(cls.name);
  return names;
}

TEST(LabelSession, AFolderThatWasMovedOrCopiedHasItsOwnClicks) {
  namespace fs = std::filesystem;
  const TempDir dir;
  const std::string here = dir / "run", moved = dir / "moved", copied = dir / "copied", earlier = dir / "earlier";
  const auto resumed = [](const std::string& folder) {
    return load_run_config(folder + "/run.yaml", {}, RunningSession::registry());
  };
  {
    RunningSession run(session_config(), here);
    run.session.apply(run.add("1", "wall"));
    run.session.apply(run.click("2", 2, "wall", {24.5, 5.5}));
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
  std::string yaml = read_text_file(earlier + "/run.yaml");
  yaml.replace(yaml.find("clicks: clicks.jsonl"), 20, "clicks: " + here + "/clicks.jsonl");
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
    EXPECT_EQ(error_of([&] { (void)open_run(folder, {}, RunningSession::registry(), findings); }), said);
    TrainRequest request{.out_dir = folder, .resume = true};
    EXPECT_EQ(error_of([&] { (void)run_training(resumed(folder), RunningSession::registry(), request, nullptr); }),
              said);
    EXPECT_FALSE(fs::exists(folder + "/clicks.jsonl")) << "nothing is made in its place";
  }
}

// The page shows the warnings of a changed scene that the terminal shows.
TEST(LabelSession, WarningsReachThePage) {
  const TempDir dir;
  {
    RunningSession run(load_run_config(testing_train::write_packed_config(dir, 20, 0), {}, RunningSession::registry()),
                       dir / "run");
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
  RunningSession again(load_run_config(dir / "run/run.yaml", {}, RunningSession::registry()), dir / "run");
  const std::vector<std::string> notes = again.session.state()->notes;
  ASSERT_EQ(notes.size(), 1u);
  EXPECT_EQ(notes.front(),
            "scene: it has changed since the run was trained: other images; restore the data, or train again "
            "[run.scene.changed]");
}

// Pictures that a labelling session makes between its steps: of views, of free cameras, for several who look.

PictureRequest of_camera(const FreeCamera& camera, const std::string& client) {
  return PictureRequest{.client = client, .camera = camera, .most_px = 48, .color = true};
}

TEST(LabelSessionPictures, ViewsAndFreeCamerasAreDrawnWhileItTrains) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.session.apply(run.add("1", "wall"));
  run.session.apply(run.click("2", 0, "wall", {24.5, 5.5}));
  run.start();
  const std::uint64_t overlay = run.settled()->overlay_revision;
  PictureRequest view{.client = "a", .view = 3, .entropy = true};
  const Picture labels = run.session.picture(view);
  EXPECT_FALSE(labels.stale);
  EXPECT_EQ(labels.label.size(), 48u * 36u);
  EXPECT_EQ(labels.entropy.size(), labels.label.size());
  EXPECT_TRUE(labels.rgb.empty());
  EXPECT_GE(labels.overlay_revision, overlay);
  const Picture seen = run.session.picture(of_camera(run.session.camera_of(3), "a"));
  EXPECT_EQ(seen.width_px, 48);
  EXPECT_EQ(seen.height_px, 36);
  EXPECT_EQ(seen.rgb.size(), 3u * 48 * 36);
  EXPECT_EQ(seen.label.size(), 48u * 36u);
  // The camera of a view sees what its photograph shows.
  const StoredFrame& photo = run.session.opened().scene.frames[run.session.frame_of(3)];
  double wrong = 0;
  for (std::size_t i = 0; i < seen.rgb.size(); ++i) wrong += std::abs(int{seen.rgb[i]} - int{photo.rgb[i]});
  EXPECT_LT(wrong / static_cast<double>(seen.rgb.size()), 40);
  view.color = view.full = true;
  EXPECT_EQ(run.session.picture(view).rgb.size(), 3u * 48 * 36);
}

TEST(LabelSessionPictures, ALaterRequestOfTheSameClientTakesThePlace) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  const FreeCamera camera = run.session.camera_of(0);
  const auto ask = [&](const std::string& client) {
    return std::async(std::launch::async,
                      [&run, camera, client] { return run.session.picture(of_camera(camera, client)); });
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
TEST(LabelSessionPictures, OneThatNobodyWantsAnyMoreIsGivenUp) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::atomic<int> looks{0};
  const Picture none = run.session.picture(of_camera(run.session.camera_of(0), "a"), [&] { return ++looks == 3; });
  EXPECT_TRUE(none.stale);
  EXPECT_EQ(looks, 3);
}

TEST(LabelSessionPictures, OfTooManyThatWaitTheOldestIsStale) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::vector<std::future<Picture>> waiting;
  std::atomic<int> answered{0};
  for (int k = 0; k < 40; ++k)
    waiting.push_back(std::async(std::launch::async, [&, k] {
      const Picture picture = run.session.picture(of_camera(run.session.camera_of(0), "c" + std::to_string(k)));
      ++answered;
      return picture;
    }));
  for (int turn = 0; answered < 24 && turn < 2000; ++turn) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_EQ(answered, 24) << "16 wait";
  run.session.stop();
  run.start();
  for (std::future<Picture>& picture : waiting) EXPECT_TRUE(picture.get().stale);
}

TEST(LabelSessionPictures, WrongRequestsAreRefusedAndTheSessionGoesOn) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  run.start();
  const auto refusal = [&](const PictureRequest& request) { return error_of([&] { run.session.picture(request); }); };
  PictureRequest nothing{.client = "a"};
  EXPECT_HAS(refusal(nothing), "picture: ");
  PictureRequest far = nothing;
  far.view = 1000;
  EXPECT_HAS(refusal(far), "view 1000 is none of the 12");
  PictureRequest large = of_camera(run.session.camera_of(0), "a");
  large.most_px = 100000;
  EXPECT_HAS(refusal(large), "most_px 100000");
  EXPECT_FALSE(run.session.picture(of_camera(run.session.camera_of(0), "a")).stale);
  EXPECT_TRUE(run.session.state()->failure.empty());
}

TEST(LabelSessionPictures, AfterTheEndTheyAreStale) {
  const TempDir dir;
  RunningSession run(session_config(), dir / "run");
  std::future<Picture> waits =
      std::async(std::launch::async, [&] { return run.session.picture(of_camera(run.session.camera_of(0), "a")); });
  run.session.stop();
  run.start();
  EXPECT_TRUE(waits.get().stale);
  run.stop();
  EXPECT_TRUE(run.session.picture(of_camera(run.session.camera_of(0), "b")).stale);
  EXPECT_EQ(run.ended_with, "");
}

}  // namespace
}  // namespace semfield
