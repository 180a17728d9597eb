// Classes: ids as on disk, names, colours, and the internal numbering 0..C-1.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <set>
#include <span>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "core/error.h"
#include "core/half.h"

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

// Classes by name: what label files say, as the indices of a class table.

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

/// `entries` with an ignored class "void" added where there is none: id 0, or the smallest id that is free. So label
/// images can be written of any class table; internal indices do not change.
ClassTable with_void(std::vector<ClassEntry> entries);

// Class probabilities of one frame's pixels, two bytes each.

/// [H * W, C] probabilities of internal class indices as binary16. A row need not sum to 1 (the rest is "some other
/// class"); a row of zeros is unlabelled.
class SoftMap {
 public:
  SoftMap() = default;
  SoftMap(std::size_t pixels, int classes);

  bool empty() const { return values_.empty(); }
  std::size_t pixels() const { return classes_ == 0 ? 0 : values_.size() / static_cast<std::size_t>(classes_); }
  int classes() const { return classes_; }
  float at(std::size_t pixel, int cls) const {
    return float_of_half(values_[pixel * static_cast<std::size_t>(classes_) + static_cast<std::size_t>(cls)]);
  }
  /// Row of a pixel into `out` [classes].
  void row(std::size_t pixel, std::span<float> out) const;
  /// Throws Error(data) for a negative value or one that is not finite.
  void set_row(std::size_t pixel, std::span<const float> probability);
  /// Most probable class, the first of equals; kVoid for a row of zeros.
  std::int16_t argmax(std::size_t pixel) const;
  bool labelled(std::size_t pixel) const { return argmax(pixel) >= 0; }
  std::size_t bytes() const { return values_.capacity() * sizeof(std::uint16_t); }
  bool operator==(const SoftMap&) const = default;

 private:
  int classes_ = 0;
  std::vector<std::uint16_t> values_;
};

// Class tables of other tools, in and out.

/// Class tables that are published: their ids and names are facts of the data sets.
/// "nyu13" (13 classes [Couprie13]), "nyu40" [Gupta13], "scannet20" (the 20 of NYU40 that ScanNet scores [Dai17]). Id 0
/// is void. Throws Error(usage) for any other name.
ClassTable published_classes(const std::string& name);
std::vector<std::string> published_class_names();

/// Colour of a class id as PASCAL VOC's label images have it [Everingham10]: bit k of the id's lower, middle and upper
/// thirds goes to red, green and blue from the top bit down.
std::array<std::uint8_t, 3> pascal_color(std::int32_t id);

std::string to_cvat_labelmap(const ClassTable& classes);
/// Header `class_id,class`, and `ignore` where names do not tell what is void; colours have no place in it.
std::string to_class_csv(const ClassTable& classes);

/// Which ids of ScanNet's label table a class table is made of.
enum class ScannetIds { raw, nyu40, nyu13 };
/// The classes that occur in scannetv2-labels.combined.tsv, with void as id 0. Throws as read_scannet_tsv.
ClassTable load_scannet_classes(const std::string& path, ScannetIds ids);

/// Any class table by its extension: .yaml, .yml, .csv, .json as ClassTable::load, .tsv as ScanNet's raw ids, .txt as
/// CVAT's labelmap.txt: lines `label:r,g,b:parts:actions`, in which a label "background" or of a void name is id 0 and
/// ignored, and the others are 1, 2, ... in the order of the file. Throws Error(data) naming file and line.
ClassTable import_classes(const std::string& path);

// ScanNet's table of label names (scannetv2-labels.combined.tsv): from the raw ids of label-filt images to NYU40 and to
// the 13 classes of Eigen and Fergus.

/// One row. Ids that the table leaves empty are 0: no class.
struct ScannetLabel {
  std::int32_t id = 0;  ///< as in label-filt images
  std::string raw_category;
  std::int32_t nyu40id = 0;    ///< 0..40
  std::int32_t eigen13id = 0;  ///< 0..13

  std::int32_t id_in(ScannetIds ids) const {
    return ids == ScannetIds::raw ? id : ids == ScannetIds::nyu40 ? nyu40id : eigen13id;
  }
};

/// Rows in the order of the file. Columns are found by the names in its first line; `id` and `raw_category` must be
/// there, and at least one of `nyu40id` and `eigen13id`. Throws Error(data) naming file, line and column for a missing
/// column, a row of another length, a number that is none or is out of range, and an id given twice with different
/// classes; Error(no_input) when the file cannot be read.
std::vector<ScannetLabel> read_scannet_tsv(const std::string& path);

}  // namespace semfield
