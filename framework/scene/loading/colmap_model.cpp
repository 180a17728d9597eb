// COLMAP models: lenses, poses, and the text files.
#include "scene/loading/colmap_model.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>

#include "core/files.h"
#include "core/text.h"
#include "formats/text_rows.h"
#include "scene/camera.h"

namespace semfield {

namespace {

// A lens by its number in cameras.bin: how many parameters it has, and which goes where in the order in which COLMAP
// writes them; nowhere for a lens that is not read.
struct Lens {
  std::string_view name;
  std::size_t count;
  std::vector<double Camera::*> params = {};
  LensKind kind = LensKind::perspective;
};

const std::vector<Lens>& lenses() {
  using C = Camera;
  static const std::vector<Lens> known{
      {"SIMPLE_PINHOLE", 3, {&C::fx, &C::cx, &C::cy}},
      {"PINHOLE", 4, {&C::fx, &C::fy, &C::cx, &C::cy}},
      {"SIMPLE_RADIAL", 4, {&C::fx, &C::cx, &C::cy, &C::k1}},
      {"RADIAL", 5, {&C::fx, &C::cx, &C::cy, &C::k1, &C::k2}},
      {"OPENCV", 8, {&C::fx, &C::fy, &C::cx, &C::cy, &C::k1, &C::k2, &C::p1, &C::p2}},
      {"OPENCV_FISHEYE", 8, {&C::fx, &C::fy, &C::cx, &C::cy, &C::k1, &C::k2, &C::k3, &C::k4}, LensKind::fisheye},
      {"FULL_OPENCV", 12},
      {"FOV", 5},
      {"SIMPLE_RADIAL_FISHEYE", 4, {&C::fx, &C::cx, &C::cy, &C::k1}, LensKind::fisheye},
      {"RADIAL_FISHEYE", 5, {&C::fx, &C::cx, &C::cy, &C::k1, &C::k2}, LensKind::fisheye},
      {"THIN_PRISM_FISHEYE", 12},
      {"RAD_TAN_THIN_PRISM_FISHEYE", 16}};
  return known;
}

// World from camera, of the quaternion (w, x, y, z) and the translation of camera from world: R^T, -R^T t. A quaternion
// that is zero or not finite gives a pose that is not finite.
Pose inverse_pose(const double p[7]) {
  Pose out;
  set_rotation(out, {p[0], -p[1], -p[2], -p[3]});  // the conjugate turns back
  out.t = out.rotate({p[4], p[5], p[6]}) * -1.0;
  return out;
}

// What the readers of both kinds of file build from.
class ColmapBuilder {
 public:
  ColmapBuilder(ColmapModel& model, Diagnostics& diagnostics) : model_(model), diagnostics_(diagnostics) {}

  // `model_name` is COLMAP's name of the lens, `place` names file and entry.
  void add_camera(std::int64_t id, std::string_view model_name, double width, double height,
                  const std::vector<double>& params, const std::string& place) {
    if (model_.cameras.count(id) > 0)
      return diagnostics_.error("scene.camera.twice", place, "camera id is given twice", "keep one of the two");
    Camera& camera = model_.cameras[id];  // kept without a size when refused: images then need no error of their own
    const auto lens = std::find_if(lenses().begin(), lenses().end(), [&](const Lens& known) {
      return known.name == model_name && !known.params.empty();
    });
    if (lens == lenses().end()) {
      std::vector<std::string> names;
      for (const Lens& known : lenses())
        if (!known.params.empty()) names.emplace_back(known.name);
      return diagnostics_.error(
          "scene.camera.model", place,
          fmt::format("camera model '{}' is not supported (only {})", model_name, join(names)),
          "undistort the images with colmap image_undistorter, or reconstruct with another camera model");
    }
    if (params.size() != lens->params.size())
      return diagnostics_.error(
          "scene.camera.format", place,
          fmt::format("camera model {} has {} parameters, got {}", model_name, lens->params.size(), params.size()),
          "export the model again");
    const auto whole = [](double v) { return v >= 1 && v <= 65536 && v == std::floor(v); };
    if (!whole(width) || !whole(height))
      return diagnostics_.error("scene.image.size", place, "image size is not a pair of whole numbers from 1 to 65536",
                                "export the model again");
    for (std::size_t i = 0; i < params.size(); ++i) camera.*(lens->params[i]) = params[i];
    if (lens->params[1] != &Camera::fy) camera.fy = camera.fx;
    camera.lens = lens->kind;
    camera.width_px = static_cast<std::int32_t>(width);
    camera.height_px = static_cast<std::int32_t>(height);
  }

