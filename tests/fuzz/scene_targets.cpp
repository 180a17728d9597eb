// Scenes: poses, indexes of the dataset plugins, meshes, packed scenes, PNG.
#include <zlib.h>

#include <cstring>

#include "datasets/obj_room/mesh_io.h"
#include "formats/png_codec.h"
#include "loading/packed_scene.h"
#include "scene/camera.h"
#include "scene/camera_path.h"
#include "system/checksum.h"
#include "system/files.h"
#include "tests/fuzz/inputs.h"
#include "tests/fuzz/targets.h"

namespace semfield::fuzz {

namespace {

void store_u32(std::string& bytes, std::size_t at, std::uint32_t value, bool big_endian) {
  for (std::size_t i = 0; i < 4; ++i) bytes[at + i] = static_cast<char>(value >> (8 * (big_endian ? 3 - i : i)) & 0xFF);
}

std::uint32_t load_be32(const std::string& bytes, std::size_t at) {
  std::uint32_t value = 0;
  for (std::size_t i = 0; i < 4; ++i) value = value << 8 | static_cast<unsigned char>(bytes[at + i]);
  return value;
}

template <class T>
T load(const std::string& bytes, std::size_t at) {
  T value;
  std::memcpy(&value, bytes.data() + at, sizeof value);
  return value;
}

// Checksums stop chance bytes at the door; these two make them right, so that what lies behind is reached too.
std::string with_png_checksums(std::string bytes) {
  for (std::size_t at = 8; at + 12 <= bytes.size();) {
    const std::size_t length = load_be32(bytes, at);
    if (length > bytes.size() - at - 12) break;
    const uLong crc = ::crc32(0, reinterpret_cast<const Bytef*>(bytes.data()) + at + 4, static_cast<uInt>(length + 4));
    store_u32(bytes, at + 8 + length, static_cast<std::uint32_t>(crc), true);
    at += length + 12;
  }
  return bytes;
}

std::string with_pack_checksums(std::string bytes) {
  if (bytes.size() < 64) return bytes;
  const std::uint64_t size = bytes.size();
  std::memcpy(bytes.data() + 16, &size, sizeof size);
  const auto offset = load<std::uint64_t>(bytes, 24), length = load<std::uint64_t>(bytes, 32);
  const auto view = std::as_bytes(std::span<const char>(bytes));
  if (offset <= size && length <= size - offset) store_u32(bytes, 40, crc32c(view.subspan(offset, length)), false);
  store_u32(bytes, 60, crc32c(view.first(60)), false);
  return bytes;
}

}  // namespace

void fuzz_poses(std::string_view bytes) {
  const std::string path = put("poses.txt", bytes);
  for (const CameraAxes axes :
       {CameraAxes::right_down_forward, CameraAxes::right_up_backward, CameraAxes::left_up_forward}) {
    accepted([&] {
      for (const Pose& pose : read_camera_file(path, axes)) {
        for (int a = 0; a < 3; ++a) {
          promise(std::isfinite(pose.t[a]), "an accepted centre is not finite");
          const Vec3d axis = pose.axis(a);
          promise(std::abs(dot(axis, axis) - 1) < 1e-6, "an accepted rotation is none");
        }
      }
    });
  }
}

void fuzz_cameras(std::string_view bytes) {
  const std::string path = put("cameras.json", bytes);
  CameraSet set;
  const bool read = accepted([&] {
    Diagnostics diagnostics;
    set = read_cameras(path, diagnostics);
  });
  if (!read) return;
  promise(!set.cameras.empty(), "an accepted file has a camera");
  for (const PlacedCamera& placed : set.cameras) {
    promise(placed.camera.fx > 0 && placed.camera.fy > 0, "an accepted camera has no focal length");
    promise(placed.far_m == 0 || placed.near_m < placed.far_m, "an accepted camera sees nothing");
    const Vec3d axis = placed.world_from_camera.axis(2);
    promise(std::abs(dot(axis, axis) - 1) < 1e-6, "an accepted rotation is none");
  }
  write_cameras(path, set);
  const std::string once = read_text_file(path);
  Diagnostics diagnostics;
  write_cameras(path, read_cameras(path, diagnostics));
  promise(once == read_text_file(path), "cameras are read back otherwise");
}

// Parts: transforms.json, classes.yaml.
void fuzz_transforms(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("transforms/transforms.json", parts[0]);
  put("transforms/classes.yaml", parts[1]);
  for (const char* name : {"a", "b", "d", "l"}) put_image("transforms/" + std::string(name) + ".png");
  open_dataset("transforms_json", "root: transforms");
}

void fuzz_llff(std::string_view bytes) {
  put("llff/poses_bounds.npy", bytes);
  for (const char* name : {"a", "b"}) put_image("llff/images/" + std::string(name) + ".png");
  open_dataset("llff", "root: llff");
}

void fuzz_record3d(std::string_view bytes) {
  put("record3d/metadata.json", bytes);
  for (const char* name : {"0", "2"}) put_image("record3d/rgb/" + std::string(name) + ".png");
  open_dataset("record3d", "root: record3d");
}

void fuzz_polycam(std::string_view bytes) {
  for (const char* name : {"0", "1"}) {
    put_image("polycam/keyframes/images/" + std::string(name) + ".png");
    put("polycam/keyframes/cameras/" + std::string(name) + ".json", bytes);
  }
  open_dataset("polycam", "root: polycam");
}

// Parts: odometry.csv, camera_matrix.csv.
void fuzz_stray_scanner(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("stray_scanner/odometry.csv", parts[0]);
  put("stray_scanner/camera_matrix.csv", parts[1]);
  for (const char* name : {"000000", "000002"}) put_image("stray_scanner/rgb/" + std::string(name) + ".png");
  open_dataset("stray_scanner", "root: stray_scanner");
}

// Parts: lowres_wide.traj, the .pincam of both photographs.
void fuzz_arkit_scenes(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("arkit_scenes/lowres_wide.traj", parts[0]);
  for (const char* name : {"7_1.000", "7_1.100"}) {
    put_image("arkit_scenes/lowres_wide/" + std::string(name) + ".png");
    put("arkit_scenes/lowres_wide_intrinsics/" + std::string(name) + ".pincam", parts[1]);
  }
  open_dataset("arkit_scenes", "root: arkit_scenes");
}

// Parts: rgb.txt, groundtruth.txt, depth.txt.
void fuzz_tum(std::string_view bytes) {
  const auto parts = parts_of(bytes, 3);
  put("tum/rgb.txt", parts[0]);
  put("tum/groundtruth.txt", parts[1]);
  put("tum/depth.txt", parts[2]);
  put_image("tum/rgb/a.png");
  open_dataset("tum", "root: tum");
}

// Parts: traj_w_c.txt, info_semantic.json.
void fuzz_replica(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("replica/traj_w_c.txt", parts[0]);
  put("replica/info_semantic.json", parts[1]);
  for (int i = 0; i < 3; ++i) {
    const std::string number = std::to_string(i) + ".png";
    put_image("replica/rgb/rgb_" + number);
    put_image("replica/semantic_class/semantic_class_" + number);
  }
  open_dataset("replica", "{root: replica, train_step: 2, train_offset: 0, test_step: 2, test_offset: 1}");
}

// Parts: traj.txt, cam_params.json.
void fuzz_replica_slam(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  put("slam/traj.txt", parts[0]);
  put("slam/cam_params.json", parts[1]);
  for (const char* number : {"0", "1"}) {
    put_image(std::string("slam/results/frame00000") + number + ".png");
    put_image(std::string("slam/results/depth00000") + number + ".png");
  }
  open_dataset("replica", "root: slam");
}

// Parts: pose of frame 0, intrinsics, the table of labels.
void fuzz_scannet(std::string_view bytes) {
  const auto parts = parts_of(bytes, 3);
  put("scannet/pose/0.txt", parts[0]);
  put("scannet/intrinsic/intrinsic_color.txt", parts[1]);
  put("scannet/intrinsic/intrinsic_depth.txt", parts[1]);
  put("scannet/scannetv2-labels.combined.tsv", parts[2]);
  for (const char* name : {"color", "depth", "label-filt"}) put_image("scannet/" + std::string(name) + "/0.png");
  open_dataset("scannet", "root: scannet");
}

// The first byte chooses the file, the others are as they should be.
void fuzz_colmap_binary(std::string_view bytes) {
  if (bytes.empty()) return;
  const auto number = [](std::string& out, auto value) {
    out.append(reinterpret_cast<const char*>(&value), sizeof value);
  };
  std::string cameras, images, points;
  number(cameras, std::uint64_t{1});
  number(cameras, std::uint32_t{1});
  number(cameras, std::int32_t{1});  // PINHOLE
  number(cameras, std::uint64_t{4});
  number(cameras, std::uint64_t{3});
  for (const double v : {3.0, 3.0, 2.0, 1.5}) number(cameras, v);
  number(images, std::uint64_t{1});
  number(images, std::uint32_t{1});
  for (const double v : {1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}) number(images, v);
  number(images, std::uint32_t{1});
  images += std::string("a.png") + '\0';
  number(images, std::uint64_t{0});
  number(points, std::uint64_t{0});
  const char which = bytes.front();
  bytes.remove_prefix(1);
  (which == 'c' ? cameras : which == 'p' ? points : images) = bytes;
  put("colmap/sparse/0/cameras.bin", cameras);
  put("colmap/sparse/0/images.bin", images);
  put("colmap/sparse/0/points3D.bin", points);
  put_image("colmap/images/a.png");
  open_dataset("colmap", "root: colmap");
}

// Parts: cameras.txt, images.txt, points3D.txt.
void fuzz_colmap_text(std::string_view bytes) {
  const auto parts = parts_of(bytes, 3);
  put("colmap_text/sparse/0/cameras.txt", parts[0]);
  put("colmap_text/sparse/0/images.txt", parts[1]);
  put("colmap_text/sparse/0/points3D.txt", parts[2]);
  put_image("colmap_text/images/a.png");
  open_dataset("colmap", "root: colmap_text");
}

// Parts: the OBJ file, the MTL file a.mtl.
void fuzz_obj(std::string_view bytes) {
  const auto parts = parts_of(bytes, 2);
  const std::string path = put("obj/a.obj", parts[0]);
  put("obj/a.mtl", parts[1]);
  accepted([&] {
    Diagnostics diagnostics;
    const TriangleMesh mesh = load_obj(path, diagnostics);
    promise(mesh.size() > 0, "an accepted mesh has no triangle");
    for (std::size_t t = 0; t < mesh.size(); ++t) {
      for (const std::uint32_t v : mesh.triangles[t]) promise(v < mesh.positions.size(), "a corner without a vertex");
      promise(mesh.material_of[t] < static_cast<std::int32_t>(mesh.materials.size()), "a material that is none");
      promise(mesh.object_of[t] < static_cast<std::int32_t>(mesh.objects.size()), "an object that is none");
      promise(mesh.group_of[t] < static_cast<std::int32_t>(mesh.groups.size()), "a group that is none");
    }
  });
}

void fuzz_packed(std::string_view bytes) {
  put("scene.pack", bytes);
  open_dataset("packed", "file: scene.pack");
  put("scene.pack", with_pack_checksums(std::string(bytes)));
  open_dataset("packed", "file: scene.pack");
}

void fuzz_png(std::string_view bytes) {
  for (const std::string& file : {std::string(bytes), with_png_checksums(std::string(bytes))}) {
    const auto view = std::as_bytes(std::span<const char>(file));
    accepted([&] { (void)png_size(view); });
    accepted([&] {
      const PngImage image = decode_png(view);
      const std::size_t samples = static_cast<std::size_t>(image.width_px) * static_cast<std::size_t>(image.height_px) *
                                  static_cast<std::size_t>(image.channels);
      promise((image.bits == 16 ? image.words.size() : image.bytes.size()) == samples,
              "samples that do not fill the image");
    });
    const std::string path = put("image.png", file);
    accepted([&] { (void)image_size(path); });
    accepted([&] { (void)read_rgb(path, 128); });
    accepted([&] { (void)read_ids(path); });
  }
}

}  // namespace semfield::fuzz
