// Whole files in and out, atomically.
#pragma once

#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/error.h"

namespace semfield {

namespace fs = std::filesystem;  // as all files below spell it

/// What a path leads to, past links; false also where that cannot be looked at.
inline bool is_there(const std::filesystem::path& path) {
  std::error_code ignored;
  return std::filesystem::exists(path, ignored);
}
inline bool is_file(const std::filesystem::path& path) {
  std::error_code ignored;
  return std::filesystem::is_regular_file(path, ignored);
}
inline bool is_folder(const std::filesystem::path& path) {
  std::error_code ignored;
  return std::filesystem::is_directory(path, ignored);
}

/// An open file, closed at its end; below 0: none.
class FileDescriptor {
 public:
  FileDescriptor(int number = -1) : number_(number) {}  // NOLINT(google-explicit-constructor): as system calls give it
  FileDescriptor(FileDescriptor&& other) noexcept : number_(std::exchange(other.number_, -1)) {}
  FileDescriptor& operator=(FileDescriptor&& other) noexcept {
    std::swap(number_, other.number_);
    return *this;
  }
  ~FileDescriptor();
  operator int() const { return number_; }  // NOLINT(google-explicit-constructor): as system calls take it

 private:
  int number_;
};

/// The one way in which files are opened to be read. Throws Error(no_input) for what cannot be opened, and for folders,
/// pipes, sockets and devices, which it never waits for.
FileDescriptor open_for_reading(const std::string& path);

/// Whole file. Throws Error(no_input) when it cannot be opened, Error(data) when larger than `limit_bytes`.
std::string read_text_file(const std::string& path, std::size_t limit_bytes = std::size_t{256} << 20);
/// The first `bytes` of a file, or all of a shorter one. Throws Error(no_input) when it cannot be opened.
std::string read_file_start(const std::string& path, std::size_t bytes);
/// A file that the system makes up as it is read, such as those below /proc: its size is not known before. "" where it
/// cannot be read.
std::string read_system_file(const std::string& path);

/// What a failed call while writing `path` means: the cause, for a full disk "need ..., have ...", and the remedy. The
/// kind is cannot_create where the place refuses (permissions, a missing folder), io where the device does.
/// `needed_bytes`: size of the whole file as far as it is known.
Error write_error(std::string_view doing, const std::string& path, int cause, std::uint64_t needed_bytes = 0);

/// Creates a folder and those above it that are missing, and syncs every entry made. Throws write_error.
void create_folders(const std::string& path);

/// A file that grows, made where it is missing; none with errno. Past EINTR.
FileDescriptor open_for_appending(const std::string& path);
/// Appends to an open file, past EINTR and short writes. Throws write_error.
void append_all(int file, const std::string& path, std::string_view bytes);
/// fsync. EINTR is tried again; any other failure is final, because a second fsync of the same descriptor may report
/// success for pages that are lost. Throws write_error.
void sync_file(int file, const std::string& path);

/// Makes the entry of a file that was created outlive a power cut. Throws write_error.
void sync_folder_of(const std::string& path);

/// Writes `path` so that a reader, or a crash at any moment, sees the old file or the new one, never a part; after it
/// returns the new one outlives a power cut. Throws write_error and removes the temporary file.
void write_file_atomic(const std::string& path, std::span<const std::byte> bytes);
void write_file_atomic(const std::string& path, std::string_view text);

/// Removes from `folder` the temporary files whose writer has died, whatever their target; returns how many. Those of
/// living writers, of this process or another, stay. A folder that cannot be read is left alone. For folders that are
/// the program's own, such as a run's: other programs have names of that form too, so elsewhere nothing goes but what a
/// write of the same target left (AtomicFile).
int remove_stale_temporaries(const std::string& folder);

/// The same promise for a file too large to hold: append in pieces, then commit. Without commit() nothing of it stays.
///
/// The pieces go into `.NAME.N.tmp` beside the target (O_EXCL, O_NOFOLLOW), which is locked (flock) until it gets its
/// name: a temporary file that can be locked has lost its writer, and the next write of the same target removes it.
class AtomicFile {
 public:
  explicit AtomicFile(std::string path);
  ~AtomicFile();

