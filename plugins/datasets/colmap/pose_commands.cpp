// Photographs without camera poses: the command that finds poses for them.

#include <filesystem>
#include <utility>
#include <vector>

#include "core/text.h"
#include "datasets/colmap/colmap.h"
#include "loading/frame_files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::size_t kFewest = 3;

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
  const std::string scene = folder + "_scene";
  return "'" + where.string() + "' holds " + std::to_string(photographs.size()) +
         " photographs and no camera poses that a dataset knows. This finds poses, with COLMAP:\n" +
         "  semfield prepare " + shell_word(where.string()) + " --out " + shell_word(scene) + "\n" +
         "then: semfield init " + shell_word(scene);
}

}  // namespace semfield
