// parallel_for: every index once, exceptions, nesting, concurrent callers, changing thread counts; limits of groups.
#include "compute/parallel.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <filesystem>
#include <fstream>
#include <numeric>
#include <stdexcept>
#include <thread>
#include <vector>

#include "system/cpu_quota.h"

namespace semfield {
namespace {

struct Threads {
  explicit Threads(int count) { set_thread_count(count); }
  ~Threads() { set_thread_count(0); }
};

TEST(ParallelFor, CallsEveryIndexOnceForAnyThreadCount) {
  for (const int threads : {1, 2, 3, 8, 2}) {
    const Threads scope(threads);
    for (const std::int64_t count : {0, 1, 2, 7, 1000}) {
      std::vector<std::atomic<int>> calls(static_cast<std::size_t>(count));
      parallel_for(count, [&](std::int64_t i) { ++calls[static_cast<std::size_t>(i)]; });
      for (const auto& c : calls) ASSERT_EQ(c, 1) << threads << " threads, " << count << " indices";
    }
  }
}

TEST(ParallelFor, WhatBodiesWroteIsSeenAfterwards) {
  const Threads scope(4);
  std::vector<std::int64_t> values(64);
  for (std::int64_t round = 1; round <= 5000; ++round) {
    parallel_for(64, [&](std::int64_t i) { values[static_cast<std::size_t>(i)] += i + round; });
  }
  for (std::int64_t i = 0; i < 64; ++i) ASSERT_EQ(values[static_cast<std::size_t>(i)], 5000 * i + 5000 * 5001 / 2);
}

TEST(ParallelFor, SeveralThreadsTakePart) {
  const Threads scope(2);
  std::atomic<int> met{0};
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(20);
  parallel_for(2, [&](std::int64_t) {  // each waits for the other: a serial run would not get through
    ++met;
    while (met < 2 && std::chrono::steady_clock::now() < end) std::this_thread::yield();
  });
  EXPECT_EQ(met, 2);
  EXPECT_LT(std::chrono::steady_clock::now(), end);
}

TEST(ParallelFor, RethrowsAfterAllBodiesHaveEnded) {
  const Threads scope(3);
  std::atomic<int> calls{0};
  for (int round = 0; round < 3; ++round) {
    calls = 0;
    EXPECT_THROW(parallel_for(100,
                              [&](std::int64_t i) {
                                ++calls;
                                if (i % 10 == 3) throw std::runtime_error("body");
                              }),
                 std::runtime_error);
    EXPECT_EQ(calls, 100);
  }
}

TEST(ParallelFor, NestedCallsRunSerially) {
  const Threads scope(4);
  std::atomic<int> calls{0}, strangers{0};
  parallel_for(8, [&](std::int64_t) {
    const std::thread::id outer = std::this_thread::get_id();
    parallel_for(16, [&](std::int64_t) {
      ++calls;
      strangers += std::this_thread::get_id() == outer ? 0 : 1;
    });
  });
  EXPECT_EQ(calls, 8 * 16);
  EXPECT_EQ(strangers, 0);
}

TEST(ParallelFor, ConcurrentCallersDoNotMix) {
  const Threads scope(3);
  std::vector<std::int64_t> sums(4);
  std::vector<std::thread> callers;
  for (std::size_t c = 0; c < sums.size(); ++c) {
    callers.emplace_back([&, c] {
      for (int round = 0; round < 300; ++round) {
        std::atomic<std::int64_t> sum{0};
        parallel_for(50, [&](std::int64_t i) { sum += i; });
        sums[c] += sum;
      }
    });
  }
  for (std::thread& caller : callers) caller.join();
  for (const std::int64_t sum : sums) EXPECT_EQ(sum, 300 * 49 * 50 / 2);
}

TEST(CpuQuota, TheSmallestGroupOnTheWayUpCounts) {
  namespace fs = std::filesystem;
  const fs::path root = fs::path(::testing::TempDir()) / ("semfield_quota_" + std::to_string(::getpid()));
  const auto put = [&](const std::string& file, const std::string& text) {
    fs::create_directories((root / file).parent_path());
    std::ofstream(root / file) << text;
  };
  put("cpu.max", "max 100000\n");
  put("a/cpu.max", "250000 100000\n");
  put("a/b/cpu.max", "max 100000\n");
  put("cpu/c/cpu.cfs_quota_us", "150000\n");
  put("cpu/c/cpu.cfs_period_us", "100000\n");
  put("cpu/d/cpu.cfs_quota_us", "-1\n");
  put("cpu/d/cpu.cfs_period_us", "100000\n");
  EXPECT_EQ(cpu_quota("0::/a/b\n", root.string()), 3);
  EXPECT_EQ(cpu_quota("0::/\n", root.string()), 0);
  EXPECT_EQ(cpu_quota("0::/nowhere/else\n", root.string()), 0);
  EXPECT_EQ(cpu_quota("4:cpu,cpuacct:/c\n7:memory:/a\n0::/a\n", root.string()), 2);
  EXPECT_EQ(cpu_quota("4:cpu,cpuacct:/d\n", root.string()), 0);
  EXPECT_EQ(cpu_quota("4:memory:/c\nnonsense\n", root.string()), 0);
  EXPECT_EQ(cpu_quota("", root.string()), 0);
  fs::remove_all(root);
  EXPECT_GE(hardware_threads(), 1);
}

}  // namespace
}  // namespace semfield
