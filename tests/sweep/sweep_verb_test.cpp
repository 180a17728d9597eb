// `semfield sweep` as a program: cells in parallel, tables, going on after a kill, a failing cell.
#include <gtest/gtest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <thread>

#include "core/files.h"
#include "tests/program.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_program::Result;
using testing_program::semfield_run;
using testing_room::fresh_folder;

// Five frames, three of which train; two variants that train and one that fuses.
std::string write_sweep(const std::string& folder, int steps, const std::string& more = "") {
  fs::create_directories(folder + "/room");
  testing_room::write_replica(folder + "/room", 5);
  const std::string base = "include: " + std::string(SEMFIELD_SOURCE_DIR) +
                           "/configs/experiments/editions/hash_field.yaml\n" +
                           "scene: {type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1}\n"
                           "train: {steps: " +
                           std::to_string(steps) + ", rays: 64}\n";
  write_file_atomic(folder + "/base.yaml", std::string_view(base));
  const std::string sweep =
      "base: base.yaml\nsplit: train\nscenes: {room: {pack: true}}\nmetrics: [miou_present, given_miou_present]\n"
      "variants:\n"
      "  clean: {x: 0}\n"
      "  noisy: {x: 50, set: {scene.labels.degrade: [{type: pixel_noise, ratio: 0.5}]}}\n"
      "  fused: {fuse: {method: bayesian, field: noisy}, set: {scene.labels.degrade: [{type: pixel_noise, ratio: "
      "0.5}]}}\n" +
      more;
  write_file_atomic(folder + "/tiny.yaml", std::string_view(sweep));
  return folder + "/tiny.yaml";
}

TEST(SweepVerb, RunsEveryCellOnceAndWritesItsTables) {
  const std::string folder = fresh_folder("sweep");
  const std::string file = write_sweep(folder, 6);
  const std::string out = folder + "/out";
  Result r = semfield_run("sweep " + file + " --jobs 2 --out " + out, folder);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(r.out, "sweep: cells=3 done=3 failed=0 folder=" + out + "\n");
  const std::string csv = read_text_file(out + "/results.csv");
  EXPECT_NE(csv.find("tiny,room,clean,1,given_miou_present,1"), std::string::npos) << csv;
  EXPECT_NE(csv.find("tiny,room,noisy,1,miou_present,"), std::string::npos) << csv;
  EXPECT_NE(csv.find("tiny,room,fused,1,miou_present,"), std::string::npos) << csv;
  EXPECT_NE(read_text_file(out + "/tables.md").find("| fused |"), std::string::npos);
  EXPECT_TRUE(fs::exists(out + "/tiny.svg"));
  EXPECT_EQ(std::distance(fs::directory_iterator(out + "/scenes"), {}), 1);

  // Again: nothing runs, the same bytes.
  r = semfield_run("sweep " + file + " --out " + out, folder);
  EXPECT_EQ(r.code, 0);
  EXPECT_NE(r.err.find("3 of them done"), std::string::npos) << r.err;
  EXPECT_EQ(read_text_file(out + "/results.csv"), csv);
  fs::remove_all(folder);
}

TEST(SweepVerb, AFailingCellIsNamedAndTheOthersGoOn) {
  const std::string folder = fresh_folder("sweep_failing");
  // One labelled pixel source too few: label-balanced rays without any label.
  const std::string file =
      write_sweep(folder, 3, "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n");
  const Result r = semfield_run("sweep " + file + " --out " + folder + "/out", folder);
  EXPECT_EQ(r.code, 1);
  EXPECT_NE(r.err.find("broken, room, seed 1: exit code 65"), std::string::npos) << r.err;
  EXPECT_NE(r.err.find("no training pixel carries a label"), std::string::npos) << r.err;
  EXPECT_NE(r.out.find("done=3 failed=1"), std::string::npos) << r.out;
  fs::remove_all(folder);
}

// Stopped by SIGTERM while cells train: they save, nothing is left running, and the next start resumes them.
TEST(SweepVerb, GoesOnWhereItWasStopped) {
  const std::string folder = fresh_folder("sweep_stopped");
  const std::string file = write_sweep(folder, 400);
  const std::string out = folder + "/out";
  const pid_t pid = fork();
  if (pid == 0) {
    execl(SEMFIELD_BINARY, SEMFIELD_BINARY, "sweep", file.c_str(), "--out", out.c_str(), "--jobs", "2", "-q", nullptr);
    _exit(127);
  }
  const auto rows = [&] {
    int count = 0;
    if (!fs::exists(out + "/cells")) return 0;
    for (const auto& cell : fs::directory_iterator(out + "/cells")) {
      const fs::path log = cell.path() / "run" / "metrics.jsonl";
      if (fs::exists(log) && fs::file_size(log) > 0) ++count;
    }
    return count;
  };
  for (int i = 0; i < 3000 && rows() < 1; ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  ASSERT_GE(rows(), 1) << "no cell began to train";
  kill(pid, SIGTERM);
  int status = 0;
  waitpid(pid, &status, 0);
  EXPECT_EQ(WEXITSTATUS(status), 143);
  bool saved = false;
  for (const auto& cell : fs::directory_iterator(out + "/cells"))
    saved = saved || fs::exists(cell.path() / "run" / "checkpoints" / "latest");
  EXPECT_TRUE(saved);
  const Result r = semfield_run("sweep " + file + " --out " + out, folder);
  EXPECT_EQ(r.code, 0) << r.err;
  bool resumed = false;
  for (const auto& cell : fs::directory_iterator(out + "/cells")) {
    if (!fs::exists(cell.path() / "run" / "metrics.jsonl")) continue;
    const std::string log = read_text_file((cell.path() / "run" / "metrics.jsonl").string());
    resumed = resumed || log.find("\"step\":400") != std::string::npos;
  }
  EXPECT_TRUE(resumed);
  fs::remove_all(folder);
}

}  // namespace
}  // namespace semfield
