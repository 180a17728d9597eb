// A library to preload: counts the file calls of a process below one folder, records them, and at one of them kills
// the process or fails the call.
//
// SEMFIELD_FAULT_BELOW  absolute path; only calls on paths below it (or on files opened there) count, from 1
// SEMFIELD_FAULT_LOG    file that gets one line per call: number, name, descriptor, path, second path, offset, size
// (flags
//                       of an open), result, errno, separated by tabs; written bytes follow one another in LOG.data
// SEMFIELD_FAULT_CALL   number of the call that is hit
// SEMFIELD_FAULT        kill_before, kill_after, kill_half (half of a write is done), short (half a write succeeds), or
// a
//                       number of errno
// SEMFIELD_FAULT_STICKY 1: calls that need space keep failing from then on, as on a disk that is full
#include <dlfcn.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <mutex>
#include <string>

namespace {

struct Call {
  const char* name;
  int descriptor = -1;
  const char* path = "";
  const char* other = "";
  long long offset = 0;
  long long size = 0;
  const void* data = nullptr;  // of a write
  bool needs_space = false;
};

struct Plan {
  std::string below, log;
  long hit = 0;
  std::string fault;
  bool sticky = false;
  int log_file = -1, data_file = -1;
  long count = 0;   // calls so far
  int failing = 0;  // errno of a sticky fault that has begun
};

std::string variable(const char* name) {
  const char* value = std::getenv(name);
  return value == nullptr ? std::string() : std::string(value);
}

int raw_open(const std::string& path) {
  return static_cast<int>(syscall(SYS_openat, AT_FDCWD, path.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600));
}

void raw_write(int file, const void* data, std::size_t size) {
  if (file >= 0 && syscall(SYS_write, file, data, size) < 0) std::abort();
}

// Leaked on purpose: calls are made until the very end of the process.
Plan& plan() {
  static Plan* made = [] {
    auto* p = new Plan;
    p->below = variable("SEMFIELD_FAULT_BELOW");
    p->log = variable("SEMFIELD_FAULT_LOG");
    p->hit = std::atol(variable("SEMFIELD_FAULT_CALL").c_str());
    p->fault = variable("SEMFIELD_FAULT");
    p->sticky = variable("SEMFIELD_FAULT_STICKY") == "1";
    if (!p->log.empty()) {
      p->log_file = raw_open(p->log);
      p->data_file = raw_open(p->log + ".data");
    }
    return p;
  }();
  return *made;
}

constexpr std::size_t kDescriptors = 4096;
std::array<std::string, kDescriptors>& paths() {
  static auto* table = new std::array<std::string, kDescriptors>;
  return *table;
}
std::recursive_mutex& guard() {
  static auto* mutex = new std::recursive_mutex;
  return *mutex;
}

bool watched(const char* path) {
  const std::string& below = plan().below;
  return path != nullptr && !below.empty() && std::strncmp(path, below.c_str(), below.size()) == 0 &&
         (path[below.size()] == '/' || path[below.size()] == '\0');
}

const char* path_of(int descriptor) {
  if (descriptor < 0 || static_cast<std::size_t>(descriptor) >= kDescriptors) return nullptr;
  const std::string& path = paths()[descriptor];
  return path.empty() ? nullptr : path.c_str();
}

std::string at(int folder, const char* path) {
  if (path == nullptr || path[0] == '/') return path == nullptr ? "" : path;
  if (folder == AT_FDCWD) {
    std::array<char, 4096> here{};
    return (getcwd(here.data(), here.size()) == nullptr ? std::string() : std::string(here.data())) + "/" + path;
  }
  const char* known = path_of(folder);
  return known == nullptr ? std::string() : std::string(known) + "/" + path;
}

void record(long number, const Call& call, long long result, int cause) {
  if (plan().log_file < 0) return;
  std::array<char, 9000> line{};
  const int size =
      std::snprintf(line.data(), line.size(), "%ld\t%s\t%d\t%s\t%s\t%lld\t%lld\t%lld\t%d\n", number, call.name,
                    call.descriptor, call.path, call.other, call.offset, call.size, result, result < 0 ? cause : 0);
  raw_write(plan().log_file, line.data(), static_cast<std::size_t>(size));
  if (call.data != nullptr && result > 0) raw_write(plan().data_file, call.data, static_cast<std::size_t>(result));
}

// `make(size)` performs the call, a write with so many of its bytes.
template <class Make>
long long counted(Call call, Make&& make) {
  const std::lock_guard<std::recursive_mutex> lock(guard());
  Plan& p = plan();
  const long number = ++p.count;
  const bool hit = number == p.hit;
  if (hit && p.fault == "kill_before") kill(getpid(), SIGKILL);
  long long size = call.size;
  const bool halves = call.data != nullptr && hit && (p.fault == "short" || p.fault == "kill_half");
  if (halves && size > 1) size /= 2;
  const int number_of_errno = hit && !halves ? std::atoi(p.fault.c_str()) : 0;
  if (number_of_errno != 0 && p.sticky) p.failing = number_of_errno;
  const int refused = number_of_errno != 0 ? number_of_errno : call.needs_space ? p.failing : 0;
  long long result = -1;
  int cause = refused;
  if (refused == 0) {
    result = make(size);
    cause = errno;
  } else if (std::strcmp(call.name, "close") == 0) {
    make(size);  // a close that reports an error has closed all the same
  }
  if (hit && (p.fault == "kill_after" || p.fault == "kill_half")) kill(getpid(), SIGKILL);
  record(number, call, result, cause);
  errno = cause;
  return result;
}

template <class Function>
Function* next(const char* name) {
  return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, name));
}

