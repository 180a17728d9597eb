// Training gives the bits that it gave: checksums after 20 steps of twelve configurations, on every instruction set.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <sstream>

#include "compute/isa.h"
#include "tests/golden/golden_file.h"
#include "tests/program.h"

namespace semfield {
namespace {

using namespace testing_golden;
using testing_program::Result;

const std::string kFile = SEMFIELD_SOURCE_DIR "/tests/golden/golden.txt";

/// "" when this build and processor have the set.
std::string why_not(const std::string& isa) {
  const auto among = [&isa](const std::string& sets) {
    std::istringstream words(sets);
    for (std::string word; words >> word;) {
      if (word == isa) return true;
    }
    return false;
  };
  if (!among(isas_of_build())) return "this build compiles its kernels for '" + isas_of_build() + "', not for " + isa;
  if (!among(isas_of_machine())) return "this processor has no " + isa;
#if defined(__x86_64__)
  // The C library picks its exp and log by the processor, and those without fused multiply-adds round in another way.
  if (!__builtin_cpu_supports("avx2") || !__builtin_cpu_supports("fma"))
    return "this processor has no fused multiply-add; the golden values were made on one that has";
#endif
  return "";
}

Column rows_of(const std::string& isa) {
  const std::string folder = testing::TempDir() + "golden_" + isa + "_" + std::to_string(::getpid());
  std::filesystem::create_directory(folder);
  const Result run = testing_program::semfield_run("", folder, "SEMFIELD_ISA=" + isa + " ");
  std::filesystem::remove_all(folder);
  EXPECT_EQ(run.code, 0) << run.err;
  return parse_column(run.out);
}

/// This toolchain's section anew; the others stay.
void write_section() {
  auto sections = read_golden_file(kFile);
  Section fresh;
  for (const char* isa : {"generic", "avx2", "avx512", "avx512_bf16", "amx_emulated"}) {
    ASSERT_EQ(why_not(isa), "") << "a section is written whole: use a release build and a processor with every set";
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
        for (std::size_t k = 0; k < i; ++k) {
          EXPECT_NE(column[i].second, column[k].second) << column[i].first << " and " << column[k].first;
        }
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
