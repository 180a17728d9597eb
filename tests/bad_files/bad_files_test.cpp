// Every case of the tables through the real program: its exit code, what it says, and what refusing costs.
#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <cstdlib>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>

#include "datasets/obj_room/raycast.h"
#include "formats/image_io.h"
#include "system/files.h"
#include "tests/bad_files/case_file.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::bad_files {
namespace {

namespace fs = std::filesystem;

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kMeasured = false;  // the sanitizers' own memory and time
#else
constexpr bool kMeasured = true;
#endif

struct Outcome {
  int code = -1;  ///< minus the signal that ended it
  std::string said;
  double cpu_s = 0;
  long peak_kib = 0;
};

void limit(int what, rlim_t most) {
  const rlimit both{most, most};
  (void)::setrlimit(what, &both);
}

std::vector<std::string> words_of_line(const std::string& line) {
  std::istringstream in(line);
  std::vector<std::string> out;
  for (std::string word; in >> word;) out.push_back(word);
  return out;
}

// The program in `folder`; what it said lies in ../said beside it.
Outcome run(const std::string& line, const std::string& folder) {
  std::vector<std::string> words = words_of_line(line);
  words.insert(words.begin(), SEMFIELD_BINARY);
  std::vector<char*> argv;
  for (std::string& word : words) argv.push_back(word.data());
  argv.push_back(nullptr);
  const std::string log = folder + ".said";
  const pid_t child = ::fork();
  if (child == 0) {
    if (kMeasured) {
      limit(RLIMIT_CPU, 10);
      limit(RLIMIT_AS, rlim_t{8} << 30);
    }
    limit(RLIMIT_CORE, 0);
    ::alarm(120);
    const int out = ::open(log.c_str(), O_CREAT | O_TRUNC | O_WRONLY, 0600), in = ::open("/dev/null", O_RDONLY);
    ::dup2(in, 0);
    ::dup2(out, 1);
    ::dup2(out, 2);
    if (::chdir(folder.c_str()) == 0) ::execv(argv[0], argv.data());
    ::_exit(127);
  }
  int status = 0;
  rusage used{};
  Outcome outcome;
  if (child < 0 || ::wait4(child, &status, 0, &used) != child) return outcome;
  outcome.code = WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status);
  outcome.said = read_text_file(log);
  const auto seconds = [](const timeval& t) {
    return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
  };
  outcome.cpu_s = seconds(used.ru_utime) + seconds(used.ru_stime);
  outcome.peak_kib = used.ru_maxrss;
  return outcome;
}

void run_setup(const std::string& words, const std::string& folder) {
  const Outcome outcome = run(words, folder);
  if (outcome.code != 0) throw std::runtime_error("setup '" + words + "': " + outcome.said);
}

// Bases of all files, made when the first case needs them.
class Bases {
 public:
  explicit Bases(const std::vector<Base>& bases, std::string folder) : folder_(std::move(folder)) {
    for (const Base& base : bases) by_name_[base.name] = &base;
  }
  // A fresh copy of the base for a case.
  std::string copy_for(const Case& one) {
    const auto base = by_name_.find(one.base);
    if (base == by_name_.end()) throw std::runtime_error(one.place + ": no base '" + one.base + "'");
    const std::string made = folder_ + "/base_" + one.base, copy = folder_ + "/" + one.name;
    if (!fs::exists(made)) {
      fs::create_directories(made);
      for (const Edit& edit : base->second->edits) apply(edit, made, run_setup);
    }
    fs::copy(made, copy, fs::copy_options::recursive | fs::copy_options::copy_symlinks);
    return copy;
  }

 private:
  std::string folder_;
  std::map<std::string, const Base*> by_name_;
};

// The case's folder as ROOT, that of shipped files as SHARE.
std::string with_root(std::string said, const std::string& folder) {
  for (const auto& [path, word] : {std::pair(folder, "ROOT"), std::pair(shared_root(), "SHARE")}) {
    for (std::size_t at = said.find(path); at != std::string::npos; at = said.find(path, at + 4))
      said.replace(at, path.size(), word);
  }
  return said;
}

