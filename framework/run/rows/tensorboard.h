// Scalars for TensorBoard: an events.out.tfevents file, written without its libraries.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

namespace semfield {

/// CRC-32C as record files store it: rotated and shifted, so that a checksum of checksums stays strong.
std::uint32_t masked_crc32c(std::string_view bytes);

/// One record: length (u64), its masked CRC (u32), the bytes, their masked CRC (u32), little-endian.
std::string record_frame(std::string_view bytes);

/// Appends events to a file of its own, `<folder>/events.out.tfevents.<seconds>.<host>.<pid>`.
class EventWriter {
 public:
  /// `now_s`: seconds since 1970, part of the name and of the first event. Throws Error(cannot_create).
  EventWriter(const std::string& folder, double now_s);
  EventWriter(const EventWriter&) = delete;
  EventWriter& operator=(const EventWriter&) = delete;
  ~EventWriter();

  void scalar(std::string_view tag, std::int64_t step, double value, double now_s);
  const std::string& path() const { return path_; }

 private:
  void write(const std::string& event);
  std::string path_;
  int descriptor_ = -1;
};

}  // namespace semfield
