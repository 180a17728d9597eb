// Whole files in and out: a reader or a crash sees the old file or the new one.
#include "core/files.h"

#include <dlfcn.h>
#include <fcntl.h>
#include <sys/file.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <sstream>

#include "core/text.h"

namespace semfield {

namespace {

// Calls that POSIX lets a signal interrupt are made again.
template <class Call>
auto uninterrupted(Call&& call) {
  auto result = call();
  while (result < 0 && errno == EINTR) result = call();
  return result;
}

bool place_refuses(int cause) {
  return cause == EACCES || cause == EPERM || cause == EROFS || cause == ENOENT || cause == ENOTDIR || cause == ELOOP ||
         cause == ENAMETOOLONG;
}

std::string write_remedy(int cause) {
  switch (cause) {
    case ENOENT:
      return "create the folder first";
    case EACCES:
    case EPERM:
    case EROFS:
      return "choose a folder that you may write to";
    case EISDIR:
    case ENOTDIR:
      return "choose another name";
    case ENOSPC:
    case EDQUOT:
      return "free some space or choose another disk";
    case EFBIG:
      return "raise it with `ulimit -f`, or choose a file system for larger files";
    case EMFILE:
    case ENFILE:
      return "raise the number of open files with `ulimit -n`";
    case EIO:
      return "check the disk";
    default:
      return "try again, or choose another folder";
  }
}

std::string folder_of(const std::string& path) {
  const fs::path target(path);
  return target.has_parent_path() ? target.parent_path().string() : std::string(".");
}

// ".NAME.N.tmp"
bool is_temporary_name(std::string_view name) {
  if (!name.starts_with('.') || !name.ends_with(".tmp")) return false;
  name.remove_suffix(4);
  const std::size_t digits = name.size() - 1 - name.find_last_not_of("0123456789");
  return digits > 0 && digits + 2 < name.size() && name[name.size() - digits - 1] == '.';
}

std::vector<fs::directory_entry> entries_of(const fs::path& folder, std::error_code& failed) {
  std::vector<fs::directory_entry> entries;
  for (fs::directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed))
    entries.push_back(*it);
  return entries;
}

// Nobody holds its lock, so nobody writes it any more. Never a link, never another kind of file.
bool remove_if_stale(const std::string& path) {
  const FileDescriptor file = ::open(path.c_str(), O_RDWR | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
  if (file < 0) return false;
  struct stat about {};
  const bool stale = ::fstat(file, &about) == 0 && S_ISREG(about.st_mode) && ::flock(file, LOCK_EX | LOCK_NB) == 0;
  return stale && ::unlink(path.c_str()) == 0;
}

// Makes the entries of a folder durable. A folder that may not be read, and a file system that cannot sync one, have
// nothing to add.
int sync_folder(int folder) {
  if (folder < 0 || uninterrupted([&] { return ::fsync(folder); }) == 0) return 0;
  return errno == EINVAL || errno == ENOTSUP ? 0 : errno;
}

FileDescriptor open_folder(const std::string& folder) {
  return uninterrupted([&] { return ::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC); });
}

// Makes the entry that names `path` durable; the cause of a failure, or 0.
int sync_entry_of(const std::string& path) {
  const FileDescriptor folder = open_folder(folder_of(path));
  return folder < 0 && errno != EACCES ? errno : sync_folder(folder);
}

[[noreturn]] void refuse_special(const std::string& path, mode_t mode) {
  const char* what = S_ISDIR(mode)                    ? "folder"
                     : S_ISFIFO(mode)                 ? "pipe"
                     : S_ISSOCK(mode)                 ? "socket"
                     : S_ISCHR(mode) || S_ISBLK(mode) ? "device"
                                                      : "special file";
  throw Error(ErrorKind::no_input, "files.read.kind", "'" + path + "' is a " + what + ", not a file", "check the path");
}

// Names of the temporary files that this process is writing, for a handler of signals, which may neither lock nor take
// memory. A place is never given back to the system, so that what it reads is always a name of ours.
struct OwnTemporary {
  std::atomic<bool> taken{false};
  std::atomic<pid_t> writer{0};  // 0: none is there
  std::array<char, 1024> path{};
};
std::array<OwnTemporary, 64> g_own;

// Where there is no room, it stays until the next write of the same file.
void remember(const std::string& path) {
  for (OwnTemporary& own : g_own) {
    if (path.size() >= own.path.size() || own.taken.exchange(true)) continue;
    std::copy_n(path.c_str(), path.size() + 1, own.path.begin());
    own.writer = ::getpid();
    return;
  }
}

void forget(const std::string& path) {
  for (OwnTemporary& own : g_own) {
    if (own.writer != ::getpid() || path != own.path.data()) continue;
    own.writer = 0;
    own.taken = false;
  }
}

// A hold on a folder or a file: flock of a lock file in it or beside it.

// "PID HOST" of the file as words; it may hold anything.
std::string holder_of(int descriptor) {
  std::array<char, 320> text{};
  const ssize_t size = ::pread(descriptor, text.data(), text.size() - 1, 0);
  std::istringstream words(size > 0 ? text.data() : "");
  std::string pid, host;
  words >> pid >> host;
  const auto of_a_name = [](char c) { return is_alnum(c) || c == '-' || c == '.' || c == '_'; };
  if (pid.empty() || !std::all_of(pid.begin(), pid.end(), is_digit)) return "process ?";
  if (host.empty() || !std::all_of(host.begin(), host.end(), of_a_name)) return "process " + pid;
  return "process " + pid + " on " + host;
}

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
  std::error_code failed, gone;
  for (const fs::directory_entry& file : entries_of(folder, failed)) {
    const auto size = file.file_size(gone);
    if (!gone) sum += size;
  }
  return sum;
}

}  // namespace

