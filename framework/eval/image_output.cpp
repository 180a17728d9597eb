// Rendered maps as files.
#include "eval/image_output.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "core/check.h"
#include "core/error.h"
#include "formats/image_io.h"

namespace semfield {

namespace {

// OKLab -> linear sRGB [Ottosson20].
std::array<double, 3> linear_from_oklab(double lightness, double a, double b) {
  const double l = std::pow(lightness + 0.3963377774 * a + 0.2158037573 * b, 3);
  const double m = std::pow(lightness - 0.1055613458 * a - 0.0638541728 * b, 3);
  const double s = std::pow(lightness - 0.0894841775 * a - 1.2914855480 * b, 3);
  return {4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
          -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
          -0.0041960863 * l - 0.7034186147 * m + 1.7076147010 * s};
}

std::uint8_t byte_from_linear(double x) {
  const double clamped = std::clamp(x, 0.0, 1.0);
  const double encoded = clamped <= 0.0031308 ? 12.92 * clamped : 1.055 * std::pow(clamped, 1 / 2.4) - 0.055;
  return static_cast<std::uint8_t>(std::lround(255 * encoded));
}

constexpr int kMapSize = 1024;

std::array<std::uint8_t, 3> compute_color(double t) {
  // A quadratic chroma between ends chosen so that the whole path lies inside sRGB and its steps are even (factor 1.2).
  const double lightness = 0.22 + 0.73 * t;
  const double hue = (310.0 - 200.0 * t) * 3.14159265358979323846 / 180;
  const double chroma = 0.10 * (1 - t) * (1 - t) + 2 * 0.07 * t * (1 - t) + 0.16 * t * t;
  const std::array<double, 3> rgb = linear_from_oklab(lightness, chroma * std::cos(hue), chroma * std::sin(hue));
  return {byte_from_linear(rgb[0]), byte_from_linear(rgb[1]), byte_from_linear(rgb[2])};
}

const std::vector<std::array<std::uint8_t, 3>>& color_map() {
  static const std::vector<std::array<std::uint8_t, 3>> table = [] {
    std::vector<std::array<std::uint8_t, 3>> colors;
    for (int i = 0; i < kMapSize; ++i) colors.push_back(compute_color(static_cast<double>(i) / (kMapSize - 1)));
    return colors;
  }();
  return table;
}

void check_size(MapSize size, std::size_t values, std::size_t channels) {
  SEMFIELD_CHECK(
      size.width_px > 0 && size.height_px > 0 &&
          values == static_cast<std::size_t>(size.width_px) * static_cast<std::size_t>(size.height_px) * channels,
      "a map has width * height * channels values");
}

bool needs_16_bits(const ClassTable& classes) {
  return std::any_of(classes.entries().begin(), classes.entries().end(),
                     [](const ClassEntry& e) { return e.id > 254; });
}

void check_label(std::int16_t label, const ClassTable& classes) {
  SEMFIELD_CHECK(label == kVoid || (label >= 0 && label < classes.valid_count()), "a label lies in the class table");
}

// Id of each label, checked against the table.
std::vector<std::uint16_t> ids_of(std::span<const std::int16_t> label, const ClassTable& classes) {
  std::vector<std::uint16_t> ids(label.size());
  for (std::size_t i = 0; i < label.size(); ++i) {
    check_label(label[i], classes);
    const std::int32_t id = classes.id_of(label[i]);
    if (id < 0 || id > 65535) {
      throw Error(ErrorKind::data, "classes.id.large", fmt::format("class id {} does not fit a 16-bit image", id),
                  "give the class an id of at most 65535");
    }
    ids[i] = static_cast<std::uint16_t>(id);
  }
  return ids;
}

std::array<std::uint8_t, 3> void_color(const ClassTable& classes) {
  const std::int32_t id = classes.id_of(kVoid);
  for (const ClassEntry& entry : classes.entries()) {
    if (entry.ignore && entry.id == id) return entry.color;
  }
  return {0, 0, 0};
}

void put(std::vector<std::uint8_t>& rgb, std::size_t pixel, std::array<std::uint8_t, 3> color) {
  std::copy(color.begin(), color.end(), rgb.begin() + static_cast<std::ptrdiff_t>(3 * pixel));
}

}  // namespace

std::array<std::uint8_t, 3> perceptual_color(double t) {
  if (std::isnan(t)) return {0, 0, 0};
  return color_map()[static_cast<std::size_t>(std::lround(std::clamp(t, 0.0, 1.0) * (kMapSize - 1)))];
}

std::vector<std::uint8_t> label_colors(std::span<const std::int16_t> label, const ClassTable& classes) {
  std::vector<std::uint8_t> rgb(label.size() * 3);
  const std::array<std::uint8_t, 3> unlabelled = void_color(classes);
  for (std::size_t i = 0; i < label.size(); ++i) {
    check_label(label[i], classes);
    put(rgb, i, label[i] == kVoid ? unlabelled : classes.valid(label[i]).color);
  }
  return rgb;
}

std::vector<std::uint8_t> depth_colors(std::span<const float> depth_m, double near_m, double far_m) {
  std::vector<std::uint8_t> rgb(depth_m.size() * 3, 0);
  const double scale = far_m > near_m ? 1 / (far_m - near_m) : 0;
  for (std::size_t i = 0; i < depth_m.size(); ++i) {
    const double d = depth_m[i];
    if (std::isfinite(d) && d > 0) put(rgb, i, perceptual_color(1 - (d - near_m) * scale));
  }
  return rgb;
}

std::vector<std::uint8_t> entropy_colors(std::span<const float> entropy_nats, double most) {
  std::vector<std::uint8_t> rgb(entropy_nats.size() * 3);
  const double scale = most > 0 ? 1 / most : 0;
  for (std::size_t i = 0; i < entropy_nats.size(); ++i) put(rgb, i, perceptual_color(entropy_nats[i] * scale));
  return rgb;
}

DepthRange robust_depth_range(std::span<const float> depth_m) {
  std::vector<float> valid;
  for (float d : depth_m) {
    if (std::isfinite(d) && d > 0) valid.push_back(d);
  }
  if (valid.empty()) return {};
  const double near_m = quantile(valid, 0.02);
  return {near_m, quantile(valid, 0.98)};
}

void write_label_ids(const std::string& path, MapSize size, std::span<const std::int16_t> label,
                     const ClassTable& classes) {
  check_size(size, label.size(), 1);
  const std::vector<std::uint16_t> ids = ids_of(label, classes);
  if (needs_16_bits(classes)) {
    write_png_gray16(path, size.width_px, size.height_px, ids);
    return;
  }
  const std::vector<std::uint8_t> narrow(ids.begin(), ids.end());
  write_png_gray8(path, size.width_px, size.height_px, narrow);
}

void write_label_colors(const std::string& path, MapSize size, std::span<const std::int16_t> label,
                        const ClassTable& classes) {
  check_size(size, label.size(), 1);
  if (needs_16_bits(classes)) {
    write_png_rgb(path, size.width_px, size.height_px, label_colors(label, classes));
    return;
  }
  const std::vector<std::uint16_t> ids = ids_of(label, classes);
  const std::vector<std::uint8_t> index(ids.begin(), ids.end());
  std::vector<std::uint8_t> palette(256 * 3, 0);
  for (const ClassEntry& entry : classes.entries()) put(palette, static_cast<std::size_t>(entry.id), entry.color);
  write_png_palette(path, size.width_px, size.height_px, index, palette);
}

double depth_step(bool metric, Vec3d scene_size) {
  const double longest = std::max({scene_size.x, scene_size.y, scene_size.z});
  if (is_in_metres(metric, scene_size) || !(longest > 0) || !std::isfinite(longest)) return 1e-3;
  return std::pow(10.0, std::floor(std::log10(longest / 2)) - 3);
}

std::int64_t write_depth(const std::string& path, MapSize size, std::span<const float> depth, double step) {
  check_size(size, depth.size(), 1);
  std::vector<std::uint16_t> steps(depth.size(), 0);
  std::int64_t beyond = 0;
  for (std::size_t i = 0; i < depth.size(); ++i) {
    const double value = std::round(static_cast<double>(depth[i]) / step);
    if (!(value > 0)) continue;  // NaN, zero and negative: no value
    if (value > kMostDepthSteps) {
      ++beyond;
    } else {
      steps[i] = static_cast<std::uint16_t>(value);
    }
  }
  write_png_gray16(path, size.width_px, size.height_px, steps);
  return beyond;
}

void write_entropy(const std::string& path, MapSize size, std::span<const float> entropy_nats, int classes) {
  check_size(size, entropy_nats.size(), 1);
  std::vector<std::uint16_t> values(entropy_nats.size(), 0);
  if (classes > 1) {
    const double scale = 65535 / std::log(static_cast<double>(classes));
    for (std::size_t i = 0; i < values.size(); ++i) {
      const double value = entropy_nats[i] * scale;
      values[i] = value > 0 ? static_cast<std::uint16_t>(std::lround(std::min(value, 65535.0))) : std::uint16_t{0};
    }
  }
  write_png_gray16(path, size.width_px, size.height_px, values);
}

void write_map_npy(const std::string& path, MapSize size, std::span<const float> values) {
  check_size(size, values.size(), 1);
  const std::array<std::int64_t, 2> shape{size.height_px, size.width_px};
  write_npy(path, shape, values);
}

std::vector<std::uint8_t> to_bytes(std::span<const float> rgb) {
  std::vector<std::uint8_t> bytes(rgb.size());
  for (std::size_t i = 0; i < rgb.size(); ++i) {
    if (std::isnan(rgb[i])) {
      throw Error(ErrorKind::data, "render.pixel.not_finite",
                  fmt::format("pixel {}, channel {} of a rendered image is NaN", i / 3, i % 3),
                  "render from an earlier checkpoint");
    }
    bytes[i] = static_cast<std::uint8_t>(std::lround(std::clamp(rgb[i], 0.0f, 1.0f) * 255.0f));
  }
  return bytes;
}

void write_color(const std::string& path, MapSize size, std::span<const float> rgb) {
  check_size(size, rgb.size(), 3);
  write_png_rgb(path, size.width_px, size.height_px, to_bytes(rgb));
}

}  // namespace semfield