  void append(std::span<const std::byte> bytes);
  /// Replaces bytes already written (a header whose fields are known only at the end).
  void overwrite(std::uint64_t offset, std::span<const std::byte> bytes);
  std::uint64_t size() const { return size_; }
  /// For another program, which may write the file as /proc/self/fd/DESCRIPTOR; count_written() then takes its size.
  int descriptor() const { return file_; }
  void count_written();
  /// fsync, `verify` with the temporary file's path (it throws to refuse what was written), rename, fsync of the
  /// folder.
  void commit(const std::function<void(const std::string&)>& verify = {});

 private:
  bool open_temporary(const std::string& name);
  void write_at(std::uint64_t offset, std::span<const std::byte> bytes);
  [[noreturn]] void fail(const char* doing, int cause, std::uint64_t needed_bytes);
  void discard() noexcept;
  std::string path_, folder_, temporary_;
  std::uint64_t size_ = 0;
  FileDescriptor file_;
};

// A hold on a folder or a file, alone or shared, that ends with the processes that have it, however they end.

/// flock of `FOLDER/.lock`, which says who took it last. The lock file stays: removing it would let two processes lock
/// two files of one name.
class FolderLock {
 public:
  /// 0: held from now on. EWOULDBLOCK: another has it, whom holder() names. ENOENT: no lock file is there, and none may
  /// be created. Any other errno: the folder cannot be written.
  int take(const std::string& folder, bool may_create = true);
  /// The same for one file in a folder that others may use: flock of `.NAME.lock` beside it, under any path that leads
  /// to the file.
  int take_file(const std::string& file);
  /// As take() for a hold that others may share, while nobody has the folder alone; then EWOULDBLOCK.
  int share(const std::string& folder);
  bool held() const { return descriptor_ >= 0; }
  /// Of a call that found another: "process 4711 on HOST", as far as the lock file tells.
  const std::string& holder() const { return holder_; }
  /// Writes the process for which it is held into the file. Errno or 0.
  int sign(pid_t process) const;
  /// In a forked child: the lock lives until the program that it starts has ended too. Async-signal-safe.
  void keep_over_exec() const;

 private:
  int lock(const std::string& lock_file, int how, int more_flags);
  FileDescriptor descriptor_;
  std::string holder_;
};

// Files that come with the program and the library: configurations, scenes, pages.

/// The folder of shipped files, which holds configs/ and scenes/: what the environment variable SEMFIELD_SHARE names,
/// else share/semfield in a folder above the framework's library, which is the installed copy wherever its prefix was
/// moved to, or in a build folder a link to the source tree. "" where there is none. Throws Error(config) where
/// SEMFIELD_SHARE names no folder.
std::string shared_root();

/// Path of a shipped file or folder by its place in the source tree ("configs/paper.yaml"). Throws Error(no_input).
std::string shared_file(const std::string& relative);

// What lies in a folder, in the order of names: file systems each have an order of their own.

/// Entries of `folder`, by name. Throws Error(no_input) for a folder that cannot be read.
std::vector<std::filesystem::directory_entry> sorted_folder(const std::string& folder);

// What a process that ends by a signal still does about its files.

/// Removes the temporary files that this process is writing (AtomicFile). Async-signal-safe; nothing may be written
/// afterwards.
void remove_own_temporaries() noexcept;

// Where a program keeps what it can make again, and how much of it.

/// FOLDER/NAME of the user's cache, made if need be: the environment variable SEMFIELD_CACHE, else
/// XDG_CACHE_HOME/semfield, else HOME/.cache/semfield. "" where SEMFIELD_CACHE is `off`, where none of them is set, and
/// where the folder cannot be made: then nothing is kept.
std::string cache_folder(const std::string& name);

/// Bytes that a cache folder may hold: SEMFIELD_CACHE_GB, or 2 GB. Throws Error(config) for what is no number.
std::uint64_t cache_limit();

/// Notes that `entry`, a folder in a cache folder, is used now, and removes the entries unused for longest until the
/// folder holds at most `limit` bytes; `entry` stays. Others may read an entry meanwhile: they make anew what is gone.
void use_cache_entry(const std::string& entry, std::uint64_t limit);

}  // namespace semfield
