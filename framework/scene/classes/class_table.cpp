// Class tables: reading, numbering, writing.
#include "scene/classes/class_table.h"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <utility>

#include "config/config_tree.h"
#include "core/check.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/text_rows.h"

namespace semfield {

namespace {

constexpr std::int32_t kMaxId = 65535;  // what a 16-bit label image can hold

// A whole number of at least `low` and at most `high`.
bool parse_int(std::string_view text, std::int32_t& out, std::int32_t low = std::numeric_limits<std::int32_t>::min(),
               std::int32_t high = std::numeric_limits<std::int32_t>::max()) {
  const std::optional<std::int32_t> number = to_number<std::int32_t>(text);
  out = number.value_or(out);
  return number && out >= low && out <= high;
}

// As a table has it that tells neither colours nor what is void.
ClassEntry plain_entry(std::int32_t id, std::string name) {
  const bool ignore = is_void_entry(id, name);
  return {id, std::move(name), ClassTable::default_color(id), ignore};
}

[[noreturn]] void refuse(Code code, const std::string& place, const std::string& message,
                         const std::string& remedy = {}) {
  throw Error(ErrorKind::data, code, place + ": " + message, remedy);
}

constexpr const char* kCsvRemedy = "write one line 'id,name' for each class";
constexpr const char* kCvatRemedy = "write lines 'label:r,g,b::'";
constexpr const char* kYamlRemedy = "write lines such as - {id: 3, name: lamp}";

enum CsvColumn : std::size_t { kId, kName, kRed, kGreen, kBlue, kIgnore, kColor };

// "true" and what spreadsheets make of it; "" is false.
bool truth_of(std::string text, const std::string& place) {
  text = lower_case(std::move(text));
  if (text == "true" || text == "1" || text == "yes") return true;
  if (text.empty() || text == "false" || text == "0" || text == "no") return false;
  refuse("classes.table.value", place, "ignore: expected true or false, got '" + text + "'");
}

// "#aeC7e8" as "174", "199", "232"; else the numbers of "174,199,232" or "(174 199 232)".
std::vector<std::string> color_values(const std::string& text) {
  std::vector<std::string> out;
  if (text.size() == 7 && text[0] == '#') {
    for (std::size_t i = 1; i < 7; i += 2) {
      unsigned value = 256;
      const auto end = std::from_chars(text.data() + i, text.data() + i + 2, value, 16).ptr;
      out.push_back(end == text.data() + i + 2 ? std::to_string(value) : text);
    }
    return out;
  }
  std::string plain = text;
  for (char& c : plain) c = std::string_view("[](),;/").find(c) == std::string_view::npos ? c : ' ';
  for (const std::string_view word : words_of(plain)) out.emplace_back(word);
  return out;
}

ClassEntry csv_entry(const TextRow& row, bool says_ignore) {
  const std::vector<std::string>& f = row.fields;
  std::int32_t id = 0;
  if (!parse_int(f[kId], id))
    refuse("classes.table.format", row.place, "expected a class id, got '" + f[kId] + "'", kCsvRemedy);
  if (f[kName].empty()) refuse("classes.table.format", row.place, "class " + f[kId] + " has no name", kCsvRemedy);
  ClassEntry entry = plain_entry(id, f[kName]);
  if (says_ignore) entry.ignore = truth_of(f[kIgnore], row.place);
  std::vector<std::string> color{f[kRed], f[kGreen], f[kBlue]};
  if (!f[kColor].empty()) color = color_values(f[kColor]);
  if (std::all_of(color.begin(), color.end(), [](const std::string& value) { return value.empty(); })) return entry;
  for (std::size_t i = 0; i < 3; ++i) {
    std::int32_t value = 0;
    if (color.size() != 3 || !parse_int(color[i], value, 0, 255))
      refuse("classes.table.value", row.place,
             "colour: expected three numbers from 0 to 255, got '" + join(color, ",") + "'",
             "put a name that holds a comma in double quotes, and colours in columns red, green and blue");
    entry.color[i] = static_cast<std::uint8_t>(value);
  }
  return entry;
}

ClassTable load_csv(const std::string& path) {
  (void)read_text_file(path, std::size_t{4} << 20);  // refuses what is too large for a class table
  const TextTable table = read_text_table(
      path, {{"id", "class_id", "classid", "label_id", "labelid", "category_id", "class_index", "index", "value",
              "label", "class"},
             {"name", "class", "class_name", "classname", "label", "label_name", "category", "category_name"},
             {"red", "r"},
             {"green", "g"},
             {"blue", "b"},
             {"ignore", "ignored", "void"},
             {"color", "colour", "rgb", "hex"}});
  for (const auto& [column, name] : {std::pair{kId, "id"}, {kName, "name"}})
    if (!table.header.empty() && table.has[column] == 0)
      refuse("classes.table.format", table.header, fmt::format("no column '{}'", name),
             "name the columns id,name or id,name,red,green,blue");
  std::vector<ClassEntry> entries;
  for (const TextRow& row : table.rows) entries.push_back(csv_entry(row, table.has[kIgnore] != 0));
  if (entries.empty()) refuse("classes.table.format", path, "no classes in it", kCsvRemedy);
  return ClassTable(std::move(entries));
}

// Replica's info_semantic.json: {"classes": [{"id": 1, "name": "backpack"}, ...]}; id 0 stands for undefined there.
ClassTable load_json(const std::string& path) {
  nlohmann::json root;
  try {
    root = nlohmann::json::parse(read_text_file(path));
  } catch (const nlohmann::json::exception& e) {
    refuse("classes.table.format", path, "not valid JSON: " + json_cause(e.what()), "export the table again");
  }
  const nlohmann::json* list = root.is_array()                                ? &root
                               : root.is_object() && root.contains("classes") ? &root["classes"]
                                                                              : nullptr;
  if (list == nullptr || !list->is_array())
    refuse("classes.table.format", path, "no list 'classes' in it",
           "write {\"classes\": [{\"id\": 1, \"name\": \"wall\"}, ...]}");
  std::vector<ClassEntry> entries;
  bool has_zero = false;
  for (const nlohmann::json& item : *list) {
    if (!item.is_object() || !item.contains("id") || !item["id"].is_number_integer() || !item.contains("name") ||
        !item["name"].is_string())
      refuse("classes.table.format", path,
             fmt::format("class {} of the list needs an integer 'id' and a text 'name'", entries.size()),
             "export the table again");
    const auto id = item["id"].get<std::int64_t>();
    if (id < 0) continue;  // Replica writes -1 for "no class"
    if (id > kMaxId)
      refuse("classes.table.id", path, "class id " + std::to_string(id) + " is above " + std::to_string(kMaxId));
    entries.push_back(plain_entry(static_cast<std::int32_t>(id), item["name"].get<std::string>()));
    has_zero = has_zero || id == 0;
  }
  if (!has_zero) entries.push_back({0, "undefined", ClassTable::default_color(0), true});
  return ClassTable(std::move(entries));
}

std::int32_t scalar_int(const ConfigNode& node, const std::string& what, std::int32_t low, std::int32_t high) {
  std::int32_t value = 0;
  if (node.is_scalar() && !node.quoted() && parse_int(node.text(), value, low, high)) return value;
  refuse("classes.table.value", node.location().text(),
         fmt::format("{}: expected an integer from {} to {}, got '{}'", what, low, high, node.text()));
}

ClassEntry yaml_entry(const ConfigNode& item) {
  const std::string place = item.location().text();
  if (!item.is_map()) refuse("classes.table.format", place, "a class is a map {id, name, color, ignore}", kYamlRemedy);
  static const std::vector<std::string> keys{"id", "name", "color", "ignore"};
  for (const auto& [key, value] : item.entries())
    if (std::find(keys.begin(), keys.end(), key) == keys.end())
      refuse("config.key.unknown", value.location().text(), "unknown key '" + key + "' of a class",
             near_name_remedy(key, keys, "known: " + join(keys)));
  const ConfigNode* id = item.find("id");
  const ConfigNode* name = item.find("name");
  if (id == nullptr) refuse("classes.table.format", place, "a class needs an 'id'", kYamlRemedy);
  const std::int32_t number = scalar_int(*id, "id", 0, kMaxId);
  if (name == nullptr || !name->is_scalar() || name->text().empty())
    refuse("classes.table.format", place, "class " + std::to_string(number) + " needs a 'name'", kYamlRemedy);
  ClassEntry entry = plain_entry(number, name->text());
  if (const ConfigNode* color = item.find("color"); color != nullptr && !color->is_null()) {
    if (!color->is_list() || color->items().size() != 3)
      refuse("classes.table.value", color->location().text(), "color: expected [r, g, b]");
    for (std::size_t i = 0; i < 3; ++i)
      entry.color[i] = static_cast<std::uint8_t>(scalar_int(color->items()[i], "color", 0, 255));
  }
  if (const ConfigNode* ignore = item.find("ignore"); ignore != nullptr) {
    if (ignore->text() != "true" && ignore->text() != "false")
      refuse("classes.table.value", ignore->location().text(),
             "ignore: expected true or false, got '" + ignore->text() + "'");
    entry.ignore = ignore->text() == "true";
  }
  return entry;
}

ClassTable load_yaml(const std::string& path) {
  const ConfigNode root = parse_config_file(path);
  const ConfigNode* list = root.is_list() ? &root : root.find("classes");
  if (list == nullptr || !list->is_list())
    refuse("classes.table.format", path, "expected a list of classes {id, name, color, ignore}", kYamlRemedy);
  std::vector<ClassEntry> entries;
  for (const ConfigNode& item : list->items()) entries.push_back(yaml_entry(item));
  return ClassTable(std::move(entries));
}

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    out += c == '\n' ? "\\n" : c == '\t' ? "\\t" : std::string(1, c);
  }
  return out + "\"";
}

}  // namespace

