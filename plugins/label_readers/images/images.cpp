// Label images: ids, palette indices or exact colours, one file a frame.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <span>

#include "core/files.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "plugin/module.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"

namespace semfield {

enum class LabelImageKind { ids, palette, color };
SEMFIELD_CHOICES(LabelImageKind, "ids", "palette", "color");

namespace {

using Rgb = std::array<std::uint8_t, 3>;

std::string text_of(Rgb c) { return fmt::format("({}, {}, {})", c[0], c[1], c[2]); }

bool is_palette_png(const std::string& path) {
  const std::string start = read_file_start(path, 26);
  return looks_like_png(std::as_bytes(std::span<const char>(start.data(), start.size()))) && start.size() == 26 &&
         start[25] == 3;  // the colour type, after width, height and depth in the first chunk
}

struct NamedColor {
  Rgb color{};
  std::string name, place;
};

std::vector<NamedColor> read_colors(const std::string& path) {
  std::vector<NamedColor> out;
  std::map<Rgb, std::string> seen;
  const TextTable table = read_text_table(
      path, {{"r", "red"}, {"g", "green"}, {"b", "blue"}, {"name", "class", "class_name", "label", "category"}});
  if (!table.header.empty() && std::ranges::find(table.has, 0) != table.has.end())
    refuse_labels("labels.colors.format", table.header, "expected columns r, g, b and name");
  for (const TextRow& row : table.rows) {
    if (row.fields[3].empty()) refuse_labels("labels.colors.format", row.place, "expected 'r,g,b,name'");
    NamedColor entry{{}, row.fields[3], row.place};
    for (std::size_t i = 0; i < 3; ++i) {
      std::int64_t value = 0;
      if (!parse_whole(row.fields[i], value) || value < 0 || value > 255)
        refuse_labels("labels.colors.format", row.place, "expected a number from 0 to 255, got '" + row.fields[i] + "'",
                      "write lines 'r,g,b,name'");
      entry.color[i] = static_cast<std::uint8_t>(value);
    }
    const auto [other, fresh] = seen.emplace(entry.color, entry.name);
    if (!fresh)
      refuse_labels("labels.colors.twice", row.place,
                    "colour " + text_of(entry.color) + " is given to '" + other->second + "' before");
    out.push_back(std::move(entry));
  }
  if (out.empty()) refuse_labels("labels.colors.format", path, "no colours in it", "write lines 'r,g,b,name'");
  return out;
}

class ImageLabelReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, folder, "folder of the images");
    SEMFIELD_PARAM(visit, *this, pattern,
                   "file of a frame: {name} is the frame's name, {stem} its image's name without extension, {number} "
                   "the digits at the end of its name, with or without zeros before them");
    SEMFIELD_PARAM(visit, *this, kind,
                   "ids: one channel of class ids; palette: a palette PNG whose indices are ids; color: exact colours");
    SEMFIELD_PARAM(visit, *this, file,
                   "for color: CSV file of lines r,g,b,name, or with these columns named in its first line; empty: the "
                   "class table's colours");
    SEMFIELD_PARAM(visit, *this, classes,
                   "class table, for a scene without one (classes.yaml, .csv, .json, or CVAT's "
                   "labelmap.txt)");
    SEMFIELD_PARAM(visit, *this, unknown, "how an id or colour outside the table is read");
  }

  void validate(Diagnostics& diagnostics) const override {
    check_pattern(pattern, diagnostics);
    if (!file.empty() && kind != LabelImageKind::color)
      diagnostics.error("config.value.conflict", "file", "a table of colours is given, but kind is not color",
                        "set kind: color");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    colors_.clear();
    files_.clear();
    (void)check_folder(folder, pattern, diagnostics);
    ProblemList problems(diagnostics);
    ClassTable table = known;
    if (table.empty() && !classes.empty()) problems.collect([&] { table = import_classes(classes); });
    if (!file.empty()) problems.collect([&] { colors_ = read_colors(file); });
    if (!colors_.empty()) table = table_of_colors(table, problems);
    if (table.empty() && problems.count() == 0)
      problems.error("labels.classes.none", "classes", "the scene has no class table",
                     "name one in scene.labels.from.classes");
    if (kind == LabelImageKind::color && problems.count() == 0) problems.collect([&] { (void)index_of_color(table); });
    return table;
  }

  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) override {
    files_.match(folder, pattern, frames, diagnostics);
  }

  bool has(const FrameInfo& frame) const override { return files_.has(frame); }

  LabelRaster read(const FrameInfo& shown, const ClassTable& table) const override {
    const FramesFiles::File found = files_.of(shown, "label image");
    const std::string& path = found.path;
    if (kind == LabelImageKind::palette && !is_palette_png(path))
      refuse_labels("labels.image.palette", "'" + path + "'", "it is not a PNG with a palette",
                    "set kind: ids or color");
    const ImageSize size = image_size(path);  // before anything is unpacked on the word of its header
    check_label_shape(size.width_px, size.height_px, found.frame.camera);
    if (kind != LabelImageKind::color && size.channels > 1)
      refuse_labels("labels.image.channels", "'" + path + "'",
                    fmt::format("has {} channels: it is a picture in colours, not one of class ids", size.channels),
                    "read the classes from the colours with --set scene.labels.from.kind=color");
    LabelRaster raster = kind == LabelImageKind::color ? read_color(path, table) : read_index(path, table);
    raster.as_stored = found.as_stored;
    return raster;
  }

  std::string folder, pattern = "{name}.png", file, classes;
  LabelImageKind kind = LabelImageKind::ids;
  UnknownLabels unknown = UnknownLabels::error;

 private:
  ClassTable table_of_colors(const ClassTable& known, ProblemList& problems) const {
    std::map<std::string, std::string> place_of_name;
    for (const NamedColor& color : colors_) place_of_name.emplace(color.name, color.place);
    if (!known.empty()) return table_for(place_of_name, known, problems);
    // Ids in the order of the file, colours as it gives them.
    std::vector<std::string> names;
    std::map<std::string, Rgb> color_of_name;
    for (const NamedColor& color : colors_)
      if (color_of_name.emplace(color.name, color.color).second) names.push_back(color.name);
    std::vector<ClassEntry> entries = table_of_names(names).entries();
    for (ClassEntry& entry : entries)
      if (const auto own = color_of_name.find(entry.name); own != color_of_name.end()) entry.color = own->second;
    return ClassTable(std::move(entries));
  }

  std::map<Rgb, std::int16_t> index_of_color(const ClassTable& table) const {
    std::map<Rgb, std::int16_t> index;
    if (!colors_.empty()) {
      const ClassNames names(table);
      for (const NamedColor& color : colors_) index.emplace(color.color, names.index_of(color.name, color.place));
      return index;
    }
    std::map<Rgb, std::string> owner;
    for (const ClassEntry& entry : table.entries()) {
      const auto [other, fresh] = owner.emplace(entry.color, entry.name);
      if (!fresh)
        refuse_labels("labels.colors.twice", "class table",
                      "'" + other->second + "' and '" + entry.name + "' have the same colour " + text_of(entry.color),
                      "give each class its own colour, or name a table of colours in scene.labels.from.file");
      index.emplace(entry.color, static_cast<std::int16_t>(table.index_of(entry.id)));
    }
    return index;
  }

  // Values without a class become void, or are told all at once.
  void refuse_unknown(const char* noun, UnknownValues values, const std::string& path, std::int32_t width) const {
    if (values.empty() || unknown == UnknownLabels::as_void) return;
    throw UnknownLabelError(noun, std::move(values), path, width,
                            "add what is missing to the table, or read it as void with --set "
                            "scene.labels.from.unknown=void");
  }

  LabelRaster read_index(const std::string& path, const ClassTable& table) const {
    const Image<std::uint16_t> image = read_ids(path);
    LabelRaster raster{image.width_px, image.height_px, {}, {}};
    raster.hard.resize(image.pixels.size());
    UnknownValues values;
    for (std::size_t i = 0; i < raster.hard.size(); ++i) {
      const int index = table.index_of(image.pixels[i]);
      if (index == -2) values.try_emplace(std::to_string(image.pixels[i]), i);
      raster.hard[i] = index < 0 ? kVoid : static_cast<std::int16_t>(index);
    }
    refuse_unknown("label id", std::move(values), path, image.width_px);
    return raster;
  }

  LabelRaster read_color(const std::string& path, const ClassTable& table) const {
    const std::map<Rgb, std::int16_t> index = index_of_color(table);
    const Image<std::uint8_t> image = read_rgb(path);
    LabelRaster raster{image.width_px, image.height_px, {}, {}};
    raster.hard.resize(image.pixels.size() / 3);
    UnknownValues values;
    for (std::size_t i = 0; i < raster.hard.size(); ++i) {
      const Rgb color{image.pixels[3 * i], image.pixels[3 * i + 1], image.pixels[3 * i + 2]};
      const auto found = index.find(color);
      raster.hard[i] = found == index.end() ? kVoid : found->second;
      // A photograph has as many colours as pixels: a few tell that it is none of the table.
      if (found == index.end() && values.size() < 256) values.try_emplace(text_of(color), i);
    }
    refuse_unknown("colour", std::move(values), path, image.width_px);
    return raster;
  }

  std::vector<NamedColor> colors_;
  FramesFiles files_;
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(images, "1.0", [](Registry& registry) {
  registry.add_label_reader<ImageLabelReader>("images", "label images: class ids, palette indices, or exact colours");
})

}  // namespace semfield
