// The program gives the bits that it gave: checksums of what golden_rows makes, on every instruction set.
#include <gnu/libc-version.h>

#include <algorithm>
#include <cstdio>
#include <map>
#include <set>
#include <sstream>

#include "compute/isa.h"
#include "core/error.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using testing_program::Result;

// row -> column -> checksum; "-": this build does not make it.
using Section = std::map<std::string, std::map<std::string, std::string>>;
using Sections = std::map<std::string, Section>;

const std::string kFile = SEMFIELD_SOURCE_DIR "/tests/golden/golden.txt";
constexpr const char* kHead =
    "# CRC-32C of what tests/golden/golden_rows.cpp makes. A column is an instruction set of the CPU, or a GPU. A\n"
    "# section holds for one compiler and one C library: compilers contract different products and sums to fused\n"
    "# multiply-adds, C libraries round exp and log differently; for a GPU also for one compiler of its kernels.\n"
    "# avx512_bf16 also names the maker of the CPU, since nothing promises that both round VDPBF16PS alike; amx "
    "stands\n"
    "# for both, the tile instructions and their emulation. Files (-) are made by the first three instruction sets.\n"
    "# A change that is meant to change numbers names its rows in docs/decisions.md (0045), writes the "
    "columns\n"
    "# of its machine anew, and removes by hand those that it cannot write. On a CPU with every set, or a GPU:\n"
    "# SEMFIELD_WRITE_GOLDEN=1 build/release/tests/golden/golden_test [--gtest_filter='GoldenCuda*']\n";

std::vector<std::string> words_of(const std::string& line) {
  std::istringstream stream(line);
  return {std::istream_iterator<std::string>(stream), {}};
}

// What the values depend on beside the instruction set: "gcc 12, glibc 2.36".
std::string toolchain() {
#if defined(__clang__)
  const std::string compiler = "clang " + std::to_string(__clang_major__);
#else
  const std::string compiler = "gcc " + std::to_string(__GNUC__);
#endif
  return compiler + ", glibc " + gnu_get_libc_version();
}

// The column of an instruction set on this CPU.
std::string column_name(const std::string& isa) {
#if defined(__x86_64__)
  if (isa == "amx_emulated" || isa == "amx_bf16") return "amx";
  if (isa == "avx512_bf16")
    return isa + (__builtin_cpu_is("amd") ? "/amd" : __builtin_cpu_is("intel") ? "/intel" : "/other");
#endif
  return isa;
}

// Throws Error(data) naming file and line.
Sections read_golden_file() {
  Sections sections;
  std::istringstream text(read_text_file(kFile));
  Section* section = nullptr;
  std::vector<std::string> columns;
  std::string line;
  for (int number = 1; std::getline(text, line); ++number) {
    const std::vector<std::string> words = words_of(line);
    if (words.empty() || line[0] == '#') continue;
    if (line.front() == '[' && line.back() == ']') {
      section = &sections[line.substr(1, line.size() - 2)];
      columns.clear();
    } else if (section == nullptr || words.size() < 2 || (!columns.empty() && words.size() != columns.size())) {
      throw Error(ErrorKind::data, "test.error.made",
                  kFile + ":" + std::to_string(number) + ": no row of golden values",
                  "write the section anew, as the head of the file says");
    } else if (columns.empty()) {
      columns = words;
    } else {
      for (std::size_t i = 1; i < words.size(); ++i)
        if (words[i] != "-") (*section)[words[0]][columns[i]] = words[i];
    }
  }
  return sections;
}

void write_golden_file(const Sections& sections) {
  std::string text = kHead;
  const auto put = [&text](std::vector<std::string> words) {
    words[0].resize(std::max<std::size_t>(40, words[0].size()), ' ');
    std::string line;
    for (std::string& word : words) {
      word.resize(std::max<std::size_t>(8, word.size()), ' ');
      line += word + "  ";
    }
    text += line.substr(0, line.find_last_not_of(' ') + 1) + '\n';
  };
  for (const auto& [name, section] : sections) {
    std::set<std::string> columns;
    for (const auto& [row, values] : section)
      for (const auto& [column, value] : values) columns.insert(column);
    text += "\n[" + name + "]\n";
    std::vector<std::string> head{"row"};
    head.insert(head.end(), columns.begin(), columns.end());
    put(head);
    for (const auto& [row, values] : section) {
      std::vector<std::string> words{row};
      for (const std::string& column : columns) {
        std::string word = values.contains(column) ? values.at(column) : "-";
        word.resize(std::max(word.size(), column.size()), ' ');
        words.push_back(word);
      }
      put(words);
    }
  }
  write_file_atomic(kFile, text);
}

/// "" when this build and CPU have the set.
std::string why_not(const std::string& isa) {
  const auto among = [&isa](const std::string& sets) {
    const std::vector<std::string> words = words_of(sets);
    return std::find(words.begin(), words.end(), isa) != words.end();
  };
  if (!among(isas_of_build())) return "this build compiles its kernels for '" + isas_of_build() + "', not for " + isa;
  if (!among(isas_of_machine())) return "this CPU has no " + isa;
#if defined(__x86_64__)
  // The C library picks its exp and log by the CPU, and those without fused multiply-adds round in another way.
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma"))
    return "this CPU has no fused multiply-add; the golden values were made on one that has";
#endif
  return "";
}

