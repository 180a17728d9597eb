#include "scene/classes/class_names.h"

#include <algorithm>
#include <cctype>
#include <functional>
#include <set>

namespace semfield {

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
  if (!name.starts_with(kUnnamed) || name.size() == kUnnamed.size()) return false;
  name.remove_prefix(kUnnamed.size());
  return name.find_first_not_of("0123456789") == std::string_view::npos;
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
  const std::string near = did_you_mean(name, known_);
  return near.empty() ? "add the class to the class table, or rename the label" : "did you mean '" + near + "'?";
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

}  // namespace semfield
