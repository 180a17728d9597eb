#include "scene/scene.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <set>

#include "core/check.h"
#include "core/text.h"

namespace semfield {

Split HoldOut::split_of(std::size_t rank, std::size_t frames) const {
  if (every <= 0 || frames < 2) return Split::train;
  return rank % static_cast<std::size_t>(every) == static_cast<std::size_t>(first) ? Split::test : Split::train;
}

void check_root_and_test_every(const std::string& root, std::int32_t test_every, Diagnostics& diagnostics) {
  if (root.empty())
    diagnostics.error("scene.root.unnamed", "root", "the scene's folder is not given", "set scene.root");
  if (test_every == 1)
    diagnostics.error("scene.split.empty", "test_every", "1 leaves no frame to train on",
                      "take 2 or more, or 0 for no test frames");
}

std::string output_name(std::string_view frame) {
  std::string name(frame);
  std::replace(name.begin(), name.end(), '/', '_');
  return name;
}

std::optional<std::string> OutputNames::add(const std::string& frame) {
  constexpr std::size_t kMostBytes = 200;  // file systems take 255, and kinds and endings follow
  if (frame.empty()) return "its name is empty";
  if (frame.size() > kMostBytes)
    return fmt::format("its name has {} bytes; at most {} are allowed", frame.size(), kMostBytes);
  if (!is_line_of_text(frame)) return "its name has a control character, or is not UTF-8";
  const auto [other, fresh] = frames_.emplace(output_name(frame), frame);
  if (fresh) return std::nullopt;
  if (other->second == frame) return "another one has its name";
  return "its files would be called '" + other->first + "', as those of '" + other->second + "'";
}

void check_output_names(const SceneInfo& info, Diagnostics& diagnostics) {
  OutputNames names;
  for (const FrameInfo& frame : info.frames)
    if (const auto wrong = names.add(frame.name))
      diagnostics.error("scene.frame.name", frame_place(frame), *wrong, kFrameNameRemedy);
}

// Packing of loaded frames; every packing is undone exactly.

std::uint16_t DepthPacking::narrowed(float depth_m) {
  const double mm = std::rint(static_cast<double>(depth_m) * 1000.0);
  // NaN and what does not fit come back as another value.
  return static_cast<std::uint16_t>(static_cast<std::int32_t>(mm >= 0 && mm <= 65535 ? mm : 0));
}

template <class Packing>
PackedMap<Packing>::PackedMap(std::vector<Wide> values) : narrow_(values.size()) {
  constexpr std::size_t kBlock = 4096;  // most maps that do not fit are told after the first of them
  for (std::size_t begin = 0; begin < values.size(); begin += kBlock) {
    int misses = 0;
    for (std::size_t i = begin; i < std::min(begin + kBlock, values.size()); ++i) {
      narrow_[i] = Packing::narrowed(values[i]);
      misses += Packing::widened(narrow_[i]) == values[i] ? 0 : 1;
    }
    if (misses == 0) continue;
    narrow_ = std::vector<typename Packing::Narrow>();
    wide_ = std::move(values);
    return;
  }
}

template <class Packing>
std::vector<typename PackedMap<Packing>::Wide> PackedMap<Packing>::expand() const {
  std::vector<Wide> out(size());
  for (std::size_t i = 0; i < out.size(); ++i) out[i] = (*this)[i];
  return out;
}

template class PackedMap<LabelPacking>;
template class PackedMap<DepthPacking>;

StoredFrame::StoredFrame(FrameBuffer frame)
    : width_px(frame.width_px),
      height_px(frame.height_px),
      rgb(std::move(frame.rgb)),
      depth_m(std::move(frame.depth_m)),
      label(std::move(frame.label)),
      instance(std::move(frame.instance)),
      mask(frame.used),
      channels(std::move(frame.channels)) {
  const auto of_alpha =
      std::find_if(channels.begin(), channels.end(), [](const FrameChannel& c) { return c.name == kAlphaChannel; });
  if (of_alpha == channels.end()) return;
  alpha = alpha_bytes(*of_alpha);
  channels.erase(of_alpha);
}

const FrameChannel* StoredFrame::channel(std::string_view name) const {
  const auto found =
      std::find_if(channels.begin(), channels.end(), [&](const FrameChannel& c) { return c.name == name; });
  return found == channels.end() ? nullptr : &*found;
}

void StoredFrame::read_channel(std::string_view name, std::int32_t index, std::span<float> out) const {
  const FrameChannel* const from = channel(name);
  if (from == nullptr) return std::fill(out.begin(), out.end(), 0.0F);
  const std::int64_t row = std::int64_t{index / width_px} * from->height / height_px;
  const std::int64_t col = std::int64_t{index % width_px} * from->width / width_px;
  const float* const cell = from->values.data() + (row * from->width + col) * from->cols;
  std::copy(cell, cell + from->cols, out.begin());
}

std::size_t StoredFrame::bytes() const {
  std::size_t sum =
      rgb.capacity() + alpha.capacity() + depth_m.bytes() + label.bytes() + mask.bytes() + instance.capacity() * 4;
  for (const FrameChannel& one : channels) sum += one.values.capacity() * sizeof(float);
  return sum;
}

// Masks as bits.

PixelMask::PixelMask(std::span<const std::uint8_t> used) {
  masked_px_ = std::count(used.begin(), used.end(), std::uint8_t{0});
  if (masked_px_ == 0) return;
  pixels_ = used.size();
  words_.resize((pixels_ + 63) / 64);
  for (std::size_t i = 0; i < pixels_; ++i) words_[i / 64] |= std::uint64_t{used[i] != 0 ? 1U : 0U} << (i % 64);
}

std::vector<std::uint8_t> PixelMask::expand() const {
  std::vector<std::uint8_t> out(pixels_);
  for (std::size_t i = 0; i < pixels_; ++i) out[i] = uses(i) ? 1 : 0;
  return out;
}

void hide_masked(FrameBuffer& frame) {
  for (std::size_t i = 0; i < frame.used.size(); ++i) {
    if (frame.used[i] != 0) continue;
    std::fill_n(frame.rgb.begin() + static_cast<std::ptrdiff_t>(3 * i), 3, std::uint8_t{0});
    if (!frame.depth_m.empty()) frame.depth_m[i] = 0;
    if (!frame.label.empty()) frame.label[i] = kVoid;
    if (!frame.instance.empty()) frame.instance[i] = 0;
  }
}

FrameChannelInfo alpha_info(const Camera& camera) {
  return {std::string(kAlphaChannel), camera.height_px, camera.width_px, 1};
}

FrameChannel alpha_channel(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> alpha) {
  FrameChannel out{std::string(kAlphaChannel), height_px, width_px, 1, {}};
  out.values.reserve(alpha.size());
  for (const std::uint8_t a : alpha) out.values.push_back(static_cast<float>(a) / 255.0F);
  return out;
}

std::vector<std::uint8_t> alpha_bytes(const FrameChannel& channel) {
  std::vector<std::uint8_t> out;
  out.reserve(channel.values.size());
  for (const float a : channel.values) out.push_back(static_cast<std::uint8_t>(std::lround(a * 255.0F)));
  return out;
}

namespace {

constexpr std::size_t kListed = 16;

using FrameCounts = std::map<std::string, int, ByLengthThenText>;

std::string sentence(const std::string& noun, const FrameCounts& frames, const std::string& first) {
  std::vector<std::string> listed;
  for (const auto& [value, count] : frames) {
    if (listed.size() == kListed) {
      listed.push_back(std::to_string(frames.size() - kListed) + " more");
      break;
    }
    listed.push_back(value + (count > 1 ? " (" + std::to_string(count) + " frames)" : ""));
  }
  return noun + (frames.size() > 1 ? "s " + join(listed) + " are" : " " + listed.front() + " is") +
         " not in the class table, first at " + first;
}

FrameCounts counts_of(const UnknownValues& values) {
  FrameCounts counts;
  for (const auto& [value, pixel] : values) counts[value] = 1;
  return counts;
}

std::string first_of(const UnknownValues& values, const std::string& path, std::int32_t width_px) {
  std::size_t pixel = values.begin()->second;
  for (const auto& [value, at] : values) pixel = std::min(pixel, at);
  const auto width = static_cast<std::size_t>(width_px);
  return "x " + std::to_string(pixel % width) + ", y " + std::to_string(pixel / width) + " of '" + path + "'";
}

}  // namespace

UnknownLabelError::UnknownLabelError(std::string noun, UnknownValues values, const std::string& path,
                                     std::int32_t width_px, std::string remedy)
    : Error(ErrorKind::data, "labels.id.unknown", sentence(noun, counts_of(values), first_of(values, path, width_px)),
            std::move(remedy)),
      noun_(std::move(noun)),
      first_(first_of(values, path, width_px)),
      values_(std::move(values)) {}

void report_unknown_labels(const std::vector<FrameInfo>& frames,
                           const std::vector<std::optional<UnknownLabelError>>& found, Diagnostics& diagnostics) {
  FrameCounts counts;
  std::optional<std::size_t> first;
  for (std::size_t i = 0; i < found.size(); ++i) {
    if (!found[i]) continue;
    if (!first) first = i;
    for (const auto& [value, pixel] : found[i]->values_) ++counts[value];
  }
  if (!first) return;
  const UnknownLabelError& e = *found[*first];
  diagnostics.error(e.code(), frame_place(frames[*first]), sentence(e.noun_, counts, e.first_), e.remedy());
}

namespace {

std::string number(double value) { return fmt::format("{:.3g}", value); }

bool finite(std::span<const double> all) {
  return std::all_of(all.begin(), all.end(), [](double v) { return std::isfinite(v); });
}
bool finite(const Vec3d& v) { return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z); }
bool finite(const Pose& pose) { return finite(pose.r[0]) && finite(pose.r[1]) && finite(pose.r[2]) && finite(pose.t); }
bool finite(const Camera& c) { return finite(std::array{c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2}); }
bool finite(const Box& box) { return finite(box.lo) && finite(box.hi); }

// A perspective lens sees less than 180 degrees: at a thousandth of the image it is 179.9.
bool is_focal(double focal_px, int size_px) { return focal_px >= 1e-3 * size_px && focal_px <= 1e6 * size_px; }

void check_focal(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const bool positive = camera.fx > 0 && camera.fy > 0;
  if (is_focal(camera.fx, camera.width_px) && is_focal(camera.fy, camera.height_px)) return;
  const std::string range = fmt::format("between a thousandth and a million times the image, which has {} x {} pixels",
                                        camera.width_px, camera.height_px);
  diagnostics.error(
      "scene.camera.focal", place,
      fmt::format("focal length is {:.3g} x {:.3g} pixels; it must be {}", camera.fx, camera.fy,
                  positive ? range : "positive"),
      positive ? "check that the intrinsics are in pixels" : "check the intrinsics and the axes convention");
}

// What no fisheye and no panorama has.
void check_wide_lens(const Camera& c, const std::string& place, Diagnostics& diagnostics) {
  if (!c.is_wide()) return;
  const bool is_panorama = c.lens == LensKind::equirectangular;
  if (c.p1 != 0 || c.p2 != 0 || (is_panorama && (c.k1 != 0 || c.k2 != 0 || c.k3 != 0 || c.k4 != 0)))
    diagnostics.error("scene.camera.model", place,
                      std::string(is_panorama ? "a panorama has no distortion" : "a fisheye has k1 to k4 alone") +
                          ", and others of its coefficients are not 0",
                      "set them to 0, or name the camera's own model");
  const double turns = c.width_px / (2 * M_PI * c.fx);
  if (is_panorama && c.fx > 0 && turns > 1 + 1e-6)
    diagnostics.error("scene.camera.focal", place,
                      "the panorama goes " + number(turns) + " times around: its focal length is too short",
                      "leave fl_x and fl_y out where the image shows the whole sphere");
}

// The angle of a pixel's ray to the axis against that which a lens without distortion gives it; 1 near the axis, 0
// where the lens has no ray.
double bend_at(const Camera& c, double u, double v) {
  const double x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy, away = std::hypot(x, y);
  const double plain = c.is_wide() ? away : std::atan(away);
  const Vec3d ray = c.direction(u, v);
  if (ray == Vec3d{0, 0, 0}) return 0;
  return plain < 1e-3 * (c.width_px / c.fx) ? 1 : std::atan2(std::hypot(ray.x, ray.y), ray.z) / plain;
}

// A lens whose polynomial has no inverse in the image, or bends rays as none does.
void check_distortion(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  if (!camera.has_distortion() || camera.lens == LensKind::equirectangular) return;
  constexpr double kFar = 10, kUnusual = 2;
  int lost = 0, lost_inside = 0;  // of 9 points up to the border; of 8 around the middle, half as far out
  double least = 1, most = 1;
  const auto look_at = [&](double u, double v, int& count) {
    const double bend = bend_at(camera, u, v);
    count += bend == 0 ? 1 : 0;
    if (bend == 0) return;
    least = std::min(least, bend);
    most = std::max(most, bend);
  };
  for (int i = 0; i <= 2; ++i) {
    for (int j = 0; j <= 2; ++j) {
      look_at(camera.width_px * i / 2.0, camera.height_px * j / 2.0, lost);
      if (i != 1 || j != 1) look_at(camera.width_px * (i + 1) / 4.0, camera.height_px * (j + 1) / 4.0, lost_inside);
    }
  }
  const double bend = 1 / least > most ? least : most;
  const std::string bent = "lens distortion bends rays to " + number(bend) + " times their angle to the axis";
  if (lost == 9 || lost_inside == 8) {
    diagnostics.error("scene.camera.distortion", place,
                      lost == 9 ? "lens distortion has no inverse anywhere in the image"
                                : "lens distortion has no inverse but in the very middle of the image",
                      "calibrate again");
  } else if (bend > kFar || bend < 1 / kFar) {
    diagnostics.error("scene.camera.distortion", place, bent + ", which no lens does",
                      "check that the coefficients are those of this camera model, in its order");
  } else if (bend > kUnusual || bend < 1 / kUnusual) {
    diagnostics.warning("scene.camera.bent", place, bent,
                        "check that the coefficients are those of this camera model, in its order");
  } else if (lost > 0 && !camera.is_wide()) {  // a fisheye's corners lie beyond its circle, as they should
    diagnostics.warning("scene.camera.masked", place,
                        fmt::format("lens distortion has no inverse at {} of 9 points of the image; such pixels are "
                                    "masked",
                                    lost),
                        "calibrate with points up to the image corners");
  }
}

// max |R^T R - I|
double orthonormal_error(const Pose& pose) {
  double worst = 0;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b)
      worst = std::max(worst, std::abs(dot(pose.axis(a), pose.axis(b)) - (a == b ? 1.0 : 0.0)));
  }
  return worst;
}

