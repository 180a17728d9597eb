// The table of bad files: scenes as they should be, and cases that spoil one thing in one of them, as text.

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/wait.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "datasets/obj_room/obj_room.h"
#include "formats/image_io.h"
#include "system/files.h"
#include "tests/scene/image_bytes.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::bad_files {
namespace {

/// One change of a folder, in the words of README.md.
struct Edit {
  std::string place;  ///< "poses.cases:12"
  std::string verb;
  std::vector<std::string> words;
};

/// A folder that is as it should be.
struct Base {
  std::string name;
  std::string words;  ///< of its cases that have none
  std::vector<Edit> edits;
};

struct Case {
  std::string name, place, base;
  std::vector<Edit> edits;
  std::string words;  ///< of the command line
  int code = -1;
  long most_mib = 256;             ///< at its peak
  std::vector<std::string> says;   ///< parts of what is written to stderr or stdout; ROOT stands for the case's folder,
                                   ///< SHARE for that of shipped files
  std::vector<std::string> never;  ///< what may not be said
};

struct CaseFile {
  std::vector<Base> bases;
  std::vector<Case> cases;
};

namespace fs = std::filesystem;

[[noreturn]] void fail(const std::string& place, const std::string& what) {
  throw std::runtime_error(place + ": " + what);
}

int digit(char c, const std::string& place) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'a' && c <= 'f') return c - 'a' + 10;
  fail(place, "expected two small hexadecimal digits after \\x");
}

// \n, \t, \r, \\ and \xHH.
std::string unescaped(const std::string& text, const std::string& place) {
  std::string out;
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (text[i] != '\\' || i + 1 == text.size()) {
      out += text[i];
      continue;
    }
    const char c = text[++i];
    if (c == 'x' && i + 2 < text.size()) {
      out += static_cast<char>(16 * digit(text[i + 1], place) + digit(text[i + 2], place));
      i += 2;
    } else {
      out += c == 'n' ? '\n' : c == 't' ? '\t' : c == 'r' ? '\r' : c == '0' ? '\0' : c;
    }
  }
  return out;
}

std::string rest_of(std::istringstream& in) {
  std::string rest;
  std::getline(in >> std::ws, rest);
  return rest;
}

// "FILE REST" or, where REST is "<<", the lines up to ">>".
Edit read_edit(const std::string& verb, std::istringstream& words, std::istream& file, int& line,
               const std::string& place) {
  Edit edit{place, verb, {}};
  std::string first;
  words >> first;
  std::string rest;  // behind one blank; further ones belong to it
  std::getline(words, rest);
  if (!rest.empty()) rest.erase(0, 1);
  if (rest == "<<") {
    rest.clear();
    for (std::string next; std::getline(file, next) && next != ">>"; ++line) rest += next + "\n";
    ++line;
    edit.words = {first, rest};
    return edit;
  }
  if (verb == "setup") {
    edit.words = {first + " " + rest};
    return edit;
  }
  edit.words = {first};
  const std::size_t arrow = verb == "replace" ? rest.find(" => ") : std::string::npos;
  if (arrow != std::string::npos) {
    edit.words.push_back(unescaped(rest.substr(0, arrow), place));
    rest = rest.substr(arrow + 4);
  } else if (verb == "replace" && rest.size() > 2 && rest.substr(rest.size() - 3) == " =>") {
    edit.words.push_back(unescaped(rest.substr(0, rest.size() - 3), place));
    rest.clear();
  }
  edit.words.push_back(unescaped(rest, place));
  return edit;
}

std::string read_whole(const fs::path& path, const std::string& place) {
  if (!fs::is_regular_file(path)) fail(place, "no file " + path.string());
  return read_text_file(path.string());
}

void write_whole(const fs::path& path, const std::string& bytes) {
  fs::create_directories(path.parent_path());
  fs::remove(path);
  std::ofstream(path, std::ios::binary) << bytes;
}

