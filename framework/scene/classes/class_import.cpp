#include "scene/classes/class_import.h"

#include <algorithm>
#include <filesystem>
#include <map>
#include <optional>
#include <span>
#include <string_view>

#include "core/error.h"
#include "formats/text_rows.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

constexpr std::array<std::string_view, 13> kNyu13{"bed",       "books",   "ceiling", "chair", "floor",
                                                  "furniture", "objects", "picture", "sofa",  "table",
                                                  "tv",        "wall",    "window"};

struct Nyu40Class {
  std::string_view name;
  std::uint8_t nyu13;
};
constexpr std::array<Nyu40Class, 40> kNyu40{{
    {"wall", 12},       {"floor", 5},          {"cabinet", 6},        {"bed", 1},
    {"chair", 4},       {"sofa", 9},           {"table", 10},         {"door", 12},
    {"window", 13},     {"bookshelf", 6},      {"picture", 8},        {"counter", 6},
    {"blinds", 13},     {"desk", 10},          {"shelves", 6},        {"curtain", 13},
    {"dresser", 6},     {"pillow", 7},         {"mirror", 7},         {"floor mat", 5},
    {"clothes", 7},     {"ceiling", 3},        {"books", 2},          {"refrigerator", 6},
    {"television", 11}, {"paper", 7},          {"towel", 7},          {"shower curtain", 7},
    {"box", 7},         {"whiteboard", 7},     {"person", 7},         {"night stand", 6},
    {"toilet", 7},      {"sink", 7},           {"lamp", 7},           {"bathtub", 7},
    {"bag", 7},         {"otherstructure", 7}, {"otherfurniture", 6}, {"otherprop", 7},
}};

// ScanNet's twenty with the colours of its pictures.
struct ScannetClass {
  std::uint8_t nyu40;
  std::array<std::uint8_t, 3> color;
};
constexpr std::array<ScannetClass, 20> kScannet20{{
    {1, {174, 199, 232}},  {2, {152, 223, 138}}, {3, {31, 119, 180}},   {4, {255, 187, 120}},  {5, {188, 189, 34}},
    {6, {140, 86, 75}},    {7, {255, 152, 150}}, {8, {214, 39, 40}},    {9, {197, 176, 213}},  {10, {148, 103, 189}},
    {11, {196, 156, 148}}, {12, {23, 190, 207}}, {14, {247, 182, 210}}, {16, {219, 219, 141}}, {24, {255, 127, 14}},
    {28, {158, 218, 229}}, {33, {44, 160, 44}},  {34, {112, 128, 144}}, {36, {227, 119, 194}}, {39, {82, 84, 163}},
}};

std::string_view nyu40_name(std::int32_t id) { return kNyu40[static_cast<std::size_t>(id - 1)].name; }

ClassEntry pascal_entry(std::int32_t id, std::string_view name) {
  return {id, std::string(name), pascal_color(id), false};
}

std::uint8_t color_value(const std::string& text, const std::string& place) {
  std::int64_t value = 0;
  if (!parse_whole(text, value) || value < 0 || value > 255) {
    throw Error(ErrorKind::data, "classes.label_map.color",
                place + ": expected a colour value from 0 to 255, got '" + text + "'", "write lines 'label:r,g,b::'");
  }
  return static_cast<std::uint8_t>(value);
}

std::array<std::uint8_t, 3> color_of(const std::string& text, const std::string& place) {
  const std::size_t first = text.find(','), second = text.find(',', first + 1);
  if (first == std::string::npos || second == std::string::npos)
    throw Error(ErrorKind::data, "classes.label_map.color", place + ": expected a colour 'r,g,b', got '" + text + "'",
                "write lines 'label:r,g,b::'");
  return {color_value(text.substr(0, first), place), color_value(text.substr(first + 1, second - first - 1), place),
          color_value(text.substr(second + 1), place)};
}

}  // namespace

std::vector<std::string> published_class_names() { return {"nyu13", "nyu40", "scannet20"}; }

ClassTable published_classes(const std::string& name) {
  std::vector<ClassEntry> entries;
  if (name == "nyu13") {
    for (std::size_t i = 0; i < kNyu13.size(); ++i)
      entries.push_back(pascal_entry(static_cast<std::int32_t>(i) + 1, kNyu13[i]));
  } else if (name == "nyu40") {
    for (std::size_t i = 0; i < kNyu40.size(); ++i)
      entries.push_back(pascal_entry(static_cast<std::int32_t>(i) + 1, kNyu40[i].name));
  } else if (name == "scannet20") {
    for (const ScannetClass& c : kScannet20)
      entries.push_back({c.nyu40, std::string(nyu40_name(c.nyu40)), c.color, false});
  } else {
    throw Error(ErrorKind::usage, "classes.published.unknown", "no published class table '" + name + "'",
                "there are " + join(published_class_names()));
  }
  return with_void(std::move(entries));
}

