#include "labels/label_export.h"

#include <algorithm>
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "labels/mask_outlines.h"
#include "scene/scene.h"

namespace semfield {

namespace {

using ExportJson = nlohmann::json;

struct Box2 {
  std::int64_t x0, y0, x1, y1;
  ExportJson list() const { return ExportJson::array({x0, y0, x1 - x0, y1 - y0}); }
};

Box2 box_of(const Outline& outline) {
  const auto [left, right] =
      std::minmax_element(outline.begin(), outline.end(), [](auto& a, auto& b) { return a.x < b.x; });
  const auto [top, bottom] =
      std::minmax_element(outline.begin(), outline.end(), [](auto& a, auto& b) { return a.y < b.y; });
  return {std::int64_t(left->x), std::int64_t(top->y), std::int64_t(right->x), std::int64_t(bottom->y)};
}

// Pixels and box of each class; area 0 for those that are not there.
struct ClassExtent {
  std::int64_t area = 0;
  Box2 box{INT32_MAX, INT32_MAX, 0, 0};
};

std::vector<ClassExtent> extents(const LabelledFrame& frame, int classes) {
  std::vector<ClassExtent> out(static_cast<std::size_t>(classes));
  for (std::int64_t i = 0; i < std::ssize(frame.label); ++i) {
    const std::int16_t index = frame.label[static_cast<std::size_t>(i)];
    if (index < 0) continue;
    ClassExtent& c = out.at(static_cast<std::size_t>(index));
    const std::int64_t x = i % frame.width_px, y = i / frame.width_px;
    ++c.area;
    c.box = {std::min(c.box.x0, x), std::min(c.box.y0, y), std::max(c.box.x1, x + 1), std::max(c.box.y1, y + 1)};
  }
  return out;
}

void append(std::string& list, const std::string& item) {
  if (!list.empty()) list += ",\n";
  list += item;
}

}  // namespace

// No two images of a file are called alike.
std::string CocoExport::image_name(const LabelledFrame& frame) {
  if (!frame.picture.empty()) return frame.picture;
  const fs::path file =
      frame.image_path.empty() ? fs::path(output_name(frame.name) + ".png") : fs::path(frame.image_path);
  if (stems_.insert(file.stem().string()).second) return file.filename().string();
  const std::string own = output_name(frame.name);
  if (!stems_.insert(own).second)
    throw Error(ErrorKind::data, "scene.frame.name",
                "frame '" + frame.name + "': another image of the file is called '" + own + "'",
                "give the frame another name");
  return own + file.extension().string();
}

void CocoExport::annotate(const std::string& text) {
  append(annotations_, text);
  ++annotation_count_;
}

void CocoExport::add(const LabelledFrame& frame) {
  const std::int64_t image = ++image_count_;
  append(images_,
         ExportJson{
             {"id", image}, {"file_name", image_name(frame)}, {"width", frame.width_px}, {"height", frame.height_px}}
             .dump(-1, ' ', false, ExportJson::error_handler_t::replace));
  const auto entry = [&](int index, ExportJson segmentation, std::int64_t area, const Box2& box) {
    annotate(ExportJson{{"id", annotation_count_ + 1},
                        {"image_id", image},
                        {"category_id", classes_.id_of(index)},
                        {"segmentation", std::move(segmentation)},
                        {"area", area},
                        {"bbox", box.list()},
                        {"iscrowd", masks_ == CocoMasks::run_lengths ? 1 : 0}}
                 .dump());
  };
  if (masks_ == CocoMasks::run_lengths) {
    const std::vector<ClassExtent> all = extents(frame, classes_.valid_count());
    for (std::size_t c = 0; c < all.size(); ++c) {
      if (all[c].area == 0) continue;
      const std::string counts =
          text_of_counts(counts_of_class(frame.label, static_cast<std::int16_t>(c), frame.width_px, frame.height_px));
      entry(static_cast<int>(c), ExportJson{{"size", {frame.height_px, frame.width_px}}, {"counts", counts}},
            all[c].area, all[c].box);
    }
    return;
  }
  for (const MaskRegion& region : mask_regions(frame.label, frame.width_px, frame.height_px)) {
    ExportJson points = ExportJson::array();
    for (const PixelPoint& p : region.outline) {
      points.push_back(std::int64_t(p.x));
      points.push_back(std::int64_t(p.y));
    }
    entry(region.index, ExportJson::array({std::move(points)}), region.area_px, box_of(region.outline));
  }
}

void CocoExport::write(const std::string& path) const {
  std::string categories;
  for (int c = 0; c < classes_.valid_count(); ++c) {
    const ClassEntry& e = classes_.valid(c);
    if (is_unnamed_class(e.name)) continue;
    append(categories, ExportJson{{"id", e.id}, {"name", e.name}, {"supercategory", ""}, {"color", e.color}}.dump());
  }
  write_file_atomic(path, "{\"images\": [\n" + images_ + "\n],\n\"annotations\": [\n" + annotations_ +
                              "\n],\n\"categories\": [\n" + categories + "\n]}\n");
}

std::int64_t write_labelme(const std::string& folder, const LabelledFrame& frame, const ClassTable& classes) {
  ExportJson shapes = ExportJson::array();
  for (const MaskRegion& region : mask_regions(frame.label, frame.width_px, frame.height_px)) {
    ExportJson points = ExportJson::array();
    for (const PixelPoint& p : region.outline) points.push_back({std::int64_t(p.x), std::int64_t(p.y)});
    shapes.push_back({{"label", classes.valid(region.index).name},
                      {"points", std::move(points)},
                      {"group_id", nullptr},
                      {"shape_type", "polygon"},
                      {"flags", ExportJson::object()}});
  }
  const std::string stem = output_name(frame.name);
  // labelme opens the image beside the file, by a relative path.
  std::error_code failed;
  fs::path image = frame.image_path.empty() ? fs::path(stem + ".png") : fs::relative(frame.image_path, folder, failed);
  if (failed || image.empty()) image = frame.image_path;
  const auto count = static_cast<std::int64_t>(shapes.size());
  const ExportJson root{{"version", "5.0.0"},          {"flags", ExportJson::object()},
                        {"shapes", std::move(shapes)}, {"imagePath", image.string()},
                        {"imageData", nullptr},        {"imageHeight", frame.height_px},
                        {"imageWidth", frame.width_px}};
  write_file_atomic((fs::path(folder) / (stem + ".json")).string(),
                    root.dump(-1, ' ', false, ExportJson::error_handler_t::replace) + "\n");
  return count;
}

}  // namespace semfield