std::string read_text_file(const std::string& path, std::size_t limit_bytes) {
  // Where the size is known, nothing of a file that is too large is read.
  std::error_code unknown;
  const auto size = fs::file_size(path, unknown);
  std::string out;
  if (unknown || size <= limit_bytes) out = read_file_start(path, limit_bytes + 1);
  if ((!unknown && size > limit_bytes) || out.size() > limit_bytes) {
    throw Error(ErrorKind::data, "files.read.size",
                "'" + path + "' is larger than " + std::to_string(limit_bytes) + " bytes",
                "check that it is the right file");
  }
  return out;
}

FileDescriptor::~FileDescriptor() {
  if (number_ >= 0) ::close(number_);
}

FileDescriptor open_for_reading(const std::string& path) {
  // Without O_NONBLOCK opening a pipe waits for its writer, which may never come.
  FileDescriptor file = uninterrupted([&] { return ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK); });
  if (file < 0) {
    const int cause = errno;
    if (cause == ENXIO) refuse_special(path, S_IFSOCK);
    throw Error(ErrorKind::no_input, "files.read.missing", "cannot open '" + path + "': " + std::strerror(cause),
                cause == ENOENT ? "check the path" : "check the permissions");
  }
  struct stat about {};
  if (::fstat(file, &about) == 0 && S_ISREG(about.st_mode)) return file;
  refuse_special(path, about.st_mode);
}

