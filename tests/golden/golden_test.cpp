// Training gives the bits that it gave: checksums after 20 steps of twelve configurations, on every instruction set.
#include <gnu/libc-version.h>

#include <cstdio>
#include <map>
#include <sstream>

#include "compute/isa.h"
#include "core/error.h"
#include "system/files.h"
#include "tests/program.h"
#include "tests/temp_dir.h"

namespace semfield {
namespace {

using testing_program::Result;

// configuration -> checksum, in the order of the rows.
using Column = std::vector<std::pair<std::string, std::string>>;
// column_name -> its column.
using Section = std::map<std::string, Column>;

constexpr const char* kHead =
    "# CRC-32C of all parameters, moments and states after 20 steps on the CPU. A row is a configuration of\n"
    "# tests/golden/golden_rows.cpp, a column an instruction set. A section holds for one compiler and one C library:\n"
    "# compilers contract different products and sums to fused multiply-adds, C libraries round exp and log "
    "differently.\n"
    "# avx512_bf16 also names the maker of the CPU, since nothing promises that both round VDPBF16PS alike;\n"
    "# amx stands for both, the tile instructions and their emulation: their sums are the same bits.\n"
    "# A change that is meant to change numbers writes the section of its machine anew, and removes those it cannot "
    "write:\n"
    "# SEMFIELD_WRITE_GOLDEN=1 build/release/tests/golden/golden_test\n";

std::vector<std::string> words_of(const std::string& line) {
  std::istringstream stream(line);
  std::vector<std::string> words;
  for (std::string word; stream >> word;) words.push_back(word);
  return words;
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

// toolchain -> its section. Throws Error(data) naming file and line.
std::map<std::string, Section> read_golden_file(const std::string& path) {
  std::map<std::string, Section> sections;
  std::istringstream text(read_text_file(path));
  std::string line;
  Section* section = nullptr;
  std::vector<std::string> isas;
  for (int number = 1; std::getline(text, line); ++number) {
    if (line.empty() || line[0] == '#') continue;
    if (line.front() == '[' && line.back() == ']') {
      section = &sections[line.substr(1, line.size() - 2)];
      isas.clear();
      continue;
    }
    const std::vector<std::string> words = words_of(line);
    if (section == nullptr || words.size() < 2 || (!isas.empty() && words.size() != isas.size() + 1))
      throw Error(ErrorKind::data, "test.error.made", path + ":" + std::to_string(number) + ": no row of golden values",
                  "write the section anew, as the head of the file says");
    if (isas.empty()) {
      isas.assign(words.begin() + 1, words.end());
      continue;
    }
    for (std::size_t i = 0; i < isas.size(); ++i) (*section)[isas[i]].emplace_back(words[0], words[i + 1]);
  }
  return sections;
}

// Columns of a section have the same rows.
void write_golden_file(const std::string& path, const std::map<std::string, Section>& sections) {
  std::string text = kHead;
  const auto cell = [&text](const char* format, const std::string& word) {
    char buffer[64];
    std::snprintf(buffer, sizeof buffer, format, word.c_str());
    text += buffer;
  };
  for (const auto& [name, section] : sections) {
    text += "\n[" + name + "]\n";
    cell("%-32s", "configuration");
    for (const auto& [isa, column] : section) cell("  %-15s", isa);
    text += '\n';
    const Column& first = section.begin()->second;
    for (std::size_t row = 0; row < first.size(); ++row) {
      cell("%-32s", first[row].first);
      for (const auto& [isa, column] : section) cell("  %-15s", column.at(row).second);
      text += '\n';
    }
  }
  std::string trimmed;  // without blanks at the ends of lines
  for (const char c : text) {
    if (c == '\n') trimmed.erase(trimmed.find_last_not_of(' ') + 1);
    trimmed += c;
  }
  write_file_atomic(path, trimmed);
}

// What golden_rows printed.
Column parse_column(const std::string& text) {
  Column column;
  std::istringstream stream(text);
  for (std::string name, value; stream >> name >> value;) column.emplace_back(name, value);
  return column;
}

const std::string kFile = SEMFIELD_SOURCE_DIR "/tests/golden/golden.txt";

/// "" when this build and CPU have the set.
std::string why_not(const std::string& isa) {
  const auto among = [&isa](const std::string& sets) {
    std::istringstream words(sets);
    for (std::string word; words >> word;) {
      if (word == isa) return true;
    }
    return false;
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

Column rows_of(const std::string& isa) {
  const TempDir dir;
  const Result run = testing_program::semfield_run("", dir.path(), "SEMFIELD_ISA=" + isa + " ");
  EXPECT_EQ(run.code, 0) << run.err;
  return parse_column(run.out);
}

/// This toolchain's section anew; the others stay.
void write_section() {
  auto sections = read_golden_file(kFile);
  Section fresh;
  for (const char* isa : {"generic", "avx2", "avx512", "avx512_bf16", "amx_emulated"}) {
    ASSERT_EQ(why_not(isa), "") << "a section is written whole: use a release build and a CPU with every set";
    const Column column = rows_of(isa);
    ASSERT_EQ(column.size(), 12U);
    fresh[column_name(isa)] = column;
  }
  sections[toolchain()] = fresh;
  write_golden_file(kFile, sections);
}

class GoldenFile : public testing::Test {
 protected:
  static void SetUpTestSuite() {
    if (std::getenv("SEMFIELD_WRITE_GOLDEN") != nullptr) write_section();
  }
};

// A resumed run has the bits of one that was never stopped, and no two other rows agree: each trains something else.
TEST_F(GoldenFile, RowsDifferUnlessTheyMustNot) {
  const auto sections = read_golden_file(kFile);
  ASSERT_FALSE(sections.empty());
  for (const auto& [name, section] : sections) {
    for (const auto& [isa, column] : section) {
      ASSERT_EQ(column.size(), 12U) << name << " " << isa;
      EXPECT_EQ(column.back().first, "resumed_at_step_10");
      EXPECT_EQ(column.back().second, column.front().second) << name << " " << isa;
      for (std::size_t i = 0; i + 1 < column.size(); ++i) {
        for (std::size_t k = 0; k < i; ++k)
          EXPECT_NE(column[i].second, column[k].second) << column[i].first << " and " << column[k].first;
      }
    }
  }
}

class Golden : public testing::TestWithParam<const char*> {};

TEST_P(Golden, ParametersAfter20StepsAreTheRecordedOnes) {
  const std::string isa = GetParam();
  if (const std::string reason = why_not(isa); !reason.empty()) GTEST_SKIP() << reason;
  const auto sections = read_golden_file(kFile);
  const auto section = sections.find(toolchain());
  if (section == sections.end()) {
    GTEST_SKIP() << "golden.txt has no values for " << toolchain()
                 << "; run golden_test of a commit that is known to be good with SEMFIELD_WRITE_GOLDEN=1";
  }
  const auto column = section->second.find(column_name(isa));
  if (column == section->second.end()) GTEST_SKIP() << "golden.txt has no column " << column_name(isa);
  const Column& expected = column->second;
  const Column found = rows_of(isa);
  ASSERT_EQ(found.size(), expected.size()) << "golden.txt lists other configurations than golden_rows.cpp";
  EXPECT_EQ(found.size(), 12U);
  for (std::size_t i = 0; i < found.size(); ++i) {
    EXPECT_EQ(found[i].first, expected[i].first);
    EXPECT_EQ(found[i].second, expected[i].second) << found[i].first << " trains to other bits on " << isa;
  }
}

INSTANTIATE_TEST_SUITE_P(EveryIsa, Golden,
                         testing::Values("generic", "avx2", "avx512", "avx512_bf16", "amx_emulated", "amx_bf16"),
                         [](const auto& set) { return std::string(set.param); });

}  // namespace
}  // namespace semfield
