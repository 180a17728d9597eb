// Rendered maps as files: labels with their original ids, colours, depth, entropy.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "core/small_math.h"
#include "scene/classes/class_table.h"

namespace semfield {

/// Width and height of a row-major map, top-left first.
struct MapSize {
  std::int32_t width_px = 0, height_px = 0;
};

/// The house's map for scalar images, t in [0, 1] (clamped; NaN gives black): in OKLab [Ottosson20] lightness rises
/// evenly from 0.22 to 0.95 while the hue turns from violet over teal to yellow, so equal steps of t look equally
/// large.
std::array<std::uint8_t, 3> perceptual_color(double t);

/// Pixels of `label` (internal indices, kVoid = void) as sRGB; void is black unless the table gives it a colour. [H * W
/// * 3]
std::vector<std::uint8_t> label_colors(std::span<const std::int16_t> label, const ClassTable& classes);
/// Depth in metres as colours: near is bright. Values that are not finite or <= 0 are black. [H * W * 3]
std::vector<std::uint8_t> depth_colors(std::span<const float> depth_m, double near_m, double far_m);
/// Entropy in nats as colours, from 0 to `most`, the brightest: ln(classes) is the full range. [H * W * 3]
std::vector<std::uint8_t> entropy_colors(std::span<const float> entropy_nats, double most);

/// 2nd and 98th percentile of the valid depths, for depth_colors; {0, 1} without any.
struct DepthRange {
  double near_m = 0, far_m = 1;
};
DepthRange robust_depth_range(std::span<const float> depth_m);

/// Single-channel PNG with the ids of the class table: 8 bits, or 16 when the table has an id above 254.
void write_label_ids(const std::string& path, MapSize size, std::span<const std::int16_t> label,
                     const ClassTable& classes);
/// The same map for the eye: a palette PNG whose indices are the ids, or RGB when the table has an id above 254.
void write_label_colors(const std::string& path, MapSize size, std::span<const std::int16_t> label,
                        const ClassTable& classes);

/// A step of depth pictures, in units of the scene: a thousandth, and in a scene that is no room in metres a thousandth
/// of the power of ten with which its longest side is 2 to 20.
double depth_step(bool metric, Vec3d scene_size);
/// 16-bit PNG, z-depth in such steps; 0 = no value. Depths beyond kMostDepthSteps do not fit and are written as 0;
/// returns how many.
std::int64_t write_depth(const std::string& path, MapSize size, std::span<const float> depth, double step);
inline constexpr std::int32_t kMostDepthSteps = 65534;  // readers take 65535 for "no depth"
/// 16-bit PNG, 65535 = ln(classes) nats: the full range, whatever the image holds. One class: all 0.
void write_entropy(const std::string& path, MapSize size, std::span<const float> entropy_nats, int classes);
/// Float32 .npy of shape [height, width].
void write_map_npy(const std::string& path, MapSize size, std::span<const float> values);
/// 8-bit RGB PNG of linear display values in [0, 1], rounded to nearest; NaN is an error naming the pixel. [H * W * 3]
void write_color(const std::string& path, MapSize size, std::span<const float> rgb);
std::vector<std::uint8_t> to_bytes(std::span<const float> rgb);

}  // namespace semfield