std::string read_system_file(const std::string& path) {
  std::ifstream file(path);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

std::string read_file_start(const std::string& path, std::size_t bytes) {
  const FileDescriptor file = open_for_reading(path);
  std::string out;
  struct stat about {};
  if (::fstat(file, &about) == 0 && about.st_size > 0)
    out.reserve(std::min(bytes, static_cast<std::size_t>(about.st_size)));
  std::vector<char> block(std::min(bytes, std::size_t{1} << 16));
  while (out.size() < bytes) {
    const ssize_t got =
        uninterrupted([&] { return ::read(file, block.data(), std::min(block.size(), bytes - out.size())); });
    if (got == 0) break;
    if (got < 0)
      throw Error(ErrorKind::no_input, "files.read.failed", "cannot read '" + path + "': " + std::strerror(errno),
                  "check the path");
    out.append(block.data(), static_cast<std::size_t>(got));
  }
  return out;
}

Error write_error(std::string_view doing, const std::string& path, int cause, std::uint64_t needed_bytes) {
  std::string text = std::strerror(cause);
  if (cause == ENOSPC || cause == EDQUOT) {
    text = "disk full: need " + std::to_string(needed_bytes) + " bytes";
    struct statvfs disk {};
    if (::statvfs(folder_of(path).c_str(), &disk) == 0) {
      text += ", have " + std::to_string(static_cast<std::uint64_t>(disk.f_bavail) * disk.f_frsize);
    }
    if (cause == EDQUOT) text += std::string(" (") + std::strerror(cause) + ")";
  } else if (cause == EFBIG) {
    text = "the limit of a file's size is reached: need " + std::to_string(needed_bytes) + " bytes";
    rlimit limit{};
    if (::getrlimit(RLIMIT_FSIZE, &limit) == 0 && limit.rlim_cur != RLIM_INFINITY)
      text += ", the process may write " + std::to_string(limit.rlim_cur);
  }
  return Error(place_refuses(cause) ? ErrorKind::cannot_create : ErrorKind::io, "files.write.failed",
               "cannot " + std::string(doing) + " '" + path + "': " + text, write_remedy(cause));
}

void sync_folder_of(const std::string& path) {
  if (const int cause = sync_entry_of(path); cause != 0) throw write_error("create", path, cause);
}

void create_folders(const std::string& path) {
  fs::path made;
  for (const fs::path& part : fs::path(path)) {
    made /= part;
    if (part.empty() || ::mkdir(made.c_str(), 0777) == 0) {
      if (part.empty()) continue;
      if (const int cause = sync_entry_of(made.string()); cause != 0)
        throw write_error("create the folder", made.string(), cause);
    } else if (const int cause = errno; !fs::is_directory(made)) {
      throw write_error("create the folder", path, cause == EEXIST ? ENOTDIR : cause);
    }
  }
}

FileDescriptor open_for_appending(const std::string& path) {
  return uninterrupted([&] { return ::open(path.c_str(), O_RDWR | O_CREAT | O_APPEND | O_CLOEXEC, 0666); });
}

void append_all(int file, const std::string& path, std::string_view bytes) {
  const std::size_t needed = bytes.size();
  while (!bytes.empty()) {
    const ssize_t wrote = uninterrupted([&] { return ::write(file, bytes.data(), bytes.size()); });
    if (wrote <= 0) throw write_error("append to", path, wrote < 0 ? errno : ENOSPC, needed);
    bytes.remove_prefix(static_cast<std::size_t>(wrote));
  }
}

void sync_file(int file, const std::string& path) {
  if (uninterrupted([&] { return ::fsync(file); }) != 0) throw write_error("write", path, errno);
}

int remove_stale_temporaries(const std::string& folder) {
  std::error_code unreadable;
  const auto entries = entries_of(folder, unreadable);
  return static_cast<int>(std::count_if(entries.begin(), entries.end(), [](const fs::directory_entry& entry) {
    return is_temporary_name(entry.path().filename().string()) && remove_if_stale(entry.path().string());
  }));
}

void remove_own_temporaries() noexcept {
  for (const OwnTemporary& own : g_own)
    if (own.writer == ::getpid()) ::unlink(own.path.data());
}

AtomicFile::AtomicFile(std::string path) : path_(std::move(path)), folder_(folder_of(path_)) {
  const std::string prefix = folder_ + "/." + fs::path(path_).filename().string() + ".";
  for (int number = 0; number < 100; ++number) {
    const std::string name = prefix + std::to_string(number) + ".tmp";
    if (open_temporary(name)) return;
    if (errno != EEXIST) break;
    if (remove_if_stale(name) && open_temporary(name)) return;
    errno = EEXIST;
  }
  fail("create", errno, 0);
}

// False with errno. A file that another process took for stale between its creation and its lock counts as existing.
bool AtomicFile::open_temporary(const std::string& name) {
  file_ =
      uninterrupted([&] { return ::open(name.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0666); });
  if (file_ < 0) return false;
  temporary_ = name;
  remember(name);
  struct stat about {};
  const bool locked = uninterrupted([&] { return ::flock(file_, LOCK_EX | LOCK_NB); }) == 0 || errno != EWOULDBLOCK;
  if (locked && ::fstat(file_, &about) == 0 && about.st_nlink > 0) return true;
  discard();
  errno = EEXIST;
  return false;
}

AtomicFile::~AtomicFile() { discard(); }

void AtomicFile::discard() noexcept {
  if (!temporary_.empty()) ::unlink(temporary_.c_str());
  forget(temporary_);
  temporary_.clear();
  file_ = {};
}

void AtomicFile::fail(const char* doing, int cause, std::uint64_t needed_bytes) {
  discard();  // first, so that the space told is what a next attempt finds
  throw write_error(doing, path_, cause, needed_bytes);
}

void AtomicFile::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  const std::uint64_t needed = std::max(size_, offset + bytes.size());
  while (!bytes.empty()) {
    const ssize_t wrote =
        uninterrupted([&] { return ::pwrite(file_, bytes.data(), bytes.size(), static_cast<off_t>(offset)); });
    if (wrote <= 0) fail("write", wrote < 0 ? errno : ENOSPC, needed);
    bytes = bytes.subspan(static_cast<std::size_t>(wrote));
    offset += static_cast<std::uint64_t>(wrote);
  }
}

