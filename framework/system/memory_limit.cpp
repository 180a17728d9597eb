#include "system/memory_limit.h"

#include <alloca.h>
#include <fmt/format.h>
#include <malloc.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <optional>
#include <sstream>

#include "system/files.h"

namespace semfield {

namespace {

// The number behind a word of a text of "word number" lines, or the text's only number when the word is "".
std::optional<std::size_t> number_in(const std::string& text, const std::string& word) {
  std::istringstream words(text);
  std::string name;
  std::uint64_t value = 0;
  if (word.empty()) return words >> value ? std::optional<std::size_t>(value) : std::nullopt;
  while (words >> name) {
    if (name == word && words >> value) return value;
  }
  return std::nullopt;
}

// What one group leaves; kNoMemoryLimit without a limit ("max", or a file that is not there).
std::size_t room_in(const std::string& folder, const char* limit_file, const char* usage_file, const char* cache) {
  const std::optional<std::size_t> limit = number_in(read_system_file(folder + limit_file), "");
  const std::optional<std::size_t> usage = number_in(read_system_file(folder + usage_file), "");
  if (!limit || !usage) return kNoMemoryLimit;
  const std::size_t dropped = std::min(*usage, number_in(read_system_file(folder + "/memory.stat"), cache).value_or(0));
  const std::size_t held = *usage - dropped;
  return *limit > held ? *limit - held : 0;
}

}  // namespace

std::size_t available_memory(const std::string& meminfo, const std::string& groups, const std::string& root) {
  std::size_t least = kNoMemoryLimit;
  if (const auto kilobytes = number_in(meminfo, "MemAvailable:")) least = *kilobytes * 1024;
  std::istringstream lines(groups);
  for (std::string line; std::getline(lines, line);) {  // number:controllers:path; version 2 names no controller
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = "," + line.substr(first + 1, second - first - 1) + ",";
    const bool unified = controllers == ",,";
    if (!unified && controllers.find(",memory,") == std::string::npos) continue;
    for (std::string path = line.substr(second + 1);; path.resize(path.rfind('/'))) {
      if (path == "/") path.clear();
      least = std::min(least, unified ? room_in(root + path, "/memory.max", "/memory.current", "inactive_file")
                                      : room_in(root + "/memory" + path, "/memory.limit_in_bytes",
                                                "/memory.usage_in_bytes", "total_inactive_file"));
      if (path.rfind('/') == std::string::npos) break;
    }
  }
  return least;
}

std::size_t available_memory() {
  return available_memory(read_system_file("/proc/meminfo"), read_system_file("/proc/self/cgroup"), "/sys/fs/cgroup");
}

std::size_t resident_bytes() {
  std::istringstream pages(read_system_file("/proc/self/statm"));
  std::size_t all = 0, resident = 0;
  return pages >> all >> resident ? resident * static_cast<std::size_t>(sysconf(_SC_PAGESIZE)) : 0;
}

std::size_t peak_resident_bytes() {
  rusage usage{};
  if (getrusage(RUSAGE_SELF, &usage) != 0) return 0;
  return static_cast<std::size_t>(usage.ru_maxrss) * 1024;
}

void release_freed_memory() { malloc_trim(0); }

#if defined(__GNUC__)
__attribute__((noinline))
#endif
bool claim_stack() {
  constexpr std::size_t kPage = 4096;
  std::size_t bytes = std::size_t{1} << 20;
  rlimit limit{};
  if (getrlimit(RLIMIT_STACK, &limit) == 0 && limit.rlim_cur != RLIM_INFINITY)
    bytes = std::min<std::size_t>(bytes, limit.rlim_cur / 2);
  // Asked for first, because a stack that cannot grow says so by a signal.
  void* const room = mmap(nullptr, bytes + kPage, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (room == MAP_FAILED) return false;
  munmap(room, bytes + kPage);
  auto* const stack = static_cast<volatile char*>(alloca(bytes));
  for (std::size_t at = bytes; at >= kPage; at -= kPage) stack[at - 1] = 0;
  return true;
}

std::string memory_text(std::size_t bytes) {
  const double mb = static_cast<double>(bytes) / (1 << 20);
  return mb < 1000 ? fmt::format("{:.0f} MB", mb) : fmt::format("{:.1f} GB", mb / 1024);
}

}  // namespace semfield
