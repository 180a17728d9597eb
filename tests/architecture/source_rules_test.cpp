// Rules on the text of sources: length, the CUDA switch, fast math.
#include <gtest/gtest.h>

#include <algorithm>

#include "tests/architecture/include_rules.h"

namespace semfield::architecture {
namespace {

constexpr long kMostLines = 500;

std::vector<SourceFile> all_sources() {
  std::vector<SourceFile> files;
  for (const char* folder : {"framework", "plugins", "app", "tests", "bench"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files.push_back(std::move(file));
  }
  return files;
}

TEST(SourceRules, NoFileIsTooLong) {
  const std::vector<SourceFile> files = all_sources();
  EXPECT_GT(files.size(), 50u);
  for (const SourceFile& file : files) {
    EXPECT_LE(std::count(file.text.begin(), file.text.end(), '\n'), kMostLines)
        << file.path << " wants to be two files";
  }
}

TEST(SourceRules, OneFileTestsForTheCudaCompiler) {
  const std::string word = std::string("__CUDA") + "CC__";
  int users = 0;
  for (const SourceFile& file : all_sources()) {
    if (file.text.find(word) == std::string::npos) continue;
    ++users;
    EXPECT_EQ(file.path, "framework/core/host_device.h");
  }
  EXPECT_EQ(users, 1);
}

TEST(SourceRules, ParallelSectionsLiveInOneFile) {
  const std::string word = std::string("#pragma ") + "omp";
  for (const SourceFile& file : all_sources()) {
    if (file.text.find(word) == std::string::npos) continue;
    EXPECT_EQ(file.path, "framework/core/parallel.cpp");
  }
}

TEST(SourceRules, AHeaderOpensWithASentence) {
  for (const SourceFile& file : all_sources()) {
    if (file.path.substr(file.path.size() - 2) != ".h") continue;
    EXPECT_EQ(file.text.rfind("//", 0), 0u) << file.path << " does not open by saying what it is";
  }
}

TEST(SourceRules, NoBuildFileAsksForFastMath) {
  std::vector<SourceFile> files;
  for (const char* folder : {"cmake", "framework", "plugins", "app", "tests", "bench"}) {
    for (SourceFile& file : files_under(folder, {"CMakeLists.txt", ".cmake"})) files.push_back(std::move(file));
  }
  EXPECT_GT(files.size(), 10u);
  for (const SourceFile& file : files) {
    for (const char* flag :
         {"-ffast-math", "-Ofast", "-funsafe-math", "-fassociative-math", "-ffinite-math-only", "--use_fast_math"}) {
      EXPECT_EQ(file.text.find(flag), std::string::npos) << file.path << " has " << flag;
    }
  }
}

}  // namespace
}  // namespace semfield::architecture
