// What the machine lets this process have: CPU time, memory, libraries that are loaded late.
#pragma once

#include <cstddef>
#include <limits>
#include <string>

namespace semfield {

// How much CPU time a control group allows, as whole cores.

/// Cores' worth of time that Linux control groups grant this process, rounded up: the smallest of its group and the
/// groups above, version 2 (cpu.max) or 1 (cpu.cfs_quota_us); 0 = no limit, or none that can be read. `groups` is the
/// text of /proc/self/cgroup, `root` where the groups are mounted.
int cpu_quota(const std::string& groups, const std::string& root);
/// Of this process.
int cpu_quota();

// How much memory this process holds and may still take: the system's, and that of its control groups.

inline constexpr std::size_t kNoMemoryLimit = std::numeric_limits<std::size_t>::max();

/// Bytes that can still be taken: the least of MemAvailable in `meminfo` (text of /proc/meminfo) and, for every control
/// group of the process and those above it, its limit less what it uses, version 2 (memory.max, memory.current) or 1
/// (memory.limit_in_bytes, memory.usage_in_bytes); file caches that a group can drop count as free. kNoMemoryLimit
/// where nothing can be read. `groups` is the text of /proc/self/cgroup, `root` where the groups are mounted.
std::size_t available_memory(const std::string& meminfo, const std::string& groups, const std::string& root);
/// Of this process.
std::size_t available_memory();

/// Resident bytes of this process, now and at most so far; 0 where the system does not tell.
std::size_t resident_bytes();
std::size_t peak_resident_bytes();

/// Gives memory that was freed back to the system, so that resident_bytes() is what is held.
void release_freed_memory();

/// Takes 1 MiB of the calling thread's stack now, or half of its limit where that is less. The stack of a process's first
/// thread grows page by page; where the address space is used up (`ulimit -v`), the next page is a SIGSEGV, which nobody
/// can report. False where there is no room for it.
bool claim_stack();

/// "812 MB", "6.0 GB".
std::string memory_text(std::size_t bytes);

// Libraries of ours that are loaded when they are needed: they lie beside the framework's own and bring large
// dependencies that most runs do without.

/// The symbol of library `file` in the folder of the framework's library. Throws Error(unavailable): "<what>: <the
/// loader's words>"; `remedy` as in Error.
void* library_symbol(const std::string& file, const char* symbol, const std::string& what, const std::string& remedy);

/// The same of `target`, a library lib<target>.so that a build of the program alone leaves out; the remedy names the
/// target that builds it.
void* part_symbol(const std::string& target, const char* symbol, const std::string& what);

}  // namespace semfield
