// PNG files put together byte by byte, for headers and layouts that no writer makes.
#pragma once

#include <zlib.h>

#include <cstdint>
#include <string>
#include <vector>

namespace semfield::testing_room {

inline void put32(std::vector<std::uint8_t>& out, std::uint32_t v) {
  for (int s = 24; s >= 0; s -= 8) out.push_back(static_cast<std::uint8_t>(v >> s));
}

inline void put_chunk(std::vector<std::uint8_t>& out, const std::string& type, const std::vector<std::uint8_t>& data) {
  put32(out, static_cast<std::uint32_t>(data.size()));
  std::vector<std::uint8_t> body(type.begin(), type.end());
  body.insert(body.end(), data.begin(), data.end());
  out.insert(out.end(), body.begin(), body.end());
  put32(out, static_cast<std::uint32_t>(::crc32(0, body.data(), static_cast<uInt>(body.size()))));
}

/// A PNG from raw (already filtered) rows; the header may say anything.
inline std::vector<std::uint8_t> png_of(std::uint32_t w, std::uint32_t h, std::uint8_t bits, std::uint8_t type,
                                        std::uint8_t interlace, const std::vector<std::uint8_t>& raw) {
  std::vector<std::uint8_t> out{0x89, 'P', 'N', 'G', 13, 10, 26, 10}, header;
  put32(header, w);
  put32(header, h);
  header.insert(header.end(), {bits, type, 0, 0, interlace});
  put_chunk(out, "IHDR", header);
  uLongf size = ::compressBound(static_cast<uLong>(raw.size()));
  std::vector<std::uint8_t> packed(size);
  ::compress(packed.data(), &size, raw.data(), static_cast<uLong>(raw.size()));
  packed.resize(size);
  put_chunk(out, "IDAT", packed);
  put_chunk(out, "IEND", {});
  return out;
}

}  // namespace semfield::testing_room