// "WIDTH HEIGHT KIND VALUE": kind gray8, gray16, rgb or palette.
void write_image(const fs::path& path, const std::string& words, const std::string& place) {
  std::istringstream in(words);
  std::int32_t width = 0, height = 0;
  std::string kind;
  unsigned value = 0;
  if (!(in >> width >> height >> kind >> value)) fail(place, "image FILE WIDTH HEIGHT KIND VALUE");
  fs::create_directories(path.parent_path());
  const std::size_t pixels = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
  const auto byte = static_cast<std::uint8_t>(value);
  if (kind == "gray8") {
    write_png_gray8(path.string(), width, height, std::vector<std::uint8_t>(pixels, byte));
  } else if (kind == "gray16") {
    write_png_gray16(path.string(), width, height,
                     std::vector<std::uint16_t>(pixels, static_cast<std::uint16_t>(value)));
  } else if (kind == "rgb") {
    write_png_rgb(path.string(), width, height, std::vector<std::uint8_t>(pixels * 3, byte));
  } else if (kind == "palette") {
    write_png_palette(path.string(), width, height, std::vector<std::uint8_t>(pixels, byte),
                      std::vector<std::uint8_t>{0, 0, 0, 255, 0, 0, 0, 255, 0});
  } else {
    fail(place, "unknown kind of image '" + kind + "'");
  }
}

// "OFFSET HEX": bytes written over those that are there.
void poke(std::string& bytes, const std::string& words, const std::string& place) {
  std::istringstream in(words);
  std::size_t offset = 0;
  std::string hex;
  if (!(in >> offset >> hex) || hex.size() % 2 != 0 || offset + hex.size() / 2 > bytes.size())
    fail(place, "poke FILE OFFSET HEX, inside the file");
  for (std::size_t i = 0; i < hex.size(); i += 2)
    bytes[offset + i / 2] = static_cast<char>(16 * digit(hex[i], place) + digit(hex[i + 1], place));
}

// Right checksums for a PNG or a packed scene that was changed on purpose.
void seal(std::string& bytes) {
  const bool png = bytes.size() > 8 && bytes.substr(1, 3) == "PNG";
  bytes = png ? testing_room::with_png_checksums(bytes) : testing_room::with_pack_checksums(bytes);
}

/// Throws std::runtime_error naming file and line for a line that is not understood.
CaseFile read_cases(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error("no file " + path);
  const std::string name = fs::path(path).filename().string();
  CaseFile out;
  std::vector<Edit>* edits = nullptr;
  Case* of_case = nullptr;  // that lines belong to; none in a base
  std::size_t first = 0;    // of the cases that `or` joins
  int line = 0;
  for (std::string text; std::getline(file, text);) {
    const std::string place = name + ":" + std::to_string(++line);
    std::istringstream words(text);
    std::string verb;
    if (!(words >> verb) || verb[0] == '#') continue;
    if (verb == "base") {
      out.bases.push_back({rest_of(words), "", {}});
      edits = &out.bases.back().edits;
      of_case = nullptr;
    } else if (verb == "case" || verb == "or") {
      Case next;
      if (verb == "or" && of_case == nullptr) fail(place, "'or' before any case");
      next.place = place;
      words >> next.name;
      if (verb == "case") {
        words >> next.base;
        first = out.cases.size();
      } else {
        next.base = of_case->base;
      }
      out.cases.push_back(next);
      of_case = &out.cases.back();
      edits = &of_case->edits;
    } else if (edits == nullptr) {
      fail(place, "'" + verb + "' before any base or case");
    } else if (verb == "run" && of_case == nullptr) {
      out.bases.back().words = rest_of(words);
    } else if (verb == "run" || verb == "within" || verb == "says" || verb == "never" || verb == "and") {
      if (of_case == nullptr) fail(place, "'" + verb + "' before any case");
      Case said;
      if (verb == "within" && !(words >> said.most_mib)) fail(place, "within MEBIBYTES");
      if (verb == "says") words >> said.code;
      const std::string rest = rest_of(words);
      for (std::size_t i = first; i < out.cases.size(); ++i) {
        Case& one = out.cases[i];
        if (verb == "run") one.words = rest;
        if (verb == "within") one.most_mib = said.most_mib;
        if (verb == "says") one.code = said.code;
        if (verb == "says" || verb == "and") one.says.push_back(rest);
        if (verb == "never") one.never.push_back(rest);
      }
    } else {
      edits->push_back(read_edit(verb, words, file, line, place));
    }
  }
  return out;
}