void AtomicFile::append(std::span<const std::byte> bytes) {
  write_at(size_, bytes);
  size_ += bytes.size();
}

void AtomicFile::overwrite(std::uint64_t offset, std::span<const std::byte> bytes) { write_at(offset, bytes); }

void AtomicFile::count_written() {
  struct stat about {};
  if (::fstat(file_, &about) != 0) fail("write", errno, size_);
  size_ = static_cast<std::uint64_t>(about.st_size);
}

void AtomicFile::commit(const std::function<void(const std::string&)>& verify) {
  if (uninterrupted([&] { return ::fsync(file_); }) != 0) fail("write", errno, size_);
  if (verify) verify(temporary_);
  // Opened before the rename: where it fails, the old file is still there.
  const FileDescriptor folder = open_folder(folder_);
  if (folder < 0 && errno != EACCES) fail("write", errno, size_);
  if (::rename(temporary_.c_str(), path_.c_str()) != 0) fail("replace", errno, size_);
  forget(temporary_);
  temporary_.clear();
  // Everything is on the disk, so closing has nothing left to report. The rename itself must survive a power cut.
  file_ = {};
  if (const int cause = sync_folder(folder); cause != 0) fail("write", cause, size_);
}

void write_file_atomic(const std::string& path, std::span<const std::byte> bytes) {
  AtomicFile file(path);
  file.append(bytes);
  file.commit();
}

void write_file_atomic(const std::string& path, std::string_view text) {
  write_file_atomic(path, std::as_bytes(std::span<const char>(text.data(), text.size())));
}

int FolderLock::take(const std::string& folder, bool may_create) {
  return lock(fs::path(folder) / ".lock", LOCK_EX, may_create ? O_CREAT : 0);
}

int FolderLock::take_file(const std::string& file) {
  std::error_code unknown;
  fs::path path = fs::weakly_canonical(file, unknown);
  if (unknown) path = file;
  return lock(path.parent_path() / ("." + path.filename().string() + ".lock"), LOCK_EX, O_CREAT);
}

int FolderLock::share(const std::string& folder) { return lock(fs::path(folder) / ".lock", LOCK_SH, O_CREAT); }

int FolderLock::lock(const std::string& lock_file, int how, int more_flags) {
  descriptor_ = {};
  descriptor_ =
      uninterrupted([&] { return ::open(lock_file.c_str(), O_RDWR | O_CLOEXEC | O_NOFOLLOW | more_flags, 0644); });
  if (descriptor_ < 0) return errno;
  int cause = ::flock(descriptor_, how | LOCK_NB) == 0 ? 0 : errno;
  if (cause == EWOULDBLOCK) holder_ = holder_of(descriptor_);
  if (cause == 0) cause = sign(::getpid());
  if (cause != 0) descriptor_ = {};
  return cause;
}

