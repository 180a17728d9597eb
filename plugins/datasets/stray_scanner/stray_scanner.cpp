// Recordings of Stray Scanner from a phone with LiDAR: odometry.csv, camera_matrix.csv, rgb/, depth/, confidence/.
#include <fmt/format.h>

#include <cmath>
#include <map>

#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "plugin/module.h"
#include "scene/camera.h"
#include "scene/loading/posed_photographs.h"
#include "scene/scene.h"

namespace semfield {

struct StrayScannerParams : PhotographParams {};

namespace {

[[noreturn]] void refuse_stray(Code code, const std::string& what, const char* remedy = "export the recording again") {
  throw Error(ErrorKind::data, code, what, remedy);
}

// Columns by the names in the first row, for versions of the app write different ones.
class Odometry {
 public:
  explicit Odometry(const std::string& path) : rows_(read_text_rows(path, ',')) {
    if (rows_.size() < 2) refuse_stray("scene.index.format", "'" + path + "' has no poses");
    for (std::size_t i = 0; i < rows_[0].fields.size(); ++i) {
      const std::string& name = rows_[0].fields[i];
      if (!column_.emplace(name, i).second && !name.empty())
        refuse_stray("scene.index.twice", rows_[0].place + ": has the column '" + name + "' twice");
    }
    for (const char* name : {"x", "y", "z", "qx", "qy", "qz", "qw"})
      if (!has(name)) refuse_stray("scene.index.format", "'" + path + "' has no column '" + name + "'");
  }
  bool has(const char* name) const { return column_.count(name) > 0; }
  // The row of each frame by its number, which is its place where no column tells it.
  std::map<std::int64_t, const TextRow*> by_frame() const {
    std::map<std::int64_t, const TextRow*> out;
    for (std::size_t i = 1; i < rows_.size(); ++i) {
      const TextRow& row = rows_[i];
      if (row.fields.size() > rows_[0].fields.size())
        refuse_stray("scene.index.format", fmt::format("{}: has {} columns, the first row {}", row.place,
                                                       row.fields.size(), rows_[0].fields.size()));
      const double number = has("frame") ? value(row, "frame") : static_cast<double>(i - 1);
      if (!(number >= 0 && number <= 1e9 && number == std::floor(number)))
        refuse_stray("scene.index.value", row.place + ": 'frame' is not the number of a frame");
      if (const auto [other, fresh] = out.emplace(static_cast<std::int64_t>(number), &row); !fresh)
        refuse_stray("scene.index.twice",
                     fmt::format("{}: is of frame {}, as {}", row.place, other->first, other->second->place),
                     "keep one of the two lines");
    }
    return out;
  }
  double value(const TextRow& row, const char* name) const {
    const std::size_t i = column_.at(name);
    double number = 0;
    if (i < row.fields.size() && parse_number(row.fields[i], number)) return number;
    refuse_stray("scene.index.value", row.place + ": '" + name + "' is not a number");
  }

 private:
  std::vector<TextRow> rows_;
  std::map<std::string, std::size_t> column_;
};

Camera read_matrix(const std::string& path) {
  const std::vector<TextRow> rows = read_text_rows(path, ',');
  double k[9] = {};
  bool sound = rows.size() == 3;
  for (std::size_t i = 0; sound && i < 9; ++i)
    sound = rows[i / 3].fields.size() == 3 && parse_number(rows[i / 3].fields[i % 3], k[i]);
  if (!sound || k[1] != 0 || k[3] != 0 || k[6] != 0 || k[7] != 0 || k[8] != 1)
    refuse_stray("scene.camera.format", "'" + path + "' is not a pinhole camera's matrix of three rows");
  return {.fx = k[0], .fy = k[4], .cx = k[2], .cy = k[5]};
}

}  // namespace

std::string recognise(const std::string& path, StrayScannerParams& p) {
  for (const char* name : {"odometry.csv", "camera_matrix.csv"})
    if (!is_file(fs::path(path) / name)) return "";
  p.root = path;
  return "a recording of Stray Scanner";
}

SceneInfo find_photographs(const StrayScannerParams&, PosedPhotographs& files, Diagnostics& diagnostics) {
  files.require({"", "odometry.csv", "camera_matrix.csv"}, "a recording of Stray Scanner");
  const fs::path root(files.root());
  const std::map<std::int64_t, std::string> images = numbered_photographs((root / "rgb").string(), diagnostics);
  if (images.empty() && !diagnostics.has_errors())
    throw Error(ErrorKind::no_input, "scene.frames.none", "no photographs in '" + (root / "rgb").string() + "'",
                "take them out of the video: cd " + shell_word(root.string()) +
                    " && mkdir -p rgb && ffmpeg -i rgb.mp4 -vsync passthrough -start_number 0 -q:v 2 rgb/%06d.jpg");
  const Odometry odometry((root / "odometry.csv").string());
  const Camera matrix = read_matrix((root / "camera_matrix.csv").string());
  const auto poses = odometry.by_frame();
  const bool of_frame = odometry.has("fx") && odometry.has("cx");
  std::vector<PosedPhotograph> photos;
  for (const auto& [number, image] : images) {
    const auto found = poses.find(number);
    if (found == poses.end()) {
      diagnostics.error("scene.pose.count", "'" + image + "'",
                        "odometry.csv has no pose of frame " + std::to_string(number),
                        "number the photographs from 0 as the video's frames are, or remove the image");
      continue;
    }
    const TextRow& row = *found->second;
    const auto at = [&](const char* name) { return odometry.value(row, name); };
    PosedPhotograph photo;
    photo.color = image;
    photo.camera = matrix;
    for (const auto& [name, member] :
         {std::pair{"fx", &Camera::fx}, {"fy", &Camera::fy}, {"cx", &Camera::cx}, {"cy", &Camera::cy}})
      if (of_frame) photo.camera.*member = at(name);
    const ImageSize size = image_size(image);  // the video's, which the matrix is of
    photo.camera.width_px = size.width_px;
    photo.camera.height_px = size.height_px;
    set_rotation(photo.world_from_camera, {at("qw"), at("qx"), at("qy"), at("qz")});
    photo.world_from_camera.t = {at("x"), at("y"), at("z")};
    const std::string name = fmt::format("{:06}.png", number);
    photo.depth = in_folder(root / "depth", name);
    photo.confidence = (root / "confidence" / name).string();
    photos.push_back(std::move(photo));
  }
  return files.open(std::move(photos), {.tracked = true}, diagnostics);
}

SEMFIELD_PLUGIN_MODULE(stray_scanner, "1.0", [](Registry& registry) {
  registry.add_dataset<PhotographDataset<StrayScannerParams>, StrayScannerParams>(
      "stray_scanner", "Recordings of Stray Scanner: frames of a video, poses and LiDAR depth of a phone.");
})

}  // namespace semfield
