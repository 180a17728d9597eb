#include "system/cache_folder.h"

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <filesystem>
#include <string_view>
#include <vector>

#include "core/error.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

std::string_view variable(const char* name) {
  const char* value = std::getenv(name);
  return value == nullptr ? std::string_view() : std::string_view(value);
}

fs::path root() {
  if (const auto own = variable("SEMFIELD_CACHE"); !own.empty()) return own == "off" ? fs::path() : fs::path(own);
  if (const auto xdg = variable("XDG_CACHE_HOME"); !xdg.empty()) return fs::path(xdg) / "semfield";
  if (const auto home = variable("HOME"); !home.empty()) return fs::path(home) / ".cache" / "semfield";
  return {};
}

struct Entry {
  fs::path path;
  fs::file_time_type used;
  std::uint64_t bytes;
};

std::uint64_t bytes_of(const fs::path& folder) {
  std::uint64_t sum = 0;
  std::error_code failed;
  for (fs::directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed)) {
    std::error_code gone;
    const auto size = it->file_size(gone);
    if (!gone) sum += size;
  }
  return sum;
}

}  // namespace

std::string cache_folder(const std::string& name) {
  const fs::path folder = root();
  if (folder.empty() || !folder.is_absolute()) return "";
  std::error_code failed;
  fs::create_directories(folder / name, failed);
  return failed ? "" : (folder / name).string();
}

std::uint64_t cache_limit() {
  const auto text = variable("SEMFIELD_CACHE_GB");
  if (text.empty()) return 2'000'000'000;
  double gigabytes = -1;
  const auto [end, failed] = std::from_chars(text.data(), text.data() + text.size(), gigabytes);
  if (failed != std::errc() || end != text.data() + text.size() || !(gigabytes >= 0 && gigabytes <= 1e6)) {
    throw Error(ErrorKind::config, "config.environment.value",
                "environment variable SEMFIELD_CACHE_GB: '" + std::string(text) + "' is not a number from 0 to 1000000",
                "set it to the gigabytes that the cache may hold, or set SEMFIELD_CACHE=off");
  }
  return static_cast<std::uint64_t>(gigabytes * 1e9);
}

void use_cache_entry(const std::string& entry, std::uint64_t limit) {
  std::error_code failed;
  const fs::path own(entry);
  fs::last_write_time(own, fs::file_time_type::clock::now(), failed);
  std::vector<Entry> entries;
  std::uint64_t sum = 0;
  for (fs::directory_iterator it(own.parent_path(), failed), end; !failed && it != end; it.increment(failed)) {
    std::error_code gone;
    if (!it->is_directory(gone)) continue;
    const auto used = it->last_write_time(gone);
    if (gone) continue;
    entries.push_back({it->path(), used, bytes_of(it->path())});
    sum += entries.back().bytes;
  }
  std::sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) { return a.used < b.used; });
  for (const Entry& old : entries) {
    if (sum <= limit) return;
    if (old.path == own) continue;
    fs::remove_all(old.path, failed);
    sum -= old.bytes;
  }
}

}  // namespace semfield
