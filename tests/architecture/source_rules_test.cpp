// Rules on the text of sources: length, the CUDA switch, fast math.
#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <map>
#include <regex>
#include <set>
#include <sstream>

#include "tests/architecture/include_rules.h"
#include "tests/says.h"

namespace semfield::architecture {
namespace {

constexpr long kMostLines = 500;
constexpr int kMostFiles = 30;
constexpr std::int64_t kMostFolderLines = 4000;

std::vector<SourceFile> all_sources() {
  std::vector<SourceFile> files;
  for (const char* folder : {"framework", "plugins", "app", "tests"}) {
    for (SourceFile& file : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) files.push_back(std::move(file));
  }
  return files;
}

TEST(SourceRules, NoFileIsTooLong) {
  const std::vector<SourceFile> files = all_sources();
  EXPECT_GT(files.size(), 50u);
  for (const SourceFile& file : files)
    EXPECT_LE(std::count(file.text.begin(), file.text.end(), '\n'), kMostLines)
        << file.path << " wants to be two files";
}

TEST(SourceRules, NoFolderOfTheFrameworkIsTooFull) {
  struct Folder {
    int files = 0;
    std::int64_t lines = 0;
  };
  std::map<std::string, Folder> folders;
  for (const SourceFile& file : files_under("framework", {""})) {
    Folder& folder = folders[std::filesystem::path(file.path).parent_path().string()];
    ++folder.files;
    folder.lines += std::count(file.text.begin(), file.text.end(), '\n');
  }
  EXPECT_GT(folders.size(), 25u);
  for (const auto& [name, folder] : folders) {
    EXPECT_LE(folder.files, kMostFiles) << name << " wants to be two folders";
    EXPECT_LE(folder.lines, kMostFolderLines) << name << " wants to be two folders";
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
    EXPECT_EQ(file.path, "framework/compute/parallel.cpp");
  }
}

TEST(SourceRules, AHeaderOpensWithASentence) {
  for (const SourceFile& file : all_sources()) {
    if (file.path.substr(file.path.size() - 2) != ".h") continue;
    EXPECT_EQ(file.text.rfind("//", 0), 0u) << file.path << " does not open by saying what it is";
  }
}

// Lines that give a process or a thread something that changes: thread_local, variables g_... and t_..., and statics of
// functions that are no constants.
bool keeps_state(const std::string& line) {
  static const std::regex state(
      R"(^(\s*(static )?thread_local\b.*)"
      R"(|(static |volatile )?[A-Za-z_][\w:<>, ]*[ &*]+[gt]_\w+(\{.*|;.*| = .*))"
      R"(|\s*static (?!const\b|constexpr\b|inline\b|thread_local\b)[\w:<>, ]+[ &*]+(const )?\w+(;| =|\{).*)$)");
  return std::regex_match(line, state);
}

TEST(SourceRules, StateOfTheProcessIsListed) {
  std::ifstream file(std::string(SEMFIELD_SOURCE_DIR) + "/docs/reference/inside.md");
  const std::string page{std::istreambuf_iterator<char>(file), {}};
  const std::size_t begin = page.find("## State of the process");
  ASSERT_NE(begin, std::string::npos);
  const std::string section = page.substr(begin, page.find("\n## ", begin + 1) - begin);
  std::set<std::string> found;
  for (const char* folder : {"framework", "plugins", "app"}) {
    for (const SourceFile& source : files_under(folder, {".h", ".cpp", ".cu", ".cuh"})) {
      if (source.path.ends_with("_test.cpp") || source.path.find("/tests/") != std::string::npos) continue;
      std::istringstream lines(source.text);
      for (std::string line; std::getline(lines, line);) {
        if (!keeps_state(line)) continue;
        const std::filesystem::path path(source.path);
        const std::string name = path.parent_path().filename().string() + "/" + path.filename().string();
        found.insert(name);
        EXPECT_HAS(section, "`" + name + "`")
            << source.path << " keeps state of the process, which docs/reference/inside.md does not list: " << line;
      }
    }
  }
  std::set<std::string> listed;
  const std::regex file_in_row(R"(`(\w+/\w+\.\w+)`)");
  std::istringstream rows(section);
  for (std::string row; std::getline(rows, row);) {
    const std::string where = row.starts_with("| `") ? row.substr(0, row.find(" | ")) : "";
    for (auto it = std::sregex_iterator(where.begin(), where.end(), file_in_row); it != std::sregex_iterator(); ++it)
      listed.insert((*it)[1]);
  }
  EXPECT_EQ(listed, found);
}

TEST(SourceRules, StateIsRecognised) {
  for (const char* line : {"Workspace g_scratch;", "thread_local bool t_inside = false;", "  static bool on = true;",
                           "  static Library* const only = new Library;", "volatile std::sig_atomic_t g_save = 0;",
                           "  static Teams& all = *new Teams;", "thread_local KeptBlocks* blocks_of_call = nullptr;",
                           "  static std::map<int, int> cache;"}) {
    EXPECT_TRUE(keeps_state(line)) << line;
  }
  for (const char* line : {"  static const int quota = cpu_quota();", "  static constexpr int kBits = 3;",
                           "  static std::string file_name(std::int64_t step);", "  g_save = 1;",
                           "  static void add(Sums& sums) {", "  const double g_at = f(1);"}) {
    EXPECT_FALSE(keeps_state(line)) << line;
  }
}

// Flags that let the compiler believe that there is no NaN: they would delete every finite check.
std::vector<std::string> fast_math_in(const std::string& text) {
  std::vector<std::string> found;
  for (const char* flag :
       {"-ffast-math", "-Ofast", "-funsafe-math", "-fassociative-math", "-freciprocal-math", "-ffinite-math-only",
        "-fno-honor-nans", "-fno-honor-infinities", "-fno-signed-zeros", "-ffp-model=fast", "-fp-model fast",
        "/fp:fast", "use_fast_math", "-cl-fast-relaxed-math", "optimize(\"fast-math"}) {
    if (text.find(flag) != std::string::npos) found.emplace_back(flag);
  }
  return found;
}

TEST(SourceRules, NoBuildFileAsksForFastMath) {
  std::vector<SourceFile> files;
  for (const char* folder : {"cmake", "framework", "plugins", "app", "tests", "scripts", ".ci"}) {
    for (SourceFile& file :
         files_under(folder, {"CMakeLists.txt", ".cmake", ".cmake.in", ".json", ".yml", ".yaml", ".sh"}))
      files.push_back(std::move(file));
  }
  for (const char* script : {"scripts/setup", "scripts/test", "scripts/demo", "CMakeLists.txt", "CMakePresets.json"}) {
    std::ifstream file(std::string(SEMFIELD_SOURCE_DIR) + "/" + script);
    ASSERT_TRUE(file) << script;
    files.push_back({script, {std::istreambuf_iterator<char>(file), {}}});
  }
  EXPECT_GT(files.size(), 10u);
  for (const SourceFile& file : files) {
    for (const std::string& flag : fast_math_in(file.text)) ADD_FAILURE() << file.path << " has " << flag;
  }
}

TEST(SourceRules, NoSourceTurnsFastMathOn) {
  // Two files name the flags because they search for them: this one in sources, the other in the commands of a build.
  const std::set<std::string> searches{"tests/architecture/source_rules_test.cpp",
                                       "tests/numerics/backend_finite_cases.cpp"};
  for (const SourceFile& file : all_sources()) {
    if (searches.contains(file.path)) continue;
    for (const std::string& flag : fast_math_in(file.text)) ADD_FAILURE() << file.path << " has " << flag;
  }
}

// The commands that this build runs, whatever added to them: presets, the environment's CXXFLAGS, a tool chain file.
TEST(SourceRules, NoCommandOfThisBuildAsksForFastMath) {
  std::ifstream file(std::string(SEMFIELD_BINARY_DIR) + "/build.ninja");
  if (!file) GTEST_SKIP() << "not a Ninja build";
  int commands = 0;
  for (std::string line; std::getline(file, line);) {
    if (line.find("FLAGS = ") == std::string::npos) continue;
    ++commands;
    for (const std::string& flag : fast_math_in(line)) FAIL() << flag << " in: " << line;
  }
  EXPECT_GT(commands, 50);
}

TEST(SourceRules, FastMathIsRecognised) {
  EXPECT_EQ(fast_math_in("add_compile_options(-O3 -ffast-math)").size(), 1u);
  EXPECT_EQ(fast_math_in("\"CMAKE_CUDA_FLAGS\": \"--use_fast_math\"").size(), 1u);
  EXPECT_TRUE(fast_math_in("-O3 -ffp-contract=off -fno-math-errno").empty());
}

}  // namespace
}  // namespace semfield::architecture
