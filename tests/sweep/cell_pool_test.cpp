// Which cell runs where and when. A shell script stands for the program, so cells take moments and devices need not be
// there.
#include "app/sweep/cell_pool.h"

#include <algorithm>
#include <cstdlib>
#include <set>
#include <sstream>

#include "core/error.h"
#include "report/sweep/sweep_results.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::app {
namespace {

namespace fs = std::filesystem;

// Trains in a moment: `train CONFIG --out RUN ...`. It logs its beginning and end with device and cell, fails where the
// configuration says "broken", and otherwise leaves the figures of an evaluation.
constexpr const char* kProgram = R"sh(#!/bin/sh
here=$(dirname "$0")
if test "$1" = objects; then
  echo "$*" >"$here/objects"
  echo '{"score": {"pq": 0.5}, "seconds": {"all": 2}}'
  exit 0
fi
config=$2; run=$4; device=none
for word; do case $word in runtime.device=*) device=${word#*=};; esac; done
cell=$(basename "$(dirname "$config")")
echo "begin $device $cell rank=$OMPI_COMM_WORLD_RANK" >>"$here/log"
sleep 0.1
echo "end $device $cell" >>"$here/log"
if grep -q broken "$config"; then echo "it is broken" >&2; exit 65; fi
mkdir -p "$run"
echo '{"kind": "eval", "step": 5, "train_s": 0.5, "split": "test", "psnr": 20}' >"$run/metrics.jsonl"
)sh";

struct LogLine {
  std::string what, device, cell, rank;
};

class CellPool : public testing::Test {
 protected:
  void SetUp() override {
    folder_ = testing_room::fresh_folder("pool");
    options_.folder = folder_ + "/out";
    options_.program = folder_ + "/program";
    write_file_atomic(options_.program, std::string_view(kProgram));
    fs::permissions(options_.program, fs::perms::owner_all);
  }

  static std::vector<Cell> cells(std::size_t count) {
    std::vector<Cell> made(count);
    for (std::size_t i = 0; i < count; ++i) {
      made[i].id = "cell" + std::to_string(i);
      made[i].config = "whole\n";
      made[i].split = "test";
    }
    return made;
  }

  bool run(const std::vector<Cell>& cells) {
    PoolHooks hooks{.waits_for = waits_for_};
    hooks.finished = [&](const CellOutcome& outcome) {
      outcomes_[outcome.cell->id] = outcome.done ? "done" : outcome.failure;
    };
    return run_cells(cells, options_, ended_, hooks);
  }

  std::vector<LogLine> log() const {
    std::vector<LogLine> lines;
    if (!fs::exists(folder_ + "/log")) return lines;
    std::istringstream text(read_text_file(folder_ + "/log"));
    for (std::string line; std::getline(text, line);) {
      std::istringstream words(line);
      LogLine& read = lines.emplace_back();
      words >> read.what >> read.device >> read.cell >> read.rank;
    }
    return lines;
  }

  std::string folder_;
  PoolOptions options_;
  EndedCells ended_;
  std::map<std::string, std::string> outcomes_;
  std::function<void(const std::string&)> waits_for_ = [](const std::string& text) {
    ADD_FAILURE() << "it waits: " << text;
  };
};

TEST_F(CellPool, ACellAtATimeOnEachDevice) {
  options_.devices = {"cuda:0", "cuda:5"};
  options_.jobs = 2;
  EXPECT_TRUE(run(cells(6)));
  EXPECT_EQ(ended_.results.size(), 6U);
  std::map<std::string, std::string> on_device;
  std::set<std::string> ran;
  std::size_t most = 0;
  for (const LogLine& line : log()) {
    if (line.what == "begin") {
      EXPECT_FALSE(on_device.contains(line.device)) << line.cell << " beside another cell on " << line.device;
      EXPECT_TRUE(ran.insert(line.cell).second) << line.cell << " ran twice";
      on_device[line.device] = line.cell;
      EXPECT_NE(std::find(options_.devices.begin(), options_.devices.end(), line.device), options_.devices.end());
    } else {
      on_device.erase(line.device);
    }
    most = std::max(most, on_device.size());
  }
  EXPECT_EQ(ran.size(), 6U);
  EXPECT_EQ(most, 2U) << "one of the devices was never used beside the other";
}

