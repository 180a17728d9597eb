// Whole files in and out, atomically.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/error.h"

namespace semfield {

/// A descriptor of a regular file, the caller's to close: the one way in which files are opened to be read. Throws
/// Error(no_input) for what cannot be opened, and for folders, pipes, sockets and devices, which it never waits for.
int open_for_reading(const std::string& path);

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

/// A descriptor of a file that grows, made where it is missing, the caller's to close; -1 with errno. Past EINTR.
int open_for_appending(const std::string& path);
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
  AtomicFile(const AtomicFile&) = delete;
  AtomicFile& operator=(const AtomicFile&) = delete;

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
  int file_ = -1;
};

}  // namespace semfield
