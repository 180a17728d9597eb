// COLMAP's binary files of the box room, as programs that stand for COLMAP hand them out.
#pragma once

#include <map>

#include "loading/colmap_model.h"
#include "scene/camera.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_room {

/// The room's views `numbers` as a model in `folder`, with two points of the given reprojection error, one of which
/// view i shows seen[i] times. `names` are those of the images; without them they are called by their numbers.
inline void write_room_model(const std::string& folder, const std::vector<int>& numbers, double error_px,
                             const std::vector<std::string>& names = {}, const std::map<int, int>& seen = {}) {
  std::string images, points;
  const auto put = [](std::string& out, auto value) {
    out.append(reinterpret_cast<const char*>(&value), sizeof value);
  };
  put(images, static_cast<std::uint64_t>(numbers.size()));
  for (std::size_t k = 0; k < numbers.size(); ++k) {
    const int i = numbers[k];
    const Pose pose = room_pose(i);
    const Quaternion q = quaternion_of(pose);
    const Vec3d t = pose.unrotate(pose.t) * -1.0;
    put(images, static_cast<std::uint32_t>(i + 1));
    for (const double v : {q[0], -q[1], -q[2], -q[3], t.x, t.y, t.z}) put(images, v);
    put(images, std::uint32_t{1});
    images += (names.empty() ? std::to_string(i) + ".png" : names[k]) + '\0';
    const int points_here = seen.contains(i) ? seen.at(i) : 0;
    put(images, static_cast<std::uint64_t>(points_here));
    for (int p = 0; p < points_here; ++p) {
      for (const double pixel : {10.0, 10.0}) put(images, pixel);
      put(images, std::int64_t{1});
    }
  }
  put(points, std::uint64_t{2});
  for (const double off : {-0.25, 0.25}) {
    put(points, static_cast<std::uint64_t>(off > 0 ? 1 : 2));
    for (const double v : {1.0, 0.5, off}) put(points, v);
    points += "rgb";
    put(points, error_px + off);
    put(points, std::uint64_t{0});
  }
  std::filesystem::create_directories(folder);
  plain_write(folder + "/cameras.bin", colmap_cameras_file({{1, room_camera()}}));
  plain_write(folder + "/images.bin", images);
  plain_write(folder + "/points3D.bin", points);
}

}  // namespace semfield::testing_room
