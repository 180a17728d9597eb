// Whole files in and out, atomically.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace semfield {

/// Whole file. Throws Error(no_input) when it cannot be opened, Error(data) when larger than `limit_bytes`.
std::string read_text_file(const std::string& path, std::size_t limit_bytes = std::size_t{256} << 20);
/// The first `bytes` of a file, or all of a shorter one. Throws Error(no_input) when it cannot be opened.
std::string read_file_start(const std::string& path, std::size_t bytes);

/// Writes `path` so that a reader, or a crash at any moment, sees the old file or the new one, never a part: temporary
/// file in the same folder (O_EXCL|O_NOFOLLOW), write loop (EINTR, short writes), fsync, rename, fsync of the folder.
/// Throws Error(io) naming path and cause ("disk full: need ..., have ...") and removes the temporary file.
void write_file_atomic(const std::string& path, std::span<const std::byte> bytes);
void write_file_atomic(const std::string& path, std::string_view text);

/// The same promise for a file too large to hold: append in pieces, then commit. Without commit() nothing of it stays.
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
  /// fsync, rename, fsync of the folder.
  void commit();

 private:
  void write_at(std::uint64_t offset, std::span<const std::byte> bytes);
  [[noreturn]] void fail(const char* doing, int cause, std::size_t needed_bytes);
  void discard() noexcept;
  std::string path_, folder_, temporary_;
  std::uint64_t size_ = 0;
  int file_ = -1;
};

}  // namespace semfield
