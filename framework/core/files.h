// Whole files in and out, atomically.
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace semfield {

/// Whole file. Throws Error(no_input) when it cannot be opened, Error(data) when larger than `limit_bytes`.
std::string read_text_file(const std::string& path, std::size_t limit_bytes = std::size_t{256} << 20);

/// Writes `path` so that a reader, or a crash at any moment, sees the old file or the new one, never a part: temporary file in
/// the same folder (O_EXCL|O_NOFOLLOW), write loop (EINTR, short writes), fsync, rename, fsync of the folder. Throws
/// Error(io) naming path and cause ("disk full: need ..., have ...") and removes the temporary file.
void write_file_atomic(const std::string& path, std::span<const std::byte> bytes);
void write_file_atomic(const std::string& path, std::string_view text);

}  // namespace semfield
