// Words, digests, findings and arenas.

#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cfenv>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <stdexcept>
#include <thread>

#include "compute/isa.h"
#include "core/checksum.h"
#include "core/process.h"
#include "core/workspace.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "tests/threads.h"

namespace semfield {
namespace {

// Words, lines and numbers of text files.

TEST(Words, AnyBlanksSeparate) {
  EXPECT_EQ(words_of("  a\tbc  d \r"), (std::vector<std::string_view>{"a", "bc", "d"}));
  EXPECT_TRUE(words_of(" \t").empty());
  EXPECT_TRUE(words_of("").empty());
}

TEST(Words, LinesWithEitherEnd) {
  std::string_view text = "a\r\n\nb c", line;
  std::vector<std::string_view> lines;
  while (next_line(text, line)) lines.push_back(line);
  EXPECT_EQ(lines, (std::vector<std::string_view>{"a", "", "b c"}));
}

TEST(Words, NumbersAreWholeWords) {
  double v = 7;
  EXPECT_TRUE(parse_number("-1.5e2", v));
  EXPECT_EQ(v, -150);
  EXPECT_TRUE(parse_number("+2", v));
  EXPECT_EQ(v, 2);
  EXPECT_TRUE(parse_number("-inf", v));
  EXPECT_EQ(v, -INFINITY);
  EXPECT_TRUE(parse_number("nan", v));
  EXPECT_TRUE(std::isnan(v));
  v = 7;
  for (const char* bad : {"", "x", "1x", "+-1", "1 ", "0x10", "1,5", "1e999"})
    EXPECT_FALSE(parse_number(bad, v)) << bad;
  EXPECT_EQ(v, 7);
}

TEST(Words, AShellReadsAShellWordAsTheText) {
  EXPECT_EQ(shell_word("runs/room_2,a=b"), "runs/room_2,a=b");
  EXPECT_EQ(shell_word(""), "''");
  for (const std::string text : {"a b's", "it's", "$HOME `id` \"x\" \\ !", "*", "~", "a\nb", "-x y", "\xC3\xA9"}) {
    FILE* const shell = popen(("printf %s " + shell_word(text)).c_str(), "r");
    std::string read;
    for (int c = std::fgetc(shell); c != EOF; c = std::fgetc(shell)) read += static_cast<char>(c);
    EXPECT_EQ(pclose(shell), 0);
    EXPECT_EQ(read, text);
  }
}

// SHA-256 against the published examples, and against itself cut into pieces.

TEST(Sha256, PublishedExamples) {
  EXPECT_EQ(sha256_of(""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  EXPECT_EQ(sha256_of("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  EXPECT_EQ(sha256_of("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
            "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  EXPECT_EQ(sha256_of(std::string(1000000, 'a')), "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

TEST(Sha256, PiecesDoNotMatter) {
  const std::string text(200, 'x');
  for (std::size_t size = 0; size <= text.size(); ++size) {
    Sha256 sum;
    for (std::size_t at = 0; at < size; at += 7)
      sum.add(std::as_bytes(std::span(text)).subspan(at, std::min<std::size_t>(7, size - at)));
    EXPECT_EQ(sum.hex(), sha256_of(text.substr(0, size))) << size;
  }
}

// Findings as people read them: the same trouble of many places is one line.

std::vector<std::string> lines(const Diagnostics& d) {
  std::vector<std::string> out;
  for (const Diagnostic& finding : folded(d)) out.push_back(finding.text());
  return out;
}

TEST(Diagnostics, TheSameTroubleOfManyPlacesIsOneLine) {
  Diagnostics d;
  d.error("test.finding.made", "classes.yaml", "no classes in it", "write one");
  for (int i = 0; i < 35; ++i) {
    const std::string n = std::to_string(i), file = "/my data/it's/rgb_" + n + ".png";
    d.error("test.finding.made", "frame 'rgb_" + n + "' (" + file + ")", "colour image '" + file + "' is missing",
            "restore it");
    d.warning("test.finding.made", "/my data/transforms.json: frame " + n + " (rgb (" + n + ").png)",
              "pose is 0.0" + n + " off", {});
  }
  d.error("test.finding.made", "frame 'x' (x.png)", "colour image 'a/x.png' is missing", "take another");
  const std::vector<std::string> said = lines(d);
  ASSERT_EQ(said.size(), 4u);
  EXPECT_EQ(said[0], "classes.yaml: no classes in it; write one");
  EXPECT_HAS(said[1], "frame 'rgb_0' (/my data/it's/rgb_0.png)", "; restore it (and 34 more", "frame 'rgb_4', ...)");
  EXPECT_HAS(said[2], "frame 0 (rgb (0).png): pose is 0.00 off (and 34 more", "transforms.json: frame 4, ...)");
  EXPECT_EQ(said[3], "frame 'x' (x.png): colour image 'a/x.png' is missing; take another");
  EXPECT_EQ(d.all().size(), 72u);
}

TEST(Diagnostics, WhatOnePlaceSaysTwiceIsKeptUnlessItIsTheSame) {
  Diagnostics d;
  d.error("test.finding.made", "classes.yaml", "id 3 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "classes.yaml", "id 5 is there twice", "keep one");
  d.error("test.finding.made", "room.yaml:3:5", "unknown key 'a'", {});
  d.error("test.finding.made", "room.yaml:4:5", "unknown key 'b'", {});
  EXPECT_EQ(lines(d), (std::vector<std::string>{"classes.yaml: id 3 is there twice; keep one",
                                                "classes.yaml: id 5 is there twice; keep one",
                                                "room.yaml:3:5: unknown key 'a'", "room.yaml:4:5: unknown key 'b'"}));
}

TEST(Diagnostics, AnExceptionListsThemFolded) {
  Diagnostics d;
  d.warning("test.finding.made", "frame '0'", "is dark", {});
  for (int i = 0; i < 3; ++i)
    d.error("test.finding.made", "frame '" + std::to_string(i) + "'", "is black", "expose longer");
  EXPECT_EQ(error_of([&] { d.throw_if_errors(ErrorKind::data, "problems:"); }),
            "problems:\nframe '0': is black; expose longer (and 2 more like this: frame '1', frame '2')");
}

TEST(Codes, StandBehindTheSentenceWherePeopleReadIt) {
  EXPECT_EQ(shown(Error(ErrorKind::data, "scene.pose.mirrored", "pose mirrors", "flip an axis").while_doing("reading")),
            "reading: pose mirrors; flip an axis [scene.pose.mirrored]");
  EXPECT_EQ(shown(Error(ErrorKind::no_input, "scene.poses.missing", "COLMAP finds poses:\ncolmap mapper --x y")),
            "COLMAP finds poses: [scene.poses.missing]\ncolmap mapper --x y");
  Diagnostics d;
  d.error("scene.image.size", "frame 'a'", "is small", "take another");
  d.error("scene.pose.rotation", "frame 'b'", "is no rotation", {});
  EXPECT_EQ(d.all()[1].shown(), "frame 'b': is no rotation [scene.pose.rotation]");
  try {
    d.throw_if_errors(ErrorKind::data, "problems:");
    FAIL();
  } catch (Error& e) {
    EXPECT_EQ(e.code(), Code("scene.image.size")) << "that of the first";
    e.while_doing("opening");
    EXPECT_EQ(shown(e),
              "opening: problems:\nframe 'a': is small; take another [scene.image.size]\n"
              "frame 'b': is no rotation [scene.pose.rotation]");
  }
}

TEST(Codes, FindingsOfTwoCodesAreNotFolded) {
  Diagnostics d;
  d.error("scene.image.size", "frame '0'", "is black", "expose longer");
  d.error("scene.image.kind", "frame '1'", "is black", "expose longer");
  EXPECT_EQ(folded(d).size(), 2u);
}

TEST(Codes, AreReadFromTextOnlyWhereTheyAreSome) {
  EXPECT_STREQ(Code::parse(std::string("run.folder.busy"))->text(), "run.folder.busy");
  EXPECT_EQ(Code::parse("run.folder.busy"), Code::parse("run.folder.busy"));
  for (const char* none : {"", "run", "run.", ".run", "run..folder", "Run.folder", "run folder.busy", "a.b.c.d.e"})
    EXPECT_FALSE(Code::parse(none)) << none;
}

TEST(Spelling, PartsInCommonCountOnlyWhereAsked) {
  const std::vector<std::string> known{"label_path", "file_path"};
  EXPECT_EQ(did_you_mean("normal_path", known), "label_path");
  EXPECT_EQ(closest_spelling("normal_path", known), "");
  EXPECT_EQ(closest_spelling("lable_path", known), "label_path");
}

// The bump arena: one block in the steady state, and memory that is refused.

constexpr std::size_t kMega = std::size_t{1} << 20;

TEST(Workspace, MergesItsBlocksWhenNothingIsInUse) {
  Workspace arena;
  for (int step = 0; step < 3; ++step) {
    const Workspace::Scope scope(arena);
    const std::int64_t growths = arena.growth_count();
    for (int i = 0; i < 8; ++i) std::fill_n(arena.take_bytes(kMega), kMega, std::byte{1});
    if (step > 0) {
      EXPECT_EQ(arena.growth_count(), growths);
    }
  }
  EXPECT_GE(arena.reserved_bytes(), arena.high_water_bytes());
}

// A device whose memory is counted and may run out.
std::size_t g_left = 0;
std::int64_t g_blocks = 0;
std::byte* give(std::size_t bytes) {
  if (bytes > g_left) throw Error(ErrorKind::unavailable, "test.error.made", "no memory");
  ++g_blocks;
  return static_cast<std::byte*>(std::aligned_alloc(256, bytes));
}
void take_back(std::byte* block) {
  --g_blocks;
  std::free(block);
}
constexpr BlockSource kSource{Device::cuda, give, take_back};

TEST(Workspace, AMergeThatIsRefusedIsToldByTheNextTake) {
  g_left = 64 * kMega;
  {
    Workspace arena(kSource);
    {
      const Workspace::Scope scope(arena);
      for (int i = 0; i < 8; ++i) arena.take_bytes(kMega);
      g_left = kMega;  // a neighbour took the rest
    }
    EXPECT_EQ(arena.reserved_bytes(), 0U);
    EXPECT_THROW(arena.take_bytes(64), Error);
    g_left = 64 * kMega;
    const Workspace::Scope scope(arena);
    for (int i = 0; i < 8; ++i) arena.take_bytes(kMega);
    EXPECT_EQ(g_blocks, 1);
  }
  EXPECT_EQ(g_blocks, 0);
}

TEST(Workspace, ForgetGivesEverythingBack) {
  g_left = 64 * kMega;
  Workspace arena(kSource);
  {
    const Workspace::Scope scope(arena);
    arena.take_bytes(8 * kMega);
  }
  arena.forget();
  EXPECT_EQ(g_blocks, 0);
  EXPECT_EQ(arena.high_water_bytes(), 0U);
  const Workspace::Scope scope(arena);
  arena.take_bytes(64);
  EXPECT_LE(arena.reserved_bytes(), 2 * kMega);
}

// Folders and memory of the machine: locks, the order of names, limits.

// Holds on a folder, alone and shared. Two locks of one process exclude each other as those of two processes do.

struct FolderLocks : testing::Test {
  const TempDir dir_;
  const std::string& folder_ = dir_.path();
};

TEST_F(FolderLocks, OneHasItAloneAndIsNamed) {
  FolderLock mine, theirs;
  ASSERT_EQ(mine.take(folder_), 0);
  EXPECT_TRUE(mine.held());
  EXPECT_EQ(theirs.take(folder_), EWOULDBLOCK);
  EXPECT_FALSE(theirs.held());
  EXPECT_HAS(theirs.holder(), "process " + std::to_string(::getpid()));
  EXPECT_EQ(theirs.share(folder_), EWOULDBLOCK);
  mine = {};
  EXPECT_EQ(theirs.take(folder_), 0);
}

TEST_F(FolderLocks, SeveralShareItAndThenNobodyHasItAlone) {
  FolderLock first, second, alone;
  ASSERT_EQ(first.share(folder_), 0);
  ASSERT_EQ(second.share(folder_), 0);
  EXPECT_EQ(alone.take(folder_), EWOULDBLOCK);
  first = {};
  EXPECT_EQ(alone.take(folder_), EWOULDBLOCK);
  second = {};
  EXPECT_EQ(alone.take(folder_), 0);
}

TEST_F(FolderLocks, OfAFolderThatIsNotThereTheCauseIsTold) {
  FolderLock lock;
  EXPECT_EQ(lock.take(folder_, false), ENOENT);
  EXPECT_EQ(lock.take(folder_ + "/none"), ENOENT);
  EXPECT_EQ(lock.share(folder_ + "/none"), ENOENT);
  EXPECT_FALSE(lock.held());
}

// Folders are read in the order of names on every file system.

TEST(SortedFolder, NamesInOrderWhateverTheFileSystemGives) {
  const TempDir folder;
  std::vector<std::string> names;
  for (int i = 0; i < 100; ++i) names.push_back(std::to_string(37 * i % 100));
  for (const std::string& name : names) folder.write(name, "x");
  std::sort(names.begin(), names.end());
  std::vector<std::string> found;
  for (const auto& entry : sorted_folder(folder.path())) found.push_back(entry.path().filename().string());
  EXPECT_EQ(found, names);
}

TEST(SortedFolder, AFolderThatCannotBeReadIsNamed) {
  EXPECT_HAS(error_of(ErrorKind::no_input, [] { (void)sorted_folder("/no/such/folder"); }), "/no/such/folder",
             "or directory");
}

// Memory that is left, from texts as Linux writes them.

constexpr std::size_t kMB = std::size_t{1} << 20;

struct MemoryLimit : testing::Test {
  const TempDir dir_;
  const std::string& root_ = dir_.path();
  const std::string meminfo_ = "MemTotal:  8192000 kB\nMemFree: 100 kB\nMemAvailable:    4096000 kB\n";
};

TEST_F(MemoryLimit, SystemAlone) {
  EXPECT_EQ(available_memory(meminfo_, "", root_), 4096000u * 1024);
  EXPECT_EQ(available_memory("", "", root_), kNoMemoryLimit);
}

TEST_F(MemoryLimit, GroupsAboveCountToo) {
  dir_.write("/a/b/memory.max", "max\n");
  dir_.write("/a/b/memory.current", "1000\n");
  dir_.write("/a/memory.max", std::to_string(512 * kMB));
  dir_.write("/a/memory.current", std::to_string(200 * kMB));
  dir_.write("/a/memory.stat", "anon 5\ninactive_file " + std::to_string(50 * kMB) + "\n");
  EXPECT_EQ(available_memory(meminfo_, "0::/a/b\n", root_), 362 * kMB);
  EXPECT_EQ(available_memory(meminfo_, "0::/other\n", root_), 4096000u * 1024);
}

TEST_F(MemoryLimit, VersionOneAndAFullGroup) {
  dir_.write("/memory/box/memory.limit_in_bytes", std::to_string(100 * kMB));
  dir_.write("/memory/box/memory.usage_in_bytes", std::to_string(130 * kMB));
  EXPECT_EQ(available_memory(meminfo_, "7:cpu,memory:/box\n", root_), 0u);
  EXPECT_EQ(available_memory(meminfo_, "7:cpu:/box\n", root_), 4096000u * 1024);
}

TEST_F(MemoryLimit, ThisProcess) {
  const std::size_t before = resident_bytes();
  EXPECT_GT(before, 0u);
  std::vector<char> block(64 * kMB, 1);
  EXPECT_GT(resident_bytes(), before + 60 * kMB);
  // Linux counts pages one CPU at a time, and is off by up to a batch of them for each (lib/percpu_counter.c).
  const std::size_t cores = std::thread::hardware_concurrency();
  const std::size_t counting = cores * std::max<std::size_t>(32, 2 * cores) * 4096;
  EXPECT_GE(peak_resident_bytes() + std::max(kMB, counting), resident_bytes());
  EXPECT_EQ(block.back(), 1);
}

TEST_F(MemoryLimit, Words) {
  EXPECT_EQ(memory_text(812 * kMB), "812 MB");
  EXPECT_EQ(memory_text(6 * 1024 * kMB), "6.0 GB");
}

// Threads, floating-point modes and instruction sets.

// parallel_for: every index once, exceptions, nesting, concurrent callers, changing thread counts; limits of groups.

TEST(ParallelFor, CallsEveryIndexOnceForAnyThreadCount) {
  for (const int threads : {1, 2, 3, 8, 2}) {
    const ThreadScope scope(threads);
    for (const std::int64_t count : {0, 1, 2, 7, 1000}) {
      std::vector<std::atomic<int>> calls(static_cast<std::size_t>(count));
      parallel_for(count, [&](std::int64_t i) { ++calls[i]; });
      for (const auto& c : calls) ASSERT_EQ(c, 1) << threads << " threads, " << count << " indices";
    }
  }
}

TEST(ParallelFor, SeveralThreadsTakePart) {
  const ThreadScope scope(2);
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
  const ThreadScope scope(3);
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
  const ThreadScope scope(4);
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
  const ThreadScope scope(3);
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

struct FloatMode : testing::Test {
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

// What a process says whose environment has SEMFIELD_ISA=`wanted`: this program again, at the test below.
std::string said_with(const std::string& wanted) {
  const std::string self = fs::read_symlink("/proc/self/exe").string();
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
    const std::vector<std::string> built = word_list(isas_of_build());
    EXPECT_NE(std::find(built.begin(), built.end(), said), built.end()) << said;
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::config);
    said = error.message() + "; " + error.remedy();
  }
  std::printf("isa: %s\n", said.c_str());
}

TEST(Isa, EveryOneOfTheBuildThatTheProcessorHasIsTakenWhenTheEnvironmentNamesIt) {
  const std::vector<std::string> built = word_list(isas_of_build());
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
  EXPECT_HAS(said, "SEMFIELD_ISA", "'avx1024'", word_list(isas_of_build()).front());
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

}  // namespace
}  // namespace semfield
