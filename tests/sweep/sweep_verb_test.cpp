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
using testing_sweep::files_of_cells;
using testing_sweep::write_sweep;

// IDs of cells whose runs have taken a step.
std::vector<std::string> begun_cells(const std::string& out) {
  std::vector<std::string> ids;
  for (const auto& [id, rows] : files_of_cells(out, "run/metrics.jsonl")) {
    if (!rows.empty()) ids.push_back(id);
  }
  return ids;
}

template <class Condition>
bool wait_until(const Condition& condition) {
  for (int i = 0; i < 6000 && !condition(); ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  return condition();
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
  EXPECT_EQ(std::distance(fs::directory_iterator(out + "/scenes"), {}), 1);

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

TEST(SweepVerb, ASecondSweepOnTheFolderIsRefusedByName) {
  const std::string folder = fresh_folder("sweep_twice");
  const std::string file = write_sweep(folder, 100'000);
  const std::string out = folder + "/out";
  Process first(program(), {"sweep", file, "--out", out, "--jobs", "2"}, folder);
  ASSERT_TRUE(wait_until([&] { return !begun_cells(out).empty(); })) << first.err_so_far();
  const auto before = files_of_cells(out, "run/.lock");
  const std::string other = fresh_folder("other");
  Process again(program(), {"sweep", file, "--out", out}, other);
  const std::optional<Result> second = again.wait_for(120);
  ASSERT_TRUE(second.has_value()) << "it works beside the first";
  EXPECT_EQ(second->code, 73) << second->err;
  char host[256] = {};
  gethostname(host, sizeof host - 1);
  const std::string refused = "the sweep folder '" + out + "' is in use by process " + std::to_string(first.pid()) +
                              " on " + host + ", another sweep; wait for it to end, stop it";
  EXPECT_NE(second->err.find(refused), std::string::npos) << second->err;
  // Looking is allowed.
  const Result looked = semfield_run("sweep " + shell_word(file) + " --dry-run --out " + shell_word(out), other);
  EXPECT_EQ(looked.code, 0) << looked.err;
  for (const auto& [id, lock] : before) EXPECT_EQ(kill(std::stoi(lock), 0), 0) << "cell " << id << " was ended";
  EXPECT_FALSE(first.wait_for(0).has_value());
  first.send(SIGTERM);
  EXPECT_EQ(first.wait().code, 143);
}

// Its cells are held in the middle of their work when the sweep dies, so the next one finds them alive for certain.
TEST(SweepVerb, KilledAndStartedAtOnceItWaitsForItsOldCells) {
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
  const std::string other = fresh_folder("other");
  Process second(program(), {"sweep", file, "--out", out, "--jobs", "1"}, other);
  const std::string waits = "/cells/" + cell + ": process " + std::to_string(held) + " on ";
  EXPECT_TRUE(wait_until([&] { return second.err_so_far().find(waits) != std::string::npos; })) << second.err_so_far();
  EXPECT_TRUE(fs::exists(out + "/cells/" + cell + "/run/metrics.jsonl"));
  kill(held, SIGCONT);
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
  for (const auto& pack : fs::directory_iterator(out + "/scenes"))
    fs::resize_file(pack.path(), fs::file_size(pack.path()) / 2);
  fs::remove_all(out + "/cells");
  const Result r = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder);
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_NE(r.err.find("packing the scene 'room'"), std::string::npos) << r.err;
}

}  // namespace
}  // namespace semfield