// What the principal point says of the image that the intrinsics belong to: it lies near the middle of all but cropped
// ones. "" where that may be this image.
std::string other_image(const Camera& c) {
  const double x = 2 * c.cx / c.width_px, y = 2 * c.cy / c.height_px;
  const auto near_one = [](double ratio) { return std::abs(ratio - 1) < 0.1; };
  const double shape = static_cast<double>(c.width_px) / c.height_px;
  if (near_one(x * shape) && near_one(y / shape) && (shape > 1.2 || shape < 1 / 1.2)) return "turned by a quarter";
  const double factor = 0.5 * (x + y);
  if (!(x > 0 && y > 0) || !near_one(x / y) || (factor < 1.8 && factor > 0.55)) return "";
  return factor > 1 ? number(factor) + " times as large" : number(1 / factor) + " times as small";
}

}  // namespace

std::string frame_place(const FrameInfo& frame) {
  return fmt::format("frame '{}'{}", frame.name, frame.source.empty() ? "" : " (" + frame.source + ")");
}

Pose pose_from_rows(std::span<const double> numbers) {
  SEMFIELD_CHECK(numbers.size() == 12 || numbers.size() == 16, "a pose has 12 or 16 numbers");
  Pose pose;
  for (std::size_t row = 0; row < 3; ++row) {
    for (std::size_t col = 0; col < 3; ++col) pose.r[row][col] = numbers[row * 4 + col];
  }
  pose.t = {numbers[3], numbers[7], numbers[11]};
  return pose;
}