std::int32_t nyu13_of_nyu40(std::int32_t nyu40id) {
  if (nyu40id < 0 || nyu40id > std::ssize(kNyu40))
    throw Error(ErrorKind::data, "classes.table.id", "NYU40 id " + std::to_string(nyu40id),
                "NYU40 ids run from 0 to 40");
  return nyu40id == 0 ? 0 : kNyu40[static_cast<std::size_t>(nyu40id - 1)].nyu13;
}

std::array<std::uint8_t, 3> pascal_color(std::int32_t id) {
  std::array<std::uint8_t, 3> color{};
  for (int bit = 7; id > 0 && bit >= 0; --bit, id >>= 3) {
    for (int channel = 0; channel < 3; ++channel)
      color[static_cast<std::size_t>(channel)] |= static_cast<std::uint8_t>(((id >> channel) & 1) << bit);
  }
  return color;
}

ClassTable load_cvat_labelmap(const std::string& path) {
  std::vector<ClassEntry> entries;
  std::map<std::string, std::string> place_of_name;
  std::int32_t next = 1;
  bool has_zero = false;
  for (const TextRow& row : read_text_rows(path, ':')) {
    if (row.fields[0] == "label" && row.fields.size() > 1 && row.fields[1].starts_with("color"))
      continue;  // the header
    if (row.fields.size() < 2 || row.fields.size() > 4 || row.fields[0].empty())
      throw Error(ErrorKind::data, "classes.label_map.format", row.place + ": expected 'label:color_rgb:parts:actions'",
                  "export the label map from CVAT again");
    const std::string& name = row.fields[0];
    if (const auto [other, fresh] = place_of_name.emplace(name, row.place); !fresh)
      throw Error(ErrorKind::data, "classes.name.twice",
                  row.place + ": label '" + name + "' is in " + other->second + " too", "keep one of them");
    const bool ignore = name == "background" || is_void_name(name);
    const std::int32_t id = ignore && !has_zero ? 0 : next++;
    has_zero = has_zero || id == 0;
    // CVAT leaves the colour out where none was chosen.
    entries.push_back(
        {id, name, row.fields[1].empty() ? ClassTable::default_color(id) : color_of(row.fields[1], row.place), ignore});
  }
  if (entries.empty())
    throw Error(ErrorKind::data, "classes.label_map.format", path + ": no labels in it",
                "export the label map from CVAT again");
  return with_void(std::move(entries));
}

std::string to_cvat_labelmap(const ClassTable& classes) {
  std::string out = "# label:color_rgb:parts:actions\n";
  for (const ClassEntry& e : classes.entries()) {
    if (e.name.find_first_of(":\n") != std::string::npos)
      throw Error(ErrorKind::data, "classes.name.invalid",
                  "class '" + e.name + "': a label map cannot hold a name with ':'", "rename the class");
    out += e.name + ":" + std::to_string(e.color[0]) + "," + std::to_string(e.color[1]) + "," +
           std::to_string(e.color[2]) + "::\n";
  }
  return out;
}

std::string to_class_csv(const ClassTable& classes) {
  const std::vector<ClassEntry>& all = classes.entries();
  const bool plain =
      std::all_of(all.begin(), all.end(), [](const ClassEntry& e) { return e.ignore == is_void_entry(e.id, e.name); });
  std::string out = plain ? "class_id,class\n" : "class_id,class,ignore\n";
  for (const ClassEntry& e : all)
    out += std::to_string(e.id) + "," + csv_field(e.name) + (plain ? "" : e.ignore ? ",true" : ",false") + "\n";
  return out;
}

ClassTable load_scannet_classes(const std::string& path, ScannetIds ids) {
  std::map<std::int32_t, std::string> names;
  for (const ScannetLabel& label : read_scannet_tsv(path)) {
    const std::int32_t id = ids == ScannetIds::raw     ? label.id
                            : ids == ScannetIds::nyu40 ? label.nyu40id
                                                       : label.eigen13id;
    if (id == 0) continue;
    names.emplace(id, ids == ScannetIds::raw     ? label.raw_category
                      : ids == ScannetIds::nyu40 ? std::string(nyu40_name(id))
                                                 : std::string(kNyu13[static_cast<std::size_t>(id - 1)]));
  }
  std::vector<ClassEntry> entries;
  for (const auto& [id, name] : names) entries.push_back(pascal_entry(id, name));
  return with_void(std::move(entries));
}

