// Images in and out: PNG through libpng and zlib, every other format through the library of ImageFormats.
#include "formats/image_io.h"

#include <png.h>
#include <zlib.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <csetjmp>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <new>
#include <numeric>

#include "core/check.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"
#include "formats/npz.h"

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

std::size_t row_bytes(const PngHeader& h) {
  return (std::size_t{h.width} * static_cast<std::size_t>(h.channels() * h.bits) + 7) / 8;
}

std::uint8_t paeth(int a, int b, int c) {
  const int pa = std::abs(b - c), pb = std::abs(a - c), pc = std::abs(a + b - 2 * c);
  return static_cast<std::uint8_t>(pa <= pb && pa <= pc ? a : pb <= pc ? b : c);
}

// Pixels of a file whose checksums, header and size are checked. libpng leaves an error by longjmp: what it leaves has
// nothing to destroy.

constexpr std::size_t kFaultBytes = 80;

[[noreturn]] void keep_fault(png_struct* png, const char* what) {
  std::snprintf(static_cast<char*>(png_get_error_ptr(png)), kFaultBytes, "%s", what);
  png_longjmp(png, 1);
}

void take_from_file(png_struct* png, std::uint8_t* to, std::size_t count) {
  auto& left = *static_cast<std::span<const std::uint8_t>*>(png_get_io_ptr(png));
  if (count > left.size()) png_error(png, "its data end early");
  std::memcpy(to, left.data(), count);
  left = left.subspan(count);
}

// Whole samples, row by row: a byte each below 16 bits.
bool read_samples(png_struct* png, png_info* info, std::span<const std::uint8_t>& file, std::uint8_t** rows) {
  if (setjmp(png_jmpbuf(png)) != 0) return false;
  png_set_read_fn(png, &file, take_from_file);
  png_set_crc_action(png, PNG_CRC_QUIET_USE, PNG_CRC_QUIET_USE);  // checksums and sizes are checked
  png_set_user_limits(png, PNG_UINT_31_MAX, PNG_UINT_31_MAX);
  png_set_keep_unknown_chunks(png, PNG_HANDLE_CHUNK_NEVER, nullptr, -1);  // such as colour spaces and texts
  png_read_info(png, info);
  png_set_packing(png);
  if constexpr (std::endian::native == std::endian::little) png_set_swap(png);
  png_set_interlace_handling(png);
  png_read_update_info(png, info);
  png_read_image(png, rows);
  return true;
}

void decode_samples(std::span<const std::uint8_t> file, const PngHeader& h, void* samples) {
  std::vector<std::uint8_t*> rows(h.height);
  const std::size_t bytes = std::size_t{h.width} * static_cast<std::size_t>(h.channels()) * (h.bits == 16 ? 2 : 1);
  for (std::size_t y = 0; y < rows.size(); ++y) rows[y] = static_cast<std::uint8_t*>(samples) + y * bytes;
  std::array<char, kFaultBytes> fault{};
  png_struct* png =
      png_create_read_struct(PNG_LIBPNG_VER_STRING, fault.data(), keep_fault, [](png_struct*, const char*) {});
  png_info* info = png == nullptr ? nullptr : png_create_info_struct(png);
  if (info == nullptr) {
    png_destroy_read_struct(&png, nullptr, nullptr);
    throw std::bad_alloc();
  }
  const bool whole = read_samples(png, info, file, rows.data());
  png_destroy_read_struct(&png, &info, nullptr);
  if (whole) return;
  if (std::strstr(fault.data(), "memory") != nullptr) throw std::bad_alloc();
  damaged(std::string("is damaged: ") + fault.data());
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
  std::size_t packed = 0;
  for (;;) {
    const Chunk chunk = next_chunk(file, at);
    if (chunk.type == "IEND") break;
    if (chunk.type == "IDAT") packed += chunk.data.size();
    if (chunk.type == "PLTE") image.palette_rgb.assign(chunk.data.begin(), chunk.data.end());
    if (chunk.type == "tRNS" && image.palette) image.palette_alpha.assign(chunk.data.begin(), chunk.data.end());
  }
  if (image.palette && (image.palette_rgb.empty() || image.palette_rgb.size() % 3 != 0))
    damaged("is damaged: its palette is missing");
  // Deflate expands at most 1,032-fold: a header that promises more lies, and nothing is allocated for it.
  if (const std::size_t size = row_bytes(h) * h.height; packed < size / 1032)
    damaged("is truncated: " + std::to_string(packed) + " bytes of data cannot hold " + std::to_string(size) +
            " bytes of pixels");
  const std::size_t samples = std::size_t{h.width} * h.height * static_cast<std::size_t>(h.channels());
  if (h.bits == 16) {
    image.words.resize(samples);
    decode_samples(file, h, image.words.data());
  } else {
    image.bytes.resize(samples);
    decode_samples(file, h, image.bytes.data());
  }
  return image;
}

