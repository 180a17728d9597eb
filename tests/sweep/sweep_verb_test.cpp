// `semfield sweep` as a program: cells in parallel, tables, going on after a kill, a failing cell.

#include <csignal>
#include <nlohmann/json.hpp>
#include <random>
#include <set>

#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_program;
using testing_room::fresh_folder;
using namespace testing_sweep;

// A tiny sweep in a folder of its own, and where its cells go.
struct TinySweep {
  std::string folder, file, out;

  TinySweep(const std::string& name, int steps, const std::string& more = "")
      : folder(fresh_folder(name)), file(write_sweep(folder, steps, more)), out(folder + "/out") {}
  Result run(const std::string& more = "") const {
    return semfield_run("sweep " + shell_word(file) + more + " --out " + shell_word(out), folder);
  }
};

std::vector<fs::path> packs_of(const std::string& out) {
  std::vector<fs::path> found;
  for (const auto& entry : fs::directory_iterator(out + "/scenes")) {
    if (entry.path().extension() == ".sfpack") found.push_back(entry.path());
  }
  return found;
}

TEST(SweepVerb, RunsEveryCellOnceAndWritesItsTables) {
  const TinySweep at("sweep", 6);
  Result r = succeeded(at.run(" --jobs 2"));
  EXPECT_EQ(r.out, "sweep: cells=3 done=3 failed=0 folder=" + at.out + "\n");
  const std::string csv = read_text_file(at.out + "/results.csv");
  EXPECT_HAS(csv, "tiny,room,clean,1,given_miou_present,1", "tiny,room,noisy,1,miou_present,",
             "tiny,room,fused,1,miou_present,");
  EXPECT_HAS(read_text_file(at.out + "/tables.md"), "| fused |");
  EXPECT_HAS(read_text_file(at.out + "/tables.html"), "\"experiments\"", "\"fused\"");
  EXPECT_EQ(packs_of(at.out).size(), 1U);

  // Again, from another working folder: nothing runs, the same bytes.
  r = semfield_run("sweep " + shell_word(at.file) + " --out " + shell_word(at.out), fresh_folder("elsewhere"));
  EXPECT_ENDED(r, 0, "3 of them done");
  EXPECT_EQ(read_text_file(at.out + "/results.csv"), csv);
}

// Stopped by SIGTERM while cells train: they save, nothing is left running, and the next start resumes them.
TEST(SweepVerb, GoesOnWhereItWasStopped) {
  const TinySweep at("sweep_stopped", 200);
  Process sweep(program(), {"sweep", at.file, "--out", at.out, "--jobs", "2", "-q"}, at.folder);
  ASSERT_TRUE(wait_until([&] { return !begun_cells(at.out).empty(); })) << "no cell began to train";
  sweep.send(SIGTERM);
  EXPECT_EQ(sweep.wait().code, 143);
  EXPECT_FALSE(files_of_cells(at.out, "run/checkpoints/latest").empty());
  const Result r = succeeded(at.run());
  bool resumed = false;
  for (const auto& [id, rows] : files_of_cells(at.out, "run/metrics.jsonl"))
    resumed = resumed || rows.find("\"step\":200") != std::string::npos;
  EXPECT_TRUE(resumed);
}