int open_counted(const char* name, int folder, const char* path, int flags, mode_t mode) {
  static auto* real = next<int(int, const char*, int, ...)>("openat");
  const std::string full = at(folder, path);
  if (!watched(full.c_str())) return real(folder, path, flags, mode);
  Call call{name};
  call.path = full.c_str();
  call.size = flags;
  call.needs_space = (flags & O_CREAT) != 0;
  const std::lock_guard<std::recursive_mutex> lock(guard());
  return static_cast<int>(counted(call, [&](long long) {
    const int file = real(folder, path, flags, mode);
    if (file >= 0 && static_cast<std::size_t>(file) < kDescriptors) paths()[file] = full;
    return file;
  }));
}

template <class Make>
long long on_descriptor(const char* name, int file, long long offset, long long size, const void* data,
                        bool needs_space, Make&& make) {
  const char* path = path_of(file);
  if (path == nullptr) return make(size);
  Call call{name, file, path};
  call.offset = offset;
  call.size = size;
  call.data = data;
  call.needs_space = needs_space;
  return counted(call, make);
}

template <class Make>
int on_path(const char* name, const std::string& path, const std::string& other, bool needs_space, Make&& make) {
  if (!watched(path.c_str()) && !watched(other.c_str())) return make(0);
  Call call{name};
  call.path = path.c_str();
  call.other = other.c_str();
  call.needs_space = needs_space;
  return static_cast<int>(counted(call, make));
}

mode_t mode_of(int flags, va_list more) { return (flags & (O_CREAT | O_TMPFILE)) != 0 ? va_arg(more, mode_t) : 0; }

}  // namespace

