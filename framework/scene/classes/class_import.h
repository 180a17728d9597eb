// Class tables of other tools, in and out.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <unordered_map>
#include <vector>

#include "scene/classes/class_table.h"

namespace semfield {

/// Class tables that are published: their ids and names are facts of the data sets.
/// "nyu13" (13 classes [Couprie13]), "nyu40" [Gupta13], "scannet20" (the 20 of NYU40 that ScanNet scores [Dai17]). Id 0
/// is void. Throws Error(usage) for any other name.
ClassTable published_classes(const std::string& name);
std::vector<std::string> published_class_names();
/// NYU40 id -> id of the 13 classes; 0 for 0. Throws Error(data) outside 0..40.
std::int32_t nyu13_of_nyu40(std::int32_t nyu40id);

/// Colour of a class id as PASCAL VOC's label images have it [Everingham10]: bit k of the id's lower, middle and upper
/// thirds goes to red, green and blue from the top bit down.
std::array<std::uint8_t, 3> pascal_color(std::int32_t id);

/// CVAT's labelmap.txt: lines `label:r,g,b:parts:actions`. A label "background" or of a void name is id 0 and ignored,
/// the others are 1, 2, ... in the order of the file. Throws Error(data) naming file and line.
ClassTable load_cvat_labelmap(const std::string& path);
std::string to_cvat_labelmap(const ClassTable& classes);
/// Header `class_id,class`, and `ignore` where names do not tell what is void; colours have no place in it.
std::string to_class_csv(const ClassTable& classes);

/// Which ids of ScanNet's label table a class table is made of.
enum class ScannetIds { raw, nyu40, nyu13 };
/// The classes that occur in scannetv2-labels.combined.tsv, with void as id 0. Throws as read_scannet_tsv.
ClassTable load_scannet_classes(const std::string& path, ScannetIds ids);

/// Any class table by its extension: .yaml, .yml, .csv, .json as ClassTable::load, .txt as CVAT's label map, .tsv as
/// ScanNet's raw ids.
ClassTable import_classes(const std::string& path);

// ScanNet's table of label names (scannetv2-labels.combined.tsv): from the raw ids of label-filt images to NYU40 and to
// the 13 classes of Eigen and Fergus.

/// One row. Ids that the table leaves empty are 0: no class.
struct ScannetLabel {
  std::int32_t id = 0;  ///< as in label-filt images
  std::string raw_category;
  std::int32_t nyu40id = 0;    ///< 0..40
  std::int32_t eigen13id = 0;  ///< 0..13
  std::string nyu40class, eigen13class;
};

/// Rows in the order of the file. Columns are found by the names in its first line; `id` and `raw_category` must be
/// there, and at least one of `nyu40id` and `eigen13id`. Throws Error(data) naming file, line and column for a missing
/// column, a row of another length, a number that is none or is out of range, and an id given twice with different
/// classes; Error(no_input) when the file cannot be read.
std::vector<ScannetLabel> read_scannet_tsv(const std::string& path);

/// Raw id -> class id; raw ids without a class map to 0.
std::unordered_map<std::int32_t, std::int32_t> nyu40_of_scannet(const std::vector<ScannetLabel>& labels);
std::unordered_map<std::int32_t, std::int32_t> eigen13_of_scannet(const std::vector<ScannetLabel>& labels);

}  // namespace semfield
