#include "loading/capture/photographs.h"

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>
#include <optional>

#include "compute/parallel.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::array<std::string_view, 10> kVideos{".mp4", ".mov", ".m4v", ".mkv", ".webm",
                                                   ".avi", ".3gp", ".mts", ".mpg", ".wmv"};
constexpr std::array<std::string_view, 2> kHeic{".heic", ".heif"};
constexpr std::size_t kFewest = 3;

void add_photographs(const fs::path& folder, const std::string& prefix, std::vector<Photograph>& out) {
  std::vector<std::string> files = files_with(folder.string(), kPhotographs);
  std::sort(files.begin(), files.end(), comes_before);
  for (std::string& file : files) {
    std::string name = prefix + fs::path(file).filename().string();
    out.push_back({std::move(file), std::move(name)});
  }
}

// "30 of 4032 x 3024 (a.jpg, b.jpg, ...)" of each kind.
std::string kinds_text(const std::map<std::string, std::vector<std::string>>& kinds) {
  std::vector<std::string> parts;
  for (const auto& [kind, names] : kinds) {
    const std::size_t named = std::min<std::size_t>(names.size(), 3);
    parts.push_back(std::to_string(names.size()) + " of " + kind + " (" +
                    join({names.begin(), names.begin() + static_cast<std::ptrdiff_t>(named)}) +
                    (named < names.size() ? ", ..." : "") + ")");
  }
  return join(parts, " and ");
}

std::string lens_text(const CameraTag& tag) {
  std::string out = tag.model.empty() ? "an unnamed camera" : tag.model;
  if (tag.focal_mm > 0) {
    const long hundredths = std::lround(100 * tag.focal_mm);
    const std::string cents = std::to_string(hundredths % 100);
    out += " at " + std::to_string(hundredths / 100) + "." + (cents.size() < 2 ? "0" : "") + cents + " mm";
  }
  return out;
}

}  // namespace

bool comes_before(const std::string& a, const std::string& b) {
  std::size_t i = 0, j = 0;
  while (i < a.size() && j < b.size()) {
    if (!is_digit(a[i]) || !is_digit(b[j])) {
      if (a[i] != b[j]) return a[i] < b[j];
      ++i;
      ++j;
      continue;
    }
    const auto number = [](const std::string& text, std::size_t& at) {
      while (at < text.size() && text[at] == '0') ++at;
      const std::size_t first = at;
      while (at < text.size() && is_digit(text[at])) ++at;
      return text.substr(first, at - first);
    };
    const std::string x = number(a, i), y = number(b, j);
    if (x.size() != y.size()) return x.size() < y.size();
    if (x != y) return x < y;
  }
  if ((i < a.size()) != (j < b.size())) return j < b.size();
  return a < b;  // "01" and "1"
}

CaptureSource look_at_source(const std::string& path) {
  std::error_code unknown;
  CaptureSource out;
  out.path = fs::absolute(path).lexically_normal().string();
  if (out.path.size() > 1 && out.path.ends_with('/')) out.path.pop_back();
  const std::string remedy = "name a video, or a folder of photographs (.jpg, .png, .tif)";
  if (!fs::exists(path, unknown))
    throw Error(ErrorKind::no_input, "files.folder.missing", "'" + path + "' is not there", "check the path");
  if (!fs::is_directory(path, unknown)) {
    std::string extension = fs::path(path).extension().string();
    for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    if (std::find(kVideos.begin(), kVideos.end(), extension) == kVideos.end())
      throw Error(ErrorKind::no_input, "capture.source.kind", "'" + path + "' is not a video, by its name", remedy);
    out.video = true;
    return out;
  }
  add_photographs(path, "", out.photographs);
  if (out.photographs.size() < kFewest) {
    std::vector<Photograph> inner;
    add_photographs(fs::path(path) / "images", "", inner);
    if (inner.size() >= kFewest) out.photographs = inner;
  }
  if (out.photographs.empty()) {
    for (const fs::directory_entry& entry : sorted_folder(path)) {
      if (entry.is_directory(unknown))
        add_photographs(entry.path(), entry.path().filename().string() + "/", out.photographs);
    }
    out.camera_per_folder = !out.photographs.empty();
  }
  if (!out.photographs.empty()) return out;
  const std::vector<std::string> videos = files_with(path, kVideos);
  if (!files_with(path, kHeic).empty()) {
    throw Error(
        ErrorKind::data, "capture.photographs.heic",
        "the photographs in '" + path + "' are HEIC, which COLMAP does not read",
        "make JPEG of them with `heif-convert IMG.heic IMG.jpg` (sudo apt install libheif-examples), or set the "
        "phone's camera to \"most compatible\"");
  }
  throw Error(ErrorKind::no_input, "capture.source.empty", "'" + path + "' holds no photographs",
              videos.empty() ? remedy : "name the video itself: " + shell_word(videos.front()));
}

void check_photographs(const CaptureSource& source, Diagnostics& diagnostics) {
  const std::vector<Photograph>& all = source.photographs;
  if (source.video) return;
  if (all.size() < kFewest)
    diagnostics.error("capture.photographs.few", source.path,
                      std::to_string(all.size()) + " photographs are too few for poses",
                      "take at least 20, each sharing two thirds of what the one before shows");
  std::vector<ImageSize> sizes(all.size());
  std::vector<CameraTag> tags(all.size());
  std::vector<std::optional<Error>> errors(all.size());
  parallel_for(static_cast<std::int64_t>(all.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    try {
      sizes[i] = image_size(all[i].path);
      tags[i] = camera_tag(all[i].path);
    } catch (const Error& e) {
      errors[i] = e;
    }
  });
  using Kinds = std::map<std::string, std::vector<std::string>>;
  std::map<std::string, Kinds> by_size, by_lens;  // of each folder that is a camera
  std::vector<std::string> turned;
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (errors[i]) {
      diagnostics.error(errors[i]->code(), "", errors[i]->message(),
                        errors[i]->remedy() + "; or take the file out of the folder");
      continue;
    }
    const std::string folder = source.camera_per_folder ? all[i].name.substr(0, all[i].name.find('/')) : "";
    by_size[folder][size_text(sizes[i].width_px, sizes[i].height_px)].push_back(all[i].name);
    by_lens[folder][lens_text(tags[i])].push_back(all[i].name);
    if (sizes[i].orientation != 1) turned.push_back(all[i].name);
  }
  const std::string apart = "take the few out, or put those of each camera into a folder of its own inside '" +
                            source.path + "': each folder is then one camera";
  for (const auto& [folder, kinds] : by_size) {
    const std::string place = folder.empty() ? source.path : source.path + "/" + folder;
    if (kinds.size() > 1) {
      diagnostics.error("capture.photographs.sizes", place, "photographs of several sizes: " + kinds_text(kinds),
                        apart);
    } else if (by_lens[folder].size() > 1) {
      diagnostics.error("capture.photographs.cameras", place,
                        "photographs of several cameras or zooms: " + kinds_text(by_lens[folder]), apart);
    }
  }
  if (!turned.empty()) {
    diagnostics.note("scene.image.orientation", source.path,
                     std::to_string(turned.size()) + " of " + std::to_string(all.size()) +
                         " photographs have an EXIF orientation by which viewers turn them; here pixels count as they "
                         "are stored, as the sensor saw them");
  }
}

}  // namespace semfield