Pose opencv_from_opengl(Pose pose) {
  for (auto& row : pose.r) {
    row[1] = -row[1];
    row[2] = -row[2];
  }
  return pose;
}

bool check_last_row(std::span<const double> numbers, const std::string& place, Diagnostics& diagnostics) {
  if (numbers.size() != 16) return true;
  const std::span<const double> row = numbers.subspan(12);
  bool finite = true, good = true;
  for (std::size_t i = 0; i < 4; ++i) {
    finite = finite && std::isfinite(row[i]);
    good = good && std::abs(row[i] - (i == 3 ? 1.0 : 0.0)) < 1e-6;
  }
  if (good || !finite) return true;
  diagnostics.error("scene.pose.last_row", place, "the last row of the pose is not 0 0 0 1",
                    "write camera-to-world matrices row by row; a transposed one has its centre there");
  return false;
}

PoseState check_pose(Pose& pose, const std::string& place, Diagnostics& diagnostics) {
  if (!finite(pose)) return PoseState::not_finite;
  const double error = orthonormal_error(pose);
  const double determinant = dot(cross(pose.axis(0), pose.axis(1)), pose.axis(2));
  if (error > 1e-3) {
    diagnostics.error("scene.pose.rotation", place,
                      "pose is not a rotation: its axes are " + number(error) + " off orthonormal (1e-3 is allowed)",
                      "check that the matrix is camera-to-world, row by row, without a scale");
    return PoseState::refused;
  }
  if (determinant < 0) {
    diagnostics.error("scene.pose.mirrored", place, "pose mirrors the scene (determinant -1)",
                      "flip one camera axis in the export");
    return PoseState::refused;
  }
  if (error > 1e-5)
    diagnostics.warning("scene.pose.rounded", place,
                        "pose is " + number(error) + " off orthonormal and was made orthonormal",
                        "export poses with more digits");
  if (error > 1e-9) make_rotation(pose);
  return PoseState::good;
}

