// A sweep started by mpirun: what its processes leave, whoever of them is killed.
#include <csignal>
#include <iterator>

#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

using namespace testing_program;
using testing_room::fresh_folder;
using namespace testing_sweep;

constexpr int kSteps = 120;

// By hand, in a folder of its own.
std::string results_of_one_process(const std::string& folder, const std::string& file) {
  const std::string out = folder + "/one";
  const Result r = succeeded(semfield_run("sweep " + shell_word(file) + " --out " + shell_word(out), folder));
  return results_without_times(out);
}

// Of /proc/PID/NAME, which has no size; "" where the process has ended.
std::string about_process(int pid, const std::string& name) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/" + name);
  return {std::istreambuf_iterator<char>(file), {}};
}

int parent_of(int pid) {
  const std::string status = about_process(pid, "status");
  const std::size_t at = status.find("PPid:");
  return at == std::string::npos ? 0 : std::stoi(status.substr(at + 5));
}

struct Owned {
  std::string cell;
  int process = 0;  // of the cell
  int rank = 0;     // its parent
};

// A cell in the middle of its work, stopped there, that belongs to a rank other than 0.
Owned hold_a_cell(const std::string& out, const Process& mpirun) {
  Owned found;
  const bool held = wait_until([&] {
    for (const std::string& cell : begun_cells(out)) {
      const int process = std::stoi(read_text_file(out + "/cells/" + cell + "/run/.lock"));
      if (std::filesystem::exists(out + "/cells/" + cell + "/result.json") || kill(process, SIGSTOP) != 0) continue;
      const int parent = parent_of(process);
      const std::string environment = '\0' + about_process(parent, "environ");
      const bool is_rank = environment.find(std::string("\0OMPI_COMM_WORLD_RANK=", 22)) != std::string::npos;
      if (is_rank && environment.find(std::string("\0OMPI_COMM_WORLD_RANK=0", 23)) == std::string::npos) {
        found = {cell, process, parent};
        return true;
      }
      kill(process, SIGCONT);
    }
    return false;
  });
  EXPECT_TRUE(held) << mpirun.err_so_far();
  return found;
}

class SweepRanks : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = fresh_folder("ranks");
    file_ = write_sweep(folder_, kSteps, "seeds: [1, 2]\n");
    out_ = folder_ + "/out";
    // The user of a build machine may be root.
    for (const char* name : {"OMPI_ALLOW_RUN_AS_ROOT", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM"}) setenv(name, "1", 1);
  }

  std::vector<std::string> words(int ranks, bool recovery) const {
    std::vector<std::string> all;
    if (recovery) all.emplace_back(SEMFIELD_MPIRUN_RECOVERY);
    all.insert(all.end(), {"-n", std::to_string(ranks), "--oversubscribe", program(), "sweep", file_, "--jobs", "1",
                           "--out", out_});
    return all;
  }

  std::string last_line() const { return "sweep: cells=6 done=6 failed=0 folder=" + out_ + "\n"; }

  std::string folder_, file_, out_;
};

TEST_F(SweepRanks, TheResultsAreThoseOfOneProcessAndOneOfThemTellsTheEnd) {
  const Result r = succeeded(Process(SEMFIELD_MPIRUN, words(3, false), folder_).wait());
  EXPECT_EQ(r.out, last_line());
  EXPECT_HAS(r.err, "1 at a time in each of 3 processes");
  for (const char* rank : {"rank 0: [", "rank 1: [", "rank 2: ["})
    EXPECT_HAS(r.err, rank) << rank << " did no cell\n" << r.err;
  EXPECT_EQ(results_without_times(out_), results_of_one_process(folder_, file_));
}

TEST_F(SweepRanks, AKilledRanksCellIsFinishedByTheOthers) {
  Process mpirun(SEMFIELD_MPIRUN, words(3, true), folder_);
  const Owned held = hold_a_cell(out_, mpirun);
  ASSERT_GT(held.rank, 1);
  ASSERT_EQ(kill(held.rank, SIGKILL), 0);
  ASSERT_EQ(kill(held.process, SIGCONT), 0);
  const Result r = mpirun.wait();
  EXPECT_EQ(r.out, last_line()) << r.err;
  // Another rank went on with it from its checkpoint.
  const std::string result = read_text_file(out_ + "/cells/" + held.cell + "/result.json");
  EXPECT_LACKS(result, "processor_s");
  EXPECT_EQ(results_without_times(out_), results_of_one_process(folder_, file_));
}

TEST_F(SweepRanks, WithoutRecoveryTheSameCommandGoesOnWithAnyNumberOfRanks) {
  {
    Process mpirun(SEMFIELD_MPIRUN, words(3, false), folder_);
    const Owned held = hold_a_cell(out_, mpirun);
    ASSERT_GT(held.rank, 1);
    ASSERT_EQ(kill(held.rank, SIGKILL), 0);
    ASSERT_EQ(kill(held.process, SIGCONT), 0);
    EXPECT_NE(mpirun.wait().code, 0);
  }
  const Result r = succeeded(Process(SEMFIELD_MPIRUN, words(2, false), folder_).wait());
  EXPECT_EQ(r.out, last_line());
  EXPECT_EQ(results_without_times(out_), results_of_one_process(folder_, file_));
}

TEST_F(SweepRanks, AFailedCellIsToldByTheExitCode) {
  file_ = write_sweep(folder_, 3, "  broken: {set: {scene.labels.frames: none, train.ray_source: label_balanced}}\n");
  const Result r = Process(SEMFIELD_MPIRUN, words(2, false), folder_).wait();
  EXPECT_EQ(r.code, 1) << r.err;
  EXPECT_HAS(r.out, "sweep: cells=4 done=3 failed=1 folder=");
}

}  // namespace
}  // namespace semfield