ClassTable::ClassTable(std::vector<ClassEntry> entries) : entries_(std::move(entries)) {
  std::stable_sort(entries_.begin(), entries_.end(),
                   [](const ClassEntry& a, const ClassEntry& b) { return a.id < b.id; });
  for (std::size_t i = 0; i < entries_.size(); ++i) {
    const ClassEntry& e = entries_[i];
    if (e.id < 0 || e.id > kMaxId)
      throw Error(ErrorKind::data, "classes.table.id", fmt::format("class '{}' has id {}", e.name, e.id),
                  fmt::format("ids run from 0 to {}", kMaxId));
    if (!is_line_of_text(e.name))
      throw Error(ErrorKind::data, "classes.name.invalid",
                  fmt::format("the name of class {} has control characters or is not UTF-8", e.id),
                  "give it a plain name, and save the file as UTF-8");
    if (i > 0 && entries_[i - 1].id == e.id)
      throw Error(ErrorKind::data, "classes.id.twice",
                  fmt::format("class id {} is given twice ('{}' and '{}')", e.id, entries_[i - 1].name, e.name),
                  "keep one of them");
    if (!e.ignore) valid_.push_back(static_cast<int>(i));
  }
  check_input_limit(std::ssize(valid_), input_limits().classes, "", "classes", "classes");
  if (!entries_.empty()) index_of_.assign(static_cast<std::size_t>(entries_.back().id) + 1, -2);
  for (const ClassEntry& e : entries_) index_of_[static_cast<std::size_t>(e.id)] = kVoid;
  for (int c = 0; c < valid_count(); ++c) index_of_[static_cast<std::size_t>(valid(c).id)] = c;
}

