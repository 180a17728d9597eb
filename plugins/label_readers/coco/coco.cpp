// COCO: one JSON file with images, annotations and categories.
#include <fmt/format.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_json.h"
#include "plugin/module.h"

namespace semfield {

namespace {

using Json = nlohmann::json;

struct Annotation {
  std::string place, category;
  CocoMask mask;
};

struct CocoImage {
  std::string name = {}, place = {};
  std::int32_t width_px = 0, height_px = 0;
  std::vector<Annotation> annotations = {};
};

class CocoReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, file,
                   "JSON file of images, annotations and categories; file_name names the frame's image, with as many "
                   "of its folders as it has");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    images_.clear();
    image_of_frame_.clear();
    const Json root = read_label_json<Json>(file, "export the annotations again");
    for (const char* key : {"images", "annotations", "categories"})
      if (!root.is_object() || !root.contains(key) || !root[key].is_array())
        refuse_labels("labels.file.format", file, fmt::format("no list '{}' in it", key),
                      "give a COCO file of instances");
    ProblemList problems(diagnostics);
    std::map<std::int64_t, std::size_t> image_of_id;
    std::map<std::int64_t, std::string> categories = read_categories(root["categories"], problems);
    std::size_t number = 0;
    for (const Json& item : root["images"]) {
      const std::string place = file + ": image " + std::to_string(++number);
      problems.collect([&] { read_image(item, place, image_of_id); });
    }
    std::map<std::string, std::string> place_of_name;
    std::map<std::int64_t, std::int64_t> uses;  // of categories
    std::int64_t boxes = 0;
    number = 0;
    for (const Json& item : root["annotations"]) {
      const std::string place = file + ": annotation " + std::to_string(++number);
      problems.collect([&] {
        const std::int64_t category = whole_of(item, "category_id", place);
        const auto name = categories.find(category);
        if (name == categories.end())
          refuse_labels("labels.annotation.reference", place, "no category has the id " + std::to_string(category));
        ++uses[category];
        if (read_annotation(item, place, name->second, image_of_id))
          place_of_name.emplace(name->second, fmt::format("{} (category {})", place, category));
        else
          ++boxes;
      });
    }
    if (boxes > 0)
      diagnostics.warning("labels.annotation.box", file,
                          fmt::format("{} annotations have a box and no mask; left out", boxes),
                          "export masks or polygons for them");
    merge_namesakes(categories, uses, diagnostics);
    if (known.empty()) return own_table(categories, problems);
    return table_for(place_of_name, known, problems);
  }

  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) override {
    std::vector<PictureName> pictures;
    for (const CocoImage& image : images_)
      pictures.push_back({.path = image.name, .place = image.place, .labelled = !image.annotations.empty()});
    image_of_frame_ = match_frames(pictures, frames, file, diagnostics);
  }

  bool has(const FrameInfo& frame) const override {
    const CocoImage* image = image_of(frame);
    return image != nullptr && !image->annotations.empty();
  }

  LabelRaster read(const FrameInfo& frame, const ClassTable& classes) const override {
    const CocoImage* image = image_of(frame);
    if (image == nullptr) refuse_labels("labels.frame.unlabelled", file, "no image of frame '" + frame.name + "'");
    check_label_shape(image->width_px, image->height_px, frame.camera);
    LabelRaster raster = void_raster(image->width_px, image->height_px);
    const ClassNames names(classes);
    std::vector<MaskPixels> masks;
    for (const Annotation& annotation : image->annotations) {
      const std::int16_t index = names.index_of(annotation.category, annotation.place);
      masks.emplace_back(annotation.mask.runs(raster.width_px, raster.height_px, annotation.place), index);
    }
    sort_by_area(masks);
    for (const MaskPixels& mask : masks) paint(mask.runs, mask.index, raster);
    return raster;
  }

  std::string file;

 private:
  std::map<std::int64_t, std::string> read_categories(const Json& list, ProblemList& problems) const {
    std::map<std::int64_t, std::string> names;
    std::size_t number = 0;
    for (const Json& item : list) {
      const std::string place = file + ": category " + std::to_string(++number);
      problems.collect([&] {
        const std::int64_t id = whole_of(item, "id", place);
        if (!names.emplace(id, text_of(item, "name", place, 1)).second)
          refuse_labels("labels.annotation.twice", place, "id " + std::to_string(id) + " is given twice");
      });
    }
    return names;
  }

  // Annotation tools add categories that are called as their group: one class, with the id that annotations use most.
  void merge_namesakes(std::map<std::int64_t, std::string>& categories,
                       const std::map<std::int64_t, std::int64_t>& uses, Diagnostics& diagnostics) const {
    const auto used = [&](std::int64_t id) { return uses.contains(id) ? uses.at(id) : 0; };
    std::map<std::string, std::int64_t> kept;
    for (const auto& [id, name] : categories) {
      const auto [other, fresh] = kept.emplace(name, id);
      if (!fresh && used(id) > used(other->second)) other->second = id;
    }
    std::erase_if(categories, [&](const auto& category) {
      const auto& [own, name] = category;
      const std::int64_t id = kept.at(name);
      if (id != own)
        diagnostics.note("classes.name.twice", file,
                         fmt::format("categories {} and {} are both called '{}': they are one class here, with the id "
                                     "{}",
                                     std::min(id, own), std::max(id, own), name, id));
      return id != own;
    });
  }

  void read_image(const Json& item, const std::string& place, std::map<std::int64_t, std::size_t>& image_of_id) {
    CocoImage image{.place = place};
    const std::int64_t id = whole_of(item, "id", place);
    image.name = text_of(item, "file_name", place, 1);
    const std::int64_t width = whole_of(item, "width", place), height = whole_of(item, "height", place);
    at_place(place, [&] { check_image_limits(width, height); });
    image.width_px = static_cast<std::int32_t>(width);
    image.height_px = static_cast<std::int32_t>(height);
    if (!image_of_id.emplace(id, images_.size()).second)
      refuse_labels("labels.annotation.twice", place, "id " + std::to_string(id) + " is given twice");
    images_.push_back(std::move(image));
  }

  // False for an annotation that is a box alone.
  bool read_annotation(const Json& item, const std::string& place, const std::string& category,
                       const std::map<std::int64_t, std::size_t>& image_of_id) {
    const std::int64_t id = whole_of(item, "image_id", place);
    const auto found = image_of_id.find(id);
    if (found == image_of_id.end())
      refuse_labels("labels.annotation.reference", place, "no image has the id " + std::to_string(id));
    CocoImage& image = images_[found->second];
    const auto segmentation = item.find("segmentation");
    if (segmentation == item.end() || segmentation->empty()) return false;
    image.annotations.push_back({place, category, coco_mask(*segmentation, image.width_px, image.height_px, place)});
    return true;
  }

  ClassTable own_table(const std::map<std::int64_t, std::string>& categories, ProblemList& problems) const {
    std::vector<ClassEntry> entries;
    ClassTable table;
    problems.collect([&] {
      for (const auto& [id, name] : categories) {
        if (id < 0 || id > 65535)
          refuse_labels("classes.table.id", file, "category '" + name + "' has id " + std::to_string(id),
                        "ids run from 0 to 65535");
        const auto small = static_cast<std::int32_t>(id);
        entries.push_back({small, name, ClassTable::default_color(small), is_void_name(name)});
      }
      table = with_void(std::move(entries));
    });
    return table;
  }

  const CocoImage* image_of(const FrameInfo& frame) const {
    const auto found = image_of_frame_.find(frame.name);
    return found == image_of_frame_.end() ? nullptr : &images_[found->second];
  }

  std::vector<CocoImage> images_;
  std::map<std::string, std::size_t> image_of_frame_;
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(coco, "1.0", [](Registry& registry) {
  registry.add_label_reader<CocoReader>("coco", "polygons and run lengths of COCO: one JSON file for all frames");
})

}  // namespace semfield