std::vector<std::uint8_t> encode_png(std::int32_t width, std::int32_t height, int color_type, int bits,
                                     std::span<const std::uint8_t> rows, const PngPalette& palette, int level) {
  check_image_limits(width, height);
  const PngHeader h{static_cast<std::uint32_t>(width), static_cast<std::uint32_t>(height), bits, color_type, 0};
  const std::size_t bytes = row_bytes(h);
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

namespace {

constexpr std::size_t kMaxImageFileBytes = std::size_t{1} << 30;

std::span<const std::byte> bytes_of(const std::string& text) {
  return std::as_bytes(std::span<const char>(text.data(), text.size()));
}

std::uint8_t blend(unsigned value, unsigned alpha, int background) {
  const unsigned mixed = value * alpha + static_cast<unsigned>(background) * (255 - alpha);
  return static_cast<std::uint8_t>((mixed + 127) / 255);
}

// Colour over the background, and alpha where it is wanted.
Image<std::uint8_t> rgb_of(PngImage png, int alpha_background, std::vector<std::uint8_t>* alpha_out) {
  const std::size_t pixels = pixel_at(0, png.height_px, png.width_px);
  if (alpha_out != nullptr) alpha_out->assign(pixels, 255);
  Image<std::uint8_t> out{png.width_px, png.height_px, 3, {}};
  if (png.channels == 3 && png.bits == 8) {
    out.pixels = std::move(png.bytes);
    return out;
  }
  out.pixels.resize(pixels * 3);
  const unsigned top = (1u << png.bits) - 1;
  const auto channels = static_cast<std::size_t>(png.channels);
  const auto to8 = [top](unsigned v) { return top == 255 ? v : (v * 255 + top / 2) / top; };
  for (std::size_t i = 0; i < pixels; ++i) {
    const std::size_t first = i * channels;
    unsigned rgb[3], alpha = 255;
    if (png.palette) {
      const std::size_t index = png.sample(first);
      if (index * 3 + 2 >= png.palette_rgb.size())
        damaged("is damaged: palette index " + std::to_string(index) + " has no colour");
      for (std::size_t c = 0; c < 3; ++c) rgb[c] = png.palette_rgb[index * 3 + c];
      if (index < png.palette_alpha.size()) alpha = png.palette_alpha[index];
    } else {
      for (std::size_t c = 0; c < 3; ++c) rgb[c] = to8(png.sample(first + (channels >= 3 ? c : 0)));
      if (channels == 2 || channels == 4) alpha = to8(png.sample(first + channels - 1));
    }
    for (std::size_t c = 0; c < 3; ++c)
      out.pixels[i * 3 + c] =
          alpha_background < 0 ? static_cast<std::uint8_t>(rgb[c]) : blend(rgb[c], alpha, alpha_background);
    if (alpha_out != nullptr) (*alpha_out)[i] = static_cast<std::uint8_t>(alpha);
  }
  return out;
}

// A JPEG cut short decodes to grey without an error, so the end-of-image marker is looked for first.
void check_jpeg_end(const std::string& file) {
  const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(file[i]); };
  if (file.size() < 4 || byte(0) != 0xFF || byte(1) != 0xD8) return;
  std::size_t at = 2;
  while (at + 1 < file.size()) {
    if (byte(at) != 0xFF) {
      ++at;  // entropy-coded data
      continue;
    }
    const unsigned marker = byte(at + 1);
    if (marker == 0xD9) return;
    if (marker == 0xFF) {
      ++at;
    } else if (marker == 0x00 || marker == 0x01 || (marker >= 0xD0 && marker <= 0xD8)) {
      at += 2;
    } else {
      if (at + 3 >= file.size()) break;
      at += 2 + static_cast<std::size_t>(byte(at + 2) << 8 | byte(at + 3));
    }
  }
  throw Error(ErrorKind::data, "files.image.damaged",
              "JPEG is truncated: it ends after " + std::to_string(file.size()) + " bytes, before its end marker",
              "copy or export the file again");
}

// The tag Orientation of an EXIF block [Exif 2.3]; 1 where it is not told.
int exif_orientation(std::string_view exif) {
  const bool little = exif.starts_with("II");
  const auto number = [&](std::size_t at, std::size_t bytes) {
    std::size_t out = 0;
    for (std::size_t i = 0; i < bytes && at + bytes <= exif.size(); ++i)
      out = out << 8 | static_cast<unsigned char>(exif[little ? at + bytes - 1 - i : at + i]);
    return out;
  };
  const std::size_t directory = number(4, 4), entries = number(directory, 2);
  for (std::size_t i = 0; i < entries && directory + 2 + 12 * (i + 1) <= exif.size(); ++i) {
    const std::size_t at = directory + 2 + 12 * i, value = number(at + 8, 2);
    if (number(at, 2) == 0x0112 && number(at + 2, 2) == 3 && value >= 1 && value <= 8) return static_cast<int>(value);
  }
  return 1;
}

// By the chunk eXIf, which may stand before or behind the pixels [PNG3].
int png_orientation(const std::string& path) {
  constexpr std::uint32_t kMostBytes = 1 << 16;
  std::ifstream file(path, std::ios::binary);
  file.seekg(8);
  for (std::array<char, 8> head{}; file.read(head.data(), 8);) {
    const std::uint32_t length = big32(reinterpret_cast<const std::uint8_t*>(head.data()));
    if (std::string_view(head.data() + 4, 4) == "eXIf") {
      std::string exif(std::min(length, kMostBytes), '\0');
      return file.read(exif.data(), static_cast<std::streamsize>(exif.size())) ? exif_orientation(exif) : 1;
    }
    file.seekg(std::int64_t{length} + 4, std::ios::cur);
  }
  return 1;
}

void write_bytes(const std::string& path, const std::vector<std::uint8_t>& bytes) {
  write_file_atomic(path, std::as_bytes(std::span<const std::uint8_t>(bytes)));
}

}  // namespace

