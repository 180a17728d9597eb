// COCO: one JSON file with images, annotations and categories.
#include <algorithm>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>

#include "core/text.h"
#include "formats/image_io.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_outlines.h"
#include "plugin/module.h"
#include "system/files.h"

namespace semfield {

namespace {

using Json = nlohmann::json;

struct Annotation {
  std::string place, category;
  std::vector<Outline> parts;
  std::vector<std::int64_t> counts;  // run lengths; empty with parts
};

struct CocoImage {
  std::string name = {}, place = {};
  std::int32_t width_px = 0, height_px = 0;
  std::vector<Annotation> annotations = {};
};

std::int64_t whole(const Json& item, const char* key, const std::string& place) {
  const auto found = item.find(key);
  if (!item.is_object() || found == item.end() || !found->is_number_integer())
    refuse_labels("labels.file.format", place, std::string("needs a whole number '") + key + "'");
  return found->get<std::int64_t>();
}

std::string text(const Json& item, const char* key, const std::string& place) {
  const auto found = item.find(key);
  if (!item.is_object() || found == item.end() || !found->is_string() || found->get<std::string>().empty())
    refuse_labels("labels.file.format", place, std::string("needs a text '") + key + "'");
  return found->get<std::string>();
}

Outline outline_of(const Json& part, const std::string& place) {
  if (!part.is_array() || part.size() < 6 || part.size() % 2 != 0 || part.size() > 2 * kMaxOutlinePoints)
    refuse_labels("labels.shape.points", place,
                  "a polygon is a list [x, y, x, y, ...] of 3 to " + std::to_string(kMaxOutlinePoints) + " points");
  Outline outline;
  for (std::size_t i = 0; i < part.size(); i += 2) {
    if (!part[i].is_number() || !part[i + 1].is_number())
      refuse_labels("labels.file.format", place, "point " + std::to_string(i / 2 + 1) + " is not a pair of numbers");
    const PixelPoint p{part[i].get<double>(), part[i + 1].get<double>()};
    if (!(std::abs(p.x) <= kMaxCoordinate) || !(std::abs(p.y) <= kMaxCoordinate))
      refuse_labels("labels.shape.outside", place,
                    "point " + std::to_string(i / 2 + 1) + " lies more than a million pixels outside");
    outline.push_back(p);
  }
  return outline;
}

std::vector<std::int64_t> counts_of(const Json& segmentation, const CocoImage& image, const std::string& place) {
  const auto size = segmentation.find("size");
  if (size != segmentation.end() && *size != Json::array({image.height_px, image.width_px}))
    refuse_labels("labels.image.size", place,
                  "run lengths of size " + size->dump() + ", the image is [" + std::to_string(image.height_px) + "," +
                      std::to_string(image.width_px) + "] (height, width)");
  const auto counts = segmentation.find("counts");
  if (counts == segmentation.end() || (!counts->is_string() && !counts->is_array()))
    refuse_labels("labels.run_lengths.damaged", place, "run lengths need 'counts', a list or a text");
  std::vector<std::int64_t> out;
  if (counts->is_string()) {
    out = counts_of_text(counts->get<std::string>());
  } else {
    for (const Json& count : *counts) {
      if (!count.is_number_integer())
        refuse_labels("labels.run_lengths.damaged", place,
                      "count " + std::to_string(out.size() + 1) + " is not a whole number");
      out.push_back(count.get<std::int64_t>());
    }
  }
  if (out.empty()) refuse_labels("labels.run_lengths.damaged", place, "run lengths without a count");
  return out;
}

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
    Json root;
    try {
      root = Json::parse(read_text_file(file));
    } catch (const Json::exception& e) {
      refuse_labels("labels.file.format", file, "not valid JSON: " + json_cause(e.what()),
                    "export the annotations again");
    }
    for (const char* key : {"images", "annotations", "categories"}) {
      if (!root.is_object() || !root.contains(key) || !root[key].is_array())
        refuse_labels("labels.file.format", file, std::string("no list '") + key + "' in it",
                      "give a COCO file of instances");
    }
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
        const std::int64_t category = whole(item, "category_id", place);
        const auto name = categories.find(category);
        if (name == categories.end())
          refuse_labels("labels.annotation.reference", place, "no category has the id " + std::to_string(category));
        ++uses[category];
        if (!read_annotation(item, place, name->second, image_of_id)) {
          ++boxes;
          return;
        }
        place_of_name.emplace(name->second, place + " (category " + std::to_string(category) + ")");
      });
    }
    if (boxes > 0) {
      diagnostics.warning("labels.annotation.box", file,
                          std::to_string(boxes) + " annotations have a box and no mask; left out",
                          "export masks or polygons for them");
    }
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
    struct Mask {
      std::vector<PixelRun> runs;
      std::int64_t area;
      std::int16_t index;
    };
    std::vector<Mask> masks;
    for (const Annotation& annotation : image->annotations) {
      Mask mask{{}, 0, names.index_of(annotation.category, annotation.place)};
      if (annotation.parts.empty()) {
        try {
          mask.runs = runs_of_counts(annotation.counts, raster.width_px, raster.height_px);
        } catch (const Error& e) {
          refuse_labels(e.code(), annotation.place, e.message(), e.remedy());
        }
      }
      for (const Outline& part : annotation.parts) {
        const std::vector<PixelRun> runs = outline_runs(part, raster.width_px, raster.height_px);
        mask.runs.insert(mask.runs.end(), runs.begin(), runs.end());
      }
      mask.area = area_of(mask.runs);
      masks.push_back(std::move(mask));
    }
    // What is in front of a large thing is mostly smaller than it: the smaller mask is painted later.
    std::stable_sort(masks.begin(), masks.end(), [](const Mask& a, const Mask& b) { return a.area > b.area; });
    for (const Mask& mask : masks) paint(mask.runs, mask.index, raster);
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
        const std::int64_t id = whole(item, "id", place);
        if (!names.emplace(id, text(item, "name", place)).second)
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
    for (auto at = categories.begin(); at != categories.end();) {
      const std::int64_t id = kept.at(at->second);
      if (id == at->first) {
        ++at;
        continue;
      }
      diagnostics.note("classes.name.twice", file,
                       "categories " + std::to_string(std::min(id, at->first)) + " and " +
                           std::to_string(std::max(id, at->first)) + " are both called '" + at->second +
                           "': they are one class here, with the id " + std::to_string(id));
      at = categories.erase(at);
    }
  }

  void read_image(const Json& item, const std::string& place, std::map<std::int64_t, std::size_t>& image_of_id) {
    CocoImage image{.place = place};
    const std::int64_t id = whole(item, "id", place);
    image.name = text(item, "file_name", place);
    const std::int64_t width = whole(item, "width", place), height = whole(item, "height", place);
    try {
      check_image_limits(width, height);
    } catch (const Error& e) {
      refuse_labels(e.code(), place, e.message(), e.remedy());
    }
    image.width_px = static_cast<std::int32_t>(width);
    image.height_px = static_cast<std::int32_t>(height);
    if (!image_of_id.emplace(id, images_.size()).second)
      refuse_labels("labels.annotation.twice", place, "id " + std::to_string(id) + " is given twice");
    images_.push_back(std::move(image));
  }

  // False for an annotation that is a box alone.
  bool read_annotation(const Json& item, const std::string& place, const std::string& category,
                       const std::map<std::int64_t, std::size_t>& image_of_id) {
    const std::int64_t id = whole(item, "image_id", place);
    const auto found = image_of_id.find(id);
    if (found == image_of_id.end())
      refuse_labels("labels.annotation.reference", place, "no image has the id " + std::to_string(id));
    CocoImage& image = images_[found->second];
    const auto segmentation = item.find("segmentation");
    if (segmentation == item.end() || segmentation->empty()) return false;
    Annotation annotation{place, category, {}, {}};
    if (segmentation->is_object()) {
      try {
        annotation.counts = counts_of(*segmentation, image, place);
      } catch (const Error& e) {
        if (e.message().rfind(place, 0) == 0) throw;
        refuse_labels(e.code(), place, e.message(), e.remedy());
      }
    } else if (segmentation->is_array()) {
      for (const Json& part : *segmentation) annotation.parts.push_back(outline_of(part, place));
    } else {
      refuse_labels("labels.file.format", place, "'segmentation' is neither polygons nor run lengths");
    }
    image.annotations.push_back(std::move(annotation));
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
