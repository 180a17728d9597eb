#include "app/serve/page_files.h"

#include <fcntl.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstdint>
#include <filesystem>
#include <optional>

#include "core/error.h"
#include "core/files.h"

namespace semfield::app {

namespace fs = std::filesystem;

std::string new_token() {
  std::array<std::uint8_t, 16> bits{};
  if (getrandom(bits.data(), bits.size(), 0) != static_cast<ssize_t>(bits.size()))
    throw Error(ErrorKind::unavailable, "system.random.missing",
                "the system gives no random bits for the page's secret address",
                "see `man 2 getrandom`; a kernel from 3.17 on has it");
  std::string token;
  for (const std::uint8_t b : bits) {
    token += "0123456789abcdef"[b >> 4];
    token += "0123456789abcdef"[b & 15];
  }
  return token;
}

std::string kept_token(const std::string& run_dir) {
  const std::string path = run_dir + "/serve_token";
  struct stat facts {};
  if (lstat(path.c_str(), &facts) == 0 && S_ISREG(facts.st_mode) && (facts.st_mode & 077) == 0 &&
      facts.st_uid == geteuid()) {
    const std::string kept = read_text_file(path);
    if (kept.size() == 32 && kept.find_first_not_of("0123456789abcdef") == std::string::npos) return kept;
  }
  unlink(path.c_str());
  const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC | O_NOFOLLOW, 0600);
  if (file < 0) throw write_error("create", path, errno);
  const std::string token = new_token();
  try {
    append_all(file, path, token);
  } catch (...) {
    close(file);
    throw;
  }
  close(file);
  return token;
}

std::map<std::string, PageFile> read_page_files(const std::string& folder) {
  static const std::map<std::string, std::string> types{{".html", "text/html; charset=utf-8"},
                                                        {".js", "text/javascript; charset=utf-8"},
                                                        {".css", "text/css; charset=utf-8"},
                                                        {".svg", "image/svg+xml"},
                                                        {".png", "image/png"},
                                                        {".ico", "image/x-icon"}};
  std::map<std::string, PageFile> files;
  std::error_code failed;
  for (const auto& entry : std::filesystem::directory_iterator(folder, failed)) {
    const auto type = types.find(entry.path().extension().string());
    if (type == types.end() || !entry.is_regular_file(failed)) continue;
    files[entry.path().filename().string()] = {type->second, read_text_file(entry.path().string())};
  }
  const auto index = files.find("index.html");
  if (index == files.end())
    throw Error(ErrorKind::no_input, "files.shared.missing",
                folder + ": the page's index.html is not there, which comes with the program",
                "install the component 'app' whole, or run the program from its build folder");
  files[""] = index->second;
  return files;
}

namespace {

struct Kept {
  std::string id, place;
};

// None: there is no such file, or it holds something else.
std::optional<Kept> kept_in(const fs::path& run_dir) {
  constexpr std::size_t kMostBytes = 8192;
  const fs::path file = run_dir / "run_id";
  if (!is_file(file)) return std::nullopt;
  const std::string text = read_file_start(file.string(), kMostBytes);
  const std::size_t end = text.find('\n');
  if (end != 32 || text.find_first_not_of("0123456789abcdef") != end || !text.ends_with('\n')) return std::nullopt;
  return Kept{text.substr(0, end), text.substr(end + 1, text.size() - end - 2)};
}

bool is_copy(const Kept& kept, const fs::path& place) {
  std::error_code unknown;
  if (kept.place == place || fs::equivalent(kept.place, place, unknown)) return false;
  const std::optional<Kept> original = kept_in(kept.place);
  return original && original->id == kept.id;
}

}  // namespace

std::string kept_run_id(const std::string& run_dir) {
  const fs::path place = fs::weakly_canonical(fs::absolute(run_dir));
  std::optional<Kept> kept = kept_in(place);
  if (kept && kept->place == place) return kept->id;
  if (kept && is_copy(*kept, place)) {
    fs::remove(place / "serve_token");
    kept.reset();
  }
  const std::string id = kept ? kept->id : new_token();
  write_file_atomic((place / "run_id").string(), id + "\n" + place.string() + "\n");
  return id;
}

}  // namespace semfield::app