int ClassTable::index_of(std::int32_t id) const {
  if (id < 0 || static_cast<std::size_t>(id) >= index_of_.size()) return -2;
  return index_of_[static_cast<std::size_t>(id)];
}

std::int32_t ClassTable::id_of(int index) const {
  if (index >= 0 && index < valid_count()) return valid(index).id;
  const auto ignored = std::find_if(entries_.begin(), entries_.end(), [](const ClassEntry& e) { return e.ignore; });
  return ignored == entries_.end() ? 0 : ignored->id;
}

ClassTable ClassTable::load(const std::string& path) {
  const std::string extension = fs::path(path).extension().string();
  try {
    if (extension == ".csv") return load_csv(path);
    if (extension == ".json") return load_json(path);
    if (extension == ".yaml" || extension == ".yml") return load_yaml(path);
  } catch (Error& e) {
    if (e.message().find(path) != std::string::npos) throw;
    throw Error(e.kind(), e.code(), path + ": " + e.message(), e.remedy());
  }
  throw Error(ErrorKind::data, "classes.table.format", "'" + path + "' is not a class table",
              "give a .yaml, .csv or .json file");
}

std::string ClassTable::to_yaml() const {
  std::string out;
  for (const ClassEntry& e : entries_)
    out += fmt::format("- {{id: {}, name: {}, color: [{}, {}, {}], ignore: {}}}\n", e.id, quoted(e.name), e.color[0],
                       e.color[1], e.color[2], e.ignore);
  return out.empty() ? "[]\n" : out;
}

