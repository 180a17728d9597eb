// Threads, floating-point modes and instruction sets.
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cfenv>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <sstream>
#include <stdexcept>
#include <thread>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/error.h"
#include "core/text.h"
#include "core/workspace.h"
#include "system/process.h"
#include "tests/says.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

// parallel_for: every index once, exceptions, nesting, concurrent callers, changing thread counts; limits of groups.

struct Threads {
  explicit Threads(int count) { set_thread_count(count); }
  ~Threads() { set_thread_count(0); }
};

TEST(ParallelFor, CallsEveryIndexOnceForAnyThreadCount) {
  for (const int threads : {1, 2, 3, 8, 2}) {
    const Threads scope(threads);
    for (const std::int64_t count : {0, 1, 2, 7, 1000}) {
      std::vector<std::atomic<int>> calls(static_cast<std::size_t>(count));
      parallel_for(count, [&](std::int64_t i) { ++calls[i]; });
      for (const auto& c : calls) ASSERT_EQ(c, 1) << threads << " threads, " << count << " indices";
    }
  }
}

TEST(ParallelFor, WhatBodiesWroteIsSeenAfterwards) {
  const Threads scope(4);
  std::vector<std::int64_t> values(64);
  for (std::int64_t round = 1; round <= 5000; ++round)
    parallel_for(64, [&](std::int64_t i) { values[i] += i + round; });
  for (std::int64_t i = 0; i < 64; ++i) ASSERT_EQ(values[i], 5000 * i + 5000 * 5001 / 2);
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
  const TempDir root;
  root.write("cpu.max", "max 100000\n");
  root.write("a/cpu.max", "250000 100000\n");
  root.write("a/b/cpu.max", "max 100000\n");
  root.write("cpu/c/cpu.cfs_quota_us", "150000\n");
  root.write("cpu/c/cpu.cfs_period_us", "100000\n");
  root.write("cpu/d/cpu.cfs_quota_us", "-1\n");
  root.write("cpu/d/cpu.cfs_period_us", "100000\n");
  EXPECT_EQ(cpu_quota("0::/a/b\n", root.path()), 3);
  EXPECT_EQ(cpu_quota("0::/\n", root.path()), 0);
  EXPECT_EQ(cpu_quota("0::/nowhere/else\n", root.path()), 0);
  EXPECT_EQ(cpu_quota("4:cpu,cpuacct:/c\n7:memory:/a\n0::/a\n", root.path()), 2);
  EXPECT_EQ(cpu_quota("4:cpu,cpuacct:/d\n", root.path()), 0);
  EXPECT_EQ(cpu_quota("4:memory:/c\nnonsense\n", root.path()), 0);
  EXPECT_EQ(cpu_quota("", root.path()), 0);
  EXPECT_GE(hardware_threads(), 1);
}

// Settings of work: seen by the threads that help, by no other thread, and given back.

TEST(WorkScope, HelpersSeeItOtherThreadsDoNotAndItEnds) {
  const int before = thread_count();
  WorkSettings three{.threads = 3};
  {
    const WorkScope scope(three);
    EXPECT_EQ(thread_count(), 3);
    std::atomic<int> others{0};
    parallel_for(1000, [&](std::int64_t) { others += &work_settings() == &three ? 0 : 1; });
    EXPECT_EQ(others, 0);
    int elsewhere = 0;
    std::thread([&] { elsewhere = thread_count(); }).join();
    EXPECT_EQ(elsewhere, before);
    {
      WorkSettings one{.threads = 1};
      const WorkScope inner(one);
      EXPECT_EQ(thread_count(), 1);
    }
    EXPECT_EQ(thread_count(), 3);
    three.threads = 2;
    EXPECT_EQ(thread_count(), 2) << "borrowed, so a change is seen";
  }
  EXPECT_EQ(thread_count(), before);
}

// Compute threads flush subnormals, on every thread and in every call; the caller's own mode comes back.

#if defined(__SSE2__) || defined(__aarch64__)
constexpr bool kHasMode = true;
#else
constexpr bool kHasMode = false;
#endif

// Through volatile, so that nothing is computed before the program runs.
bool flushes() {
  const volatile float small = 1e-20F, subnormal = std::numeric_limits<float>::denorm_min(), large = 1e30F;
  const volatile double tiny = 1e-160;
  const volatile float product = small * small, scaled = subnormal * large;
  const volatile double wide = tiny * tiny;
  return product == 0 && scaled == 0 && wide == 0;
}

bool rounds_to_nearest() {
  const volatile float one = 1, little = 1e-10F;
  const volatile float sum = one + little;
  return sum == 1;
}

class FloatMode : public testing::Test {
 protected:
  void SetUp() override {
    if (!kHasMode) GTEST_SKIP() << "this CPU has no mode that flushes subnormals";
    ASSERT_FALSE(ComputeFloatMode::in_effect()) << "the test's own thread keeps subnormals";
  }
  void TearDown() override {
    EXPECT_FALSE(ComputeFloatMode::in_effect());
    EXPECT_FALSE(flushes());
    std::fesetround(FE_TONEAREST);
    set_thread_count(0);
  }
};

TEST_F(FloatMode, ScopesNestAndGiveTheCallersModeBack) {
  std::fesetround(FE_UPWARD);
  EXPECT_FALSE(rounds_to_nearest());
  {
    const ComputeFloatMode outer;
    EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest());
    {
      const ComputeFloatMode inner;
      EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes());
    }
    EXPECT_TRUE(ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest());
  }
  EXPECT_EQ(std::fegetround(), FE_UPWARD);
  EXPECT_FALSE(rounds_to_nearest());
}