// A terminal sends Ctrl-C to every process of the group: a cell must not take it as its first signal and the sweep's as
// the second, which ends at once.
TEST(SweepVerb, CtrlCOfATerminalLetsCellsSave) {
  const TinySweep at("sweep_ctrl_c", 100'000);
  Process sweep("/usr/bin/setsid", {program(), "sweep", at.file, "--out", at.out, "--jobs", "2"}, at.folder);
  ASSERT_TRUE(wait_until([&] { return begun_cells(at.out).size() == 2; })) << sweep.err_so_far();
  const auto runs = files_of_cells(at.out, "run/.lock");
  EXPECT_EQ(runs.size(), 2U);
  for (const auto& [id, lock] : runs) EXPECT_NE(getpgid(std::stoi(lock)), sweep.pid());
  ASSERT_EQ(kill(-sweep.pid(), SIGINT), 0);
  EXPECT_EQ(sweep.wait().code, 130);
  for (const auto& [id, lock] : runs)
    EXPECT_TRUE(fs::exists(at.out + "/cells/" + id + "/run/checkpoints/latest")) << id;
}

// A cell that outlives its sweep holds the cell's lock until it has saved; here the test does.
TEST(SweepVerb, KilledAndStartedAgainItWaitsForItsOldCells) {
  const TinySweep at("sweep_killed", 200);
  int held = 0;
  std::string cell;
  {
    Process first(program(), {"sweep", at.file, "--out", at.out, "--jobs", "1"}, at.folder);
    ASSERT_TRUE(wait_until([&] { return !begun_cells(at.out).empty(); })) << first.err_so_far();
    cell = begun_cells(at.out).front();
    held = std::stoi(read_text_file(at.out + "/cells/" + cell + "/run/.lock"));
    ASSERT_EQ(kill(held, SIGSTOP), 0);
  }  // killed
  kill(held, SIGCONT);
  FolderLock old;
  ASSERT_TRUE(wait_until([&] { return old.take(at.out + "/cells/" + cell) == 0; })) << "its cell does not end";
  EXPECT_TRUE(fs::exists(at.out + "/cells/" + cell + "/run/checkpoints/latest"));
  const std::string other = fresh_folder("other");
  Process second(program(), {"sweep", at.file, "--out", at.out, "--jobs", "1"}, other);
  const std::string waits = "/cells/" + cell + ": process " + std::to_string(getpid()) + " on ";
  EXPECT_TRUE(wait_until([&] { return second.err_so_far().find(waits) != std::string::npos; })) << second.err_so_far();
  EXPECT_TRUE(fs::exists(at.out + "/cells/" + cell + "/run/metrics.jsonl"));
  old = {};
  const Result r = succeeded(second.wait());
  EXPECT_HAS(r.out, "cells=3 done=3 failed=0") << r.out << r.err;
  // What it had learned is not lost: the run was gone on with.
  const std::string words = read_text_file(at.out + "/cells/" + cell + "/result.json");
  EXPECT_LACKS(words, "processor_s");
}

TEST(SweepVerb, ADamagedPackIsMadeAgain) {
  const TinySweep at("sweep_pack", 3);
  ASSERT_EQ(at.run().code, 0);
  for (const fs::path& pack : packs_of(at.out)) fs::resize_file(pack, fs::file_size(pack) / 2);
  fs::remove_all(at.out + "/cells");
  const Result r = succeeded(at.run());
  EXPECT_HAS(r.err, "packing the scene 'room'");
}

// Two processes of one sweep side by side in its folder, killed at random moments and started again: no result is lost
// or changed.

constexpr std::size_t kCells = 6;

// What is measured of a process differs from run to run; everything else has the same bits.
std::string without_times(const std::string& result) {
  nlohmann::ordered_json root = nlohmann::ordered_json::parse(result);
  for (const char* name : {"train_s", "processor_s", "peak_mb"}) root["values"].erase(name);
  return root.dump();
}

// 0: all done. 128 + n: stopped in order. A SIGKILL, or a SIGTERM before the handler is
// there, ends it by the signal.
void expect_documented(const Result& r, int sent) {
  const bool documented = r.code == 0 || (r.code == 143 && sent == SIGTERM) || r.signal == sent;
  EXPECT_TRUE(documented) << "code " << r.code << ", signal " << r.signal << ", sent " << sent << "\n" << r.err;
}

// SEMFIELD_SWEEP_KILLS: starts and kills of both together; scripts/release_check sweep_torture gives it.
TEST(SweepTorture, KillsOfTwoProcessesSideBySideLoseNoResult) {
  const char* const asked = std::getenv("SEMFIELD_SWEEP_KILLS");
  const int kills = asked != nullptr ? std::atoi(asked) : 6;
  const std::string folder = fresh_folder("torture");
  const std::string file = write_sweep(folder, 60, "seeds: [1, 2]\n");
  const std::string whole = folder + "/whole";
  const auto begin = std::chrono::steady_clock::now();
  ASSERT_EQ(semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(whole), folder).code, 0);
  const double whole_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  const std::map<std::string, std::string> expected = files_of_cells(whole, "result.json");
  ASSERT_EQ(expected.size(), kCells);

  std::mt19937 random(1);  // the moments are the machine's, the choices are not
  const auto moment = [&] {
    return std::chrono::duration<double>(0.4 * whole_s * static_cast<double>(random()) / 4294967296.0);
  };
  int sweeps = 0, resumed = 0;
  for (int killed = 0; killed < kills; ++sweeps) {
    const std::string out = folder + "/out" + std::to_string(sweeps);
    std::map<std::string, std::string> done;
    while (killed < kills && done.size() < kCells) {
      const std::string of_a = fresh_folder("a"), of_b = fresh_folder("b");
      const std::vector<std::string> words{"sweep", file, "--out", out, "--jobs", "2"};
      Process a(program(), words, of_a);
      std::this_thread::sleep_for(moment() / 10);
      Process b(program(), words, of_b);
      for (Process* process : random() % 2 == 0 ? std::array{&a, &b} : std::array{&b, &a}) {
        std::this_thread::sleep_for(moment());
        const int signal = random() % 3 == 0 ? SIGTERM : SIGKILL;
        process->send(signal);
        const Result r = process->wait();
        expect_documented(r, signal);
        ++killed;
      }
      const std::map<std::string, std::string> now = files_of_cells(out, "result.json");
      for (const auto& [id, result] : done) {
        ASSERT_TRUE(now.contains(id)) << "the result of " << id << " is gone after " << killed << " kills";
        ASSERT_EQ(now.at(id), result) << "another result of " << id << " after " << killed << " kills";
      }
      done = now;
    }
    const Result last =
        succeeded(semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(out), folder));
    const std::map<std::string, std::string> ended = files_of_cells(out, "result.json");
    for (const auto& [id, result] : done) EXPECT_EQ(ended.at(id), result);
    ASSERT_EQ(ended.size(), kCells);
    for (const auto& [id, result] : ended) {
      EXPECT_EQ(without_times(result), without_times(expected.at(id))) << id;
      if (result.find("processor_s") == std::string::npos) ++resumed;
    }
    EXPECT_HAS(last.out, "cells=6 done=6 failed=0");
    fs::remove_all(out);
  }
  std::printf("sweep torture: kills=%d sweeps=%d resumed_cells=%d lost=0 changed=0\n", kills, sweeps, resumed);
}

