#include "labels/label_files.h"

#include <algorithm>
#include <cmath>

#include "core/files.h"
#include "core/rng.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "scene/scene.h"

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
  return fs::path(path).stem().string();
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
    return (fs::path(folder) / out).string();
  };
  const bool by_number = pattern.find("{number}") != std::string::npos;
  if (by_number && number.empty()) return {};
  std::string path = path_with(number);
  if (!by_number || is_there(path)) return path;
  // The same number with other zeros before it: "12" for "00012", and the other way round.
  const std::size_t first = std::min(number.find_first_not_of('0'), number.size() - 1);
  for (std::string digits = number.substr(first); digits.size() <= kMostDigits; digits.insert(0, "0")) {
    std::string other = path_with(digits);
    if (is_there(other)) return other;
  }
  return path;
}

bool has_file(const std::string& folder, const std::string& pattern, const FrameInfo& frame) {
  const std::string path = path_of(folder, pattern, frame);
  return !path.empty() && is_file(path);
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
  const std::string cameras = (fs::path(path).parent_path() / "cameras.json").string();
  return is_file(cameras) && read_file_start(cameras, 256).find("semfield-cameras-") != std::string::npos;
}

bool check_folder(const std::string& folder, Diagnostics& diagnostics) {
  if (folder.empty()) {
    diagnostics.error("labels.folder.unnamed", "folder", "no folder is named", "set scene.labels.from.folder");
  } else if (!is_folder(folder)) {
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

// Choosing the labelled key-frames.

namespace {

[[noreturn]] void refuse(Code code, const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::config, code, "scene.labels." + message, remedy);
}

std::vector<int> named_frames(const SceneInfo& info, const std::vector<std::string>& names) {
  std::vector<int> out;
  std::vector<std::string> known;
  for (const FrameInfo& f : info.frames) known.push_back(f.name);
  for (const std::string& name : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      refuse("scene.frame.unknown", "names: no frame '" + name + "'",
             near_name_remedy(name, known, "see `semfield inspect` for the names"));
    }
    const auto index = static_cast<std::size_t>(found - known.begin());
    if (info.frames[index].split != Split::train)
      refuse("labels.frame.untrained", "names: frame '" + name + "' is not a training frame",
             "name training frames only");
    if (!info.frames[index].has_labels)
      refuse("labels.frame.unlabelled", "names: frame '" + name + "' has no labels",
             "name frames that have a label image");
    out.push_back(static_cast<int>(index));
  }
  std::sort(out.begin(), out.end());
  out.erase(std::unique(out.begin(), out.end()), out.end());
  return out;
}

std::vector<int> covering_frames(std::vector<int> left, std::int64_t count,
                                 const std::vector<std::vector<std::int64_t>>& class_pixels) {
  std::vector<int> out;
  std::vector<char> seen;
  while (std::ssize(out) < count) {
    std::pair<std::int64_t, std::int64_t> most{-1, -1};  // classes not yet seen, labelled pixels
    std::size_t best = 0;
    for (std::size_t k = 0; k < left.size(); ++k) {
      const std::vector<std::int64_t>& pixels = class_pixels.at(static_cast<std::size_t>(left[k]));
      std::pair<std::int64_t, std::int64_t> shows{0, 0};
      for (std::size_t c = 0; c + 1 < pixels.size(); ++c) {
        if (pixels[c] > 0 && (c >= seen.size() || seen[c] == 0)) ++shows.first;
        shows.second += pixels[c];
      }
      if (shows > most) {
        most = shows;
        best = k;
      }
    }
    const std::vector<std::int64_t>& pixels = class_pixels[static_cast<std::size_t>(left[best])];
    seen.resize(std::max(seen.size(), pixels.size()));
    for (std::size_t c = 0; c + 1 < pixels.size(); ++c) seen[c] |= pixels[c] > 0 ? 1 : 0;
    out.push_back(left[best]);
    left.erase(left.begin() + static_cast<std::ptrdiff_t>(best));
  }
  std::sort(out.begin(), out.end());
  return out;
}

}  // namespace