ImageSize image_size(const std::string& path) {
  return naming(path, [&]() -> ImageSize {
    std::string head = read_file_start(path, 64);
    if (looks_like_png(bytes_of(head))) {
      ImageSize size = png_size(bytes_of(head));
      size.orientation = png_orientation(path);
      return size;
    }
    return image_formats().size(path);
  });
}

CameraTag camera_tag(const std::string& path) {
  return naming(path, [&]() -> CameraTag {
    const std::string head = read_file_start(path, 64);
    return looks_like_png(bytes_of(head)) ? CameraTag{} : image_formats().camera(path);
  });
}

Image<std::uint8_t> read_rgb(const std::string& path, int alpha_background, std::vector<std::uint8_t>* alpha_out) {
  return naming(path, [&]() -> Image<std::uint8_t> {
    const std::string file = read_text_file(path, kMaxImageFileBytes);
    if (looks_like_png(bytes_of(file))) return rgb_of(decode_png(bytes_of(file)), alpha_background, alpha_out);
    check_jpeg_end(file);
    Image<std::uint8_t> in = image_formats().read8(path);
    return rgb_of({in.width_px, in.height_px, in.channels, 8, false, {}, {}, std::move(in.pixels), {}},
                  alpha_background, alpha_out);
  });
}

Image<std::uint16_t> read_ids(const std::string& path) {
  return naming(path, [&]() -> Image<std::uint16_t> {
    const std::string file = read_text_file(path, kMaxImageFileBytes);
    Image<std::uint16_t> out;
    if (looks_like_png(bytes_of(file))) {
      PngImage png = decode_png(bytes_of(file));
      out = {png.width_px, png.height_px, png.channels, std::move(png.words)};
      if (png.bits < 16) out.pixels.assign(png.bytes.begin(), png.bytes.end());
    } else {
      check_jpeg_end(file);
      if (image_formats().size(path).bits == 8) {
        const Image<std::uint8_t> narrow = image_formats().read8(path);
        out = {narrow.width_px, narrow.height_px, narrow.channels, {narrow.pixels.begin(), narrow.pixels.end()}};
      } else {
        out = image_formats().read16(path);
      }
    }
    if (out.channels != 1) {
      throw Error(ErrorKind::data, "files.image.kind",
                  "expected one channel of ids, the image has " + std::to_string(out.channels),
                  "export ids or millimetres as a grey or palette PNG, not a coloured picture of them");
    }
    return out;
  });
}

Image<float> read_float(const std::string& path) {
  return naming(path, [&]() -> Image<float> {
    (void)read_file_start(path, 1);  // a missing file is told apart from an unreadable one
    Image<float> in = image_formats().read_float(path);
    if (in.channels == 1) return in;
    Image<float> out{in.width_px, in.height_px, 1, {}};
    for (std::size_t i = 0; i < in.pixels.size(); i += static_cast<std::size_t>(in.channels))
      out.pixels.push_back(in.pixels[i]);
    return out;
  });
}

void write_png_rgb(const std::string& path, std::int32_t width, std::int32_t height,
                   std::span<const std::uint8_t> rgb) {
  write_bytes(path, encode_png(width, height, 2, 8, rgb));
}

void write_png_gray16(const std::string& path, std::int32_t width, std::int32_t height,
                      std::span<const std::uint16_t> values) {
  std::vector<std::uint8_t> rows;
  rows.reserve(values.size() * 2);
  for (const std::uint16_t v : values)
    rows.insert(rows.end(), {static_cast<std::uint8_t>(v >> 8), static_cast<std::uint8_t>(v)});
  write_bytes(path, encode_png(width, height, 0, 16, rows));
}