int FolderLock::sign(pid_t process) const {
  std::array<char, 256> host{};
  if (::gethostname(host.data(), host.size() - 1) != 0) host[0] = '\0';
  const std::string text = std::to_string(process) + " " + host.data() + "\n";
  errno = 0;
  if (::ftruncate(descriptor_, 0) != 0) return errno;
  const ssize_t written = uninterrupted([&] { return ::pwrite(descriptor_, text.data(), text.size(), 0); });
  const bool whole = written == static_cast<ssize_t>(text.size());
  return whole ? 0 : errno != 0 ? errno : ENOSPC;
}

void FolderLock::keep_over_exec() const { ::fcntl(descriptor_, F_SETFD, 0); }

// Where shipped files lie, told by where the framework's library lies.

std::string shared_root() {
  std::error_code unknown;
  if (const char* named = std::getenv("SEMFIELD_SHARE"); named != nullptr && *named != '\0') {
    if (!is_folder(named))
      throw Error(ErrorKind::config, "config.environment.value",
                  std::string("environment variable SEMFIELD_SHARE: no folder '") + named + "'",
                  "set it to the folder that holds configs/ and scenes/, or leave it out");
    return fs::absolute(named).lexically_normal().string();
  }
  Dl_info self{};
  if (::dladdr(reinterpret_cast<const void*>(&shared_root), &self) == 0 || self.dli_fname == nullptr) return "";
  // lib/, lib/semfield/ or lib/x86_64-linux-gnu/semfield/: libraries lie one to three folders below the prefix.
  fs::path folder = fs::weakly_canonical(self.dli_fname, unknown).parent_path();
  for (int level = 0; level < 3; ++level) {
    folder = folder.parent_path();
    const fs::path share = folder / "share" / "semfield";
    if (is_folder(share / "configs")) return share.string();
  }
  return "";
}

std::string shared_file(const std::string& relative) {
  const std::string root = shared_root();
  const fs::path path = (fs::path(root) / relative).lexically_normal();
  if (root.empty() || !is_there(path))
    throw Error(
        ErrorKind::no_input, "files.shared.missing",
        root.empty() ? "no file '" + relative + "', which comes with the program: no folder share/semfield"
                     : "no file '" + path.string() + "', which comes with the program",
        "install the component 'app' whole, or set SEMFIELD_SHARE to the folder that holds configs/ and scenes/");
  return path.string();
}

std::vector<fs::directory_entry> sorted_folder(const std::string& folder) {
  std::error_code error;
  std::vector<fs::directory_entry> entries = entries_of(folder, error);
  if (error) {
    throw Error(ErrorKind::no_input, "files.folder.unreadable",
                "cannot read the folder '" + folder + "': " + error.message(),
                error == std::errc::permission_denied ? "check the permissions" : "check the path");
  }
  std::sort(entries.begin(), entries.end());
  return entries;
}

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
  if (!parse_number(text, gigabytes) || !(gigabytes >= 0 && gigabytes <= 1e6)) {
    throw Error(ErrorKind::config, "config.environment.value",
                "environment variable SEMFIELD_CACHE_GB: '" + std::string(text) + "' is not a number from 0 to 1000000",
                "set it to the gigabytes that the cache may hold, or set SEMFIELD_CACHE=off");
  }
  return static_cast<std::uint64_t>(gigabytes * 1e9);
}

void use_cache_entry(const std::string& entry, std::uint64_t limit) {
  std::error_code failed, gone;
  const fs::path own(entry);
  fs::last_write_time(own, fs::file_time_type::clock::now(), failed);
  std::vector<Entry> entries;
  std::uint64_t sum = 0;
  for (const fs::directory_entry& one : entries_of(own.parent_path(), failed)) {
    if (!one.is_directory(gone)) continue;
    const auto used = one.last_write_time(gone);
    if (gone) continue;
    entries.push_back({one.path(), used, bytes_of(one.path())});
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