// Several processes of one sweep, started by hand on one folder: they share the cells, and what they leave is what one
// process leaves.

std::size_t count_of(const std::string& text, const std::string& word) {
  std::size_t count = 0;
  for (std::size_t at = text.find(word); at != std::string::npos; at = text.find(word, at + word.size())) ++count;
  return count;
}

TEST(SweepShared, TwoProcessesRunEveryCellOnceAndLeaveTheFilesOfOne) {
  const std::string folder = fresh_folder("shared");
  const std::string file = write_sweep(folder, 40, "seeds: [1, 2]\n");
  const std::string one = folder + "/one", both = folder + "/both";
  ASSERT_EQ(semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(one), folder).code, 0);
  const std::vector<std::string> words{"sweep", file, "--jobs", "1", "--out", both};
  Process a(program(), words, fresh_folder("a")), b(program(), words, fresh_folder("b"));
  const Result of_a = succeeded(a.wait()), of_b = b.wait();
  EXPECT_EQ(of_b.code, 0) << of_b.err;
  // Each reports the end of the whole sweep, and of its cells alone.
  EXPECT_EQ(of_a.out, "sweep: cells=6 done=6 failed=0 folder=" + both + "\n");
  EXPECT_EQ(of_b.out, of_a.out);
  EXPECT_EQ(count_of(of_a.err, "/6] ") + count_of(of_b.err, "/6] "), 6U) << of_a.err << of_b.err;
  EXPECT_GT(count_of(of_a.err, "/6] "), 0U) << of_a.err;
  EXPECT_GT(count_of(of_b.err, "/6] "), 0U) << of_b.err;
  EXPECT_EQ(count_of(of_a.err, "packing the scene") + count_of(of_b.err, "packing the scene"), 1U);

  EXPECT_EQ(results_without_times(both), results_without_times(one));
  for (const char* name : {"tables.md", "cells.csv", "tiny.csv", "tables.html"})
    EXPECT_EQ(read_text_file(both + "/" + name), read_text_file(one + "/" + name)) << name;
  const auto names = [](const std::string& out) {
    std::set<std::string> found;
    for (const auto& entry : fs::recursive_directory_iterator(out)) {
      const std::string name = fs::relative(entry.path(), out).string();
      // Named by the moment and the process that wrote it.
      if (name.find("events.out") == std::string::npos) found.insert(name);
    }
    return found;
  };
  EXPECT_EQ(names(both), names(one));
}

TEST(SweepShared, AFailedCellIsTriedByOneAndByTheNextSweepAgain) {
  const TinySweep at("shared_failing", 60,
                     "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n");
  const std::vector<std::string> words{"sweep", at.file, "--jobs", "1", "--out", at.out};
  Process a(program(), words, fresh_folder("a")), b(program(), words, fresh_folder("b"));
  const Result of_a = a.wait(), of_b = b.wait();
  EXPECT_EQ(of_a.code, 1) << of_a.err;
  EXPECT_EQ(of_b.code, 1) << of_b.err;
  EXPECT_EQ(of_a.out, "sweep: cells=4 done=3 failed=1 folder=" + at.out + "\n");
  EXPECT_EQ(of_b.out, of_a.out);
  const std::string broken = "broken, room, seed 1: exit code 65";
  EXPECT_EQ(count_of(of_a.err, broken) + count_of(of_b.err, broken), 1U) << of_a.err << of_b.err;
  const auto failures = files_of_cells(at.out, "failure.txt");
  ASSERT_EQ(failures.size(), 1U);
  EXPECT_HAS(failures.begin()->second, "no training pixel carries a label");

  const Result next = at.run();
  EXPECT_EQ(next.code, 1);
  EXPECT_EQ(count_of(next.err, broken), 1U) << next.err;
  EXPECT_HAS(next.err, "no training pixel carries a label");
  EXPECT_EQ(next.out, of_a.out);
}

