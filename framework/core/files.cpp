// Whole files in and out: a reader or a crash sees the old file or the new one.
#include "core/files.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstring>
#include <filesystem>

#include "core/error.h"

namespace semfield {

namespace {

std::string cause_text(int cause) { return std::strerror(cause); }

std::string file_remedy(int cause) {
  switch (cause) {
    case ENOENT:
      return "create the folder first";
    case EACCES:
    case EPERM:
    case EROFS:
      return "choose a folder that you may write to";
    case ENOSPC:
    case EDQUOT:
      return "free some space or choose another disk";
    default:
      return {};
  }
}

}  // namespace

std::string read_text_file(const std::string& path, std::size_t limit_bytes) {
  std::string out = read_file_start(path, limit_bytes + 1);
  if (out.size() > limit_bytes) {
    throw Error(ErrorKind::data, "'" + path + "' is larger than " + std::to_string(limit_bytes) + " bytes",
                "check that it is the right file");
  }
  return out;
}

std::string read_file_start(const std::string& path, std::size_t bytes) {
  const int file = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) {
    const int cause = errno;
    throw Error(ErrorKind::no_input, "cannot open '" + path + "': " + cause_text(cause),
                cause == ENOENT ? "check the path" : "check the permissions");
  }
  std::string out;
  struct stat about {};
  int cause = 0;
  if (::fstat(file, &about) != 0) {
    cause = errno;
  } else if (S_ISDIR(about.st_mode)) {
    cause = EISDIR;
  } else {
    if (about.st_size > 0) out.reserve(std::min(bytes, static_cast<std::size_t>(about.st_size)));
    std::vector<char> block(std::min(bytes, std::size_t{1} << 16));
    while (out.size() < bytes) {
      const ssize_t got = ::read(file, block.data(), std::min(block.size(), bytes - out.size()));
      if (got == 0) break;
      if (got < 0) {
        if (errno == EINTR) continue;
        cause = errno;
        break;
      }
      out.append(block.data(), static_cast<std::size_t>(got));
    }
  }
  ::close(file);
  if (cause != 0)
    throw Error(ErrorKind::no_input, "cannot read '" + path + "': " + cause_text(cause), "check the path");
  return out;
}

AtomicFile::AtomicFile(std::string path) : path_(std::move(path)) {
  static std::atomic<unsigned> counter{0};
  const std::filesystem::path target(path_);
  folder_ = target.has_parent_path() ? target.parent_path().string() : std::string(".");
  const std::string prefix = folder_ + "/." + target.filename().string() + "." + std::to_string(::getpid()) + ".";
  // A name left behind by a killed process of the same number is passed over, never opened.
  for (int attempt = 0; attempt < 100; ++attempt) {
    temporary_ = prefix + std::to_string(counter++) + ".tmp";
    file_ = ::open(temporary_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_NOFOLLOW | O_CLOEXEC, 0666);
    if (file_ >= 0 || errno != EEXIST) break;
  }
  if (file_ < 0) {
    const int cause = errno;
    temporary_.clear();
    fail("create", cause, 0);
  }
}

AtomicFile::~AtomicFile() { discard(); }

void AtomicFile::discard() noexcept {
  if (file_ >= 0) ::close(file_);
  file_ = -1;
  if (!temporary_.empty()) ::unlink(temporary_.c_str());
  temporary_.clear();
}

void AtomicFile::fail(const char* doing, int cause, std::size_t needed_bytes) {
  discard();
  std::string text = cause_text(cause);
  if (cause == ENOSPC || cause == EDQUOT) {
    text = "disk full: need " + std::to_string(needed_bytes) + " bytes";
    struct statvfs disk {};
    if (::statvfs(folder_.c_str(), &disk) == 0) {
      text += ", have " + std::to_string(static_cast<std::uint64_t>(disk.f_bavail) * disk.f_frsize);
    }
  }
  throw Error(ErrorKind::io, std::string("cannot ") + doing + " '" + path_ + "': " + text, file_remedy(cause));
}

void AtomicFile::write_at(std::uint64_t offset, std::span<const std::byte> bytes) {
  while (!bytes.empty()) {
    const ssize_t wrote = ::pwrite(file_, bytes.data(), bytes.size(), static_cast<off_t>(offset));
    if (wrote < 0) {
      if (errno == EINTR) continue;
      fail("write", errno, bytes.size());
    }
    if (wrote == 0) fail("write", ENOSPC, bytes.size());
    bytes = bytes.subspan(static_cast<std::size_t>(wrote));
    offset += static_cast<std::uint64_t>(wrote);
  }
}

void AtomicFile::append(std::span<const std::byte> bytes) {
  write_at(size_, bytes);
  size_ += bytes.size();
}

void AtomicFile::overwrite(std::uint64_t offset, std::span<const std::byte> bytes) { write_at(offset, bytes); }

void AtomicFile::commit() {
  if (::fsync(file_) != 0) fail("write", errno, size_);
  const int closed = ::close(file_);
  file_ = -1;
  if (closed != 0 && errno != EINTR) fail("write", errno, size_);
  if (::rename(temporary_.c_str(), path_.c_str()) != 0) fail("replace", errno, size_);
  temporary_.clear();
  // The rename itself must survive a crash; a file system that cannot sync a folder (EINVAL) has nothing to add.
  const int folder = ::open(folder_.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (folder < 0) return;
  const int synced = ::fsync(folder);
  const int cause = errno;
  ::close(folder);
  if (synced != 0 && cause != EINVAL && cause != ENOTSUP) fail("write", cause, 0);
}

void write_file_atomic(const std::string& path, std::span<const std::byte> bytes) {
  AtomicFile file(path);
  file.append(bytes);
  file.commit();
}

void write_file_atomic(const std::string& path, std::string_view text) {
  write_file_atomic(path, std::as_bytes(std::span<const char>(text.data(), text.size())));
}

}  // namespace semfield