std::array<std::uint8_t, 3> ClassTable::default_color(std::int32_t id) {
  if (id == 0) return {0, 0, 0};
  // Hue by the golden ratio keeps any run of ids apart; three levels of saturation and value tell the near hues from
  // each other.
  const double hue = std::fmod(static_cast<double>(id) * 0.61803398874989485, 1.0) * 6.0;
  const double saturation = (id % 3 == 0) ? 0.55 : (id % 3 == 1) ? 0.85 : 0.7;
  const double value = (id / 3 % 3 == 0) ? 0.95 : (id / 3 % 3 == 1) ? 0.7 : 0.82;
  const auto channel = [&](double shift) {
    const double k = std::fmod(shift + hue, 6.0);
    const double c = value - value * saturation * std::clamp(std::min(k, 4.0 - k), 0.0, 1.0);
    return static_cast<std::uint8_t>(std::lround(c * 255.0));
  };
  return {channel(5), channel(3), channel(1)};
}

namespace {

// Small letters and digits between others than these at both ends; whatever is in between is one blank.
std::string bare_word(std::string_view name) {
  std::string out;
  bool gap = false;
  for (const char c : name) {
    const auto byte = static_cast<unsigned char>(c);
    if (byte < 128 && std::isalnum(byte) == 0) {
      gap = !out.empty();
      continue;
    }
    if (gap) out += ' ';
    gap = false;
    out += static_cast<char>(std::tolower(byte));
  }
  return out;
}

}  // namespace

bool is_void_name(std::string_view name) {
  static const std::set<std::string, std::less<>> words{
      "void",    "undefined",  "unlabelled",   "unlabeled", "unknown",    "other",       "ignore",
      "ignored", "none",       "null",         "no label",  "nolabel",    "no class",    "unannotated",
      "invalid", "unassigned", "unclassified", "dont care", "don t care", "not labeled", "not labelled"};
  const std::string word = bare_word(name);
  return words.contains(word) || (word == "background" && name.starts_with('_'));
}

bool is_void_entry(std::int32_t id, std::string_view name) {
  const std::string word = bare_word(name);
  return is_void_name(name) && (id == 0 || (word != "other" && word != "unknown"));
}

namespace {
constexpr std::string_view kUnnamed = "unnamed ";
}

std::string unnamed_class(std::int32_t id) { return std::string(kUnnamed) + std::to_string(id); }

bool is_unnamed_class(std::string_view name) {
  return name.starts_with(kUnnamed) && name.size() > kUnnamed.size() &&
         name.find_first_not_of("0123456789", kUnnamed.size()) == std::string_view::npos;
}

ClassTable named_classes(const ClassTable& classes) {
  std::vector<ClassEntry> entries = classes.entries();
  std::erase_if(entries, [](const ClassEntry& entry) { return is_unnamed_class(entry.name); });
  return ClassTable(std::move(entries));
}

ClassNames::ClassNames(const ClassTable& classes) {
  for (const ClassEntry& entry : classes.entries()) {
    const int index = classes.index_of(entry.id);
    const auto [other, fresh] = index_.emplace(entry.name, index);
    if (fresh) known_.push_back(entry.name);
    if (!fresh && other->second != index) twice_.insert(entry.name);
  }
}

int ClassNames::find(const std::string& name) const {
  const auto found = index_.find(name);
  if (found != index_.end()) return found->second;
  return is_void_name(name) ? kVoid : -2;
}

