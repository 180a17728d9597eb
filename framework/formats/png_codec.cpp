// PNG in and out through zlib alone [PNG3].
#include "formats/png_codec.h"

#include <zlib.h>

#include <algorithm>
#include <array>
#include <cstdlib>
#include <cstring>
#include <new>

#include "core/check.h"
#include "core/error.h"

namespace semfield {

namespace {

constexpr std::array<std::uint8_t, 8> kSignature{0x89, 'P', 'N', 'G', 0x0D, 0x0A, 0x1A, 0x0A};

[[noreturn]] void damaged(const std::string& cause) {
  throw Error(ErrorKind::data, "files.image.damaged", "PNG " + cause, "copy or export the file again");
}

std::uint32_t big32(const std::uint8_t* p) {
  return std::uint32_t{p[0]} << 24 | std::uint32_t{p[1]} << 16 | std::uint32_t{p[2]} << 8 | p[3];
}

struct Chunk {
  std::string type;
  std::span<const std::uint8_t> data;
};

// The chunk at `at`, which moves behind it; its checksum is verified.
Chunk next_chunk(std::span<const std::uint8_t> file, std::size_t& at) {
  if (file.size() - at < 12)
    damaged("is truncated: it ends after " + std::to_string(file.size()) + " bytes, before its end chunk");
  const std::uint32_t length = big32(file.data() + at);
  const std::string type(reinterpret_cast<const char*>(file.data()) + at + 4, 4);
  if (length > file.size() - at - 12) {
    damaged("is truncated: chunk " + type + " needs " + std::to_string(length) + " bytes, " +
            std::to_string(file.size() - at - 12) + " are there");
  }
  const std::uint8_t* body = file.data() + at + 8;
  const auto sum = static_cast<std::uint32_t>(::crc32(::crc32(0, nullptr, 0), file.data() + at + 4, length + 4));
  if (sum != big32(body + length)) damaged("is damaged: wrong checksum of chunk " + type);
  at += std::size_t{12} + length;
  return {type, {body, length}};
}

struct PngHeader {
  std::uint32_t width = 0, height = 0;
  int bits = 0, color_type = 0, interlace = 0;
  int channels() const { return color_type == 2 ? 3 : color_type == 4 ? 2 : color_type == 6 ? 4 : 1; }
};

PngHeader read_header(std::span<const std::uint8_t> file, std::size_t& at) {
  if (file.size() < 8 || std::memcmp(file.data(), kSignature.data(), 8) != 0) damaged("signature is missing");
  at = 8;
  const Chunk chunk = next_chunk(file, at);
  if (chunk.type != "IHDR" || chunk.data.size() != 13) damaged("is damaged: it does not start with a header chunk");
  const std::uint8_t* p = chunk.data.data();
  const PngHeader h{big32(p), big32(p + 4), p[8], p[9], p[12]};
  check_image_limits(h.width, h.height, h.channels(), h.bits == 16 ? 2 : 1);
  const bool small = h.bits == 1 || h.bits == 2 || h.bits == 4;
  const bool valid = h.color_type == 0   ? small || h.bits == 8 || h.bits == 16
                     : h.color_type == 3 ? small || h.bits == 8
                     : h.color_type == 2 || h.color_type == 4 || h.color_type == 6 ? h.bits == 8 || h.bits == 16
                                                                                   : false;
  if (!valid || p[10] != 0 || p[11] != 0 || h.interlace > 1)
    damaged("is damaged: its header has no valid pixel format");
  return h;
}

// Adam7: first column and row and their steps of each pass; pass 0 of a plain image covers all.
struct Pass {
  std::uint32_t x0, y0, dx, dy;
};
constexpr std::array<Pass, 7> kAdam7{
    {{0, 0, 8, 8}, {4, 0, 8, 8}, {0, 4, 4, 8}, {2, 0, 4, 4}, {0, 2, 2, 4}, {1, 0, 2, 2}, {0, 1, 1, 2}}};
constexpr std::array<Pass, 1> kPlain{{{0, 0, 1, 1}}};

std::uint32_t steps(std::uint32_t size, std::uint32_t start, std::uint32_t step) {
  return size <= start ? 0 : (size - start + step - 1) / step;
}

std::size_t row_bytes(const PngHeader& h, std::uint32_t width) {
  return (std::size_t{width} * static_cast<std::size_t>(h.channels() * h.bits) + 7) / 8;
}

std::uint8_t paeth(int a, int b, int c) {
  const int pa = std::abs(b - c), pb = std::abs(a - c), pc = std::abs(a + b - 2 * c);
  return static_cast<std::uint8_t>(pa <= pb && pa <= pc ? a : pb <= pc ? b : c);
}

// Undoes the row filter in place, the bytes of a pixel known to the compiler; `up` is the decoded row above, all zero
// for the first. The pixel to the left is kept in `left`, the one above it in `corner`.
template <std::size_t kBytes>
void unfilter_row(int filter, std::uint8_t* __restrict row, const std::uint8_t* __restrict up, std::size_t bytes) {
  std::array<std::uint8_t, kBytes> left{}, corner{};
  switch (filter) {
    case 1:
      for (std::size_t i = 0; i < bytes; i += kBytes) {
        for (std::size_t c = 0; c < kBytes; ++c) row[i + c] = left[c] = static_cast<std::uint8_t>(row[i + c] + left[c]);
      }
      break;
    case 2:
      for (std::size_t i = 0; i < bytes; ++i) row[i] = static_cast<std::uint8_t>(row[i] + up[i]);
      break;
    case 3:
      for (std::size_t i = 0; i < bytes; i += kBytes) {
        for (std::size_t c = 0; c < kBytes; ++c)
          row[i + c] = left[c] = static_cast<std::uint8_t>(row[i + c] + (left[c] + up[i + c]) / 2);
      }
      break;
    case 4:
      for (std::size_t i = 0; i < bytes; i += kBytes) {
        for (std::size_t c = 0; c < kBytes; ++c) {
          const std::uint8_t above = up[i + c];
          row[i + c] = left[c] = static_cast<std::uint8_t>(row[i + c] + paeth(left[c], above, corner[c]));
          corner[c] = above;
        }
      }
      break;
    default:
      break;
  }
}

// Rows are whole pixels except below 8 bits, where a pixel counts as one byte.
void unfilter(int filter, std::uint8_t* row, const std::uint8_t* up, std::size_t bytes, std::size_t pixel_bytes) {
  switch (pixel_bytes) {
    case 1:
      return unfilter_row<1>(filter, row, up, bytes);
    case 2:
      return unfilter_row<2>(filter, row, up, bytes);
    case 3:
      return unfilter_row<3>(filter, row, up, bytes);
    case 4:
      return unfilter_row<4>(filter, row, up, bytes);
    case 6:
      return unfilter_row<6>(filter, row, up, bytes);
    default:
      return unfilter_row<8>(filter, row, up, bytes);
  }
}

std::uint16_t sample_at(const std::uint8_t* row, std::size_t i, int bits) {
  if (bits == 8) return row[i];
  if (bits == 16) return static_cast<std::uint16_t>(row[2 * i] << 8 | row[2 * i + 1]);
  const std::size_t bit = i * static_cast<std::size_t>(bits);
  return static_cast<std::uint16_t>(row[bit / 8] >> (8 - bits - static_cast<int>(bit % 8)) & ((1 << bits) - 1));
}

// Inflates the concatenated IDAT bodies into exactly `size` bytes.
std::vector<std::uint8_t> inflate_data(const std::vector<std::span<const std::uint8_t>>& parts, std::size_t size) {
  std::size_t packed = 0;
  for (const auto& part : parts) packed += part.size();
  // Deflate expands at most 1,032-fold: a header that promises more lies, and nothing is allocated for it.
  if (packed < size / 1032) {
    damaged("is truncated: " + std::to_string(packed) + " bytes of data cannot hold " + std::to_string(size) +
            " bytes of pixels");
  }
  std::vector<std::uint8_t> out(size);
  z_stream z{};
  const int started = ::inflateInit(&z);
  if (started == Z_MEM_ERROR) throw std::bad_alloc();
  if (started != Z_OK) throw Error(ErrorKind::failure, "memory.zlib.failed", "zlib could not start");
  z.next_out = out.data();
  z.avail_out = static_cast<uInt>(size);
  int status = Z_OK;
  for (const auto& part : parts) {
    z.next_in = const_cast<Bytef*>(part.data());
    z.avail_in = static_cast<uInt>(part.size());
    while (status == Z_OK && z.avail_in > 0 && z.avail_out > 0) status = ::inflate(&z, Z_NO_FLUSH);
    if (status != Z_OK) break;
  }
  const std::size_t made = size - z.avail_out;
  ::inflateEnd(&z);
  if (status == Z_MEM_ERROR) throw std::bad_alloc();
  if (status != Z_OK && status != Z_STREAM_END && status != Z_BUF_ERROR)
    damaged("is damaged: its compressed data has an error");
  if (made < size)
    damaged("is truncated: " + std::to_string(made) + " of " + std::to_string(size) + " bytes of pixels are there");
  return out;
}

// Decodes the filtered rows of one pass that start at raw[at], front to back, and hands each to `row_done(y, row)`.
// Rows are decoded where they lie; `at` moves behind the pass.
template <class RowDone>
void unfilter_pass(const PngHeader& h, std::uint32_t width, std::uint32_t height, std::vector<std::uint8_t>& raw,
                   std::size_t& at, RowDone&& row_done) {
  const std::size_t bytes = row_bytes(h, width);
  const std::size_t pixel_bytes = std::max<std::size_t>(1, static_cast<std::size_t>(h.channels() * h.bits) / 8);
  const std::vector<std::uint8_t> zeros(bytes);
  const std::uint8_t* up = zeros.data();
  for (std::uint32_t y = 0; y < height; ++y, at += bytes + 1) {
    if (raw[at] > 4) damaged("is damaged: unknown row filter " + std::to_string(raw[at]));
    std::uint8_t* row = raw.data() + at + 1;
    unfilter(raw[at], row, up, bytes, pixel_bytes);
    up = row;
    row_done(y, row);
  }
}

// Whole rows of 8-bit samples: the inflated buffer itself becomes the pixels, each row moved over the filter bytes
// before it as soon as the row below no longer needs it.
void unpack_bytes(const PngHeader& h, std::vector<std::uint8_t>& raw, PngImage& image) {
  const std::size_t bytes = row_bytes(h, h.width);
  std::size_t at = 0;
  unfilter_pass(h, h.width, h.height, raw, at, [&](std::uint32_t y, const std::uint8_t*) {
    if (y > 0) std::memmove(raw.data() + (y - 1) * bytes, raw.data() + (y - 1) * (bytes + 1) + 1, bytes);
  });
  const std::size_t last = h.height - 1;
  std::memmove(raw.data() + last * bytes, raw.data() + last * (bytes + 1) + 1, bytes);
  raw.resize(bytes * h.height);
  image.bytes = std::move(raw);
}

// Every other format: sample by sample.
template <class T>
void unpack_samples(const PngHeader& h, std::vector<std::uint8_t>& raw, std::vector<T>& samples) {
  const auto channels = static_cast<std::size_t>(h.channels());
  samples.resize(std::size_t{h.width} * h.height * channels);
  const std::span<const Pass> passes = h.interlace != 0 ? std::span<const Pass>(kAdam7) : std::span<const Pass>(kPlain);
  std::size_t at = 0;
  for (const Pass& pass : passes) {
    const std::uint32_t width = steps(h.width, pass.x0, pass.dx), height = steps(h.height, pass.y0, pass.dy);
    if (width == 0 || height == 0) continue;
    unfilter_pass(h, width, height, raw, at, [&](std::uint32_t y, const std::uint8_t* row) {
      T* line = samples.data() + std::size_t{pass.y0 + y * pass.dy} * h.width * channels;
      for (std::uint32_t x = 0; x < width; ++x) {
        T* pixel = line + std::size_t{pass.x0 + x * pass.dx} * channels;
        for (std::size_t c = 0; c < channels; ++c) pixel[c] = static_cast<T>(sample_at(row, x * channels + c, h.bits));
      }
    });
  }
}

void put32(std::vector<std::uint8_t>& out, std::uint32_t value) {
  for (int shift = 24; shift >= 0; shift -= 8) out.push_back(static_cast<std::uint8_t>(value >> shift));
}

void put_chunk(std::vector<std::uint8_t>& out, const char* type, std::span<const std::uint8_t> data) {
  put32(out, static_cast<std::uint32_t>(data.size()));
  const std::size_t start = out.size();
  out.insert(out.end(), type, type + 4);
  out.insert(out.end(), data.begin(), data.end());
  put32(out, static_cast<std::uint32_t>(
                 ::crc32(::crc32(0, nullptr, 0), out.data() + start, static_cast<uInt>(out.size() - start))));
}

std::span<const std::uint8_t> as_uint8(std::span<const std::byte> bytes) {
  return {reinterpret_cast<const std::uint8_t*>(bytes.data()), bytes.size()};
}

}  // namespace

bool looks_like_png(std::span<const std::byte> bytes) {
  return bytes.size() >= 8 && std::memcmp(bytes.data(), kSignature.data(), 8) == 0;
}

ImageSize png_size(std::span<const std::byte> bytes) {
  std::size_t at = 0;
  const PngHeader h = read_header(as_uint8(bytes), at);
  return {static_cast<std::int32_t>(h.width), static_cast<std::int32_t>(h.height), h.channels(), h.bits};
}

PngImage decode_png(std::span<const std::byte> bytes) {
  const std::span<const std::uint8_t> file = as_uint8(bytes);
  std::size_t at = 0;
  const PngHeader h = read_header(file, at);
  PngImage image;
  image.width_px = static_cast<std::int32_t>(h.width);
  image.height_px = static_cast<std::int32_t>(h.height);
  image.channels = h.channels();
  image.bits = h.bits;
  image.palette = h.color_type == 3;
  std::vector<std::span<const std::uint8_t>> parts;
  for (;;) {
    const Chunk chunk = next_chunk(file, at);
    if (chunk.type == "IEND") break;
    if (chunk.type == "IDAT") parts.push_back(chunk.data);
    if (chunk.type == "PLTE") image.palette_rgb.assign(chunk.data.begin(), chunk.data.end());
    if (chunk.type == "tRNS" && image.palette) image.palette_alpha.assign(chunk.data.begin(), chunk.data.end());
  }
  if (image.palette && (image.palette_rgb.empty() || image.palette_rgb.size() % 3 != 0))
    damaged("is damaged: its palette is missing");
  std::size_t size = 0;
  if (h.interlace != 0) {
    for (const Pass& p : kAdam7) {
      const std::uint32_t w = steps(h.width, p.x0, p.dx);
      if (w > 0) size += (row_bytes(h, w) + 1) * steps(h.height, p.y0, p.dy);
    }
  } else {
    size = (row_bytes(h, h.width) + 1) * h.height;
  }
  std::vector<std::uint8_t> raw = inflate_data(parts, size);
  if (h.bits == 16) {
    unpack_samples(h, raw, image.words);
  } else if (h.bits == 8 && h.interlace == 0) {
    unpack_bytes(h, raw, image);
  } else {
    unpack_samples(h, raw, image.bytes);
  }
  return image;
}

std::vector<std::uint8_t> encode_png(std::int32_t width, std::int32_t height, int color_type, int bits,
                                     std::span<const std::uint8_t> rows, const PngPalette& palette, int level) {
  check_image_limits(width, height);
  const PngHeader h{static_cast<std::uint32_t>(width), static_cast<std::uint32_t>(height), bits, color_type, 0};
  const std::size_t bytes = row_bytes(h, h.width);
  SEMFIELD_CHECK(rows.size() == bytes * h.height, "PNG rows do not match the size");
  SEMFIELD_CHECK(color_type != 3 || (!palette.rgb.empty() && palette.rgb.size() % 3 == 0 && palette.rgb.size() <= 768 &&
                                     3 * palette.alpha.size() <= palette.rgb.size()),
                 "a palette has 1 to 256 colours, and no more alphas than colours");
  // Photographs pack best after a prediction, maps of ids without one.
  const int filter = color_type == 2 ? 4 : 0;
  const std::size_t pixel_bytes = std::max<std::size_t>(1, static_cast<std::size_t>(h.channels() * bits) / 8);
  std::vector<std::uint8_t> raw;
  raw.reserve((bytes + 1) * h.height);
  for (std::size_t y = 0; y < h.height; ++y) {
    raw.push_back(static_cast<std::uint8_t>(filter));
    const std::uint8_t* row = rows.data() + y * bytes;
    const std::uint8_t* up = y > 0 ? row - bytes : nullptr;
    if (filter == 0) {
      raw.insert(raw.end(), row, row + bytes);
      continue;
    }
    for (std::size_t i = 0; i < bytes; ++i) {
      const int a = i >= pixel_bytes ? row[i - pixel_bytes] : 0;
      const int b = up != nullptr ? up[i] : 0;
      const int c = up != nullptr && i >= pixel_bytes ? up[i - pixel_bytes] : 0;
      raw.push_back(static_cast<std::uint8_t>(row[i] - paeth(a, b, c)));
    }
  }
  uLongf packed_size = ::compressBound(static_cast<uLong>(raw.size()));
  std::vector<std::uint8_t> packed(packed_size);
  const int status = ::compress2(packed.data(), &packed_size, raw.data(), static_cast<uLong>(raw.size()), level);
  if (status == Z_MEM_ERROR) throw std::bad_alloc();
  SEMFIELD_CHECK(status == Z_OK, "zlib could not compress");
  packed.resize(packed_size);

  std::vector<std::uint8_t> out(kSignature.begin(), kSignature.end());
  std::vector<std::uint8_t> header;
  put32(header, h.width);
  put32(header, h.height);
  header.insert(header.end(), {static_cast<std::uint8_t>(bits), static_cast<std::uint8_t>(color_type), 0, 0, 0});
  put_chunk(out, "IHDR", header);
  if (color_type == 3) put_chunk(out, "PLTE", palette.rgb);
  if (!palette.alpha.empty()) put_chunk(out, "tRNS", palette.alpha);
  put_chunk(out, "IDAT", packed);
  put_chunk(out, "IEND", {});
  return out;
}

}  // namespace semfield