TEST_F(CellPool, WithoutDevicesCellsRunWhereTheyWant) {
  options_.jobs = 2;
  EXPECT_TRUE(run(cells(2)));
  for (const LogLine& line : log()) EXPECT_EQ(line.device, "none");
  EXPECT_EQ(log().size(), 4U);
}

TEST_F(CellPool, AFailedCellIsTriedOnceInASweep) {
  std::vector<Cell> three = cells(3);
  three[1].config = "broken\n";
  EXPECT_TRUE(run(three));
  EXPECT_EQ(outcomes_["cell0"], "done");
  EXPECT_HAS(outcomes_["cell1"], "exit code 65: it is broken");
  EXPECT_EQ(ended_.failures["cell1"], outcomes_["cell1"]);
  const std::size_t lines = log().size();
  // Another process of the sweep, which knows nothing yet.
  ended_ = {};
  outcomes_.clear();
  EXPECT_TRUE(run(three));
  EXPECT_TRUE(outcomes_.empty());
  EXPECT_EQ(ended_.results.size(), 2U);
  EXPECT_HAS(ended_.failures["cell1"], "it is broken");
  EXPECT_EQ(log().size(), lines) << "a cell ran again";
  // The next sweep.
  forget_cell_failure(options_.folder, "cell1");
  three[1].config = "whole\n";
  ended_ = {};
  EXPECT_TRUE(run(three));
  EXPECT_EQ(outcomes_["cell1"], "done");
  EXPECT_EQ(ended_.results.size(), 3U);
  EXPECT_TRUE(ended_.failures.empty());
}

// Its owner dies after the others are done: the cell is taken up here.
TEST_F(CellPool, ACellOfAnotherProcessIsWaitedForAndTakenUp) {
  const std::string folder = cell_folder(options_.folder, "cell0");
  create_folders(folder);
  FolderLock theirs;
  ASSERT_EQ(theirs.take(folder), 0);
  std::string waits;
  waits_for_ = [&](const std::string& text) {
    waits = text;
    EXPECT_EQ(outcomes_.size(), 2U) << "it waits while there are others to run";
    theirs = {};
  };
  EXPECT_TRUE(run(cells(3)));
  EXPECT_HAS(waits, "cells/cell0: process ");
  EXPECT_EQ(outcomes_.size(), 3U);
  EXPECT_EQ(log().back().cell, "cell0");
}

TEST_F(CellPool, AResultOfAnotherProcessIsNoticed) {
  const std::string folder = cell_folder(options_.folder, "cell0"), failed = cell_folder(options_.folder, "cell1");
  create_folders(folder);
  create_folders(failed);
  FolderLock theirs, others;
  ASSERT_EQ(theirs.take(folder), 0);
  ASSERT_EQ(others.take(failed), 0);
  waits_for_ = [&](const std::string&) {
    write_cell_result(folder + "/result.json", {{"psnr", 7.0}});
    write_cell_failure(options_.folder, "cell1", "broken elsewhere");
    theirs = {};
    others = {};
  };
  EXPECT_TRUE(run(cells(3)));
  EXPECT_EQ(outcomes_.size(), 1U);
  EXPECT_EQ(ended_.results.at("cell0"), (CellValues{{"psnr", 7.0}}));
  EXPECT_EQ(ended_.failures.at("cell1"), "broken elsewhere");
  for (const LogLine& line : log()) EXPECT_EQ(line.cell, "cell2");
}

TEST_F(CellPool, CellsAreNoRanksOfALauncher) {
  ASSERT_EQ(setenv("OMPI_COMM_WORLD_RANK", "1", 1), 0);
  ASSERT_EQ(setenv("OMPI_COMM_WORLD_SIZE", "2", 1), 0);
  EXPECT_TRUE(run(cells(1)));
  unsetenv("OMPI_COMM_WORLD_RANK");
  unsetenv("OMPI_COMM_WORLD_SIZE");
  ASSERT_FALSE(log().empty());
  EXPECT_EQ(log().front().rank, "rank=");
}

// What a process of a sweep takes of its host.

using Names = std::vector<std::string>;

