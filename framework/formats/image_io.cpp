// Images in and out: PNG by our own codec, every other format through image_formats.h.
#include "formats/image_io.h"

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstring>
#include <fstream>

#include "core/check.h"
#include "core/error.h"
#include "formats/image_formats.h"
#include "formats/png_codec.h"
#include "system/files.h"
#include "system/process.h"

namespace semfield {

namespace {

constexpr std::size_t kMaxImageFileBytes = std::size_t{1} << 30;

std::span<const std::byte> bytes_of(const std::string& text) {
  return std::as_bytes(std::span<const char>(text.data(), text.size()));
}

// Runs `body`; an error on the way names the file.
template <class Body>
auto naming(const std::string& path, Body&& body) {
  try {
    return body();
  } catch (Error& e) {
    if (e.message().find(path) != std::string::npos) throw;
    throw Error(e.kind(), e.code(), "'" + path + "': " + e.message(), e.remedy());
  }
}

std::uint8_t blend(unsigned value, unsigned alpha, int background) {
  const unsigned mixed = value * alpha + static_cast<unsigned>(background) * (255 - alpha);
  return static_cast<std::uint8_t>((mixed + 127) / 255);
}

// Colour over the background, and alpha beside it where it is wanted.
class RgbWriter {
 public:
  RgbWriter(std::int32_t width_px, std::int32_t height_px, int background, std::vector<std::uint8_t>* alpha)
      : image{width_px, height_px, 3, {}}, background_(background), alpha_(alpha) {
    const std::size_t pixels = static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px);
    image.pixels.resize(pixels * 3);
    if (alpha_ != nullptr) alpha_->assign(pixels, 255);
  }
  void put(std::size_t pixel, const unsigned (&rgb)[3], unsigned alpha) {
    for (std::size_t c = 0; c < 3; ++c)
      image.pixels[pixel * 3 + c] =
          background_ < 0 ? static_cast<std::uint8_t>(rgb[c]) : blend(rgb[c], alpha, background_);
    if (alpha_ != nullptr) (*alpha_)[pixel] = static_cast<std::uint8_t>(alpha);
  }
  Image<std::uint8_t> image;

 private:
  int background_;
  std::vector<std::uint8_t>* alpha_;
};

Image<std::uint8_t> rgb_of_png(PngImage png, int alpha_background, std::vector<std::uint8_t>* alpha_out) {
  RgbWriter out(png.width_px, png.height_px, alpha_background, alpha_out);
  if (png.channels == 3 && png.bits == 8) {
    out.image.pixels = std::move(png.bytes);
    return std::move(out.image);
  }
  const std::size_t pixels = out.image.pixels.size() / 3;
  const unsigned top = (1u << png.bits) - 1;
  const auto channels = static_cast<std::size_t>(png.channels);
  const auto to8 = [top](unsigned v) { return top == 255 ? v : (v * 255 + top / 2) / top; };
  for (std::size_t i = 0; i < pixels; ++i) {
    const std::size_t first = i * channels;
    unsigned rgb[3], alpha = 255;
    if (png.palette) {
      const std::size_t index = png.sample(first);
      if (index * 3 + 2 >= png.palette_rgb.size()) {
        throw Error(ErrorKind::data, "files.image.damaged",
                    "PNG is damaged: palette index " + std::to_string(index) + " has no colour",
                    "export the file again");
      }
      for (std::size_t c = 0; c < 3; ++c) rgb[c] = png.palette_rgb[index * 3 + c];
      if (index < png.palette_alpha.size()) alpha = png.palette_alpha[index];
    } else {
      for (std::size_t c = 0; c < 3; ++c) rgb[c] = to8(png.sample(first + (channels >= 3 ? c : 0)));
      if (channels == 2 || channels == 4) alpha = to8(png.sample(first + channels - 1));
    }
    out.put(i, rgb, alpha);
  }
  return std::move(out.image);
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
    std::uint32_t length = 0;
    for (std::size_t i = 0; i < 4; ++i) length = length << 8 | static_cast<unsigned char>(head[i]);
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
    if (looks_like_png(bytes_of(file))) return rgb_of_png(decode_png(bytes_of(file)), alpha_background, alpha_out);
    check_jpeg_end(file);
    Image<std::uint8_t> in = image_formats().read8(path);
    RgbWriter out(in.width_px, in.height_px, alpha_background, alpha_out);
    if (in.channels == 3) return in;
    const auto channels = static_cast<std::size_t>(in.channels);
    for (std::size_t i = 0; i < in.pixels.size() / channels; ++i) {
      const std::uint8_t* s = in.pixels.data() + i * channels;
      const unsigned rgb[3] = {s[0], s[channels >= 3 ? 1 : 0], s[channels >= 3 ? 2 : 0]};
      out.put(i, rgb, channels == 2 || channels == 4 ? s[channels - 1] : 255u);
    }
    return std::move(out.image);
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

std::vector<std::uint8_t> encode_png_rgb(std::int32_t width, std::int32_t height, std::span<const std::uint8_t> rgb) {
  return encode_png(width, height, 2, 8, rgb);
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
  std::string dims;
  std::int64_t count = 1;
  for (const std::int64_t n : shape) {
    dims += std::to_string(n) + ", ";
    count *= n;
  }
  if (shape.size() > 1) dims.resize(dims.size() - 2);
  if (shape.size() == 1) dims.resize(dims.size() - 1);  // "(3,)"
  SEMFIELD_CHECK(count == static_cast<std::int64_t>(values.size()), "npy shape does not match the values");
  // Format 1.0: magic, version, header length, a Python dict, padded so that the data starts at a multiple of 64 bytes.
  std::string header = "{'descr': '<f4', 'fortran_order': False, 'shape': (" + dims + "), }";
  header.append(63 - (10 + header.size()) % 64, ' ');
  header += '\n';
  std::string out("\x93NUMPY\x01\x00", 8);
  out += static_cast<char>(header.size() & 0xFF);
  out += static_cast<char>(header.size() >> 8);
  out += header;
  AtomicFile file(path);
  file.append(bytes_of(out));
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

// Loads the library of image_formats.h when it is first needed.

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