// The first line that is there twice; "" when none is.
std::string repeated_line(const std::string& said) {
  std::set<std::string> lines;
  std::istringstream in(said);
  for (std::string line; std::getline(in, line);) {
    if (!line.empty() && !lines.insert(line).second) return line;
  }
  return "";
}

std::vector<std::string> case_files() {
  std::vector<std::string> out;
  for (const fs::directory_entry& entry : fs::directory_iterator(fs::path(SEMFIELD_SOURCE_DIR) / "tests/bad_files")) {
    if (entry.path().extension() == ".cases") out.push_back(entry.path().stem().string());
  }
  std::sort(out.begin(), out.end());
  return out;
}

CaseFile read_named(const std::string& name) {
  return read_cases((fs::path(SEMFIELD_SOURCE_DIR) / "tests/bad_files" / (name + ".cases")).string());
}

class BadFiles : public ::testing::TestWithParam<std::string> {};

TEST_P(BadFiles, AreRefusedWithPlaceCauseAndRemedy) {
  const CaseFile file = read_named(GetParam());
  const std::string folder = testing_room::fresh_folder(GetParam());
  Bases bases(file.bases, folder);
  const bool whole_build = raycast_available() && images_available();
  std::size_t absent = 0;
  double slowest_s = 0;
  long largest_kib = 0;
  for (const Case& one : file.cases) {
    SCOPED_TRACE(one.place + ": " + one.name);
    const std::string root = bases.copy_for(one);
    for (const Edit& edit : one.edits) apply(edit, root, run_setup);
    const Outcome outcome = run(one.words, root);
    const std::string said = with_root(outcome.said, root);
    if (std::getenv("SEMFIELD_SHOW_CASES") != nullptr)
      std::printf("@ %s %d\n%s", one.name.c_str(), outcome.code, said.c_str());
    if (!whole_build && said.find("this build ") != std::string::npos) {
      ++absent;
      continue;
    }
    EXPECT_EQ(outcome.code, one.code) << said;
    EXPECT_FALSE(one.says.empty()) << said;
    for (const std::string& part : one.says) EXPECT_HAS(said, part) << "not said: " << part << "\nbut: " << said;
    for (const std::string& part : one.never) EXPECT_LACKS(said, part) << "said: " << part << "\nin: " << said;
    EXPECT_EQ(repeated_line(said), "") << said;
    if (kMeasured) {
      EXPECT_LE(outcome.peak_kib, one.most_mib << 10);
    }
    slowest_s = std::max(slowest_s, outcome.cpu_s);
    largest_kib = std::max(largest_kib, outcome.peak_kib);
    fs::remove_all(root);
  }
  if (absent > 0) {
    const std::size_t whole = file.cases.size();
    GTEST_SKIP() << absent << " of " << whole << " cases need formats that this build does not read; the others hold";
  }
  std::printf("%s: %zu cases, slowest %.2f s of the CPU, largest %ld MiB\n", GetParam().c_str(),
              file.cases.size(), slowest_s, largest_kib >> 10);
}

INSTANTIATE_TEST_SUITE_P(Tables, BadFiles, ::testing::ValuesIn(case_files()),
                         [](const auto& each) { return each.param; });

TEST(BadFileTables, ThereAreThreeHundredDifferentOnes) {
  std::set<std::string> names;
  std::size_t bad = 0;
  for (const std::string& name : case_files()) {
    for (const Case& one : read_named(name).cases) {
      EXPECT_TRUE(names.insert(one.name).second) << one.place << ": '" << one.name << "' is there twice";
      bad += one.code != 0 ? 1 : 0;
    }
  }
  EXPECT_GE(bad, 300u);
}

}  // namespace
}  // namespace semfield::bad_files