void report_skipped(const std::vector<std::string>& skipped, std::size_t kept, const std::string& source,
                    Diagnostics& diagnostics) {
  if (skipped.empty() && diagnostics.has_errors()) return;  // why none is left is said already
  if (kept == 0)
    diagnostics.error(
        "scene.frames.none", source,
        skipped.empty() ? "no frames in it" : "all " + std::to_string(skipped.size()) + " poses are not finite",
        skipped.empty() ? "check the path" : "track the cameras again");
  if (skipped.empty() || kept == 0) return;
  std::vector<std::string> shown = skipped;
  shown.resize(std::min<std::size_t>(8, skipped.size()));
  if (shown.size() < skipped.size()) shown.push_back("...");
  diagnostics.warning("scene.pose.skipped", source,
                      fmt::format("{} of {} frames skipped: their poses are not finite ({})", skipped.size(),
                                  skipped.size() + kept, join(shown)),
                      {});
}

void check_manifest_numbers(const SceneInfo& info, Diagnostics& diagnostics) {
  std::set<std::string> named;
  for (const Diagnostic& d : diagnostics.all()) named.insert(d.where);
  const Camera* sound = nullptr;  // that of the frame before
  for (const FrameInfo& frame : info.frames) {
    const std::string place = frame_place(frame);
    if (named.count(place) > 0) continue;
    if (!finite(frame.world_from_camera)) {
      diagnostics.error("scene.pose.not_finite", place, "pose has a number that is not finite",
                        "the dataset must leave such frames out");
    } else if (sound == nullptr || !(frame.camera == *sound)) {
      sound = check_camera(frame.camera, place, diagnostics) ? &frame.camera : nullptr;
    }
  }
  if (!std::isfinite(info.near_hint_m) || !std::isfinite(info.far_hint_m)) {
    diagnostics.error("scene.bounds.not_finite", info.name,
                      fmt::format("near and far distance of the dataset are {:.3g} and {:.3g} m; they must be finite",
                                  info.near_hint_m, info.far_hint_m),
                      "set scene.load.near_m and scene.load.far_m");
  }
  if (!finite(info.bounds))
    diagnostics.error("scene.bounds.not_finite", info.name, "the dataset's bounds are not finite",
                      "set scene.load.bounds");
}

