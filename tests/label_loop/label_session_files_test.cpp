// The folder of a labelling session: files that cannot be written for a while, a folder that is moved or copied, clicks
// that are lost, and a scene that has changed.
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <vector>

#include "loading/packed_scene.h"
#include "run/metrics_log.h"
#include "run/open_run.h"
#include "run/train_run.h"
#include "system/files.h"
#include "testkit/analytic_scene.h"
#include "tests/label_loop/running_session.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_loop;
using testing_train::TempDir;

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
    EXPECT_NE(troubled->trouble.find("checkpoints"), std::string::npos) << troubled->trouble;
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
  EXPECT_NE(run.ended_with.find("checkpoints"), std::string::npos) << run.ended_with;
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
  EXPECT_NE(read_text_file(table).find("wall"), std::string::npos);
  const ino_t before = inode_of(table);
  for (const char* id : {"2", "3", "4"}) run.session.apply(run.click(id, 2, "wall", {24.5, 5.5}));
  run.settled();
  run.session.save();
  EXPECT_EQ(inode_of(table), before) << "clicks change no class";
  run.session.apply(run.add("5", "floor"));
  run.settled();
  run.session.save();
  EXPECT_NE(inode_of(table), before);
  EXPECT_NE(read_text_file(table).find("floor"), std::string::npos);
}

// --- a folder that is moved, copied, or lacks its clicks ---

std::string resume_refusal(const std::string& folder) {
  try {
    RunConfig config = load_run_config(folder + "/run.yaml", {}, RunningSession::registry());
    const RunningSession run(std::move(config), folder);
  } catch (const Error& error) {
    return error.what();
  }
  return "";
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
  EXPECT_NE(read_text_file(here + "/run.yaml").find("clicks: clicks.jsonl"), std::string::npos);
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
    EXPECT_EQ(testing_room::error_of([&] { (void)open_run(folder, {}, RunningSession::registry(), findings); }), said);
    TrainRequest request;
    request.out_dir = folder;
    request.resume = true;
    EXPECT_EQ(testing_room::error_of(
                  [&] { (void)run_training(resumed(folder), RunningSession::registry(), request, nullptr); }),
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
            "scene: it is not as it was when the run was trained: other images; restore the data, or train anew "
            "[run.scene.changed]");
}

}  // namespace
}  // namespace semfield