TEST_F(FloatMode, EveryTaskFlushesForAnyThreadCountAndCaller) {
  for (const int rounding : {FE_TONEAREST, FE_UPWARD}) {
    for (const int threads : {1, 2, 16}) {
      for (const std::int64_t count : {1, 64}) {
        set_thread_count(threads);
        std::fesetround(rounding);
        std::atomic<int> tasks{0}, other_modes{0};
        const auto look = [&] {
          ++tasks;
          other_modes += ComputeFloatMode::in_effect() && flushes() && rounds_to_nearest() ? 0 : 1;
        };
        parallel_for(count, [&](std::int64_t) {
          look();
          parallel_for(3, [&](std::int64_t) { look(); });
          look();
        });
        EXPECT_EQ(tasks, 5 * count);
        EXPECT_EQ(other_modes, 0) << threads << " threads, " << count << " indices";
        EXPECT_FALSE(ComputeFloatMode::in_effect());
        EXPECT_EQ(std::fegetround(), rounding);
      }
    }
  }
}

TEST_F(FloatMode, TheCallersModeComesBackAfterAnException) {
  for (const int threads : {1, 4}) {
    set_thread_count(threads);
    std::fesetround(FE_DOWNWARD);
    EXPECT_THROW(parallel_for(8, [](std::int64_t) { throw std::runtime_error("body"); }), std::runtime_error);
    EXPECT_EQ(std::fegetround(), FE_DOWNWARD);
    EXPECT_FALSE(ComputeFloatMode::in_effect());
  }
}

// The choice of an instruction set.

std::vector<std::string> words_of(const std::string& text) {
  std::istringstream in(text);
  return {std::istream_iterator<std::string>(in), {}};
}

// What a process says whose environment has SEMFIELD_ISA=`wanted`: this program again, at the test below.
std::string said_with(const std::string& wanted) {
  const std::string self = std::filesystem::read_symlink("/proc/self/exe").string();
  const std::string command =
      "SEMFIELD_ISA=" + shell_word(wanted) + " " + shell_word(self) + " --gtest_filter=Isa.SaysWhatItIsOrWhyNot 2>&1";
  const std::unique_ptr<FILE, int (*)(FILE*)> pipe(popen(command.c_str(), "r"), pclose);
  std::string text;
  std::array<char, 4096> buffer{};
  while (pipe && fgets(buffer.data(), static_cast<int>(buffer.size()), pipe.get()) != nullptr) text += buffer.data();
  const std::size_t at = text.find("isa: ");
  return at == std::string::npos ? text : text.substr(at + 5, text.find('\n', at) - at - 5);
}

// Also a part of the tests below, in a process of its own.
TEST(Isa, SaysWhatItIsOrWhyNot) {
  std::string said;
  try {
    said = isa_name(isa());
    const std::vector<std::string> built = words_of(isas_of_build());
    EXPECT_NE(std::find(built.begin(), built.end(), said), built.end()) << said;
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    said = error.message() + "; " + error.remedy();
  }
  std::printf("isa: %s\n", said.c_str());
}

TEST(Isa, EveryOneOfTheBuildThatTheProcessorHasIsTakenWhenTheEnvironmentNamesIt) {
  const std::vector<std::string> built = words_of(isas_of_build());
  ASSERT_FALSE(built.empty());
  const std::string best = said_with("");
  EXPECT_NE(std::find(built.begin(), built.end(), best), built.end()) << best;
  bool beyond = false;  // the CPU ends at the best
  for (const std::string& name : built) {
    if (name == "amx_emulated") {  // taken where it is requested and avx512_bf16 is there
      EXPECT_EQ(said_with(name) == name, said_with("avx512_bf16") == "avx512_bf16");
      continue;
    }
    if (beyond) {
      EXPECT_HAS(said_with(name), "is not an instruction set that this CPU") << name;
    } else {
      EXPECT_EQ(said_with(name), name);
    }
    beyond = beyond || name == best;
  }
  EXPECT_TRUE(beyond);
}

TEST(Isa, AnotherWordInTheEnvironmentIsRefusedWithThoseThatThereAre) {
  const std::string said = said_with("avx1024");
  EXPECT_HAS(said, "SEMFIELD_ISA", "'avx1024'", words_of(isas_of_build()).front());
}

TEST(Isa, TakesTheBestVariantThatNeedsNoMore) {
  constexpr IsaVariant<int> kOnlyWeakest[] = {{Isa::generic, 1}};
  EXPECT_EQ(best_variant(kOnlyWeakest), 1);
  constexpr IsaVariant<int> kAll[] = {{Isa::generic, 0},     {Isa::avx2, 1},         {Isa::avx512, 2},
                                      {Isa::avx512_bf16, 3}, {Isa::amx_emulated, 4}, {Isa::amx_bf16, 5},
                                      {Isa::build, 6}};
  EXPECT_EQ(best_variant(kAll), static_cast<int>(isa()));
  if (isa() >= Isa::avx512_bf16 && isa() != Isa::build) {
    constexpr IsaVariant<int> kWithout[] = {{Isa::generic, 0}, {Isa::avx2, 1}, {Isa::avx512, 2}};
    EXPECT_EQ(best_variant(kWithout), 2);
  }
}

TEST(Isa, EmulatesTilesOnlyWhenAsked) {
  const char* wanted = std::getenv("SEMFIELD_ISA");
  EXPECT_EQ(isa() == Isa::amx_emulated, wanted != nullptr && std::string_view(wanted) == "amx_emulated");
}

}  // namespace
}  // namespace semfield
