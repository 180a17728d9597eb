// Photographs without camera poses: the commands that find poses for them.

#include <algorithm>
#include <filesystem>
#include <set>
#include <utility>
#include <vector>

#include "core/error.h"
#include "core/text.h"
#include "datasets/colmap/colmap.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::size_t kFewest = 3;
constexpr std::size_t kMostPairs = 300;  // photographs beyond which all pairs take hours

// Of one camera, as far as the sizes of some tell.
bool have_one_size(const std::vector<std::string>& photographs) {
  std::set<std::pair<std::int32_t, std::int32_t>> sizes;
  const std::size_t step = std::max<std::size_t>(1, photographs.size() / 32);
  for (std::size_t i = 0; i < photographs.size(); i += step) {
    try {
      const ImageSize size = image_size(photographs[i]);
      sizes.emplace(size.width_px, size.height_px);
    } catch (const Error&) {
      continue;
    }
  }
  return sizes.size() <= 1;
}

}  // namespace

std::string preparation(const std::string& folder, const ColmapParams&) {
  std::vector<std::string> photographs;
  fs::path where;
  std::vector<fs::path> places{folder};
  std::error_code unknown;
  if (fs::is_directory(folder, unknown)) {
    for (const fs::directory_entry& entry : sorted_folder(folder)) {
      if (entry.is_directory(unknown)) places.push_back(entry.path());
    }
  }
  for (const fs::path& place : places) {
    std::vector<std::string> found = files_with(place.string(), kPhotographs);
    if (found.size() <= photographs.size()) continue;
    photographs = std::move(found);
    where = place;
  }
  if (photographs.size() < kFewest) return "";
  const bool film = photographs.size() > kMostPairs;
  const std::string database = shell_word((fs::path(folder) / "database.db").string());
  const std::string images = shell_word(where.string()), sparse = shell_word((fs::path(folder) / "sparse").string());
  const std::string one_camera = have_one_size(photographs) ? " --ImageReader.single_camera 1" : "";
  const std::string matchers[] = {"exhaustive_matcher", "sequential_matcher"};
  return "'" + where.string() + "' holds " + std::to_string(photographs.size()) +
         " photographs and no camera poses that a dataset knows. COLMAP finds poses:\n" +
         "  colmap feature_extractor --database_path " + database + " --image_path " + images +
         " --ImageReader.camera_model OPENCV" + one_camera + "\n" + "  colmap " + matchers[film ? 1 : 0] +
         " --database_path " + database + "\n" + "  mkdir -p " + sparse + "\n" + "  colmap mapper --database_path " +
         database + " --image_path " + images + " --output_path " + sparse + "\n" + "then: semfield init " +
         shell_word(folder) + "\n" +
         (film ? "For photographs in no order " : "For frames of a film, in the order of their names, ") +
         matchers[film ? 0 : 1] + " takes the place of " + matchers[film ? 1 : 0] +
         ". After a fisheye lens, `colmap image_undistorter` writes a folder of images and model that is read.";
}

}  // namespace semfield