/// Applies the change to `folder`; `setup` gives a program's words to run in it. Throws std::runtime_error naming the
/// line.
void apply(const Edit& edit, const std::string& folder, void (*setup)(const std::string&, const std::string&)) {
  const std::string& verb = edit.verb;
  if (verb == "setup") return setup(edit.words[0], folder);
  const fs::path path = fs::path(folder) / edit.words[0];
  const std::string& what = edit.words.back();
  if (verb == "write") return write_whole(path, what);
  if (verb == "image") return write_image(path, what, edit.place);
  if (verb == "folder") return (void)fs::create_directories(path);
  if (verb == "copy") return write_whole(fs::path(folder) / what, read_whole(path, edit.place));
  if (verb == "pipe") {
    if (::mkfifo(path.c_str(), 0600) != 0) fail(edit.place, "cannot make the pipe");
    return;
  }
  if (verb == "link") return fs::create_symlink(what, path);
  if (verb == "remove") {
    if (fs::remove_all(path) == 0) fail(edit.place, "nothing to remove");
    return;
  }
  if (verb == "sparse") {  // a file of so many bytes that takes no space
    write_whole(path, "");
    return fs::resize_file(path, std::stoull(what));
  }
  if (verb == "fill") {  // "COUNT TEXT"
    std::istringstream in(what);
    std::size_t count = 0;
    in >> count;
    const std::string piece = rest_of(in);
    std::string all;
    for (std::size_t i = 0; i < count; ++i) all += piece;
    return write_whole(path, all);
  }
  std::string bytes = read_whole(path, edit.place);
  if (verb == "append") {
    bytes += what;
  } else if (verb == "prepend") {
    bytes = what + bytes;
  } else if (verb == "cut") {
    const std::size_t size = std::stoull(what);
    if (size >= bytes.size()) fail(edit.place, "the file is shorter already");
    bytes.resize(size);
  } else if (verb == "poke") {
    poke(bytes, what, edit.place);
  } else if (verb == "seal") {
    seal(bytes);
  } else if (verb == "replace") {
    const std::size_t at = bytes.find(edit.words[1]);
    if (edit.words.size() != 3 || at == std::string::npos) fail(edit.place, "nothing to replace");
    bytes.replace(at, edit.words[1].size(), what);
  } else {
    fail(edit.place, "unknown change '" + verb + "'");
  }
  write_whole(path, bytes);
}

// Every case of the tables through the real program: its exit code, what it says, and what refusing costs.

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
  // A fresh copy of the base for a case, which takes its words where it has none.
  std::string copy_for(Case& one) {
    const auto base = by_name_.find(one.base);
    if (base == by_name_.end()) throw std::runtime_error(one.place + ": no base '" + one.base + "'");
    if (one.words.empty()) one.words = base->second->words;
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
  CaseFile file = read_named(GetParam());
  const std::string folder = testing_room::fresh_folder(GetParam());
  Bases bases(file.bases, folder);
  const bool whole_build = raycast_available() && images_available();
  std::size_t absent = 0;
  double slowest_s = 0;
  long largest_kib = 0;
  for (Case& one : file.cases) {
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
  std::printf("%s: %zu cases, slowest %.2f s of the CPU, largest %ld MiB\n", GetParam().c_str(), file.cases.size(),
              slowest_s, largest_kib >> 10);
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
