// COLMAP's binary files: little-endian records without padding, each file a count and that many records.
#include <array>
#include <cstring>
#include <filesystem>
#include <map>

#include "formats/input_limits.h"
#include "loading/colmap_model.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

// A lens as the number in cameras.bin, and how many parameters follow.
struct LensNumber {
  std::string_view name;
  int params;
};
constexpr std::array<LensNumber, 12> kLenses{{{"SIMPLE_PINHOLE", 3},
                                              {"PINHOLE", 4},
                                              {"SIMPLE_RADIAL", 4},
                                              {"RADIAL", 5},
                                              {"OPENCV", 8},
                                              {"OPENCV_FISHEYE", 8},
                                              {"FULL_OPENCV", 12},
                                              {"FOV", 5},
                                              {"SIMPLE_RADIAL_FISHEYE", 4},
                                              {"RADIAL_FISHEYE", 5},
                                              {"THIN_PRISM_FISHEYE", 12},
                                              {"RAD_TAN_THIN_PRISM_FISHEYE", 16}}};

class BinaryFile {
 public:
  explicit BinaryFile(std::string path) : path_(std::move(path)), bytes_(read_pose_file(path_)) {}

  template <class T>
  T take(const std::string& record) {
    if (left() < sizeof(T)) fail("ends inside " + record, at_);
    T value;
    std::memcpy(&value, bytes_.data() + at_, sizeof(T));
    at_ += sizeof(T);
    return value;
  }

  // A count of records of at least `bytes_each`: what the rest of the file cannot hold is refused before anything is
  // allocated for it.
  std::uint64_t count(const std::string& what, std::size_t bytes_each) {
    const std::size_t start = at_;
    const auto value = take<std::uint64_t>("the number of " + what);
    if (value > left() / bytes_each) {
      fail("states " + std::to_string(value) + " " + what + ", but " + std::to_string(left()) +
               " bytes are left, room for " + std::to_string(left() / bytes_each),
           start);
    }
    return value;
  }

  std::string text(const std::string& record) {
    const std::size_t end = bytes_.find('\0', at_);
    if (end == std::string::npos) fail("ends inside " + record, at_);
    std::string out = bytes_.substr(at_, end - at_);
    at_ = end + 1;
    return out;
  }

  void skip(std::size_t bytes, const std::string& record) {
    if (left() < bytes) fail("ends inside " + record, at_);
    at_ += bytes;
  }

  void finish() const {
    if (left() > 0) fail("has " + std::to_string(left()) + " bytes after its last record", at_);
  }

  [[noreturn]] void fail(const std::string& what, std::size_t offset) const {
    throw Error(ErrorKind::data, "scene.colmap.damaged",
                "'" + path_ + "' " + what + " (offset " + std::to_string(offset) + ")",
                "copy the model again, or export it again with colmap model_converter");
  }

  std::size_t left() const { return bytes_.size() - at_; }
  std::size_t offset() const { return at_; }
  const std::string& path() const { return path_; }

 private:
  std::string path_, bytes_;
  std::size_t at_ = 0;
};

void read_cameras(BinaryFile file, ColmapBuilder& out) {
  const std::uint64_t cameras = file.count("cameras", 24 + 3 * sizeof(double));
  for (std::uint64_t i = 0; i < cameras; ++i) {
    const std::string record = "camera " + std::to_string(i + 1) + " of " + std::to_string(cameras);
    const auto id = file.take<std::uint32_t>(record);
    const std::size_t lens_offset = file.offset();
    const auto lens = file.take<std::int32_t>(record);
    const auto width = file.take<std::uint64_t>(record), height = file.take<std::uint64_t>(record);
    if (lens < 0 || static_cast<std::size_t>(lens) >= kLenses.size())
      file.fail("holds the unknown lens number " + std::to_string(lens) + " in " + record, lens_offset);
    const LensNumber& known = kLenses[static_cast<std::size_t>(lens)];
    std::vector<double> params(static_cast<std::size_t>(known.params));
    for (double& p : params) p = file.take<double>(record);
    out.add_camera(id, known.name, static_cast<double>(width), static_cast<double>(height), params,
                   file.path() + ": camera " + std::to_string(id));
  }
  file.finish();
}

void read_images(BinaryFile file, ColmapBuilder& out) {
  const std::uint64_t images = file.count("images", 73);
  for (std::uint64_t i = 0; i < images; ++i) {
    const std::string record = "image " + std::to_string(i + 1) + " of " + std::to_string(images);
    ColmapImage image;
    const auto id = file.take<std::uint32_t>(record);
    image.id = id;
    double pose[7];
    for (double& value : pose) value = file.take<double>(record);
    image.camera = file.take<std::uint32_t>(record);
    image.name = file.text(record);
    image.place = file.path() + ": image " + std::to_string(id) + " ('" + image.name + "')";
    const std::uint64_t points = file.count("image points of " + record, 24);
    for (std::uint64_t p = 0; p < points; ++p) {
      file.skip(2 * sizeof(double), record);
      const auto point = file.take<std::int64_t>(record);
      if (point >= 0) image.points.push_back(point);  // -1: a feature without a point
    }
    out.add_image(std::move(image), pose);
  }
  file.finish();
}

void read_points(BinaryFile file, ColmapBuilder& out) {
  const std::uint64_t points = file.count("points", 51);
  for (std::uint64_t i = 0; i < points; ++i) {
    const std::string record = "point " + std::to_string(i + 1) + " of " + std::to_string(points);
    const std::size_t start = file.offset();
    const auto id = file.take<std::int64_t>(record);
    Vec3d position;
    for (int a = 0; a < 3; ++a) position[a] = file.take<double>(record);
    file.skip(3, record);  // colour
    const auto error_px = file.take<double>(record);
    const std::uint64_t track = file.count("views of " + record, 8);
    file.skip(track * 8, record);
    if (const std::string wrong = out.add_point(id, position, error_px); !wrong.empty())
      file.fail("holds " + wrong + " in " + record, start);
  }
  file.finish();
}

}  // namespace

std::string colmap_cameras_file(const std::unordered_map<std::int64_t, Camera>& cameras) {
  constexpr std::int32_t kOpencv = 4, kFisheye = 5;
  std::string out;
  const auto put = [&](auto value) { out.append(reinterpret_cast<const char*>(&value), sizeof value); };
  put(static_cast<std::uint64_t>(cameras.size()));
  for (const auto& [id, c] : std::map<std::int64_t, Camera>(cameras.begin(), cameras.end())) {
    put(static_cast<std::uint32_t>(id));
    const bool fisheye = c.lens == LensKind::fisheye;
    put(fisheye ? kFisheye : kOpencv);
    put(static_cast<std::uint64_t>(c.width_px));
    put(static_cast<std::uint64_t>(c.height_px));
    for (const double value : {c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, fisheye ? c.k3 : c.p1, fisheye ? c.k4 : c.p2})
      put(value);
  }
  return out;
}

void read_colmap_binary(const std::string& folder, ColmapBuilder& out) {
  const auto path_of = [&](const char* name) { return (fs::path(folder) / name).string(); };
  read_cameras(BinaryFile(path_of("cameras.bin")), out);
  read_images(BinaryFile(path_of("images.bin")), out);
  if (fs::exists(path_of("points3D.bin"))) read_points(BinaryFile(path_of("points3D.bin")), out);
}

}  // namespace semfield