ClassTable import_classes(const std::string& path) {
  const std::string extension = std::filesystem::path(path).extension().string();
  if (extension == ".txt") return load_cvat_labelmap(path);
  if (extension == ".tsv") return load_scannet_classes(path, ScannetIds::raw);
  return ClassTable::load(path);
}

namespace {

struct Column {
  std::string_view name;
  std::optional<std::size_t> at;
};

Column column_of(const TextRow& header, std::string_view name) {
  const auto found = std::find(header.fields.begin(), header.fields.end(), name);
  if (found == header.fields.end()) return {name, std::nullopt};
  return {name, static_cast<std::size_t>(found - header.fields.begin())};
}

const std::string& text_at(const TextRow& row, const Column& column) {
  static const std::string none;
  return column.at ? row.fields[*column.at] : none;
}

std::int32_t number_at(const TextRow& row, const Column& column, std::int64_t highest) {
  const std::string& text = text_at(row, column);
  if (text.empty()) return 0;
  std::int64_t value = 0;
  if (!parse_whole(text, value) || value < 0 || value > highest) {
    throw Error(ErrorKind::data, "classes.tsv.damaged",
                row.place + ": " + std::string(column.name) + ": expected a number from 0 to " +
                    std::to_string(highest) + ", got '" + text + "'",
                "restore the table as ScanNet distributes it");
  }
  return static_cast<std::int32_t>(value);
}

template <class Member>
std::unordered_map<std::int32_t, std::int32_t> map_of(const std::vector<ScannetLabel>& labels, Member member) {
  std::unordered_map<std::int32_t, std::int32_t> out;
  for (const ScannetLabel& label : labels) out.emplace(label.id, label.*member);
  return out;
}

}  // namespace

std::vector<ScannetLabel> read_scannet_tsv(const std::string& path) {
  const std::vector<TextRow> rows = read_text_rows(path, '\t');
  const std::string remedy = "give scannetv2-labels.combined.tsv: tab-separated, with a line of column names";
  if (rows.empty()) throw Error(ErrorKind::data, "classes.tsv.damaged", path + ": no rows in it", remedy);
  const TextRow& header = rows.front();
  const Column id = column_of(header, "id"), raw = column_of(header, "raw_category"),
               nyu40 = column_of(header, "nyu40id"), eigen13 = column_of(header, "eigen13id"),
               nyu40_name = column_of(header, "nyu40class"), eigen13_name = column_of(header, "eigen13class");
  for (const Column& needed : {id, raw}) {
    if (!needed.at)
      throw Error(ErrorKind::data, "classes.tsv.damaged",
                  header.place + ": no column '" + std::string(needed.name) + "'", remedy);
  }
  if (!nyu40.at && !eigen13.at)
    throw Error(ErrorKind::data, "classes.tsv.damaged",
                header.place + ": neither a column 'nyu40id' nor a column 'eigen13id'", remedy);

  std::vector<ScannetLabel> labels;
  std::unordered_map<std::int32_t, std::size_t> seen;
  for (std::size_t r = 1; r < rows.size(); ++r) {
    const TextRow& row = rows[r];
    if (row.fields.size() != header.fields.size()) {
      throw Error(ErrorKind::data, "classes.tsv.damaged",
                  row.place + ": " + std::to_string(row.fields.size()) + " columns, the first line names " +
                      std::to_string(header.fields.size()),
                  remedy);
    }
    if (text_at(row, id).empty())
      throw Error(ErrorKind::data, "classes.tsv.damaged", row.place + ": the row has no id", remedy);
    ScannetLabel label{number_at(row, id, 65535),   text_at(row, raw),        number_at(row, nyu40, 40),
                       number_at(row, eigen13, 13), text_at(row, nyu40_name), text_at(row, eigen13_name)};
    const auto [first, fresh] = seen.emplace(label.id, labels.size());
    if (!fresh) {
      const ScannetLabel& other = labels[first->second];
      if (other.nyu40id != label.nyu40id || other.eigen13id != label.eigen13id) {
        throw Error(ErrorKind::data, "classes.id.twice",
                    row.place + ": id " + std::to_string(label.id) + " ('" + label.raw_category +
                        "') is given before ('" + other.raw_category + "') with another class",
                    remedy);
      }
    }
    labels.push_back(std::move(label));
  }
  return labels;
}

std::unordered_map<std::int32_t, std::int32_t> nyu40_of_scannet(const std::vector<ScannetLabel>& labels) {
  return map_of(labels, &ScannetLabel::nyu40id);
}

std::unordered_map<std::int32_t, std::int32_t> eigen13_of_scannet(const std::vector<ScannetLabel>& labels) {
  return map_of(labels, &ScannetLabel::eigen13id);
}

}  // namespace semfield