using Rows = std::map<std::string, std::string>;

/// What golden_rows says of these parts.
Result made(const std::string& parts, const std::string& environment) {
  const TempDir dir;
  return testing_program::semfield_run(parts, dir.path(), "SEMFIELD_CACHE=off " + environment);
}

Rows rows_in(const std::string& text) {
  Rows rows;
  std::istringstream stream(text);
  for (std::string row, value; stream >> row >> value;) rows[row] = value;
  return rows;
}

/// Compares with the column, or writes it when SEMFIELD_WRITE_GOLDEN says so.
void check(const std::string& name, const std::string& column, const Rows& found) {
  Sections sections = read_golden_file();
  if (std::getenv("SEMFIELD_WRITE_GOLDEN") != nullptr) {
    std::printf("[%s] %s\n", name.c_str(), column.c_str());
    for (auto& [row, values] : sections[name]) values.erase(column);
    for (const auto& [row, value] : found) {
      ASSERT_NE(value, "-") << "a build without the labelling page cannot write " << row;
      sections[name][row][column] = value;
      std::printf("%s %s\n", row.c_str(), value.c_str());
    }
    std::erase_if(sections[name], [](const auto& row) { return row.second.empty(); });
    return write_golden_file(sections);
  }
  Rows expected;
  for (const auto& [row, values] : sections[name])
    if (values.contains(column)) expected[row] = values.at(column);
  if (expected.empty())
    GTEST_SKIP() << "golden.txt has no values of [" << name << "] " << column
                 << "; write them at a commit that is known to be good, as its head says";
  std::string unmade;
  for (const auto& [row, value] : expected) {
    const auto now = found.find(row);
    if (now == found.end())
      ADD_FAILURE() << "row " << row << " is no longer made";
    else if (now->second == "-")
      unmade += " " + row;
    else
      EXPECT_EQ(now->second, value) << "row " << row << " has other bits on " << column;
  }
  for (const auto& [row, value] : found) EXPECT_TRUE(expected.contains(row)) << "golden.txt lacks row " << row;
  if (!unmade.empty()) GTEST_SKIP() << "all others are equal, but this build does not make" << unmade;
}

class Golden : public testing::TestWithParam<const char*> {};

TEST_P(Golden, RowsAreTheRecordedOnes) {
  const std::string isa = GetParam();
  if (const std::string reason = why_not(isa); !reason.empty()) GTEST_SKIP() << reason;
  const bool files = isa == "generic" || isa == "avx2" || isa == "avx512";
  const Result run = made(files ? "steps files" : "steps", "CUDA_VISIBLE_DEVICES= SEMFIELD_ISA=" + isa + " ");
  ASSERT_EQ(run.code, 0) << run.err;
  check(toolchain(), column_name(isa), rows_in(run.out));
}
INSTANTIATE_TEST_SUITE_P(EveryIsa, Golden,
                         testing::Values("generic", "avx2", "avx512", "avx512_bf16", "amx_emulated", "amx_bf16"),
                         [](const auto& set) { return std::string(set.param); });

TEST(GoldenCuda, StepsAreTheRecordedOnes) {
  const Result run = made("cuda", "");
  if (run.code == static_cast<int>(ErrorKind::unavailable)) GTEST_SKIP() << run.err;
  ASSERT_EQ(run.code, 0) << run.err;
  Rows rows = rows_in(run.out);
  const std::string device = rows["device"];
  rows.erase("device");
  check(toolchain() + ", " + SEMFIELD_NVCC, device, rows);
}

// No two rows agree, for each makes something else, but a resumed run and one that was never stopped. Instruction sets
// agree in fp32, but for the generic one, which has no fused multiply-adds.
TEST(GoldenFile, RowsDifferUnlessTheyMustNot) {
  if (std::getenv("SEMFIELD_WRITE_GOLDEN") != nullptr) GTEST_SKIP() << "the file is written by the tests after this";
  const Sections sections = read_golden_file();
  ASSERT_FALSE(sections.empty());
  for (const auto& [name, section] : sections) {
    std::map<std::string, std::string> row_of;
    for (const auto& [row, values] : section) {
      std::set<std::string> fused;
      for (const auto& [column, value] : values) {
        if (column != "generic" && !row.ends_with("bf16")) fused.insert(value);
        const std::string& other = row_of.emplace(column + " " + value, row).first->second;
        EXPECT_TRUE(other == row || row.ends_with("/tiny_hash_grid_occupancy")) << name << ": " << other << ", " << row;
      }
      EXPECT_LE(fused.size(), 1U) << name << ": " << row;
      if (row.ends_with("/resumed_at_step_10")) {
        EXPECT_EQ(values, section.at(row.substr(0, row.find('/')) + "/tiny_hash_grid_occupancy")) << name;
      }
    }
  }
}

}  // namespace
}  // namespace semfield
