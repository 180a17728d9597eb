// A scene in one file that needs no image library: manifest, class table, and each frame's channels, every part with
// its checksum.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "core/files.h"
#include "scene/scene.h"

namespace semfield {

/// Layout, little-endian: 64-byte header {magic "SEMFPACK", u32 version, u32 frames, u64 file bytes, u64 manifest
/// offset, u64 manifest bytes, u32 CRC-32C of the manifest, 16 zero bytes, u32 CRC-32C of the 60 bytes before}, then
/// the chunks, then the manifest. Labels are internal indices (the class table with the original ids is in the
/// manifest), colour and alpha 8 bit, depth float metres or whole millimetres, instances 32 bit. A chunk is deflated
/// where that makes it smaller. Version 2 has a byte for the lens behind each camera's numbers, a chunk of the pixels
/// used, a byte each, and one of alpha; version 3 a byte for the EXIF orientation behind the lens. A scene is written
/// as the least version that holds it.
inline constexpr std::uint32_t kPackedVersion = 3;

/// Writes `path` atomically, frame by frame: `read(frame, buffer)` is called once per frame in order, so one frame is
/// in memory at a time. Of further channels it writes `alpha`. Frames that the callback leaves without a channel are
/// stored without it. Depth is kept as uint16 millimetres in frames that this rounds by at most 0.1 %, else, and
/// without `depth_as_mm`, as float, unchanged. Throws Error(io), or what `read` throws.
void write_packed_scene(const std::string& path, const SceneInfo& info,
                        const std::function<void(int, FrameBuffer&)>& read, bool depth_as_mm = true);

/// Whether the file begins as one of write_packed_scene. Throws Error(no_input) and Error(io).
bool is_packed_scene(const std::string& path);

class PackedScene {
 public:
  /// Checks header and manifest, all sizes against the file before any allocation. Throws Error(no_input) or
  /// Error(data) naming the file.
  explicit PackedScene(std::string path);

  const SceneInfo& info() const { return info_; }
  /// Thread-safe. Throws Error(data) naming file, frame and channel when a checksum or size is wrong.
  /// Of further channels it gives those of FrameBuffer::wanted.
  void read(int frame, FrameBuffer& out) const;

  struct Chunk {
    std::uint64_t offset = 0, stored_bytes = 0, raw_bytes = 0;  ///< raw_bytes 0 = the frame has no such channel
    std::uint32_t crc = 0;
    std::uint32_t format = 0;  ///< bit 0: deflated; bit 1: depth in millimetres
  };
  enum Channel : std::size_t { kColor, kDepth, kLabel, kInstance, kUsed, kAlpha, kChannels };

 private:
  std::vector<std::byte> chunk_bytes(int frame, Channel channel) const;
  std::string path_;
  FileDescriptor file_;
  std::uint64_t file_bytes_ = 0;
  SceneInfo info_;
  std::vector<std::array<Chunk, kChannels>> chunks_;
};

}  // namespace semfield
