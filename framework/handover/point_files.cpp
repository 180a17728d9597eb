#include "handover/point_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/error.h"
#include "surface/mesh/mesh_files.h"
namespace semfield {

namespace {

constexpr std::uint16_t kHeaderBytes = 375, kRecordHeaderBytes = 54, kExtraBytesEntry = 192;
constexpr std::uint16_t kPointBytes = 36;                       // of format 7
constexpr std::uint8_t kUint16 = 3, kUint32 = 5, kFloat32 = 9;  // data types of extra bytes
constexpr std::uint16_t kClassNames = 256 * 16;

struct LasLayout {
  std::vector<std::pair<const char*, std::uint8_t>> extra;
  std::uint16_t point_bytes = kPointBytes;
  double step = 1e-6;
  Vec3d offset;
  Box box;
};

LasLayout las_layout(const PointSet& points) {
  LasLayout layout;
  layout.extra.reserve(3);
  if (points.attributes.has_labels()) layout.extra = {{"label", kUint16}, {"entropy", kFloat32}};
  if (points.attributes.has_instances()) layout.extra.emplace_back("instance", kUint32);
  for (const auto& [name, type] : layout.extra)
    layout.point_bytes = static_cast<std::uint16_t>(layout.point_bytes + (type == kUint16 ? 2 : 4));
  layout.box = box_around(points.positions);
  if (layout.box.empty()) layout.box = {{}, {}};
  // At most ten million steps a side, which 32 bits hold many times over.
  const double whole = decade(layout.box);
  layout.step = 1e-6 * whole;
  for (int axis = 0; axis < 3; ++axis)
    layout.offset[axis] = whole * std::round(layout.box.center()[axis] / whole) + 0.0;
  return layout;
}

void text_of(BufferedFile& file, std::string_view words, std::size_t bytes) {
  std::string field(words.substr(0, bytes));
  field.resize(bytes, '\0');
  file.text(field);
}

void write_record(BufferedFile& file, std::uint16_t id, std::uint16_t bytes, const char* describes) {
  file.value(std::uint16_t{0});
  text_of(file, "LASF_Spec", 16);
  file.values(id, bytes);
  text_of(file, describes, 32);
}

void write_header(BufferedFile& file, const LasLayout& layout, std::size_t count, std::uint32_t records,
                  std::uint32_t data_at) {
  constexpr std::uint16_t kWellKnownText = 16;  // asked of formats from 6 on, whether there is a text or not
  constexpr std::uint16_t kNoDay = 0;           // equal points give equal files
  constexpr std::array<std::uint32_t, 6> kEarlierCounts{};
  constexpr std::array<std::uint64_t, 14> kLaterReturns{};
  constexpr std::uint64_t kNoWaveforms = 0, kNoRecordsBehind = 0;
  file.text("LASF");
  file.values(std::uint16_t{0}, kWellKnownText);
  file.text(std::string(16, '\0'));
  file.values(std::uint8_t{1}, std::uint8_t{4});
  text_of(file, "OTHER", 32);
  text_of(file, "Semfield", 32);
  file.values(kNoDay, kNoDay, kHeaderBytes, data_at, records, std::uint8_t{7}, layout.point_bytes, kEarlierCounts);
  file.values(layout.step, layout.step, layout.step, layout.offset.x, layout.offset.y, layout.offset.z);
  for (int axis = 0; axis < 3; ++axis) file.values(layout.box.hi[axis], layout.box.lo[axis]);
  file.values(kNoWaveforms, kNoRecordsBehind, std::uint32_t{0}, std::uint64_t{count}, std::uint64_t{count},
              kLaterReturns);
}

void write_extra_bytes(BufferedFile& file, const LasLayout& layout) {
  write_record(file, 4, static_cast<std::uint16_t>(kExtraBytesEntry * layout.extra.size()), "extra bytes");
  for (const auto& [name, type] : layout.extra) {
    file.values(std::uint16_t{0}, type, std::uint8_t{0});
    text_of(file, name, 32);
    file.text(std::string(kExtraBytesEntry - 36 - 32, '\0'));
    text_of(file, std::string(name) == "entropy" ? "nats" : "id; 0 = none", 32);
  }
}

std::uint8_t classification(std::int32_t id) { return static_cast<std::uint8_t>(std::min(id, 255)); }

void write_class_names(BufferedFile& file, const ClassTable& classes) {
  write_record(file, 0, kClassNames, "classification lookup");
  std::array<std::string, 256> names;
  for (const ClassEntry& entry : classes.entries())
    if (entry.id < 255) names[static_cast<std::size_t>(entry.id)] = entry.name;
  for (std::size_t id = 0; id < names.size(); ++id) {
    file.value(static_cast<std::uint8_t>(id));
    text_of(file, names[id], 15);
  }
}

}  // namespace

Vec3d write_las(const std::string& path, const PointSet& points, const ClassTable& classes) {
  const LasLayout layout = las_layout(points);
  const PointAttributes& known = points.attributes;
  const std::uint32_t records = known.has_labels() ? 2 : layout.extra.empty() ? 0 : 1;
  std::size_t data_at = kHeaderBytes;
  if (!layout.extra.empty()) data_at += kRecordHeaderBytes + kExtraBytesEntry * layout.extra.size();
  if (known.has_labels()) data_at += kRecordHeaderBytes + std::size_t{kClassNames};
  BufferedFile file(path);
  write_header(file, layout, points.positions.size(), records, static_cast<std::uint32_t>(data_at));
  if (!layout.extra.empty()) write_extra_bytes(file, layout);
  if (known.has_labels()) write_class_names(file, classes);
  for (std::size_t i = 0; i < points.positions.size(); ++i) {
    for (int axis = 0; axis < 3; ++axis)
      file.value(
          static_cast<std::int32_t>(std::llround((points.positions[i][axis] - layout.offset[axis]) / layout.step)));
    const std::int32_t id = known.has_labels() ? classes.id_of(known.label[i]) : 0;
    constexpr std::uint16_t kNoIntensity = 0, kNoSource = 0;
    constexpr std::uint8_t kFirstOfOne = 0x11, kNoFlags = 0, kNoUserData = 0;
    constexpr std::int16_t kNoAngle = 0;
    file.values(kNoIntensity, kFirstOfOne, kNoFlags, classification(id), kNoUserData, kNoAngle, kNoSource, 0.0);
    for (const std::uint8_t c : known.color[i]) file.value(static_cast<std::uint16_t>(257 * c));
    if (known.has_labels()) file.values(static_cast<std::uint16_t>(id), known.entropy[i]);
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
  return layout.offset;
}

// PCD, the format of the Point Cloud Library.

void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset) {
  const PointAttributes& known = points.attributes;
  const bool normals = !points.normals.empty();
  std::vector<std::pair<const char*, const char*>> columns{{"x", "F"}, {"y", "F"}, {"z", "F"}};
  if (normals) columns.insert(columns.end(), {{"normal_x", "F"}, {"normal_y", "F"}, {"normal_z", "F"}});
  columns.emplace_back("rgb", "U");
  if (known.has_labels()) columns.insert(columns.end(), {{"label", "U"}, {"entropy", "F"}});
  if (known.has_instances()) columns.emplace_back("instance", "U");
  std::string names, sizes, kinds, counts;
  for (const auto& [name, kind] : columns) {
    names += std::string(" ") + name;
    sizes += " 4";
    kinds += std::string(" ") + kind;
    counts += " 1";
  }
  const std::size_t count = points.positions.size();
  BufferedFile file(path);
  file.text(
      fmt::format("# .PCD v0.7 - world frame of the input less {:.17g} {:.17g} {:.17g}\n"
                  "VERSION 0.7\nFIELDS{}\nSIZE{}\nTYPE{}\nCOUNT{}\nWIDTH {}\nHEIGHT 1\n"
                  "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA binary\n",
                  offset.x, offset.y, offset.z, names, sizes, kinds, counts, count, count));
  for (std::size_t i = 0; i < count; ++i) {
    file.floats(points.positions[i] - offset);
    if (normals) file.floats(points.normals[i]);
    const auto& c = known.color[i];
    file.value(std::uint32_t{c[0]} << 16 | std::uint32_t{c[1]} << 8 | std::uint32_t{c[2]});
    if (known.has_labels()) file.values(static_cast<std::uint32_t>(classes.id_of(known.label[i])), known.entropy[i]);
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
}

std::string sidecar_json(const Sidecar& sidecar) {
  using Json = nlohmann::ordered_json;
  Json world{{"unit", sidecar.metric ? "m" : "scene"},
             {"axes", "those of the input"},
             {"pose_scale", sidecar.convention.pose_scale},
             {"poses_inverted", sidecar.convention.invert_poses},
             {"camera_axes_flipped", sidecar.convention.flip_camera_axes}};
  if (sidecar.up) world["up"] = {sidecar.up->x, sidecar.up->y, sidecar.up->z};
  Json out{{"format", "semfield-handover-1"},
           {"run", sidecar.run},
           {"scene", sidecar.scene},
           {"step", sidecar.step},
           {"world", world},
           {"files", Json::array()}};
  for (const HandedFile& file : sidecar.files) {
    Json& row = out["files"].emplace_back();
    row = {{"file", std::filesystem::path(file.path).filename().string()},
           {"holds", file.holds},
           {"offset", {file.offset.x, file.offset.y, file.offset.z}}};
    if (file.edge) row["edge"] = *file.edge;
  }
  if (sidecar.classes != nullptr) {
    out["classes"] = Json::array();
    for (const ClassEntry& entry : sidecar.classes->entries())
      out["classes"].push_back(
          {{"id", entry.id}, {"name", entry.name}, {"color", entry.color}, {"ignore", entry.ignore}});
  }
  for (const auto& [id, name] : sidecar.objects) out["objects"].push_back({{"id", id}, {"name", name}});
  return out.dump(1, ' ', false, Json::error_handler_t::replace) + "\n";
}

namespace {

constexpr std::int64_t kPointsAtOnce = 1 << 16;
constexpr std::int32_t kRowsAtOnce = 64;
constexpr double kStep = 0.7;         // of an edge, along a ray
constexpr float kLeastShare = 1e-3F;  // of a pixel's light, that counts for a cube
constexpr float kLeastLight = 0.3F;   // pixels of all views, that end in a cube that is written
constexpr float kSolid = 5;           // optical depth of a cube that nothing passes

// Li2(a) = sum of a^k / k^2; the series is short enough below kMostOpacity.
double dilogarithm(double a) {
  double sum = 0, power = 1;
  for (int k = 1; k < 600; ++k) {
    power *= a;
    sum += power / (static_cast<double>(k) * k);
  }
  return sum;
}

}  // namespace

double splat_opacity(double optical_depth, double width) {
  static const std::vector<double> table = [] {
    std::vector<double> values;
    for (int i = 0; i <= 1000; ++i) values.push_back(dilogarithm(kMostOpacity * i / 1000.0));
    return values;
  }();
  const double wanted = optical_depth / (2 * std::acos(-1.0) * width * width);
  const auto above = std::lower_bound(table.begin(), table.end(), wanted);
  if (above == table.end()) return kMostOpacity;
  if (above == table.begin()) return 0;
  const double share = (wanted - above[-1]) / (above[0] - above[-1]);
  return kMostOpacity * (static_cast<double>(above - table.begin() - 1) + share) / 1000;
}

SplatVolume::SplatVolume(const Pipeline<float>& pipeline, const VoxelGridPlace& place, const Box& bounds, bool opaque)
    : place_(place), density_(place.cells()), number_(place.cells(), -1) {
  std::vector<double> position(static_cast<std::size_t>(3 * kPointsAtOnce));
  const auto cells = static_cast<std::int64_t>(place.cells());
  for (std::int64_t begin = 0; begin < cells; begin += kPointsAtOnce) {
    const std::int64_t count = std::min(kPointsAtOnce, cells - begin);
    for (std::int64_t i = 0; i < count; ++i) {
      const Vec3d center = place.center(begin + i);
      for (int axis = 0; axis < 3; ++axis) position[static_cast<std::size_t>(3 * i + axis)] = center[axis];
    }
    pipeline.executor().density({position.data(), count, 3}, {&density_[static_cast<std::size_t>(begin)], count, 1});
    for (std::int64_t i = 0; i < count && opaque; ++i) {
      bool inside = true;
      for (int axis = 0; axis < 3; ++axis) {
        const double x = position[static_cast<std::size_t>(3 * i + axis)];
        inside = inside && x > bounds.lo[axis] && x < bounds.hi[axis];
      }
      if (!inside) density_[static_cast<std::size_t>(begin + i)] = static_cast<float>(kSolid / place.edge);
    }
  }
}

// Shares of a row's pixels: what of each one's light ends in which cube.
void SplatVolume::follow(const RayCamera& camera, const RayLimits& limits, std::int32_t width, std::int32_t row,
                         std::vector<Share>& into) const {
  const double step = kStep * place_.edge;
  for (std::int32_t column = 0; column < width; ++column) {
    double origin[3], direction[3], near_far[2];
    cast_ray(camera, limits, column, row, origin, direction, near_far);
    if (!(near_far[1] > near_far[0])) continue;
    const Vec3d from{origin[0], origin[1], origin[2]}, way{direction[0], direction[1], direction[2]};
    const auto pixel = static_cast<std::uint32_t>(row * width + column);
    float left = 1;
    // Two cubes farther than rays are rendered: the wall on the bounds lies behind them.
    for (double t = near_far[0]; t < near_far[1] + 3 * place_.edge && left > 0.01F; t += step) {
      const auto cell = place_.cell_of(from + t * way);
      if (!cell) continue;
      const float share = left * (1 - std::exp(-density_[*cell] * static_cast<float>(step)));
      left -= share;
      const auto distance = static_cast<float>(std::max(t, step));  // near pixels are smaller
      if (share > kLeastShare)
        into.push_back({static_cast<std::uint32_t>(*cell), pixel, share, share / (distance * distance)});
    }
  }
}

void SplatVolume::add(const RayCamera& camera, const RenderedFrame& frame, const RayLimits& limits) {
  labels_ = labels_ || !frame.label.empty();
  std::vector<std::vector<Share>> rows(kRowsAtOnce);
  for (std::int32_t begin = 0; begin < frame.height_px; begin += kRowsAtOnce) {
    const std::int32_t count = std::min(kRowsAtOnce, frame.height_px - begin);
    parallel_for(count, [&](std::int64_t r) {
      rows[static_cast<std::size_t>(r)].clear();
      follow(camera, limits, frame.width_px, begin + static_cast<std::int32_t>(r), rows[static_cast<std::size_t>(r)]);
    });
    for (std::int32_t r = 0; r < count; ++r)
      for (const Share& share : rows[static_cast<std::size_t>(r)]) add_share(share, frame);
  }
}

void SplatVolume::add_share(const Share& share, const RenderedFrame& frame) {
  std::int32_t& number = number_[share.cell];
  if (number < 0) {
    number = static_cast<std::int32_t>(seen_.size());
    seen_.emplace_back().cell = share.cell;
  }
  Seen& seen = seen_[static_cast<std::size_t>(number)];
  seen.light += share.light;
  seen.weight += share.weight;
  for (std::size_t k = 0; k < 3; ++k) seen.color[k] += share.weight * frame.rgb[3 * share.pixel + k];
  if (frame.label.empty() || frame.label[share.pixel] == kVoid) return;
  if (seen.lead <= 0) seen.label = frame.label[share.pixel];  // a majority of weights [Boyer91]
  seen.lead = std::abs(seen.lead + (seen.label == frame.label[share.pixel] ? share.weight : -share.weight));
}

Splats SplatVolume::splats() const {
  Splats out;
  out.deviation = kSplatWidth * place_.edge;
  for (const Seen& seen : seen_) {
    const double opacity = splat_opacity(static_cast<double>(density_[seen.cell]) * place_.edge, kSplatWidth);
    if (seen.light < kLeastLight || opacity <= 0) continue;
    out.points.positions.push_back(place_.center(static_cast<std::int64_t>(seen.cell)));
    out.opacity.push_back(static_cast<float>(opacity));
    auto& color = out.points.attributes.color.emplace_back();
    for (std::size_t k = 0; k < 3; ++k)
      color[k] = static_cast<std::uint8_t>(std::lround(255 * std::clamp(seen.color[k] / seen.weight, 0.0F, 1.0F)));
    if (labels_) out.points.attributes.label.push_back(seen.label);
  }
  return out;
}

namespace {

constexpr double kLowPass = 0.3;  // square pixels that viewers widen every footprint by [Kerbl23]
constexpr double kNear = 8;   // deviations, before which a splat is no ellipse on the image; viewers draw it late too
constexpr double kReach = 3;  // deviations that a footprint reaches
constexpr float kLeastAlpha = 1.0F / 255, kMostPower = 11.1F;  // exp(-kMostPower / 2) is less
constexpr float kLeastLeft = 1e-3F;  // of a pixel's light, that something behind still counts for
constexpr std::int64_t kSplatsAtOnce = 1 << 14;
constexpr std::int32_t kBandRows = 8;
constexpr int kSteps = 3;
constexpr double kRelaxed = 1.8;  // of a step; below 2 they converge

// A Gaussian on the image: exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2).
struct Footprint {
  float depth;
  std::uint32_t splat;
  float u, v, a, b, c;
  std::int32_t left, right, top, bottom;  // pixels, the last ones included
};

// What a splat gives to a pixel.
struct Share {
  std::uint32_t splat, pixel;
  float weight;
};

struct Drawing {
  std::vector<std::vector<Share>> bands;  // of rows, each from front to back
  std::vector<float> left;                // of each pixel's light
};

// The covariance on the image is J V J^T with the Jacobian J of a pinhole's projection [Zwicker01]; of the same
// deviation along all axes, V is a multiple of 1.
bool footprint(const RayCamera& camera, Vec3d place, double deviation, Footprint& out) {
  const Camera& lens = camera.camera;
  const Vec3d p = camera.world_from_camera.apply_inverse(place);
  if (p.z < kNear * deviation || !lens.is_within_lens(p)) return false;
  double u = lens.fx * p.x / p.z + lens.cx, v = lens.fy * p.y / p.z + lens.cy;
  if (camera.undistort) lens.project(p, u, v);
  const double x = p.x / p.z, y = p.y / p.z, sx = lens.fx * deviation / p.z, sy = lens.fy * deviation / p.z;
  const double a = sx * sx * (1 + x * x) + kLowPass, b = sx * sy * x * y, c = sy * sy * (1 + y * y) + kLowPass;
  const double det = a * c - b * b, half = 0.5 * (a - c);
  const double radius = kReach * std::sqrt(0.5 * (a + c) + std::sqrt(half * half + b * b));
  if (!(u + radius > 0 && u - radius < lens.width_px && v + radius > 0 && v - radius < lens.height_px)) return false;
  const auto pixel = [](double at, std::int32_t count) {
    return static_cast<std::int32_t>(std::clamp(std::floor(at), 0.0, count - 1.0));
  };
  out = {static_cast<float>(p.z),
         out.splat,
         static_cast<float>(u),
         static_cast<float>(v),
         static_cast<float>(c / det),
         static_cast<float>(-b / det),
         static_cast<float>(a / det),
         pixel(u - radius, lens.width_px),
         pixel(u + radius, lens.width_px),
         pixel(v - radius, lens.height_px),
         pixel(v + radius, lens.height_px)};
  return true;
}

// In the order of the splats.
std::vector<Footprint> footprints(const Splats& splats, const RayCamera& camera) {
  const std::int64_t count = std::ssize(splats.points.positions);
  std::vector<std::vector<Footprint>> parts(static_cast<std::size_t>((count + kSplatsAtOnce - 1) / kSplatsAtOnce));
  parallel_for(std::ssize(parts), [&](std::int64_t part) {
    const std::int64_t end = std::min(count, (part + 1) * kSplatsAtOnce);
    for (std::int64_t i = part * kSplatsAtOnce; i < end; ++i) {
      Footprint one{};
      one.splat = static_cast<std::uint32_t>(i);
      if (footprint(camera, splats.points.positions[static_cast<std::size_t>(i)], splats.deviation, one))
        parts[static_cast<std::size_t>(part)].push_back(one);
    }
  });
  std::vector<Footprint> all;
  for (const std::vector<Footprint>& part : parts) all.insert(all.end(), part.begin(), part.end());
  return all;
}

Drawing drawing(const Splats& splats, const RayCamera& camera) {
  const std::int32_t width = camera.camera.width_px, height = camera.camera.height_px;
  const std::vector<Footprint> seen = footprints(splats, camera);
  Drawing out;
  out.bands.resize(static_cast<std::size_t>((height + kBandRows - 1) / kBandRows));
  std::vector<std::vector<std::uint64_t>> reach(out.bands.size());  // depth, and place in `seen`, in each band
  for (std::size_t i = 0; i < seen.size(); ++i)
    for (std::int32_t band = seen[i].top / kBandRows; band <= seen[i].bottom / kBandRows; ++band)
      reach[static_cast<std::size_t>(band)].push_back(std::uint64_t{std::bit_cast<std::uint32_t>(seen[i].depth)} << 32 |
                                                      i);
  out.left.assign(static_cast<std::size_t>(width) * static_cast<std::size_t>(height), 1);
  parallel_for(std::ssize(out.bands), [&](std::int64_t band) {
    const auto first = static_cast<std::int32_t>(band) * kBandRows;
    const std::int32_t last = std::min(first + kBandRows, height) - 1;
    std::vector<std::uint64_t>& order = reach[static_cast<std::size_t>(band)];
    std::sort(order.begin(), order.end());  // bits of numbers above 0 are in the order of the numbers
    for (const std::uint64_t key : order) {
      const Footprint& one = seen[static_cast<std::uint32_t>(key)];
      for (std::int32_t row = std::max(first, one.top); row <= std::min(last, one.bottom); ++row) {
        for (std::int32_t column = one.left; column <= one.right; ++column) {
          const auto pixel = static_cast<std::uint32_t>(row * width + column);
          float& left = out.left[pixel];
          if (left < kLeastLeft) continue;
          const float dx = static_cast<float>(column) + 0.5F - one.u, dy = static_cast<float>(row) + 0.5F - one.v;
          const float power = one.a * dx * dx + 2 * one.b * dx * dy + one.c * dy * dy;
          if (power > kMostPower) continue;
          const float alpha = splats.opacity[one.splat] * std::exp(-0.5F * power);
          if (alpha < kLeastAlpha) continue;
          out.bands[static_cast<std::size_t>(band)].push_back({one.splat, pixel, left * alpha});
          left *= 1 - alpha;
        }
      }
    }
  });
  return out;
}

// `color` [N, 3].
std::vector<float> composed(const Drawing& drawn, std::span<const float> color,
                            const std::array<double, 3>& background) {
  std::vector<float> rgb(3 * drawn.left.size());
  for (std::size_t pixel = 0; pixel < drawn.left.size(); ++pixel)
    for (std::size_t k = 0; k < 3; ++k) rgb[3 * pixel + k] = drawn.left[pixel] * static_cast<float>(background[k]);
  for (const std::vector<Share>& band : drawn.bands)
    for (const Share& share : band)
      for (std::size_t k = 0; k < 3; ++k) rgb[3 * share.pixel + k] += share.weight * color[3 * share.splat + k];
  return rgb;
}

std::vector<float> colors_of(const Splats& splats) {
  std::vector<float> color;
  color.reserve(3 * splats.points.positions.size());
  for (const std::array<std::uint8_t, 3>& one : splats.points.attributes.color)
    for (const std::uint8_t c : one) color.push_back(static_cast<float>(c) / 255);
  return color;
}

}  // namespace

std::vector<float> draw_splats(const Splats& splats, const RayCamera& camera, const std::array<double, 3>& background) {
  if (camera.camera.is_wide()) return {};
  return composed(drawing(splats, camera), colors_of(splats), background);
}

void fit_colors(Splats& splats, std::span<const SplatView> views, const std::array<double, 3>& background) {
  std::vector<float> color = colors_of(splats), missed(color.size()), weight(color.size() / 3);
  for (int step = 0; step < kSteps; ++step) {
    std::fill(missed.begin(), missed.end(), 0.0F);
    std::fill(weight.begin(), weight.end(), 0.0F);
    for (const SplatView& view : views) {
      if (view.camera.camera.is_wide()) continue;
      const Drawing drawn = drawing(splats, view.camera);
      const std::vector<float> rgb = composed(drawn, color, background);
      for (const std::vector<Share>& band : drawn.bands) {
        for (const Share& share : band) {
          weight[share.splat] += share.weight;
          for (std::size_t k = 0; k < 3; ++k) {
            const std::size_t at = 3 * share.pixel + k;
            missed[3 * share.splat + k] += share.weight * (static_cast<float>(view.rgb[at]) / 255 - rgb[at]);
          }
        }
      }
    }
    for (std::size_t i = 0; i < color.size(); ++i)
      if (weight[i / 3] > 0)
        color[i] = std::clamp(color[i] + static_cast<float>(kRelaxed) * missed[i] / weight[i / 3], 0.0F, 1.0F);
  }
  for (std::size_t i = 0; i < weight.size(); ++i)
    for (std::size_t k = 0; k < 3; ++k)
      splats.points.attributes.color[i][k] = static_cast<std::uint8_t>(std::lround(255 * color[3 * i + k]));
}

// 3D Gaussians as PLY and as .splat.

void write_splat_ply(const std::string& path, const Splats& splats, const ClassTable& classes, Vec3d offset) {
  const double harmonic = 0.5 / std::sqrt(std::acos(-1.0));  // of degree 0
  const auto scale = static_cast<float>(std::log(splats.deviation));
  const PointSet& points = splats.points;
  const PointAttributes& known = points.attributes;
  BufferedFile file(path);
  std::string header = fmt::format(
      "ply\nformat binary_little_endian 1.0\ncomment Semfield: world frame of the input less {:.17g} {:.17g} {:.17g}\n"
      "element vertex {}\n",
      offset.x, offset.y, offset.z, points.positions.size());
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0",
                           "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"})
    header += fmt::format("property float {}\n", name);
  if (known.has_labels()) header += "property int class_id\n";
  if (known.has_instances()) header += "property int instance_id\n";
  file.text(header + "end_header\n");
  for (std::size_t i = 0; i < points.positions.size(); ++i) {
    file.floats(points.positions[i] - offset);
    file.floats({});
    for (const std::uint8_t c : known.color[i]) file.value(static_cast<float>((c / 255.0 - 0.5) / harmonic));
    file.value(std::log(splats.opacity[i] / (1 - splats.opacity[i])));
    file.values(scale, scale, scale, 1.0F, 0.0F, 0.0F, 0.0F);
    if (known.has_labels()) file.value(std::int32_t{classes.id_of(known.label[i])});
    if (known.has_instances()) file.value(known.instance[i]);
  }
  file.commit();
}

void write_splat(const std::string& path, const Splats& splats, Vec3d offset) {
  BufferedFile file(path);
  for (std::size_t i = 0; i < splats.points.positions.size(); ++i) {
    const auto deviation = static_cast<float>(splats.deviation);
    file.floats(splats.points.positions[i] - offset);
    file.values(deviation, deviation, deviation, splats.points.attributes.color[i],
                static_cast<std::uint8_t>(std::lround(255 * splats.opacity[i])),
                std::array<std::uint8_t, 4>{255, 128, 128, 128});
  }
  file.commit();
}

}  // namespace semfield
