// `semfield sweep` as a program: cells in parallel, tables, going on after a kill, a failing cell.
#include <gtest/gtest.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <string>
#include <thread>
#include <vector>

#include "system/files.h"
#include "system/folder_lock.h"
#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_program::Process;
using testing_program::program;
using testing_program::Result;
using testing_program::semfield_run;
using testing_room::fresh_folder;
using testing_sweep::begun_cells;
using testing_sweep::files_of_cells;
using testing_sweep::wait_until;
using testing_sweep::write_sweep;

std::vector<fs::path> packs_of(const std::string& out) {
  std::vector<fs::path> found;
  for (const auto& entry : fs::directory_iterator(out + "/scenes")) {
    if (entry.path().extension() == ".sfpack") found.push_back(entry.path());
  }
  return found;
}

TEST(SweepVerb, RunsEveryCellOnceAndWritesItsTables) {
  const std::string folder = fresh_folder("sweep");
  const std::string file = write_sweep(folder, 6);
  const std::string out = folder + "/out";
  Result r = semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(out), folder);
  ASSERT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(r.out, "sweep: cells=3 done=3 failed=0 folder=" + out + "\n");
  const std::string csv = read_text_file(out + "/results.csv");
  EXPECT_NE(csv.find("tiny,room,clean,1,given_miou_present,1"), std::string::npos) << csv;
  EXPECT_NE(csv.find("tiny,room,noisy,1,miou_present,"), std::string::npos) << csv;
  EXPECT_NE(csv.find("tiny,room,fused,1,miou_present,"), std::string::npos) << csv;
  EXPECT_NE(read_text_file(out + "/tables.md").find("| fused |"), std::string::npos);
  EXPECT_TRUE(fs::exists(out + "/tiny.svg"));
  EXPECT_EQ(packs_of(out).size(), 1U);

  // Again, from another working folder: nothing runs, the same bytes.
  r = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), fresh_folder("elsewhere"));
  EXPECT_EQ(r.code, 0);
  EXPECT_NE(r.err.find("3 of them done"), std::string::npos) << r.err;
  EXPECT_EQ(read_text_file(out + "/results.csv"), csv);
}

TEST(SweepVerb, AFailingCellIsNamedAndTheOthersGoOn) {
  const std::string folder = fresh_folder("sweep_failing");
  // One labelled pixel source too few: label-balanced rays without any label.
  const std::string file =
      write_sweep(folder, 3, "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n");
  const Result r = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(folder + "/out"), folder);
  EXPECT_EQ(r.code, 1);
  EXPECT_NE(r.err.find("broken, room, seed 1: exit code 65"), std::string::npos) << r.err;
  EXPECT_NE(r.err.find("no training pixel carries a label"), std::string::npos) << r.err;
  EXPECT_NE(r.out.find("done=3 failed=1"), std::string::npos) << r.out;
}

// Stopped by SIGTERM while cells train: they save, nothing is left running, and the next start resumes them.
TEST(SweepVerb, GoesOnWhereItWasStopped) {
  const std::string folder = fresh_folder("sweep_stopped");
  const std::string file = write_sweep(folder, 200);
  const std::string out = folder + "/out";
  Process sweep(program(), {"sweep", file, "--out", out, "--jobs", "2", "-q"}, folder);
  ASSERT_TRUE(wait_until([&] { return !begun_cells(out).empty(); })) << "no cell began to train";
  sweep.send(SIGTERM);
  EXPECT_EQ(sweep.wait().code, 143);
  EXPECT_FALSE(files_of_cells(out, "run/checkpoints/latest").empty());
  const Result r = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder);
  EXPECT_EQ(r.code, 0) << r.err;
  bool resumed = false;
  for (const auto& [id, rows] : files_of_cells(out, "run/metrics.jsonl"))
    resumed = resumed || rows.find("\"step\":200") != std::string::npos;
  EXPECT_TRUE(resumed);
}

// A terminal sends Ctrl-C to every process of the group: a cell must not take it as its first signal and the sweep's as
// the second, which ends at once.
TEST(SweepVerb, CtrlCOfATerminalLetsCellsSave) {
  const std::string folder = fresh_folder("sweep_ctrl_c");
  const std::string file = write_sweep(folder, 100'000);
  const std::string out = folder + "/out";
  Process sweep("/usr/bin/setsid", {program(), "sweep", file, "--out", out, "--jobs", "2"}, folder);
  ASSERT_TRUE(wait_until([&] { return begun_cells(out).size() == 2; })) << sweep.err_so_far();
  const auto runs = files_of_cells(out, "run/.lock");
  EXPECT_EQ(runs.size(), 2U);
  for (const auto& [id, lock] : runs) EXPECT_NE(getpgid(std::stoi(lock)), sweep.pid());
  ASSERT_EQ(kill(-sweep.pid(), SIGINT), 0);
  EXPECT_EQ(sweep.wait().code, 130);
  for (const auto& [id, lock] : runs) EXPECT_TRUE(fs::exists(out + "/cells/" + id + "/run/checkpoints/latest")) << id;
}

// A cell that outlives its sweep holds the cell's lock until it has saved; here the test does.
TEST(SweepVerb, KilledAndStartedAgainItWaitsForItsOldCells) {
  const std::string folder = fresh_folder("sweep_killed");
  const std::string file = write_sweep(folder, 200);
  const std::string out = folder + "/out";
  int held = 0;
  std::string cell;
  {
    Process first(program(), {"sweep", file, "--out", out, "--jobs", "1"}, folder);
    ASSERT_TRUE(wait_until([&] { return !begun_cells(out).empty(); })) << first.err_so_far();
    cell = begun_cells(out).front();
    held = std::stoi(read_text_file(out + "/cells/" + cell + "/run/.lock"));
    ASSERT_EQ(kill(held, SIGSTOP), 0);
  }  // killed
  kill(held, SIGCONT);
  FolderLock old;
  ASSERT_TRUE(wait_until([&] { return old.take(out + "/cells/" + cell) == 0; })) << "its cell does not end";
  EXPECT_TRUE(fs::exists(out + "/cells/" + cell + "/run/checkpoints/latest"));
  const std::string other = fresh_folder("other");
  Process second(program(), {"sweep", file, "--out", out, "--jobs", "1"}, other);
  const std::string waits = "/cells/" + cell + ": process " + std::to_string(getpid()) + " on ";
  EXPECT_TRUE(wait_until([&] { return second.err_so_far().find(waits) != std::string::npos; })) << second.err_so_far();
  EXPECT_TRUE(fs::exists(out + "/cells/" + cell + "/run/metrics.jsonl"));
  old = {};
  const Result r = second.wait();
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_NE(r.out.find("cells=3 done=3 failed=0"), std::string::npos) << r.out << r.err;
  // What it had learned is not lost: the run was gone on with.
  const std::string words = read_text_file(out + "/cells/" + cell + "/result.json");
  EXPECT_EQ(words.find("processor_s"), std::string::npos) << words;
}

TEST(SweepVerb, ADamagedPackIsMadeAgain) {
  const std::string folder = fresh_folder("sweep_pack");
  const std::string file = write_sweep(folder, 3);
  const std::string out = folder + "/out";
  ASSERT_EQ(semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder).code, 0);
  for (const fs::path& pack : packs_of(out)) fs::resize_file(pack, fs::file_size(pack) / 2);
  fs::remove_all(out + "/cells");
  const Result r = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder);
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_NE(r.err.find("packing the scene 'room'"), std::string::npos) << r.err;
}

}  // namespace
}  // namespace semfield