TEST(HostShare, CellsAtATime) {
  EXPECT_EQ(cells_at_a_time(16, 16, 1, 1), 16);
  EXPECT_EQ(cells_at_a_time(16, 16, 1, 3), 5);
  EXPECT_EQ(cells_at_a_time(16, 16, 4, 1), 4);
  EXPECT_EQ(cells_at_a_time(8, 16, 4, 1), 4);  // bound to a socket that another process is bound to, too
  EXPECT_EQ(cells_at_a_time(1, 16, 2, 1), 1);  // bound to a core
  EXPECT_EQ(cells_at_a_time(2, 2, 3, 1), 1);
  EXPECT_EQ(cells_at_a_time(2, 16, 1, 8), 1);
}

// Whatever the numbers, every device belongs to exactly one process.
TEST(HostShare, EveryDeviceIsOfOneProcess) {
  for (int devices = 1; devices <= 8; ++devices) {
    Names all;
    for (int d = 0; d < devices; ++d) all.push_back("cuda:" + std::to_string(d));
    for (int processes = 1; processes <= devices; ++processes) {
      Names given;
      for (int rank = 0; rank < processes; ++rank) {
        const Names own = devices_of_process(all, rank, processes);
        EXPECT_GE(std::ssize(own), devices / processes);
        EXPECT_EQ(own.front(), all[rank]);
        given.insert(given.end(), own.begin(), own.end());
      }
      EXPECT_EQ(given.size(), all.size()) << devices << " devices, " << processes << " processes";
      EXPECT_EQ(std::set<std::string>(given.begin(), given.end()).size(), all.size());
    }
  }
  EXPECT_TRUE(devices_of_process({"cuda:0"}, 1, 2).empty());
}

TEST(HostShare, TheNextCellGoesToTheFirstFreeDevice) {
  const Names two{"cuda:0", "cuda:3"};
  EXPECT_EQ(free_device(two, {}), "cuda:0");
  EXPECT_EQ(free_device(two, {"cuda:0"}), "cuda:3");
  EXPECT_EQ(free_device(two, {"cuda:3"}), "cuda:0");
  EXPECT_EQ(free_device(two, {"cuda:3", "cuda:0"}), "");
  EXPECT_EQ(free_device({}, {}), "");
}

TEST(HostShare, DevicesByNumberOrName) {
  EXPECT_EQ(device_names({"0", "cuda:2"}), (Names{"cuda:0", "cuda:2"}));
  const auto refusal = [](const Names& words) -> std::string {
    try {
      device_names(words);
    } catch (const Error& error) {
      EXPECT_EQ(error.kind(), ErrorKind::usage);
      return error.message();
    }
    return "";
  };
  for (const char* word : {"cpu", "cuda", "cuda:", "-1", "1000", "0x1", "gpu0", "", "all"})
    EXPECT_EQ(refusal({"0", word}), "--devices: '" + std::string(word) + "' is not a CUDA device") << word;
  EXPECT_EQ(refusal({"1", "0", "cuda:1"}), "--devices: 'cuda:1' is named twice");
  EXPECT_EQ(refusal({"1", "01"}), "--devices: '01' is named twice");
}

// Objects are found in the run of another cell, with the settings of their own.
TEST_F(CellPool, ObjectsWaitForTheirRun) {
  std::vector<Cell> all = cells(2);
  all[0].objects = true;
  all[0].field_cell = "cell1";
  all[0].config = "objects: {reach: 0.125, stuff: [wall]}\n";
  options_.jobs = 2;
  ASSERT_TRUE(run(all));
  EXPECT_EQ(outcomes_["cell0"], "done");
  EXPECT_EQ(outcomes_["cell1"], "done");
  const std::string words = read_text_file(folder_ + "/objects"), out = folder_ + "/out/cells/";
  EXPECT_NE(words.find("objects " + out + "cell1/run --out " + out + "cell0/objects --split test --score --json"),
            std::string::npos)
      << words;
  EXPECT_NE(words.find("--set objects={reach: 0.125, stuff: [wall]}"), std::string::npos) << words;
  const std::optional<CellValues> values = read_cell_result(out + "cell0/result.json");
  ASSERT_TRUE(values.has_value());
  EXPECT_EQ(values->front(), (std::pair<std::string, double>{"pq", 0.5}));
}

}  // namespace
}  // namespace semfield::app
