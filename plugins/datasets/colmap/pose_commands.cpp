// Photographs without camera poses: the command that finds poses for them.

#include <cctype>
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

// What files of camera poses are called, wherever they come from.
bool may_hold_poses(const fs::path& file) {
  std::string name = file.filename().string();
  for (char& c : name) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  const auto has = [&](const char* part) { return name.find(part) != std::string::npos; };
  const auto ends = [&](const char* ending) { return name.ends_with(ending); };
  return (has("traj") || has("pose") || has("groundtruth") || has("camera") || has("extrinsic") || has("transforms")) &&
         (ends(".txt") || ends(".json") || ends(".csv") || ends(".npy") || ends(".npz") || ends(".log"));
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
  std::string poses;
  for (const fs::path& place : places) {
    if (!poses.empty() || !fs::is_directory(place, unknown)) break;
    for (const fs::directory_entry& entry : sorted_folder(place.string()))
      if (poses.empty() && entry.is_regular_file(unknown) && may_hold_poses(entry.path()))
        poses = entry.path().string();
  }
  const std::string scene = folder + "_scene";
  if (!poses.empty())
    poses = "'" + poses +
            "' may hold poses, but not in a layout that a dataset reads: docs/guide/own_data.md lists them; write "
            "transforms.json with a frame for each image to use them.\n";
  return poses + "'" + where.string() + "' holds " + std::to_string(photographs.size()) +
         " photographs and no camera poses that a dataset knows. This finds poses, with COLMAP:\n" +
         "  semfield prepare " + shell_word(where.string()) + " --out " + shell_word(scene) + "\n" +
         "then: semfield init " + shell_word(scene);
}

}  // namespace semfield
