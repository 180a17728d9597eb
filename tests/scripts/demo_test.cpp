// `semfield demo`: what it leaves in an empty folder, and what it does to one that is not empty.
#include <filesystem>
#include <regex>

#include "tests/program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_program;

class Demo : public testing::Test {
 protected:
  Result run(const std::string& words) const { return semfield_run("demo " + words, root_.string()); }
  Result small(const std::string& words) const {
    return run(words +
               " --set scene.frames=6 --set scene.test_frames=2 --set scene.width_px=40 --set scene.height_px=30"
               " --set passes.0.position.finest_resolution=32");
  }

  const TempDir dir_;
  const fs::path root_ = dir_.path();
};

TEST_F(Demo, LabelsTheShippedRoomInAnEmptyFolder) {
  const Result r = small("--steps 20");
  ASSERT_EQ(r.code, 0) << r.err;
  const std::regex line(
      "demo: miou_present=\\S+ total_accuracy=\\S+ psnr=\\S+ absrel=\\S+ train_s=\\S+ report=runs/demo/report.html\n");
  EXPECT_TRUE(std::regex_match(r.out, line)) << r.out;
  for (const char* made : {"report.html", "mesh.ply", "mesh.glb", "render/test"})
    EXPECT_TRUE(fs::exists(root_ / "runs/demo" / made)) << made;
  EXPECT_HAS(r.err, "in " + (root_ / "runs/demo").string(), "train quickstart ");

  // The next one takes the place of its own run alone, and only when its words are right.
  const std::string before = read_text_file((root_ / "runs/demo/run.yaml").string());
  EXPECT_EQ(run("--steps x").code, 2);
  EXPECT_EQ(run("--time x").code, 2);
  EXPECT_EQ(read_text_file((root_ / "runs/demo/run.yaml").string()), before);
  const Result again = small("--steps 10 --quiet");
  EXPECT_EQ(again.code, 0) << again.err;
  EXPECT_EQ(again.err, "");
  EXPECT_HAS(read_text_file((root_ / "runs/demo/run.yaml").string()), "steps: 10");

  const Result json = small("--steps 5 --quiet --json");
  EXPECT_EQ(json.code, 0) << json.err;
  const std::regex object(R"re(\{"semfield":"[^"]+","verb":"demo","run":"[^"]+","step":5,.*\}\n)re");
  EXPECT_TRUE(std::regex_match(json.out, object)) << json.out;
}

TEST_F(Demo, LeavesFoldersOfOthersAlone) {
  dir_.write("runs/demo/notes.txt", "mine");
  EXPECT_ENDED(run(""), 73, "'runs/demo' is there already and is not an earlier demo; name a new folder with --out");
  EXPECT_TRUE(fs::exists(root_ / "runs/demo/notes.txt"));
  // A run of somebody's, even of that name.
  write_file_atomic((root_ / "runs/demo/run.yaml").string(), "name: demo\nscene: {root: /elsewhere}\n");
  EXPECT_EQ(run("").code, 73);
  EXPECT_TRUE(fs::exists(root_ / "runs/demo/notes.txt"));
  dir_.write("named/notes.txt", "mine");
  const Result named = small("--out named --steps 5");
  EXPECT_EQ(named.code, 73) << named.err;
  EXPECT_TRUE(fs::exists(root_ / "named/notes.txt"));
}

// Runs the demo until it has said `sign`, and sends `signal` to it alone.
TEST_F(Demo, ASignalStopsItInOrder) {
  const auto stopped = [&](const std::string& frames, const std::string& sign, int signal) {
    const std::string here = fs::current_path().string();
    fs::current_path(root_);
    testing_program::Process demo(testing_program::program(),
                                  {"demo", "--steps", "1000000", "--set", "scene.frames=" + frames, "--set",
                                   "scene.test_frames=2", "--set", "scene.width_px=40", "--set", "scene.height_px=30"},
                                  root_.string());
    fs::current_path(here);
    for (int i = 0; i < 3000 && demo.err_so_far().find(sign) == std::string::npos; ++i)
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    demo.send(signal);
    return demo.wait();
  };
  // While the scene is read nothing is saved yet; the next demo may have the folder.
  const Result early = stopped("2000", "$ ", SIGINT);
  EXPECT_EQ(early.code, 130) << early.err;
  EXPECT_FALSE(fs::exists(root_ / "runs/demo/run.yaml"));
  const Result late = stopped("6", "step ", SIGTERM);
  EXPECT_ENDED(late, 143, "resume with `semfield train --resume runs/demo`");
  EXPECT_TRUE(fs::exists(root_ / "runs/demo/checkpoints/latest"));
  EXPECT_EQ(late.out, "");
}

TEST_F(Demo, SaysWhereItCannotWrite) {
  dir_.write("runs", "mine");  // a file
  const Result r = small("--steps 5");
  EXPECT_ENDED(r, 73, "--out");
  EXPECT_LACKS(r.err, "$ ") << "told before anything is read: " << r.err;
}

TEST_F(Demo, TheScriptHasHelp) {
  const std::string out = (root_ / "help").string();
  ASSERT_EQ(std::system((shell_word(SEMFIELD_SOURCE_DIR "/scripts/demo") + " --help >" + shell_word(out)).c_str()), 0);
  EXPECT_HAS(read_text_file(out), "./scripts/demo [FOLDER]");
}

}  // namespace
}  // namespace semfield