std::int16_t ClassNames::index_of(const std::string& name, const std::string& place) const {
  const int index = find(name);
  if (index == -2)
    throw Error(ErrorKind::data, "labels.class.unknown", place + ": no class '" + name + "'", remedy_for(name));
  if (twice_.contains(name))
    throw Error(ErrorKind::data, "classes.name.twice",
                place + ": the class table has '" + name + "' twice, so the name means no one class",
                "give each class of the table its own name");
  return static_cast<std::int16_t>(index);
}

std::string ClassNames::remedy_for(const std::string& name) const {
  return near_name_remedy(name, known_, "add the class to the class table, or rename the label");
}

ClassTable table_of_names(const std::vector<std::string>& names) {
  std::vector<ClassEntry> entries;
  bool has_zero = false;
  std::int32_t next = 1;
  for (const std::string& name : names) {
    const bool ignore = is_void_name(name);
    const std::int32_t id = ignore && !has_zero ? 0 : next++;
    has_zero = has_zero || id == 0;
    entries.push_back({id, name, ClassTable::default_color(id), ignore});
  }
  return with_void(std::move(entries));
}

ClassTable with_void(std::vector<ClassEntry> entries) {
  if (std::any_of(entries.begin(), entries.end(), [](const ClassEntry& e) { return e.ignore; }))
    return ClassTable(std::move(entries));
  std::set<std::int32_t> taken;
  for (const ClassEntry& entry : entries) taken.insert(entry.id);
  std::int32_t id = 0;
  while (taken.count(id) != 0) ++id;
  entries.push_back({id, "void", {0, 0, 0}, true});
  return ClassTable(std::move(entries));
}

SoftMap::SoftMap(std::size_t pixels, int classes)
    : classes_(classes), values_(pixels * static_cast<std::size_t>(classes)) {}

void SoftMap::row(std::size_t pixel, std::span<float> out) const {
  const auto width = static_cast<std::size_t>(classes_);
  SEMFIELD_CHECK(out.size() == width, "row of another width");
  for (std::size_t c = 0; c < width; ++c) out[c] = float_of_half(values_[pixel * width + c]);
}

void SoftMap::set_row(std::size_t pixel, std::span<const float> probability) {
  const auto width = static_cast<std::size_t>(classes_);
  SEMFIELD_CHECK(probability.size() == width, "row of another width");
  for (std::size_t c = 0; c < width; ++c) {
    if (!(probability[c] >= 0) || !std::isfinite(probability[c]))
      throw Error(ErrorKind::data, "labels.probability.invalid",
                  fmt::format("probability of class {} at pixel {} is {:f}", c, pixel, probability[c]),
                  "probabilities are finite and not negative");
    values_[pixel * width + c] = half_of(probability[c]);
  }
}

std::int16_t SoftMap::argmax(std::size_t pixel) const {
  // Halves of non-negative values are ordered as their bits.
  const auto width = static_cast<std::size_t>(classes_);
  std::int16_t best = kVoid;
  std::uint16_t most = 0;
  for (std::size_t c = 0; c < width; ++c) {
    const std::uint16_t value = values_[pixel * width + c];
    if (value > most && value <= 0x7C00u) {
      most = value;
      best = static_cast<std::int16_t>(c);
    }
  }
  return best;
}

