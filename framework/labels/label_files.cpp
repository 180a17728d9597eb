#include "labels/label_files.h"

#include <algorithm>
#include <filesystem>

#include "core/text.h"
#include "formats/orientation.h"
#include "scene/output_names.h"
#include "system/files.h"
#include "system/sorted_folder.h"

namespace semfield {

namespace {

constexpr int kMaxProblems = 20;

constexpr std::size_t kMostDigits = 9;  // of a frame's number in the name of a file

std::string number_of(const std::string& name) {
  std::size_t first = name.size();
  while (first > 0 && is_digit(name[first - 1])) --first;
  return name.substr(first);
}

}  // namespace

std::string file_stem(std::string_view path) {
  const std::size_t slash = path.find_last_of("/\\");
  if (slash != std::string_view::npos) path.remove_prefix(slash + 1);
  return std::filesystem::path(path).stem().string();
}

std::vector<std::string> names_of(const FrameInfo& frame) {
  return {frame.name, output_name(frame.name), file_stem(frame.source)};
}

FrameInfo as_shown(FrameInfo frame) {
  if (turned_by_quarter(frame.orientation)) std::swap(frame.camera.width_px, frame.camera.height_px);
  return frame;
}

void check_pattern(const std::string& pattern, Diagnostics& diagnostics) {
  const std::string remedy = "write for example \"semantic_class_{number}.png\"; there are {name}, {stem} and {number}";
  bool has_place = false;
  for (std::size_t at = pattern.find('{'); at != std::string::npos; at = pattern.find('{', at + 1)) {
    const std::size_t end = std::min(pattern.find('}', at), pattern.size() - 1);
    const std::string place = pattern.substr(at, end - at + 1);
    if (place != "{name}" && place != "{stem}" && place != "{number}") {
      diagnostics.error("labels.pattern.invalid", "pattern", "'" + place + "' in '" + pattern + "' stands for nothing",
                        remedy);
      return;
    }
    has_place = true;
  }
  if (!has_place)
    diagnostics.error("labels.pattern.invalid", "pattern", "'" + pattern + "' names the same file for every frame",
                      remedy);
}

std::string path_of(const std::string& folder, const std::string& pattern, const FrameInfo& frame) {
  const std::string number = number_of(frame.name);
  const auto path_with = [&](const std::string& digits) {
    std::string out;
    for (std::size_t at = 0; at < pattern.size();) {
      if (pattern[at] != '{') {
        out += pattern[at++];
        continue;
      }
      const std::size_t end = pattern.find('}', at);
      const std::string place = pattern.substr(at, end - at + 1);
      out += place == "{name}" ? frame.name : place == "{stem}" ? file_stem(frame.source) : digits;
      at = end + 1;
    }
    return (std::filesystem::path(folder) / out).string();
  };
  const bool by_number = pattern.find("{number}") != std::string::npos;
  if (by_number && number.empty()) return {};
  std::string path = path_with(number);
  std::error_code ignored;
  if (!by_number || std::filesystem::exists(path, ignored)) return path;
  // The same number with other zeros before it: "12" for "00012", and the other way round.
  const std::size_t first = std::min(number.find_first_not_of('0'), number.size() - 1);
  for (std::string digits = number.substr(first); digits.size() <= kMostDigits; digits.insert(0, "0")) {
    std::string other = path_with(digits);
    if (std::filesystem::exists(other, ignored)) return other;
  }
  return path;
}

bool has_file(const std::string& folder, const std::string& pattern, const FrameInfo& frame) {
  std::error_code ignored;
  const std::string path = path_of(folder, pattern, frame);
  return !path.empty() && std::filesystem::is_regular_file(path, ignored);
}

void check_label_shape(std::int64_t width, std::int64_t height, const Camera& frame) {
  const std::int64_t w = frame.width_px, h = frame.height_px;
  if (2 * std::abs(width * h - height * w) <= width + height && width <= 64 * w) return;
  throw Error(ErrorKind::data, "labels.image.size",
              "labels are " + std::to_string(width) + " x " + std::to_string(height) + " pixels, the frame is " +
                  std::to_string(w) + " x " + std::to_string(h) + ": another shape",
              "label the image of this frame");
}

bool folder_has_cameras(const std::string& path) {
  std::error_code unknown;
  const std::string cameras = (std::filesystem::path(path).parent_path() / "cameras.json").string();
  return std::filesystem::is_regular_file(cameras, unknown) &&
         read_file_start(cameras, 256).find("semfield-cameras-") != std::string::npos;
}

bool check_folder(const std::string& folder, Diagnostics& diagnostics) {
  std::error_code ignored;
  if (folder.empty()) {
    diagnostics.error("labels.folder.unnamed", "folder", "no folder is named", "set scene.labels.from.folder");
  } else if (!std::filesystem::is_directory(folder, ignored)) {
    diagnostics.error("files.folder.missing", "folder", "'" + folder + "' is not a folder", "check the path");
  } else {
    return true;
  }
  return false;
}

ProblemList::~ProblemList() {
  if (count_ > kMaxProblems)
    diagnostics_.error("labels.problems.more", "",
                       std::to_string(count_ - kMaxProblems) + " further problems are not listed", {});
}

bool check_folder(const std::string& folder, const std::string& pattern, Diagnostics& diagnostics) {
  if (!check_folder(folder, diagnostics)) return false;
  const std::string before = pattern.substr(0, pattern.find('{')), after = pattern.substr(pattern.rfind('}') + 1);
  if (before.find('/') != std::string::npos || after.find('/') != std::string::npos) return true;
  std::string other;
  for (const auto& entry : sorted_folder(folder)) {
    const std::string name = entry.path().filename().string();
    // Names of frames may have slashes: what lies in the folders below is not looked at.
    if (entry.is_directory() ||
        (name.size() >= before.size() + after.size() && name.starts_with(before) && name.ends_with(after))) {
      return true;
    }
    if (other.empty()) other = name;
  }
  diagnostics.error("labels.pattern.nothing", "pattern", "no file in '" + folder + "' is named like '" + pattern + "'",
                    other.empty() ? "the folder is empty" : "there is for example '" + other + "'");
  return false;
}

void ProblemList::error(Code code, const std::string& where, const std::string& message, const std::string& remedy) {
  if (++count_ <= kMaxProblems) diagnostics_.error(code, where, message, remedy);
}

void ProblemList::collect(const std::function<void()>& body) {
  try {
    body();
  } catch (const Error& e) {
    error(e.code(), "", e.message(), e.remedy());
  }
}

ClassTable table_for(const std::map<std::string, std::string>& place_of_name, const ClassTable& known,
                     ProblemList& problems) {
  if (known.empty()) {
    std::vector<std::string> names;
    for (const auto& [name, place] : place_of_name) names.push_back(name);
    ClassTable built;
    problems.collect([&] { built = table_of_names(names); });
    return built;
  }
  const ClassNames classes(known);
  for (const auto& entry : place_of_name) problems.collect([&] { (void)classes.index_of(entry.first, entry.second); });
  return known;
}

}  // namespace semfield
