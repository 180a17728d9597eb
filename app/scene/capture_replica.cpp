#include "app/scene/capture_replica.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "formats/image_io.h"
#include "scene/classes/class_table.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

constexpr double kPi = 3.141592653589793;
constexpr double kMostDepth_mm = 65534;  // readers take 65535 for "no depth"

bool same_camera(const Camera& a, const Camera& b) {
  return a.width_px == b.width_px && a.height_px == b.height_px && a.fx == b.fx && a.fy == b.fy && a.cx == b.cx &&
         a.cy == b.cy;
}

void check_cameras(const SceneInfo& info) {
  Diagnostics diagnostics;
  for (const FrameInfo& frame : info.frames) {
    const std::string where = "frame " + frame.name;
    if (frame.camera.has_distortion())
      diagnostics.error("capture.camera.distortion", where, "has lens distortion", "undistort the images first");
    if (!same_camera(frame.camera, info.frames.front().camera)) {
      diagnostics.error("capture.camera.differs", where, "has another camera than frame " + info.frames.front().name,
                        "the layout has one camera for all");
    }
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the scene does not fit the Replica layout");
}

std::string numbered(const fs::path& folder, const std::string& stem, std::size_t index) {
  return (folder / stem / (stem + "_" + std::to_string(index) + ".png")).string();
}

void write_ids(const std::string& path, std::int32_t width, std::int32_t height,
               const std::vector<std::uint16_t>& values) {
  const auto most = std::max_element(values.begin(), values.end());
  if (most != values.end() && *most > 255) return write_png_gray16(path, width, height, values);
  write_png_gray8(path, width, height, std::vector<std::uint8_t>(values.begin(), values.end()));
}

void write_frame(const FrameInfo& info, const FrameBuffer& frame, const ClassTable& classes, const fs::path& folder,
                 std::size_t index, CaptureReport& report) {
  const std::int32_t w = frame.width_px, h = frame.height_px;
  write_png_rgb(numbered(folder, "rgb", index), w, h, frame.rgb);
  std::vector<std::uint16_t> values(static_cast<std::size_t>(w) * static_cast<std::size_t>(h));
  if (info.has_depth) {
    for (std::size_t i = 0; i < values.size(); ++i) {
      const double mm = std::round(static_cast<double>(frame.depth_m[i]) * 1000);
      const bool fits = frame.depth_m[i] == 0 || (mm >= 1 && mm <= kMostDepth_mm);
      if (!fits) ++report.depth_clipped;
      values[i] = fits ? static_cast<std::uint16_t>(mm) : std::uint16_t{0};
    }
    write_png_gray16(numbered(folder, "depth", index), w, h, values);
  }
  if (info.has_labels) {
    for (std::size_t i = 0; i < values.size(); ++i)
      values[i] = static_cast<std::uint16_t>(classes.id_of(frame.label[i]));
    write_ids(numbered(folder, "semantic_class", index), w, h, values);
  }
  if (info.has_instances) {
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (frame.instance[i] < 0 || frame.instance[i] > 65535) {
        throw Error(ErrorKind::data, "capture.instance.range",
                    "frame " + info.name + ": instance " + std::to_string(frame.instance[i]) + " does not fit 16 bits");
      }
      values[i] = static_cast<std::uint16_t>(frame.instance[i]);
    }
    write_ids(numbered(folder, "semantic_instance", index), w, h, values);
  }
}

}  // namespace

CaptureReport capture_replica(const Dataset& dataset, const SceneInfo& info, const std::string& out_dir,
                              const std::function<void(int done, int total)>& progress,
                              const PoseConvention& convention) {
  if (info.frames.empty()) throw Error(ErrorKind::data, "scene.frames.none", "the scene has no frames");
  check_cameras(info);
  const fs::path folder(out_dir);
  if (fs::exists(folder / "traj_w_c.txt")) {
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + out_dir + "' already holds a captured scene",
                "choose another folder or remove it");
  }
  for (const char* name : {"rgb", "depth", "semantic_class", "semantic_instance"}) {
    const FrameInfo& f = info.frames.front();
    const std::string_view channel = name;
    if ((channel == "depth" && !f.has_depth) || (channel == "semantic_class" && !f.has_labels) ||
        (channel == "semantic_instance" && !f.has_instances)) {
      continue;
    }
    std::error_code code;
    fs::create_directories(folder / name, code);
    if (code)
      throw Error(ErrorKind::cannot_create, "files.output.create",
                  "cannot create '" + (folder / name).string() + "': " + code.message());
  }
  CaptureReport report;
  FrameBuffer frame;
  const ClassTable classes = info.classes.empty() ? info.classes : with_void(info.classes);
  std::string trajectory;
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    dataset.read(static_cast<int>(i), frame);
    convert_depth(frame, convention);
    write_frame(info.frames[i], frame, classes, folder, i, report);
    const Pose& p = info.frames[i].world_from_camera;
    for (int row = 0; row < 3; ++row) {
      const auto& r = p.r[static_cast<std::size_t>(row)];
      trajectory += fmt::format("{:.17g} {:.17g} {:.17g} {:.17g} ", r[0], r[1], r[2], p.t[row]);
    }
    trajectory += "0 0 0 1\n";
    ++report.frames;
    if (progress) progress(report.frames, static_cast<int>(info.frames.size()));
  }
  const Camera& c = info.frames.front().camera;
  const double hfov_deg = 2 * std::atan(0.5 * c.width_px / c.fx) * 180 / kPi;
  write_file_atomic((folder / "intrinsics.txt").string(),
                    fmt::format("{} {} {:.17g} {:.17g} {:.17g} {:.17g} {:.10g}\n", c.width_px, c.height_px, c.fx, c.fy,
                                c.cx, c.cy, hfov_deg));
  if (!classes.empty()) write_file_atomic((folder / "classes.yaml").string(), classes.to_yaml());
  // Last, because its presence says that the scene is complete.
  write_file_atomic((folder / "traj_w_c.txt").string(), trajectory);
  for (const auto& entry : fs::recursive_directory_iterator(folder)) {
    if (entry.is_regular_file()) report.bytes += static_cast<std::int64_t>(entry.file_size());
  }
  return report;
}

}  // namespace semfield
