// What a process of a sweep takes of its host.
#include "report/sweep/host_share.h"

#include <gtest/gtest.h>

#include <set>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {
namespace {

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
        EXPECT_EQ(own.front(), all[static_cast<std::size_t>(rank)]);
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
    EXPECT_EQ(refusal({"0", word}), "--devices: '" + std::string(word) + "' is no CUDA device") << word;
  EXPECT_EQ(refusal({"1", "0", "cuda:1"}), "--devices: 'cuda:1' is named twice");
  EXPECT_EQ(refusal({"1", "01"}), "--devices: '01' is named twice");
}

}  // namespace
}  // namespace semfield