void write_png_gray8(const std::string& path, std::int32_t width, std::int32_t height,
                     std::span<const std::uint8_t> values) {
  write_bytes(path, encode_png(width, height, 0, 8, values));
}

void write_png_palette(const std::string& path, std::int32_t width, std::int32_t height,
                       std::span<const std::uint8_t> index, std::span<const std::uint8_t> palette_rgb) {
  write_bytes(path, encode_png(width, height, 3, 8, index, {palette_rgb}));
}

void write_npy(const std::string& path, std::span<const std::int64_t> shape, std::span<const float> values) {
  const auto count = std::accumulate(shape.begin(), shape.end(), std::int64_t{1}, std::multiplies<>());
  SEMFIELD_CHECK(count == std::ssize(values), "npy shape does not match the values");
  AtomicFile file(path);
  file.append(bytes_of(npy_header("<f4", shape_text(shape))));
  file.append(std::as_bytes(values));
  file.commit();
}

std::vector<std::int64_t> nearest_pixels(std::int32_t from, std::int32_t to) {
  std::vector<std::int64_t> out;
  out.reserve(static_cast<std::size_t>(to));
  for (std::int64_t i = 0; i < to; ++i) out.push_back((2 * i + 1) * from / (2 * std::int64_t{to}));
  return out;
}

Image<std::uint8_t> resize_area(const Image<std::uint8_t>& image, std::int32_t width, std::int32_t height) {
  SEMFIELD_CHECK(width > 0 && height > 0 && width <= image.width_px && height <= image.height_px,
                 "resize_area only shrinks");
  if (width == image.width_px && height == image.height_px) return image;
  const auto channels = static_cast<std::size_t>(image.channels);
  Image<std::uint8_t> out{width, height, image.channels, {}};
  out.pixels.resize(static_cast<std::size_t>(width) * static_cast<std::size_t>(height) * channels);
  // In units of 1 / target size the overlaps of source and target intervals are whole numbers, so the averages are
  // exact before their one rounding.
  const std::int64_t sw = image.width_px, sh = image.height_px;
  std::vector<std::int64_t> sums(static_cast<std::size_t>(width) * channels);
  for (std::int64_t y = 0; y < height; ++y) {
    std::fill(sums.begin(), sums.end(), 0);
    const std::int64_t y0 = y * sh, y1 = y0 + sh;
    for (std::int64_t sy = y0 / height; sy * height < y1; ++sy) {
      const std::int64_t wy = std::min(y1, (sy + 1) * height) - std::max(y0, sy * height);
      const std::uint8_t* row = image.pixels.data() + static_cast<std::size_t>(sy * sw) * channels;
      for (std::int64_t x = 0; x < width; ++x) {
        const std::int64_t x0 = x * sw, x1 = x0 + sw;
        for (std::int64_t sx = x0 / width; sx * width < x1; ++sx) {
          const std::int64_t weight = wy * (std::min(x1, (sx + 1) * width) - std::max(x0, sx * width));
          for (std::size_t c = 0; c < channels; ++c) {
            sums[static_cast<std::size_t>(x) * channels + c] +=
                weight * row[static_cast<std::size_t>(sx) * channels + c];
          }
        }
      }
    }
    const std::int64_t area = sw * sh;
    std::uint8_t* to = out.pixels.data() + static_cast<std::size_t>(y * width) * channels;
    for (std::size_t i = 0; i < sums.size(); ++i) to[i] = static_cast<std::uint8_t>((sums[i] + area / 2) / area);
  }
  return out;
}

// Loads the library of ImageFormats when it is first needed.

#ifdef SEMFIELD_WITH_IMAGES

namespace {

std::atomic<bool> g_loaded{false};

const ImageFormats& load() {
  void* symbol = library_symbol(SEMFIELD_IMAGES_LIBRARY, kImageFormatsSymbol, "images other than PNG cannot be read",
                                "install Semfield again, or convert the images to PNG");
  g_loaded = true;
  return *reinterpret_cast<const ImageFormats* (*)()>(symbol)();
}

}  // namespace

bool images_available() { return true; }

bool image_formats_loaded() { return g_loaded; }

const ImageFormats& image_formats() {
  static const ImageFormats& formats = load();  // tried again where it failed
  return formats;
}

#else

bool images_available() { return false; }

bool image_formats_loaded() { return false; }

const ImageFormats& image_formats() {
  throw Error(ErrorKind::unavailable, "files.image.unsupported", "this build reads PNG images only",
              "build with -DSEMFIELD_WITH_IMAGES=ON, or pack the scene elsewhere");
}

#endif

}  // namespace semfield