void describe(ParamVisitor& visit, LabelParams& p) {
  SEMFIELD_PARAM(visit, p, frames,
                 "training frames that keep their labels: all, none, a share such as 10%, or a number of frames");
  SEMFIELD_PARAM(visit, p, mode,
                 "how they are chosen: evenly spaced key-frames, at random, by name, or those that show most classes");
  SEMFIELD_PARAM(visit, p, seed, "seed of the random choice", {0, 9e15});
  SEMFIELD_PARAM(visit, p, names, "names of the frames, for mode named");
  SEMFIELD_PARAM(
      visit, p, clicks,
      "clicks.jsonl of the labelling page: its clicks are painted over the labels that train, also with "
      "frames: none, and its classes are added; with class_room the file need not be there yet. In a run.yaml "
      "'clicks.jsonl' is the file in the run's own folder, wherever that is");
  SEMFIELD_PARAM(visit, p, class_room,
                 "classes that the network has logits for from the start; those without a name are called 'unnamed ID' "
                 "until clicks name them, and label_balanced waits for the first label; 0: the classes there are",
                 {0, 1024});
}

void validate(const LabelParams& p, Diagnostics& diagnostics) {
  if (p.mode == LabelMode::named && p.names.empty())
    diagnostics.error("config.value.missing", "scene.labels.names", "mode named needs names",
                      "list the names of frames");
  if (p.mode != LabelMode::named && !p.names.empty())
    diagnostics.error("config.value.conflict", "scene.labels.names", "names are given but mode is not named",
                      "set scene.labels.mode: named");
  if (p.mode == LabelMode::named && p.frames != "all")
    diagnostics.error("config.value.conflict", "scene.labels.frames", "a number of frames and names exclude each other",
                      "drop scene.labels.frames");
  if (p.mode == LabelMode::named) return;
  noting(diagnostics, "", [&] { (void)label_frame_count(p.frames, 1 << 30); });
}

int label_frame_count(const std::string& frames, int available) {
  if (frames == "all") return available;
  if (frames == "none") return 0;
  if (!frames.empty() && frames.back() == '%') {
    const auto share = to_number<double>(std::string_view(frames).substr(0, frames.size() - 1));
    if (share && *share >= 0 && *share <= 100) {
      const auto count = static_cast<int>(std::floor(*share / 100 * available + 0.5));
      return *share > 0 && available > 0 ? std::max(1, count) : count;
    }
  } else if (const auto count = to_number<int>(frames); count && *count >= 0) {
    if (*count <= available) return *count;
    refuse("labels.frames.too_few",
           "frames: " + frames + " were asked for, and there are " + std::to_string(available) +
               " labelled training frames",
           "ask for fewer, or write all");
  }
  refuse("config.value.type", "frames: expected all, none, a share such as 10%, or a number, got '" + frames + "'",
         "write for example 10%");
}

std::vector<int> select_label_frames(const SceneInfo& info, const LabelParams& params,
                                     const std::vector<std::vector<std::int64_t>>& class_pixels) {
  if (params.mode == LabelMode::named) return named_frames(info, params.names);
  std::vector<int> labelled;
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    if (info.frames[i].split == Split::train && info.frames[i].has_labels) labelled.push_back(static_cast<int>(i));
  }
  const auto available = static_cast<std::int64_t>(labelled.size());
  const std::int64_t count = label_frame_count(params.frames, static_cast<int>(available));
  std::vector<int> out;
  if (params.mode == LabelMode::coverage) return covering_frames(labelled, count, class_pixels);
  if (params.mode == LabelMode::even) {
    for (std::int64_t k = 0; k < count; ++k) out.push_back(labelled[static_cast<std::size_t>(k * available / count)]);
    return out;
  }
  // Fisher-Yates, the first `count` places: without replacement, and a larger choice of the same seed contains the
  // smaller one.
  const RandomAddress address{static_cast<std::uint64_t>(params.seed), 0, stream_id("labels/selection")};
  for (std::int64_t k = 0; k < count; ++k) {
    const auto other = k + static_cast<std::int64_t>(uniform_below(address, static_cast<std::uint64_t>(k),
                                                                   static_cast<std::uint64_t>(available - k)));
    std::swap(labelled[static_cast<std::size_t>(k)], labelled[static_cast<std::size_t>(other)]);
    out.push_back(labelled[static_cast<std::size_t>(k)]);
  }
  std::sort(out.begin(), out.end());
  return out;
}

}  // namespace semfield
