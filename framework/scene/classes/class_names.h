// Classes by name: what label files say, as the indices of a class table.
#pragma once

#include <cstdint>
#include <set>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "scene/classes/class_table.h"

namespace semfield {

/// A word by which labelling tools and data sets say that a pixel has no class, in any case and between any brackets or
/// underscores: "void", "Unlabelled", "ignore", "__ignore__", "(none)", "other", ...; "_background_" and
/// "__background__" too, as labelme and networks write it, but not "background", which is a class like others.
bool is_void_name(std::string_view name);
/// Whether a row of a class table that does not tell what is ignored means void: is_void_name(), but with other ids
/// than 0 "other" and "unknown" are classes, as many data sets have them.
bool is_void_entry(std::int32_t id, std::string_view name);

/// Name of a class that has a logit and waits for its name: "unnamed 7" for id 7; and whether a name is one of these.
std::string unnamed_class(std::int32_t id);
bool is_unnamed_class(std::string_view name);
/// The table without the classes that wait for their names.
ClassTable named_classes(const ClassTable& classes);

/// Names of a table, exact to the letter. A name for void that the table does not have means void.
class ClassNames {
 public:
  explicit ClassNames(const ClassTable& classes);
  /// Internal index, kVoid for an ignored class and for void, -2 for a name that is not in the table; of a name given
  /// twice the entry with the lower id.
  int find(const std::string& name) const;
  /// As find(); throws Error(data) "PLACE: no class 'chiar'; did you mean 'chair'?" for a name that is not there, and
  /// for one that two classes of the table have.
  std::int16_t index_of(const std::string& name, const std::string& place) const;
  /// "did you mean 'chair'?", or what else to do about a name that is not there.
  std::string remedy_for(const std::string& name) const;

 private:
  std::vector<std::string> known_;
  std::unordered_map<std::string, int> index_;
  std::set<std::string> twice_;  // names of two classes
};

/// A table for label files that bring names alone: ids 1, 2, ... in the given order, void names ignored, and a void
/// class, id 0. Colours by default_color.
ClassTable table_of_names(const std::vector<std::string>& names);

/// `entries` with an ignored class added where there is none: id 0, or the smallest id that is free.
ClassTable with_void(std::vector<ClassEntry> entries);

}  // namespace semfield
