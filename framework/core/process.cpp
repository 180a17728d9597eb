// What the machine lets this process have: CPU time, memory, libraries that are loaded late.
#include "core/process.h"

#include <alloca.h>
#include <dlfcn.h>
#include <fmt/format.h>
#include <malloc.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <sstream>

#include "core/error.h"
#include "core/files.h"

namespace semfield {

namespace {

// visit(folder, whether it is of version 2) for the control groups of `controller` in the text of /proc/self/cgroup,
// and those above them.
template <class Visit>
void for_groups(const std::string& groups, const std::string& root, const std::string& controller, const Visit& visit) {
  std::istringstream lines(groups);
  for (std::string line; std::getline(lines, line);) {  // number:controllers:path; version 2 names no controller
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = "," + line.substr(first + 1, second - first - 1) + ",";
    const bool unified = controllers == ",,";
    if (!unified && controllers.find("," + controller + ",") == std::string::npos) continue;
    for (std::string path = line.substr(second + 1);; path.resize(path.rfind('/'))) {
      if (path == "/") path.clear();
      visit(root + (unified ? "" : "/" + controller) + path, unified);
      if (path.rfind('/') == std::string::npos) break;
    }
  }
}

int cores_of(double quota_us, double period_us) {
  return quota_us > 0 && period_us > 0 ? static_cast<int>(std::ceil(quota_us / period_us)) : 0;
}

// One group's own limit. Version 2 writes "max 100000" or "150000 100000", version 1 two files and -1 for none.
int limit_of(const std::string& folder) {
  double quota_us = 0, period_us = 0;
  std::istringstream both(read_system_file(folder + "/cpu.max"));
  if (both >> quota_us >> period_us) return cores_of(quota_us, period_us);
  std::istringstream(read_system_file(folder + "/cpu.cfs_quota_us")) >> quota_us;
  std::istringstream(read_system_file(folder + "/cpu.cfs_period_us")) >> period_us;
  return cores_of(quota_us, period_us);
}

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

int cpu_quota(const std::string& groups, const std::string& root) {
  int least = 0;
  for_groups(groups, root, "cpu", [&](const std::string& folder, bool) {
    const int limit = limit_of(folder);
    if (limit > 0 && (least == 0 || limit < least)) least = limit;
  });
  return least;
}

int cpu_quota() { return cpu_quota(read_system_file("/proc/self/cgroup"), "/sys/fs/cgroup"); }

std::size_t available_memory(const std::string& meminfo, const std::string& groups, const std::string& root) {
  std::size_t least = kNoMemoryLimit;
  if (const auto kilobytes = number_in(meminfo, "MemAvailable:")) least = *kilobytes * 1024;
  for_groups(groups, root, "memory", [&](const std::string& folder, bool unified) {
    least = std::min(
        least, unified ? room_in(folder, "/memory.max", "/memory.current", "inactive_file")
                       : room_in(folder, "/memory.limit_in_bytes", "/memory.usage_in_bytes", "total_inactive_file"));
  });
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

void* library_symbol(const std::string& file, const char* symbol, const std::string& what, const std::string& remedy) {
  Dl_info self{};
  ::dladdr(reinterpret_cast<const void*>(&library_symbol), &self);
  const std::filesystem::path folder =
      self.dli_fname != nullptr ? std::filesystem::path(self.dli_fname).parent_path() : std::filesystem::path();
  void* library = ::dlopen((folder / file).c_str(), RTLD_NOW | RTLD_LOCAL);
  void* found = library != nullptr ? ::dlsym(library, symbol) : nullptr;
  if (found == nullptr)
    throw Error(ErrorKind::unavailable, "system.library.missing", what + ": " + ::dlerror(), remedy);
  return found;
}

void* part_symbol(const std::string& target, const char* symbol, const std::string& what) {
  return library_symbol("lib" + target + ".so", symbol, what,
                        "build it (cmake --build FOLDER --target " + target + "), or install the whole of Semfield");
}

}  // namespace semfield