bool check_camera(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const int before = diagnostics.error_count();
  if (camera.width_px <= 0 || camera.height_px <= 0) {
    diagnostics.error("scene.image.size", place,
                      "image size is " + std::to_string(camera.width_px) + " x " + std::to_string(camera.height_px),
                      "state the size in pixels");
    return false;
  }
  if (!finite(camera)) {
    diagnostics.error("scene.camera.not_finite", place, "camera has an intrinsic that is not finite",
                      "calibrate again");
    return false;
  }
  check_focal(camera, place, diagnostics);
  const auto outside = [](double c, int size) { return c < -size || c > 2.0 * size; };
  if (outside(camera.cx, camera.width_px) || outside(camera.cy, camera.height_px)) {
    diagnostics.error("scene.camera.center", place,
                      fmt::format("principal point ({:.3g}, {:.3g}) lies far outside the image of {} x {} pixels",
                                  camera.cx, camera.cy, camera.width_px, camera.height_px),
                      "check that the intrinsics belong to images of this size");
  }
  check_wide_lens(camera, place, diagnostics);
  if (diagnostics.error_count() == before) check_distortion(camera, place, diagnostics);
  return diagnostics.error_count() == before;
}

void check_poses_differ(const SceneInfo& info, Diagnostics& diagnostics) {
  std::map<std::array<double, 12>, std::vector<const FrameInfo*>> frames_at;
  for (const FrameInfo& frame : info.frames) {
    const Pose& pose = frame.world_from_camera;
    if (!finite(pose)) continue;
    std::array<double, 12> key{pose.t.x, pose.t.y, pose.t.z};
    for (std::size_t i = 0; i < 9; ++i) key[3 + i] = pose.r[i / 3][i % 3];
    frames_at[key].push_back(&frame);
  }
  std::size_t alike = 0;
  const std::vector<const FrameInfo*>* most = nullptr;
  for (const auto& [pose, frames] : frames_at) {
    if (frames.size() < 2) continue;
    alike += frames.size();
    if (most == nullptr || frames.size() > most->size()) most = &frames;
  }
  if (most == nullptr) return;
  const std::size_t all = info.frames.size();
  diagnostics.warning("scene.pose.repeated", info.name,
                      most->size() == all
                          ? fmt::format("all {} frames have one pose: nothing shows shape", all)
                          : fmt::format("{} of {} frames have the pose of another frame, {} that of '{}'", alike, all,
                                        most->size(), most->front()->name),
                      "check the export: a tracker that is lost may repeat its last pose");
}

bool check_principal_point(const Camera& camera, const std::string& place, Diagnostics& diagnostics) {
  const std::string other = other_image(camera);
  if (other.empty()) return true;
  diagnostics.error("scene.camera.size", place,
                    fmt::format("principal point ({:.3g}, {:.3g}) is the middle of an image {} as this one of {} x {} "
                                "pixels: the intrinsics are that image's",
                                camera.cx, camera.cy, other, camera.width_px, camera.height_px),
                    "state the size that they belong to, or give those of the images as they are stored");
  return false;
}

}  // namespace semfield