extern "C" {

#define SEMFIELD_OPEN(name)                                   \
  int name(const char* path, int flags, ...) {                \
    va_list more;                                             \
    va_start(more, flags);                                    \
    const mode_t mode = mode_of(flags, more);                 \
    va_end(more);                                             \
    return open_counted("open", AT_FDCWD, path, flags, mode); \
  }
SEMFIELD_OPEN(open)
SEMFIELD_OPEN(open64)

#define SEMFIELD_OPENAT(name)                               \
  int name(int folder, const char* path, int flags, ...) {  \
    va_list more;                                           \
    va_start(more, flags);                                  \
    const mode_t mode = mode_of(flags, more);               \
    va_end(more);                                           \
    return open_counted("open", folder, path, flags, mode); \
  }
SEMFIELD_OPENAT(openat)
SEMFIELD_OPENAT(openat64)

int creat(const char* path, mode_t mode) {
  return open_counted("open", AT_FDCWD, path, O_WRONLY | O_CREAT | O_TRUNC, mode);
}

ssize_t write(int file, const void* data, size_t size) {
  static auto* real = next<ssize_t(int, const void*, size_t)>("write");
  const long long offset = path_of(file) == nullptr ? 0 : lseek(file, 0, SEEK_CUR);
  return static_cast<ssize_t>(
      on_descriptor("write", file, offset, static_cast<long long>(size), data, true,
                    [&](long long part) { return real(file, data, static_cast<size_t>(part)); }));
}

#define SEMFIELD_PWRITE(name)                                                                                \
  ssize_t name(int file, const void* data, size_t size, off_t offset) {                                      \
    static auto* real = next<ssize_t(int, const void*, size_t, off_t)>(#name);                               \
    return static_cast<ssize_t>(                                                                             \
        on_descriptor("write", file, offset, static_cast<long long>(size), data, true,                       \
                      [&](long long part) { return real(file, data, static_cast<size_t>(part), offset); })); \
  }
SEMFIELD_PWRITE(pwrite)
SEMFIELD_PWRITE(pwrite64)

ssize_t read(int file, void* data, size_t size) {
  static auto* real = next<ssize_t(int, void*, size_t)>("read");
  return static_cast<ssize_t>(on_descriptor("read", file, 0, static_cast<long long>(size), nullptr, false,
                                            [&](long long) { return real(file, data, size); }));
}

#define SEMFIELD_PREAD(name)                                                                                      \
  ssize_t name(int file, void* data, size_t size, off_t offset) {                                                 \
    static auto* real = next<ssize_t(int, void*, size_t, off_t)>(#name);                                          \
    return static_cast<ssize_t>(on_descriptor("read", file, offset, static_cast<long long>(size), nullptr, false, \
                                              [&](long long) { return real(file, data, size, offset); }));        \
  }
SEMFIELD_PREAD(pread)
SEMFIELD_PREAD(pread64)

#define SEMFIELD_SYNC(name)                                                                         \
  int name(int file) {                                                                              \
    static auto* real = next<int(int)>(#name);                                                      \
    return static_cast<int>(                                                                        \
        on_descriptor("fsync", file, 0, 0, nullptr, false, [&](long long) { return real(file); })); \
  }
SEMFIELD_SYNC(fsync)
SEMFIELD_SYNC(fdatasync)

int close(int file) {
  static auto* real = next<int(int)>("close");
  const std::lock_guard<std::recursive_mutex> lock(guard());
  const int result =
      static_cast<int>(on_descriptor("close", file, 0, 0, nullptr, false, [&](long long) { return real(file); }));
  const int cause = errno;
  if (path_of(file) != nullptr) paths()[file].clear();
  errno = cause;
  return result;
}

#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wshadow"  // the C library has a struct of this name too
int flock(int file, int operation) {
  static auto* real = next<int(int, int)>("flock");
  return static_cast<int>(
      on_descriptor("flock", file, 0, operation, nullptr, false, [&](long long) { return real(file, operation); }));
}
#pragma GCC diagnostic pop

#define SEMFIELD_TRUNCATE(name)                                                                                 \
  int name(int file, off_t size) {                                                                              \
    static auto* real = next<int(int, off_t)>(#name);                                                           \
    return static_cast<int>(                                                                                    \
        on_descriptor("ftruncate", file, 0, size, nullptr, true, [&](long long) { return real(file, size); })); \
  }
SEMFIELD_TRUNCATE(ftruncate)
SEMFIELD_TRUNCATE(ftruncate64)

int rename(const char* from, const char* to) {
  static auto* real = next<int(const char*, const char*)>("rename");
  return on_path("rename", at(AT_FDCWD, from), at(AT_FDCWD, to), true, [&](long long) { return real(from, to); });
}
int renameat(int from_folder, const char* from, int to_folder, const char* to) {
  static auto* real = next<int(int, const char*, int, const char*)>("renameat");
  return on_path("rename", at(from_folder, from), at(to_folder, to), true,
                 [&](long long) { return real(from_folder, from, to_folder, to); });
}
int link(const char* from, const char* to) {
  static auto* real = next<int(const char*, const char*)>("link");
  return on_path("link", at(AT_FDCWD, from), at(AT_FDCWD, to), true, [&](long long) { return real(from, to); });
}
int linkat(int from_folder, const char* from, int to_folder, const char* to, int flags) {
  static auto* real = next<int(int, const char*, int, const char*, int)>("linkat");
  return on_path("link", at(from_folder, from), at(to_folder, to), true,
                 [&](long long) { return real(from_folder, from, to_folder, to, flags); });
}
int unlink(const char* path) {
  static auto* real = next<int(const char*)>("unlink");
  return on_path("unlink", at(AT_FDCWD, path), "", false, [&](long long) { return real(path); });
}
int remove(const char* path) {
  static auto* real = next<int(const char*)>("remove");
  return on_path("unlink", at(AT_FDCWD, path), "", false, [&](long long) { return real(path); });
}
int unlinkat(int folder, const char* path, int flags) {
  static auto* real = next<int(int, const char*, int)>("unlinkat");
  return on_path("unlink", at(folder, path), "", false, [&](long long) { return real(folder, path, flags); });
}
int mkdir(const char* path, mode_t mode) {
  static auto* real = next<int(const char*, mode_t)>("mkdir");
  return on_path("mkdir", at(AT_FDCWD, path), "", true, [&](long long) { return real(path, mode); });
}
int mkdirat(int folder, const char* path, mode_t mode) {
  static auto* real = next<int(int, const char*, mode_t)>("mkdirat");
  return on_path("mkdir", at(folder, path), "", true, [&](long long) { return real(folder, path, mode); });
}

}  // extern "C"