  // `pose` holds the quaternion (w, x, y, z) and the translation of the world-to-camera transform.
  void add_image(ColmapImage image, const double pose[7]) {
    if (image.name.empty() || !is_line_of_text(image.name)) {
      const std::string entry = image.place.substr(0, image.place.find(" ('"));
      return diagnostics_.error("scene.frame.name", entry,
                                "the name of its image is empty, no UTF-8 or has control characters",
                                "copy the model again, or give the image a plain name");
    }
    if (model_.cameras.count(image.camera) == 0)
      return diagnostics_.error("scene.camera.missing", image.place,
                                fmt::format("its camera {} is not in the model", image.camera),
                                "take cameras and images of the same model");
    if (const auto [other, fresh] = image_places_.emplace(image.id, image.place); !fresh)
      return diagnostics_.error("scene.index.twice", image.place, "has the id of " + other->second,
                                "keep one of the two");
    image.world_from_camera = inverse_pose(pose);
    model_.images.push_back(std::move(image));
  }

  // `error_px` as the file states it. What is wrong with the point, as in "has ..."; "" for nothing.
  std::string add_point(std::int64_t id, Vec3d position, double error_px) {
    if (!std::isfinite(position.x) || !std::isfinite(position.y) || !std::isfinite(position.z))
      return "a position that is not finite";
    if (!model_.points.emplace(id, position).second) return "the id of an earlier point, " + std::to_string(id);
    if (std::isfinite(error_px)) model_.error_px += (error_px - model_.error_px) / static_cast<double>(++errors_);
    return "";
  }

 private:
  ColmapModel& model_;
  Diagnostics& diagnostics_;
  std::unordered_map<std::int64_t, std::string> image_places_;  // by id
  std::int64_t errors_ = 0;                                     // points with an error
};

class TextFile {
 public:
  explicit TextFile(std::string path) : path_(std::move(path)), text_(read_pose_file(path_)), rest_(text_) {}

  // The next line that is neither empty nor a comment.
  bool record(std::string_view& line) {
    while (any(line)) {
      const std::size_t first = line.find_first_not_of(" \t");
      if (first != std::string_view::npos && line[first] != '#') return true;
    }
    return false;
  }
  bool any(std::string_view& line) {
    ++number_;
    return next_line(rest_, line);
  }

  [[noreturn]] void fail(const std::string& what, const std::string& remedy) const {
    throw Error(ErrorKind::data, "scene.colmap.format", path_ + ":" + std::to_string(number_) + ": " + what, remedy);
  }

  double real(std::string_view word) const {
    double value = 0;
    if (!parse_number(word, value)) fail("'" + std::string(word) + "' is not a number", kAgain);
    return value;
  }
  std::int64_t integer(std::string_view word) const {
    std::int64_t value = 0;
    if (!parse_whole(word, value)) fail("'" + std::string(word) + "' is not a whole number", kAgain);
    return value;
  }
  std::string place(const std::string& what) const { return path_ + ":" + std::to_string(number_) + ": " + what; }

  static constexpr const char* kAgain = "export the model again with colmap model_converter";

 private:
  std::string path_, text_;
  std::string_view rest_;
  int number_ = 0;
};

void read_cameras_text(const std::string& path, ColmapBuilder& out) {
  TextFile file(path);
  for (std::string_view line; file.record(line);) {
    const std::vector<std::string_view> words = words_of(line);
    if (words.size() < 4) file.fail("expected 'id MODEL width height parameters'", TextFile::kAgain);
    std::vector<double> params;
    for (std::size_t i = 4; i < words.size(); ++i) params.push_back(file.real(words[i]));
    const std::int64_t id = file.integer(words[0]);
    out.add_camera(id, words[1], file.real(words[2]), file.real(words[3]), params,
                   file.place("camera " + std::to_string(id)));
  }
}

// Two lines per image; the second, its points, may be empty.
void read_images_text(const std::string& path, ColmapBuilder& out) {
  TextFile file(path);
  for (std::string_view line; file.record(line);) {
    const std::vector<std::string_view> words = words_of(line);
    if (words.size() < 10) file.fail("expected 'id qw qx qy qz tx ty tz camera name'", TextFile::kAgain);
    double pose[7];
    for (std::size_t i = 0; i < 7; ++i) pose[i] = file.real(words[i + 1]);
    ColmapImage image;
    image.id = file.integer(words[0]);
    image.camera = file.integer(words[8]);
    image.name.assign(words[9].data(), words.back().data() + words.back().size());  // names may hold blanks
    image.place = file.place(fmt::format("image {} ('{}')", image.id, image.name));
    if (file.any(line)) {
      const std::vector<std::string_view> points = words_of(line);
      if (points.size() % 3 != 0)
        file.fail(
            fmt::format("the points of image {} are {} numbers, not triples 'x y point'", image.id, points.size()),
            "keep the line of points after each image, even an empty one");
      for (std::size_t i = 2; i < points.size(); i += 3) {
        const std::int64_t point = file.integer(points[i]);
        if (point >= 0) image.points.push_back(point);
      }
    }
    out.add_image(std::move(image), pose);
  }
}

void read_points_text(const std::string& path, ColmapBuilder& out) {
  TextFile file(path);
  for (std::string_view line; file.record(line);) {
    const std::vector<std::string_view> words = words_of(line);
    if (words.size() < 8) file.fail("expected 'id x y z r g b error track'", TextFile::kAgain);
    const std::int64_t id = file.integer(words[0]);
    const std::string wrong =
        out.add_point(id, {file.real(words[1]), file.real(words[2]), file.real(words[3])}, file.real(words[7]));
    if (!wrong.empty()) file.fail("point " + std::to_string(id) + " has " + wrong, TextFile::kAgain);
  }
}

// COLMAP's binary files: little-endian records without padding, each file a count and that many records.

class BinaryFile {
 public:
  explicit BinaryFile(std::string path) : path_(std::move(path)), bytes_(read_pose_file(path_)) {}

