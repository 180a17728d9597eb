// Two processes of one sweep side by side in its folder, killed at random moments and started again: no result is lost
// or changed.
#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <random>
#include <string>
#include <thread>

#include "core/text.h"
#include "tests/program.h"
#include "tests/sweep/tiny_sweep.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;
using testing_program::Process;
using testing_program::Result;
using testing_room::fresh_folder;
using testing_sweep::files_of_cells;

constexpr std::size_t kCells = 6;

std::string write_six_cells(const std::string& folder) {
  return testing_sweep::write_sweep(folder, 60, "seeds: [1, 2]\n");
}

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

// SEMFIELD_SWEEP_KILLS: starts and kills of both together; scripts/sweep_torture gives it.
TEST(SweepTorture, KillsOfTwoProcessesSideBySideLoseNoResult) {
  const char* const asked = std::getenv("SEMFIELD_SWEEP_KILLS");
  const int kills = asked != nullptr ? std::atoi(asked) : 6;
  const std::string folder = fresh_folder("torture");
  const std::string file = write_six_cells(folder);
  const std::string whole = folder + "/whole";
  const auto begin = std::chrono::steady_clock::now();
  ASSERT_EQ(
      testing_program::semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(whole), folder).code,
      0);
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
      Process a(testing_program::program(), words, of_a);
      std::this_thread::sleep_for(moment() / 10);
      Process b(testing_program::program(), words, of_b);
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
        testing_program::semfield_run("sweep " + shell_word(file) + " --jobs 2 --out " + shell_word(out), folder);
    ASSERT_EQ(last.code, 0) << last.err;
    const std::map<std::string, std::string> ended = files_of_cells(out, "result.json");
    for (const auto& [id, result] : done) EXPECT_EQ(ended.at(id), result);
    ASSERT_EQ(ended.size(), kCells);
    for (const auto& [id, result] : ended) {
      EXPECT_EQ(without_times(result), without_times(expected.at(id))) << id;
      if (result.find("processor_s") == std::string::npos) ++resumed;
    }
    EXPECT_NE(last.out.find("cells=6 done=6 failed=0"), std::string::npos) << last.out;
    fs::remove_all(out);
  }
  std::printf("sweep torture: kills=%d sweeps=%d resumed_cells=%d lost=0 changed=0\n", kills, sweeps, resumed);
}

}  // namespace
}  // namespace semfield
