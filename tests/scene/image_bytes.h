// Image files put together byte by byte: OpenEXR, PNG headers and layouts that no writer makes, right checksums.
#pragma once

#include <zlib.h>

#include <cstdint>
#include <cstring>
#include <span>
#include <string>
#include <vector>

#include "core/checksum.h"

namespace semfield::testing_room {

// OpenEXR files by hand.

/// An uncompressed scan-line OpenEXR file with one float channel [OpenEXR file layout]. Its header states
/// `stated_width`, where that is above 0.
inline std::string exr_of(std::int32_t width, std::int32_t height, const std::vector<float>& values,
                          std::int32_t stated_width = 0) {
  std::string out;
  const auto put = [&](const auto& value) { out.append(reinterpret_cast<const char*>(&value), sizeof value); };
  const auto text = [&](const char* word) { out.append(word, std::strlen(word) + 1); };
  const auto attribute = [&](const char* name, const char* type, std::uint32_t size) {
    text(name);
    text(type);
    put(size);
  };
  const std::int32_t right = (stated_width > 0 ? stated_width : width) - 1;
  put(std::uint32_t{20000630});
  put(std::uint32_t{2});
  attribute("channels", "chlist", 19);
  text("Y");
  put(std::uint32_t{2});  // float
  put(std::uint32_t{0});
  put(std::uint32_t{1});
  put(std::uint32_t{1});
  out.push_back('\0');
  attribute("compression", "compression", 1);
  out.push_back('\0');
  for (const char* name : {"dataWindow", "displayWindow"}) {
    attribute(name, "box2i", 16);
    for (const std::int32_t edge : {0, 0, right, height - 1}) put(edge);
  }
  attribute("lineOrder", "lineOrder", 1);
  out.push_back('\0');
  attribute("pixelAspectRatio", "float", 4);
  put(1.0F);
  attribute("screenWindowCenter", "v2f", 8);
  put(0.0F);
  put(0.0F);
  attribute("screenWindowWidth", "float", 4);
  put(1.0F);
  out.push_back('\0');
  const std::size_t line = 8 + 4 * static_cast<std::size_t>(width),
                    first = out.size() + 8 * static_cast<std::size_t>(height);
  for (std::int32_t y = 0; y < height; ++y) put(static_cast<std::uint64_t>(first + static_cast<std::size_t>(y) * line));
  for (std::int32_t y = 0; y < height; ++y) {
    put(y);
    put(static_cast<std::uint32_t>(4 * width));
    for (std::int32_t x = 0; x < width; ++x) put(values[y * width + x]);
  }
  return out;
}

// PNG files put together byte by byte, for headers and layouts that no writer makes.

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

// Checksums stop chance bytes at the door; these two make them right, so that what lies behind is reached too.

/// The chunks of a PNG with their checksums.
inline std::string with_png_checksums(std::string bytes) {
  for (std::size_t at = 8; at + 12 <= bytes.size();) {
    std::size_t length = 0;
    for (std::size_t i = 0; i < 4; ++i) length = length << 8 | static_cast<unsigned char>(bytes[at + i]);
    if (length > bytes.size() - at - 12) break;
    const uLong crc = ::crc32(0, reinterpret_cast<const Bytef*>(bytes.data()) + at + 4, static_cast<uInt>(length + 4));
    for (std::size_t i = 0; i < 4; ++i) bytes[at + 8 + length + i] = static_cast<char>(crc >> (24 - 8 * i) & 0xFF);
    at += length + 12;
  }
  return bytes;
}

/// A packed scene with its size and the checksums of its manifest and header.
inline std::string with_pack_checksums(std::string bytes) {
  if (bytes.size() < 64) return bytes;
  const std::uint64_t size = bytes.size();
  std::uint64_t offset = 0, length = 0;
  std::memcpy(bytes.data() + 16, &size, 8);
  std::memcpy(&offset, bytes.data() + 24, 8);
  std::memcpy(&length, bytes.data() + 32, 8);
  const auto view = std::as_bytes(std::span<const char>(bytes));
  const auto put = [&](std::size_t at, std::uint32_t crc) { std::memcpy(bytes.data() + at, &crc, 4); };
  if (offset <= size && length <= size - offset) put(40, crc32c(view.subspan(offset, length)));
  put(60, crc32c(view.first(60)));
  return bytes;
}

}  // namespace semfield::testing_room