  template <class T>
  T take(const std::string& record) {
    const std::size_t start = at_;
    skip(sizeof(T), record);
    T value;
    std::memcpy(&value, bytes_.data() + start, sizeof(T));
    return value;
  }

  // A count of records of at least `bytes_each`: what the rest of the file cannot hold is refused before anything is
  // allocated for it.
  std::uint64_t count(const std::string& what, std::size_t bytes_each) {
    const std::size_t start = at_;
    const auto value = take<std::uint64_t>("the number of " + what);
    if (value > left() / bytes_each)
      fail(fmt::format("states {} {}, but {} bytes are left, room for {}", value, what, left(), left() / bytes_each),
           start);
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

  // All of the file: the number of its records of at least `bytes_each`, and each by `read(name)`.
  template <class Read>
  void each(const std::string& what, std::size_t bytes_each, const Read& read) {
    const std::uint64_t all = count(what + "s", bytes_each);
    for (std::uint64_t i = 1; i <= all; ++i) read(fmt::format("{} {} of {}", what, i, all));
    if (left() > 0) fail(fmt::format("has {} bytes after its last record", left()), at_);
  }

  [[noreturn]] void fail(const std::string& what, std::size_t offset) const {
    throw Error(ErrorKind::data, "scene.colmap.damaged", fmt::format("'{}' {} (offset {})", path_, what, offset),
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
  file.each("camera", 24 + 3 * sizeof(double), [&](const std::string& record) {
    const auto id = file.take<std::uint32_t>(record);
    const std::size_t lens_offset = file.offset();
    const auto lens = file.take<std::int32_t>(record);
    const auto width = file.take<std::uint64_t>(record), height = file.take<std::uint64_t>(record);
    if (lens < 0 || lens >= std::ssize(lenses()))
      file.fail("holds the unknown lens number " + std::to_string(lens) + " in " + record, lens_offset);
    const Lens& known = lenses()[static_cast<std::size_t>(lens)];
    std::vector<double> params(known.count);
    for (double& p : params) p = file.take<double>(record);
    out.add_camera(id, known.name, static_cast<double>(width), static_cast<double>(height), params,
                   file.path() + ": camera " + std::to_string(id));
  });
}

void read_images(BinaryFile file, ColmapBuilder& out) {
  file.each("image", 73, [&](const std::string& record) {
    ColmapImage image;
    image.id = file.take<std::uint32_t>(record);
    double pose[7];
    for (double& value : pose) value = file.take<double>(record);
    image.camera = file.take<std::uint32_t>(record);
    image.name = file.text(record);
    image.place = fmt::format("{}: image {} ('{}')", file.path(), image.id, image.name);
    const std::uint64_t points = file.count("image points of " + record, 24);
    for (std::uint64_t p = 0; p < points; ++p) {
      file.skip(2 * sizeof(double), record);
      const auto point = file.take<std::int64_t>(record);
      if (point >= 0) image.points.push_back(point);  // -1: a feature without a point
    }
    out.add_image(std::move(image), pose);
  });
}

void read_points(BinaryFile file, ColmapBuilder& out) {
  file.each("point", 51, [&](const std::string& record) {
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
  });
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

ColmapModel read_colmap_model(const std::string& folder, Diagnostics& diagnostics) {
  ColmapModel model;
  ColmapBuilder builder(model, diagnostics);
  const auto path_of = [&](const char* name) { return (fs::path(folder) / name).string(); };
  if (fs::exists(path_of("cameras.bin"))) {
    read_cameras(BinaryFile(path_of("cameras.bin")), builder);
    read_images(BinaryFile(path_of("images.bin")), builder);
    if (fs::exists(path_of("points3D.bin"))) read_points(BinaryFile(path_of("points3D.bin")), builder);
  } else {
    read_cameras_text(path_of("cameras.txt"), builder);
    read_images_text(path_of("images.txt"), builder);
    if (fs::exists(path_of("points3D.txt"))) read_points_text(path_of("points3D.txt"), builder);
  }
  std::sort(model.images.begin(), model.images.end(),
            [](const ColmapImage& a, const ColmapImage& b) { return a.name < b.name; });
  for (std::size_t i = 1; i < model.images.size(); ++i) {
    if (model.images[i].name == model.images[i - 1].name)
      diagnostics.error("scene.frame.twice", model.images[i].place, "image is listed twice", "keep one of the two");
  }
  return model;
}

}  // namespace semfield
