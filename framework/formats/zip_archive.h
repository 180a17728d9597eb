// Zip archives, as far as NumPy's .npz files need them: stored or deflated entries, ZIP64 sizes when reading.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace semfield {

/// The remedy for a file whose bytes are damaged.
inline constexpr const char* kSaveAgain = "save the file again, or copy it again in full";

struct ZipEntry {
  std::string name;
  unsigned method = 0;  ///< 0 stored, 8 deflated
  std::uint32_t crc = 0;
  std::uint64_t packed_bytes = 0, bytes = 0, local_at = 0;
};

/// The directory of an archive in memory. Throws Error(data) with the cause (no path: the caller adds it) for bytes
/// that are no archive, a directory that is damaged or runs past the end, and encrypted entries.
std::vector<ZipEntry> zip_entries(std::string_view file);

/// Bytes of an entry, checked against its checksum. Throws Error(data) with the cause for an entry that runs past the
/// end, another compression, damaged data, and a stated size that the packed bytes cannot have - before anything of
/// that size is allocated.
std::string zip_contents(std::string_view file, const ZipEntry& entry);

/// The first bytes of an entry, at most so many; nothing more is unpacked. Throws as zip_contents, but for the
/// checksum.
std::string zip_start(std::string_view file, const ZipEntry& entry, std::uint64_t bytes);

/// An archive of deflated entries without times: equal contents give equal files.
class ZipWriter {
 public:
  explicit ZipWriter(std::string path) : path_(std::move(path)) {}
  /// Throws Error(data) above 2 GiB in all.
  void add(const std::string& name, const std::string& bytes);
  /// Throws Error(io).
  void write();

 private:
  std::string path_, out_, directory_;
  std::uint64_t count_ = 0;
};

}  // namespace semfield