namespace {

// Names of the ids 1, 2, ..., with '_' for blanks.
constexpr std::string_view kNyu13 = "bed books ceiling chair floor furniture objects picture sofa table tv wall window";
constexpr std::string_view kNyu40 =
    "wall floor cabinet bed chair sofa table door window bookshelf picture counter blinds desk shelves curtain dresser "
    "pillow mirror floor_mat clothes ceiling books refrigerator television paper towel shower_curtain box whiteboard "
    "person night_stand toilet sink lamp bathtub bag otherstructure otherfurniture otherprop";

// ScanNet's twenty of NYU40, with the colours of its pictures.
constexpr std::array<std::pair<std::int32_t, std::uint32_t>, 20> kScannet20{
    {{1, 0xAEC7E8},  {2, 0x98DF8A},  {3, 0x1F77B4},  {4, 0xFFBB78},  {5, 0xBCBD22},  {6, 0x8C564B},  {7, 0xFF9896},
     {8, 0xD62728},  {9, 0xC5B0D5},  {10, 0x9467BD}, {11, 0xC49C94}, {12, 0x17BECF}, {14, 0xF7B6D2}, {16, 0xDBDB8D},
     {24, 0xFF7F0E}, {28, 0x9EDAE5}, {33, 0x2CA02C}, {34, 0x708090}, {36, 0xE377C2}, {39, 0x5254A3}}};

std::string name_in(std::string_view names, std::int32_t id) {
  std::string name(words_of(names)[static_cast<std::size_t>(id - 1)]);
  std::replace(name.begin(), name.end(), '_', ' ');
  return name;
}

ClassEntry pascal_entry(std::int32_t id, std::string name) { return {id, std::move(name), pascal_color(id), false}; }

// Of "r,g,b".
std::array<std::uint8_t, 3> color_of(const std::string& text, const std::string& place) {
  std::array<std::uint8_t, 3> out{};
  std::size_t at = 0;
  if (std::count(text.begin(), text.end(), ',') < 2)
    refuse("classes.label_map.color", place, "expected a colour 'r,g,b', got '" + text + "'", kCvatRemedy);
  for (std::uint8_t& channel : out) {
    const std::size_t end = &channel == &out[2] ? text.size() : text.find(',', at);
    const std::string one = text.substr(at, end - at);
    std::int32_t value = 0;
    if (!parse_int(one, value, 0, 255))
      refuse("classes.label_map.color", place, "expected a colour value from 0 to 255, got '" + one + "'", kCvatRemedy);
    channel = static_cast<std::uint8_t>(value);
    at = end + 1;
  }
  return out;
}

}  // namespace

std::vector<std::string> published_class_names() { return {"nyu13", "nyu40", "scannet20"}; }

ClassTable published_classes(const std::string& name) {
  std::vector<ClassEntry> entries;
  if (name == "nyu13" || name == "nyu40") {
    const std::string_view names = name == "nyu13" ? kNyu13 : kNyu40;
    for (std::int32_t id = 1; id <= std::ssize(words_of(names)); ++id)
      entries.push_back(pascal_entry(id, name_in(names, id)));
  } else if (name == "scannet20") {
    for (const auto& [id, rgb] : kScannet20) {
      const auto channel = [color = rgb](int shift) { return static_cast<std::uint8_t>(color >> shift); };
      entries.push_back({id, name_in(kNyu40, id), {channel(16), channel(8), channel(0)}, false});
    }
  } else {
    const std::vector<std::string> known = published_class_names();
    throw Error(ErrorKind::usage, "classes.published.unknown",
                "no published class table '" + name + "'; known: " + join(known),
                near_name_remedy(name, known, "take one of them, or a .yaml, .csv or .json file"));
  }
  return with_void(std::move(entries));
}

std::array<std::uint8_t, 3> pascal_color(std::int32_t id) {
  std::array<std::uint8_t, 3> color{};
  for (int bit = 7; id > 0 && bit >= 0; --bit, id >>= 3) {
    for (int channel = 0; channel < 3; ++channel)
      color[static_cast<std::size_t>(channel)] |= static_cast<std::uint8_t>(((id >> channel) & 1) << bit);
  }
  return color;
}

static ClassTable load_cvat_labelmap(const std::string& path) {
  std::vector<ClassEntry> entries;
  std::map<std::string, std::string> place_of_name;
  std::int32_t next = 1;
  bool has_zero = false;
  for (const TextRow& row : read_text_rows(path, ':')) {
    if (row.fields[0] == "label" && row.fields.size() > 1 && row.fields[1].starts_with("color"))
      continue;  // the header
    if (row.fields.size() < 2 || row.fields.size() > 4 || row.fields[0].empty())
      refuse("classes.label_map.format", row.place, "expected 'label:color_rgb:parts:actions'",
             "export the label map from CVAT again");
    const std::string& name = row.fields[0];
    if (const auto [other, fresh] = place_of_name.emplace(name, row.place); !fresh)
      refuse("classes.name.twice", row.place, "label '" + name + "' is in " + other->second + " too",
             "keep one of them");
    const bool ignore = name == "background" || is_void_name(name);
    const std::int32_t id = ignore && !has_zero ? 0 : next++;
    has_zero = has_zero || id == 0;
    // CVAT leaves the colour out where none was chosen.
    entries.push_back(
        {id, name, row.fields[1].empty() ? ClassTable::default_color(id) : color_of(row.fields[1], row.place), ignore});
  }
  if (entries.empty())
    refuse("classes.label_map.format", path, "no labels in it", "export the label map from CVAT again");
  return with_void(std::move(entries));
}