// The cell is held in the middle of its work while its sweep dies, so that the other process finds it unfinished.
TEST(SweepShared, TheCellOfAKilledProcessIsTakenUp) {
  const TinySweep at("shared_killed", 200);
  const std::string one = at.folder + "/one";
  const std::vector<std::string> words{"sweep", at.file, "--jobs", "1", "--out", at.out};
  std::string cell;
  int held = 0;
  std::optional<Process> first, second;
  first.emplace(program(), words, fresh_folder("a"));
  ASSERT_TRUE(wait_until([&] { return !begun_cells(at.out).empty(); })) << first->err_so_far();
  cell = begun_cells(at.out).front();
  held = std::stoi(read_text_file(at.out + "/cells/" + cell + "/run/.lock"));
  ASSERT_EQ(kill(held, SIGSTOP), 0);
  second.emplace(program(), words, fresh_folder("b"));
  const std::string shares = "process " + std::to_string(first->pid()) + " on ";
  ASSERT_TRUE(wait_until([&] { return second->err_so_far().find(shares) != std::string::npos; }))
      << second->err_so_far();
  first.reset();  // killed
  kill(held, SIGCONT);
  const Result r = succeeded(second->wait());
  EXPECT_EQ(r.out, "sweep: cells=3 done=3 failed=0 folder=" + at.out + "\n");
  // It was gone on with, so nobody knows what it took in all.
  const std::string result = read_text_file(at.out + "/cells/" + cell + "/result.json");
  EXPECT_LACKS(result, "processor_s");
  ASSERT_EQ(semfield_run("sweep " + shell_word(at.file) + " --out " + shell_word(one), at.folder).code, 0);
  EXPECT_EQ(results_without_times(at.out), results_without_times(one));
}

TEST(SweepShared, AnotherSweepOnTheFolderIsRefusedByName) {
  const TinySweep at("shared_other", 100'000);
  Process first(program(), {"sweep", at.file, "--out", at.out, "--jobs", "2"}, at.folder);
  ASSERT_TRUE(wait_until([&] { return !begun_cells(at.out).empty(); })) << first.err_so_far();
  const auto before = files_of_cells(at.out, "run/.lock");
  const std::string other = fresh_folder("other");
  const std::string other_file = write_sweep(other, 99'999);
  Process again(program(), {"sweep", other_file, "--out", at.out}, other);
  const std::optional<Result> second = again.wait_for(120);
  ASSERT_TRUE(second.has_value()) << "it works beside the first";
  EXPECT_EQ(second->code, 73) << second->err;
  char host[256] = {};
  gethostname(host, sizeof host - 1);
  const std::string refused = "the sweep folder '" + at.out + "' is in use by process " + std::to_string(first.pid()) +
                              " on " + host + ", another sweep with other cells; wait for it to end, stop it";
  EXPECT_HAS(second->err, refused);
  // Looking is allowed.
  const Result looked =
      succeeded(semfield_run("sweep " + shell_word(at.file) + " --dry-run --out " + shell_word(at.out), other));
  for (const auto& [id, lock] : before) EXPECT_EQ(kill(std::stoi(lock), 0), 0) << "cell " << id << " was ended";
  EXPECT_FALSE(first.wait_for(0).has_value());
  first.send(SIGTERM);
  EXPECT_EQ(first.wait().code, 143);
}

TEST(SweepShared, DevicesThatAreNotThereAreRefused) {
  const TinySweep at("shared_devices", 3);
  const auto refusal = [&](const std::string& words, int code) {
    const Result r = at.run(" " + words);
    EXPECT_EQ(r.code, code) << r.err;
    return r.err;
  };
  // No device of the machine is seen by tests.
  EXPECT_HAS(refusal("--devices all", 69), "--devices all: ");
  EXPECT_HAS(refusal("--devices 1,0", 69), "--devices: no cuda:1: ");
  EXPECT_HAS(refusal("--devices 0,all", 2), "--devices: 'all' is not a CUDA device");
  EXPECT_HAS(refusal("--devices 0 --jobs 2", 2), "--jobs");
  EXPECT_FALSE(fs::exists(at.out));
}

}  // namespace
}  // namespace semfield
