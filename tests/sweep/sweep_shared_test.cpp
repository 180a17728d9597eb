// Several processes of one sweep, started by hand on one folder: they share the cells, and what they leave is what one
// process leaves.
#include <csignal>
#include <set>

#include "system/files.h"
#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using namespace testing_program;
using testing_room::fresh_folder;
using namespace testing_sweep;

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
  const Result of_a = a.wait(), of_b = b.wait();
  EXPECT_EQ(of_a.code, 0) << of_a.err;
  EXPECT_EQ(of_b.code, 0) << of_b.err;
  // Each reports the end of the whole sweep, and of its cells alone.
  EXPECT_EQ(of_a.out, "sweep: cells=6 done=6 failed=0 folder=" + both + "\n");
  EXPECT_EQ(of_b.out, of_a.out);
  EXPECT_EQ(count_of(of_a.err, "/6] ") + count_of(of_b.err, "/6] "), 6U) << of_a.err << of_b.err;
  EXPECT_GT(count_of(of_a.err, "/6] "), 0U) << of_a.err;
  EXPECT_GT(count_of(of_b.err, "/6] "), 0U) << of_b.err;
  EXPECT_EQ(count_of(of_a.err, "packing the scene") + count_of(of_b.err, "packing the scene"), 1U);

  EXPECT_EQ(results_without_times(both), results_without_times(one));
  for (const char* name : {"tables.md", "cells.csv", "tiny.csv", "tiny.svg"})
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
  const std::string folder = fresh_folder("shared_failing");
  const std::string file =
      write_sweep(folder, 60, "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n");
  const std::string out = folder + "/out";
  const std::vector<std::string> words{"sweep", file, "--jobs", "1", "--out", out};
  Process a(program(), words, fresh_folder("a")), b(program(), words, fresh_folder("b"));
  const Result of_a = a.wait(), of_b = b.wait();
  EXPECT_EQ(of_a.code, 1) << of_a.err;
  EXPECT_EQ(of_b.code, 1) << of_b.err;
  EXPECT_EQ(of_a.out, "sweep: cells=4 done=3 failed=1 folder=" + out + "\n");
  EXPECT_EQ(of_b.out, of_a.out);
  const std::string broken = "broken, room, seed 1: exit code 65";
  EXPECT_EQ(count_of(of_a.err, broken) + count_of(of_b.err, broken), 1U) << of_a.err << of_b.err;
  const auto failures = files_of_cells(out, "failure.txt");
  ASSERT_EQ(failures.size(), 1U);
  EXPECT_HAS(failures.begin()->second, "no training pixel carries a label");

  const Result next = semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder);
  EXPECT_EQ(next.code, 1);
  EXPECT_EQ(count_of(next.err, broken), 1U) << next.err;
  EXPECT_EQ(next.out, of_a.out);
}

// The cell is held in the middle of its work while its sweep dies, so that the other process finds it unfinished.
TEST(SweepShared, TheCellOfAKilledProcessIsTakenUp) {
  const std::string folder = fresh_folder("shared_killed");
  const std::string file = write_sweep(folder, 200);
  const std::string out = folder + "/out", one = folder + "/one";
  const std::vector<std::string> words{"sweep", file, "--jobs", "1", "--out", out};
  std::string cell;
  int held = 0;
  std::optional<Process> first, second;
  first.emplace(program(), words, fresh_folder("a"));
  ASSERT_TRUE(wait_until([&] { return !begun_cells(out).empty(); })) << first->err_so_far();
  cell = begun_cells(out).front();
  held = std::stoi(read_text_file(out + "/cells/" + cell + "/run/.lock"));
  ASSERT_EQ(kill(held, SIGSTOP), 0);
  second.emplace(program(), words, fresh_folder("b"));
  const std::string shares = "process " + std::to_string(first->pid()) + " on ";
  ASSERT_TRUE(wait_until([&] { return second->err_so_far().find(shares) != std::string::npos; }))
      << second->err_so_far();
  first.reset();  // killed
  kill(held, SIGCONT);
  const Result r = second->wait();
  EXPECT_EQ(r.code, 0) << r.err;
  EXPECT_EQ(r.out, "sweep: cells=3 done=3 failed=0 folder=" + out + "\n");
  // It was gone on with, so nobody knows what it took in all.
  const std::string result = read_text_file(out + "/cells/" + cell + "/result.json");
  EXPECT_LACKS(result, "processor_s");
  ASSERT_EQ(semfield_run("sweep " + shell_word(file) + " --out " + shell_word(one), folder).code, 0);
  EXPECT_EQ(results_without_times(out), results_without_times(one));
}

TEST(SweepShared, AnotherSweepOnTheFolderIsRefusedByName) {
  const std::string folder = fresh_folder("shared_other");
  const std::string file = write_sweep(folder, 100'000);
  const std::string out = folder + "/out";
  Process first(program(), {"sweep", file, "--out", out, "--jobs", "2"}, folder);
  ASSERT_TRUE(wait_until([&] { return !begun_cells(out).empty(); })) << first.err_so_far();
  const auto before = files_of_cells(out, "run/.lock");
  const std::string other = fresh_folder("other");
  const std::string other_file = write_sweep(other, 99'999);
  Process again(program(), {"sweep", other_file, "--out", out}, other);
  const std::optional<Result> second = again.wait_for(120);
  ASSERT_TRUE(second.has_value()) << "it works beside the first";
  EXPECT_EQ(second->code, 73) << second->err;
  char host[256] = {};
  gethostname(host, sizeof host - 1);
  const std::string refused = "the sweep folder '" + out + "' is in use by process " + std::to_string(first.pid()) +
                              " on " + host + ", another sweep with other cells; wait for it to end, stop it";
  EXPECT_HAS(second->err, refused);
  // Looking is allowed.
  const Result looked = semfield_run("sweep " + shell_word(file) + " --dry-run --out " + shell_word(out), other);
  EXPECT_EQ(looked.code, 0) << looked.err;
  for (const auto& [id, lock] : before) EXPECT_EQ(kill(std::stoi(lock), 0), 0) << "cell " << id << " was ended";
  EXPECT_FALSE(first.wait_for(0).has_value());
  first.send(SIGTERM);
  EXPECT_EQ(first.wait().code, 143);
}

TEST(SweepShared, DevicesThatAreNotThereAreRefused) {
  const std::string folder = fresh_folder("shared_devices");
  const std::string file = write_sweep(folder, 3);
  const auto refusal = [&](const std::string& words, int code) {
    const Result r =
        semfield_run("sweep " + shell_word(file) + " --out " + shell_word(folder + "/out") + " " + words, folder);
    EXPECT_EQ(r.code, code) << r.err;
    return r.err;
  };
  // No device of the machine is seen by tests.
  EXPECT_HAS(refusal("--devices all", 69), "--devices all: ");
  EXPECT_HAS(refusal("--devices 1,0", 69), "--devices: no cuda:1: ");
  EXPECT_HAS(refusal("--devices 0,all", 2), "--devices: 'all' is not a CUDA device");
  EXPECT_HAS(refusal("--devices 0 --jobs 2", 2), "--jobs");
  EXPECT_FALSE(fs::exists(folder + "/out"));
}

}  // namespace
}  // namespace semfield