std::string to_cvat_labelmap(const ClassTable& classes) {
  std::string out = "# label:color_rgb:parts:actions\n";
  for (const ClassEntry& e : classes.entries()) {
    if (e.name.find_first_of(":\n") != std::string::npos)
      throw Error(ErrorKind::data, "classes.name.invalid",
                  "class '" + e.name + "': a label map cannot hold a name with ':'", "rename the class");
    out += fmt::format("{}:{},{},{}::\n", e.name, e.color[0], e.color[1], e.color[2]);
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
    const std::int32_t id = label.id_in(ids);
    if (id == 0) continue;
    names.emplace(id, ids == ScannetIds::raw     ? label.raw_category
                      : ids == ScannetIds::nyu40 ? name_in(kNyu40, id)
                                                 : name_in(kNyu13, id));
  }
  std::vector<ClassEntry> entries;
  for (const auto& [id, name] : names) entries.push_back(pascal_entry(id, name));
  return with_void(std::move(entries));
}

ClassTable import_classes(const std::string& path) {
  const std::string extension = fs::path(path).extension().string();
  if (extension == ".txt") return load_cvat_labelmap(path);
  if (extension == ".tsv") return load_scannet_classes(path, ScannetIds::raw);
  return ClassTable::load(path);
}

std::vector<ScannetLabel> read_scannet_tsv(const std::string& path) {
  const std::vector<TextRow> rows = read_text_rows(path, '\t');
  const std::string remedy = "give scannetv2-labels.combined.tsv: tab-separated, with a line of column names";
  const auto damaged = [&](const std::string& place, const std::string& what) {
    refuse("classes.tsv.damaged", place, what, remedy);
  };
  if (rows.empty()) damaged(path, "no rows in it");
  const auto& [header, names] = rows.front();
  const std::size_t columns = names.size();
  // `columns` where there is none.
  const auto column = [&names = names](std::string_view name) {
    return static_cast<std::size_t>(std::ranges::find(names, name) - names.begin());
  };
  for (const char* needed : {"id", "raw_category"})
    if (column(needed) == columns) damaged(header, fmt::format("no column '{}'", needed));
  if (column("nyu40id") == columns && column("eigen13id") == columns)
    damaged(header, "neither a column 'nyu40id' nor a column 'eigen13id'");

  // 0 of an empty field, and without the column.
  const auto number_at = [&](const TextRow& row, const char* name, std::int32_t highest) {
    const std::size_t at = column(name);
    const std::string text = at < columns ? row.fields[at] : "";
    std::int32_t value = 0;
    if (!text.empty() && !parse_int(text, value, 0, highest))
      refuse("classes.tsv.damaged", row.place,
             fmt::format("{}: expected a number from 0 to {}, got '{}'", name, highest, text),
             "restore the table as ScanNet distributes it");
    return value;
  };
  std::vector<ScannetLabel> labels;
  std::unordered_map<std::int32_t, ScannetLabel> seen;
  for (std::size_t r = 1; r < rows.size(); ++r) {
    const TextRow& row = rows[r];
    if (row.fields.size() != columns)
      damaged(row.place, fmt::format("{} columns, the first line names {}", row.fields.size(), columns));
    if (row.fields[column("id")].empty()) damaged(row.place, "the row has no id");
    ScannetLabel label{number_at(row, "id", kMaxId), row.fields[column("raw_category")], number_at(row, "nyu40id", 40),
                       number_at(row, "eigen13id", 13)};
    const ScannetLabel& other = seen.emplace(label.id, label).first->second;
    if (other.nyu40id != label.nyu40id || other.eigen13id != label.eigen13id)
      refuse("classes.id.twice", row.place,
             fmt::format("id {} ('{}') is given before ('{}') with another class", label.id, label.raw_category,
                         other.raw_category),
             remedy);
    labels.push_back(std::move(label));
  }
  return labels;
}

}  // namespace semfield
