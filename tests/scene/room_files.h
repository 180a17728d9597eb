// A small box room rendered analytically and written as a Replica-layout folder; needs no test framework.
#pragma once

#include <cstdio>
#include <filesystem>
#include <fstream>

#include "core/files.h"
#include "formats/image_io.h"
#include "scene/scene.h"

namespace semfield::testing_room {

/// Room [-2, 2] x [-1.5, 1.5] x [-2.5, 2.5]; wall a (0..5: -x, +x, -y, +y, -z, +z) has class id a + 1.
struct Hit {
  double t = 0;
  int wall = 0;
};
inline Hit trace(Vec3d origin, Vec3d direction) {
  const Vec3d half{2, 1.5, 2.5};
  Hit hit{1e300, 0};
  for (int a = 0; a < 3; ++a) {
    if (direction[a] == 0) continue;
    const double wall = direction[a] > 0 ? half[a] : -half[a];
    const double t = (wall - origin[a]) / direction[a];
    if (t < hit.t) hit = {t, 2 * a + (direction[a] > 0 ? 1 : 0)};
  }
  return hit;
}

inline Camera room_camera(int width = 40, int height = 30) {
  return Camera{width, height, 0.5 * width, 0.5 * width, 0.5 * width, 0.5 * height};
}

/// Turning about the vertical (y down) axis while walking a little.
inline Pose room_pose(int i) {
  const double a = 0.2 * i;
  return Pose{.r = {{{std::cos(a), 0, std::sin(a)}, {0, 1, 0}, {-std::sin(a), 0, std::cos(a)}}},
              .t = {0.1 * i - 0.3, 0.05 * i, 0.2}};
}

inline FrameBuffer render_room(const Camera& c, const Pose& pose) {
  FrameBuffer out{.width_px = c.width_px, .height_px = c.height_px};
  for (int y = 0; y < c.height_px; ++y) {
    for (int x = 0; x < c.width_px; ++x) {
      const Vec3d d = c.direction(x + 0.5, y + 0.5);
      const Hit hit = trace(pose.t, pose.rotate(d));
      out.depth_m.push_back(static_cast<float>(hit.t * c.depth_of(d)));
      out.label.push_back(static_cast<std::int16_t>(hit.wall));
      out.instance.push_back(hit.wall + 1);
      for (int k = 0; k < 3; ++k) out.rgb.push_back(static_cast<std::uint8_t>(40 * hit.wall + 10 * k + 5));
    }
  }
  return out;
}

inline std::vector<std::uint8_t> ids_of(const FrameBuffer& frame) {
  std::vector<std::uint8_t> out;
  for (const std::int16_t c : frame.label) out.push_back(static_cast<std::uint8_t>(c + 1));
  return out;
}

inline std::vector<std::uint16_t> mm_of(const FrameBuffer& frame) {
  std::vector<std::uint16_t> out;
  for (const float d : frame.depth_m) out.push_back(static_cast<std::uint16_t>(std::lround(d * 1000.0)));
  return out;
}

inline std::string pose_line(const Pose& p) {
  std::string line;
  char text[64];
  for (int row = 0; row < 4; ++row) {
    for (int col = 0; col < 4; ++col) {
      const double v = row == 3 ? (col == 3 ? 1.0 : 0.0) : col == 3 ? p.t[row] : p.r[row][col];
      std::snprintf(text, sizeof text, "%.12g", v);
      line += text;
      line += row == 3 && col == 3 ? "\n" : " ";
    }
  }
  return line;
}

inline constexpr const char* kClassesYaml =
    "- {id: 0, name: void, ignore: true}\n- {id: 1, name: west}\n- {id: 2, name: east}\n- {id: 3, name: ceiling}\n"
    "- {id: 4, name: floor}\n- {id: 5, name: south}\n- {id: 6, name: north}\n";

/// Writes `frames` frames in Replica layout into `folder`.
inline void write_replica(const std::string& folder, int frames, int width = 40, int height = 30) {
  for (const char* name : {"rgb", "depth", "semantic_class", "semantic_instance"})
    fs::create_directories(fs::path(folder) / name);
  std::string trajectory;
  for (int i = 0; i < frames; ++i) {
    const Camera c = room_camera(width, height);
    const FrameBuffer f = render_room(c, room_pose(i));
    const std::string n = std::to_string(i) + ".png";
    write_png_rgb(folder + "/rgb/rgb_" + n, width, height, f.rgb);
    write_png_gray16(folder + "/depth/depth_" + n, width, height, mm_of(f));
    write_png_gray8(folder + "/semantic_class/semantic_class_" + n, width, height, ids_of(f));
    write_png_gray8(folder + "/semantic_instance/semantic_instance_" + n, width, height, ids_of(f));
    trajectory += pose_line(room_pose(i));
  }
  write_file_atomic(folder + "/traj_w_c.txt", trajectory);
  write_file_atomic(folder + "/classes.yaml", std::string_view(kClassesYaml));
}

/// Without the fsync of write_file_atomic: for tests that write one file thousands of times.
inline void plain_write(const std::string& path, const std::string& bytes) {
  std::ofstream(path, std::ios::binary) << bytes;
}

/// Cuts the last `bytes` bytes off a file.
inline void cut(const std::string& path, std::size_t bytes) {
  std::filesystem::resize_file(path, std::filesystem::file_size(path) - bytes);
}

// Cameras of 48 x 48 pixels where a test wants them.

/// Upright, but for a hair.
inline Pose look_at(Vec3d eye, Vec3d target) {
  const Vec3d z = normalized(target - eye), x = normalized(cross(z, Vec3d{0.01, 1, 0.02})), y = cross(z, x);
  Pose pose;
  for (std::size_t row = 0; row < 3; ++row) {
    const auto r = static_cast<int>(row);
    pose.r[row] = {x[r], y[r], z[r]};
  }
  pose.t = eye;
  return pose;
}

inline FrameInfo frame_at(Vec3d eye, Vec3d target, double fov_deg = 40) {
  FrameInfo frame{.camera = {.width_px = 48, .height_px = 48}};
  frame.camera.fx = frame.camera.fy = 24 / std::tan(fov_deg * M_PI / 360);
  frame.camera.cx = frame.camera.cy = 24;
  frame.world_from_camera = look_at(eye, target);
  return frame;
}

}  // namespace semfield::testing_room
