// Choosing the labelled key-frames.
#include "labels/label_selection.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <system_error>

#include "core/rng.h"

namespace semfield {

namespace {

[[noreturn]] void refuse(Code code, const std::string& message, const std::string& remedy) {
  throw Error(ErrorKind::config, code, "scene.labels." + message, remedy);
}

template <class T>
bool parse_number(std::string_view text, T& out) {
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), out);
  return !text.empty() && status == std::errc{} && end == text.data() + text.size();
}

std::vector<int> named_frames(const SceneInfo& info, const std::vector<std::string>& names) {
  std::vector<int> out;
  std::vector<std::string> known;
  for (const FrameInfo& f : info.frames) known.push_back(f.name);
  for (const std::string& name : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      const std::string near = did_you_mean(name, known);
      refuse("scene.frame.unknown", "names: no frame '" + name + "'",
             near.empty() ? "see `semfield inspect` for the names" : "did you mean '" + near + "'?");
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
  try {
    (void)label_frame_count(p.frames, 1 << 30);
  } catch (const Error& e) {
    diagnostics.error(e.code(), "", e.message(), e.remedy());
  }
}

int label_frame_count(const std::string& frames, int available) {
  if (frames == "all") return available;
  if (frames == "none") return 0;
  if (!frames.empty() && frames.back() == '%') {
    double share = 0;
    if (parse_number(std::string_view(frames).substr(0, frames.size() - 1), share) && share >= 0 && share <= 100) {
      const auto count = static_cast<int>(std::floor(share / 100 * available + 0.5));
      return share > 0 && available > 0 ? std::max(1, count) : count;
    }
  } else if (int count = 0; parse_number(frames, count) && count >= 0) {
    if (count <= available) return count;
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
