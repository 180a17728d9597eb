// ScanNet's table of label names (scannetv2-labels.combined.tsv): from the raw ids of label-filt images to NYU40 and to
// the 13 classes of Eigen and Fergus.
#pragma once

#include <cstdint>
#include <string>
#include <unordered_map>
#include <vector>

namespace semfield {

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
