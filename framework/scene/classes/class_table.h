// Classes: ids as on disk, names, colours, and the internal numbering 0..C-1.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

/// Internal label of a pixel that no loss and no metric reads.
inline constexpr std::int16_t kVoid = -1;

struct ClassEntry {
  std::int32_t id = 0;  ///< as stored in label images
  std::string name;
  std::array<std::uint8_t, 3> color{};  ///< sRGB
  bool ignore = false;                  ///< true: void (no logit, no score)
};

/// Ordered by id. Internal index c = position among the entries that are not ignored.
class ClassTable {
 public:
  ClassTable() = default;
  /// Throws Error(data) for duplicate or negative ids and for more than 1,024 valid classes.
  explicit ClassTable(std::vector<ClassEntry> entries);

  const std::vector<ClassEntry>& entries() const { return entries_; }
  int valid_count() const { return static_cast<int>(valid_.size()); }
  const ClassEntry& valid(int index) const {
    return entries_[static_cast<std::size_t>(valid_[static_cast<std::size_t>(index)])];
  }
  /// Internal index, kVoid for ignored ids, or -2 for an id that is not in the table.
  int index_of(std::int32_t id) const;
  /// Id to write for an internal index; void writes the first ignored id, or 0 without one.
  std::int32_t id_of(int index) const;
  bool empty() const { return entries_.empty(); }

  /// classes.yaml: a list of {id, name, color: [r, g, b], ignore}; classes.csv: columns id and name, and red, green,
  /// blue, color and ignore where its first line names them; info_semantic.json. What does not say `ignore` is ignored
  /// where is_void_entry(id, name). Errors name file and line.
  static ClassTable load(const std::string& path);
  std::string to_yaml() const;
  /// A fixed, well separated palette for tables without colours.
  static std::array<std::uint8_t, 3> default_color(std::int32_t id);

 private:
  std::vector<ClassEntry> entries_;
  std::vector<int> valid_;              // internal index -> entry
  std::vector<std::int32_t> index_of_;  // id -> internal index / kVoid / -2
};

}  // namespace semfield
