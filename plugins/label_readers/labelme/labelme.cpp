// labelme: one JSON file per frame.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_json.h"
#include "plugin/module.h"

namespace semfield {

namespace {

using Json = nlohmann::json;

constexpr int kMostFolders = 3;  // one in the other

enum class ShapeKind : std::size_t { polygon, rectangle, circle, point };

// By ShapeKind: as files name it, how many points it has, and what to do about another number.
struct ShapeRule {
  const char* name;
  std::size_t least, most;
  std::string remedy;
};
const std::array<ShapeRule, 4> kShapes{
    {{"polygon", 3, kMaxOutlinePoints, "a polygon has from 3 to " + std::to_string(kMaxOutlinePoints) + " points"},
     {"rectangle", 2, 2, "give two corners"},
     {"circle", 2, 2, "give its centre and a point on it"},
     {"point", 1, 1, "give one point"}}};

struct Shape {
  ShapeKind kind = ShapeKind::polygon;
  std::string label, place;
  Outline points;
};

struct LabelmeFile {
  std::string path;
  std::int32_t width_px = 0, height_px = 0;
  std::vector<Shape> shapes = {};
  std::string image = {};       // as imagePath names it
  std::string image_path = {};  // where that is
  std::string own_name = {};    // of the file, from the folder
};

ShapeKind kind_of(const std::string& name, const std::string& place) {
  for (std::size_t i = 0; i < kShapes.size(); ++i)
    if (name == kShapes[i].name) return static_cast<ShapeKind>(i);
  refuse_labels("labels.shape.kind", place, "shape type '" + name + "' is not read",
                "draw it as polygon, rectangle, circle or point");
}

Shape shape_of(const Json& item, std::string place) {
  Shape shape;
  const auto label = item.find("label");
  if (!item.is_object() || label == item.end() || !label->is_string() || label->get<std::string>().empty())
    refuse_labels("labels.file.format", place, "the shape has no label", "give every shape the name of a class");
  shape.label = label->get<std::string>();
  shape.place = std::move(place) + " ('" + shape.label + "')";
  const auto type = item.find("shape_type");  // files of labelme before 3.4 have polygons alone and do not say so
  if (type != item.end() && !type->is_null()) {
    if (!type->is_string()) refuse_labels("labels.file.format", shape.place, "shape_type is not text");
    shape.kind = kind_of(type->get<std::string>(), shape.place);
  }
  const auto points = item.find("points");
  if (points == item.end() || !points->is_array())
    refuse_labels("labels.file.format", shape.place, "the shape has no list 'points'");
  for (const Json& point : *points) {
    const std::string which = "point " + std::to_string(shape.points.size() + 1);
    if (!point.is_array() || point.size() != 2 || !point[0].is_number() || !point[1].is_number())
      refuse_labels("labels.file.format", shape.place, which + " is not a pair of numbers [x, y]");
    shape.points.push_back(point_near_image(point[0].get<double>(), point[1].get<double>(), which, shape.place));
  }
  const ShapeRule& rule = kShapes[static_cast<std::size_t>(shape.kind)];
  if (const std::size_t count = shape.points.size(); count < rule.least || count > rule.most)
    refuse_labels("labels.shape.points", shape.place, fmt::format("a {} of {} points", rule.name, count), rule.remedy);
  return shape;
}

std::int32_t size_of(const Json& root, const char* key, const std::string& path) {
  const auto value = root.find(key);
  if (value == root.end() || !value->is_number_integer() || value->get<std::int64_t>() < 1 ||
      value->get<std::int64_t>() > 1 << 20)
    refuse_labels("labels.file.format", path,
                  fmt::format("'{}' is {}", key, value == root.end() ? "missing" : value->dump()),
                  "save the file again in labelme: it writes the size of the image");
  return value->get<std::int32_t>();
}

void paint_shape(const Shape& shape, std::int16_t index, LabelRaster& raster) {
  const std::int32_t w = raster.width_px, h = raster.height_px;
  const Outline& p = shape.points;
  switch (shape.kind) {
    case ShapeKind::polygon:
      return paint(outline_runs(p, w, h), index, raster);
    case ShapeKind::rectangle:
      return paint(outline_runs({p[0], {p[1].x, p[0].y}, p[1], {p[0].x, p[1].y}}, w, h), index, raster);
    case ShapeKind::circle:
      return paint(disc_runs(p[0], std::hypot(p[1].x - p[0].x, p[1].y - p[0].y), w, h), index, raster);
    case ShapeKind::point: {
      if (p[0].x < 0 || p[0].y < 0 || p[0].x > w || p[0].y > h)
        refuse_labels("labels.shape.outside", shape.place, "the point lies outside the image of " + size_text(w, h));
      const auto x = std::min(static_cast<std::int32_t>(p[0].x), w - 1);
      const auto y = std::min(static_cast<std::int32_t>(p[0].y), h - 1);
      return paint({{y, x, x + 1}}, index, raster);
    }
  }
}

class LabelmeReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, folder,
                   "folder of the JSON files, with those in folders below; each belongs to the frame whose image its "
                   "imagePath, or its own name, names");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    files_.clear();
    file_of_frame_.clear();
    if (!check_folder(folder, diagnostics)) return {};
    ProblemList problems(diagnostics);
    std::map<std::string, std::string> place_of_name;
    load_folder(folder, 0, place_of_name, problems, diagnostics);
    if (files_.empty() && problems.count() == 0)
      problems.error("labels.folder.empty", "folder", "no labelme file (*.json) in '" + folder + "'", "check the path");
    return table_for(place_of_name, known, problems);
  }

  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) override {
    std::vector<PictureName> pictures;
    for (const LabelmeFile& file : files_)
      pictures.push_back({.path = file.image.empty() ? file.own_name : file.image,
                          .place = file.path,
                          .other = file.own_name,
                          .file = file.image_path,
                          .labelled = !file.shapes.empty()});
    file_of_frame_ = match_frames(pictures, frames, folder, diagnostics);
  }

  bool has(const FrameInfo& frame) const override {
    const LabelmeFile* file = file_of(frame);
    return file != nullptr && !file->shapes.empty();
  }

  LabelRaster read(const FrameInfo& frame, const ClassTable& classes) const override {
    const LabelmeFile* file = file_of(frame);
    if (file == nullptr)
      refuse_labels("labels.frame.unlabelled", folder, "there is no labelme file for frame '" + frame.name + "'");
    check_label_shape(file->width_px, file->height_px, frame.camera);
    LabelRaster raster = void_raster(file->width_px, file->height_px);
    const ClassNames names(classes);
    for (const Shape& shape : file->shapes) paint_shape(shape, names.index_of(shape.label, shape.place), raster);
    return raster;
  }

  std::string folder;

 private:
  // Folders below are those of several cameras, each beside or like its images.
  void load_folder(const std::string& path, int depth, std::map<std::string, std::string>& place_of_name,
                   ProblemList& problems, Diagnostics& diagnostics) {
    for (const auto& entry : sorted_folder(path)) {
      if (entry.is_directory() && depth < kMostFolders) {
        load_folder(entry.path().string(), depth + 1, place_of_name, problems, diagnostics);
      } else if (entry.is_regular_file() && entry.path().extension() == ".json") {
        problems.collect([&] { load(entry.path().string(), place_of_name, diagnostics); });
      }
    }
  }

  void load(const std::string& path, std::map<std::string, std::string>& place_of_name, Diagnostics& diagnostics) {
    const Json root = read_label_json<Json>(path, "save the file again in labelme");
    if (!root.is_object() || !root.contains("shapes")) {
      if (fs::path(path).parent_path() == fs::path(folder))
        diagnostics.note("labels.file.foreign", path, "no labelme file (it has no 'shapes'); left out");
      return;
    }
    if (!root["shapes"].is_array())
      refuse_labels("labels.file.format", path, "'shapes' is not a list", "save the file again in labelme");
    LabelmeFile file{path, size_of(root, "imageWidth", path), size_of(root, "imageHeight", path)};
    at_place(path, [&] { check_image_limits(file.width_px, file.height_px); });
    for (const Json& item : root["shapes"]) {
      file.shapes.push_back(shape_of(item, path + ": shape " + std::to_string(file.shapes.size() + 1)));
      place_of_name.emplace(file.shapes.back().label, file.shapes.back().place);
    }
    // The image's name, and the file's own beside it: people rename either. An image without a folder lies beside the
    // file, or did.
    const fs::path own = fs::path(path).lexically_relative(folder);
    file.own_name = own.string();
    if (root.contains("imagePath") && root["imagePath"].is_string()) {
      std::string image = root["imagePath"].get<std::string>();
      std::replace(image.begin(), image.end(), '\\', '/');
      file.image_path = (fs::path(path).parent_path() / image).lexically_normal().string();
      file.image = image.find('/') == std::string::npos ? (own.parent_path() / image).string() : image;
    }
    files_.push_back(std::move(file));
  }

  const LabelmeFile* file_of(const FrameInfo& frame) const {
    const auto found = file_of_frame_.find(frame.name);
    return found == file_of_frame_.end() ? nullptr : &files_[found->second];
  }

  std::vector<LabelmeFile> files_;
  std::map<std::string, std::size_t> file_of_frame_;
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(labelme, "1.0", [](Registry& registry) {
  registry.add_label_reader<LabelmeReader>(
      "labelme", "polygons, rectangles, circles and points of labelme: one JSON file per frame");
})

}  // namespace semfield
