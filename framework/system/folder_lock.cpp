// A hold on a folder or a file: flock of a lock file in it or beside it.
#include "system/folder_lock.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cctype>
#include <cerrno>
#include <filesystem>
#include <sstream>
#include <utility>

namespace semfield {

namespace {

std::string host_name() {
  std::array<char, 256> name{};
  return ::gethostname(name.data(), name.size() - 1) == 0 ? name.data() : "";
}

std::string lock_of(const std::string& folder) { return (std::filesystem::path(folder) / ".lock").string(); }

// "PID HOST" of the file as words; it may hold anything.
std::string holder_of(int descriptor) {
  std::array<char, 320> text{};
  const ssize_t size = ::pread(descriptor, text.data(), text.size() - 1, 0);
  std::istringstream words(size > 0 ? text.data() : "");
  std::string pid, host;
  words >> pid >> host;
  const auto digit = [](unsigned char c) { return std::isdigit(c) != 0; };
  const auto of_a_name = [](unsigned char c) { return std::isalnum(c) != 0 || c == '-' || c == '.' || c == '_'; };
  if (pid.empty() || !std::all_of(pid.begin(), pid.end(), digit)) return "process ?";
  if (host.empty() || !std::all_of(host.begin(), host.end(), of_a_name)) return "process " + pid;
  return "process " + pid + " on " + host;
}

}  // namespace

FolderLock::FolderLock(FolderLock&& other) noexcept
    : descriptor_(std::exchange(other.descriptor_, -1)), holder_(std::move(other.holder_)) {}

FolderLock& FolderLock::operator=(FolderLock&& other) noexcept {
  if (this == &other) return *this;
  release();
  descriptor_ = std::exchange(other.descriptor_, -1);
  holder_ = std::move(other.holder_);
  return *this;
}

FolderLock::~FolderLock() { release(); }

void FolderLock::release() {
  if (descriptor_ >= 0) ::close(descriptor_);
  descriptor_ = -1;
}

int FolderLock::take(const std::string& folder, bool may_create) {
  return lock(lock_of(folder), LOCK_EX, may_create ? O_CREAT : 0);
}

int FolderLock::take_file(const std::string& file) {
  std::error_code unknown;
  std::filesystem::path path = std::filesystem::weakly_canonical(file, unknown);
  if (unknown) path = file;
  return lock(path.parent_path() / ("." + path.filename().string() + ".lock"), LOCK_EX, O_CREAT);
}

int FolderLock::share(const std::string& folder) { return lock(lock_of(folder), LOCK_SH, O_CREAT); }

int FolderLock::lock(const std::string& lock_file, int how, int more_flags) {
  release();
  int descriptor = -1;
  do descriptor = ::open(lock_file.c_str(), O_RDWR | O_CLOEXEC | O_NOFOLLOW | more_flags, 0644);
  while (descriptor < 0 && errno == EINTR);
  if (descriptor < 0) return errno;
  int cause = ::flock(descriptor, how | LOCK_NB) == 0 ? 0 : errno;
  if (cause == EWOULDBLOCK) holder_ = holder_of(descriptor);
  descriptor_ = descriptor;
  if (cause == 0) cause = sign(::getpid());
  if (cause != 0) release();
  return cause;
}

int FolderLock::sign(pid_t process) const {
  const std::string text = std::to_string(process) + " " + host_name() + "\n";
  errno = 0;
  if (::ftruncate(descriptor_, 0) != 0) return errno;
  ssize_t written = -1;
  do written = ::pwrite(descriptor_, text.data(), text.size(), 0);
  while (written < 0 && errno == EINTR);
  const bool whole = written == static_cast<ssize_t>(text.size());
  return whole ? 0 : errno != 0 ? errno : ENOSPC;
}

void FolderLock::keep_over_exec() const { ::fcntl(descriptor_, F_SETFD, 0); }

}  // namespace semfield
