#include "labels/frame_match.h"

#include <algorithm>
#include <cctype>
#include <cstddef>
#include <set>

#include "core/files.h"
#include "labels/label_files.h"
#include "scene/loading/frame_files.h"

namespace semfield {

namespace {

constexpr std::size_t kNamed = 4;       // pictures in a message
constexpr std::size_t kLookedAt = 500;  // pictures without a frame that are compared with all frames

// Score of a picture that is the frame's image, or is called as the frame.
constexpr int kSameFile = 1 << 20, kSameName = 1 << 19;

// From the last to the first; '.' and '..' tell nothing.
std::vector<std::string> parts_from_end(std::string_view path) {
  std::vector<std::string> out;
  while (!path.empty()) {
    const std::size_t slash = path.find_last_of("/\\");
    const std::string_view part = slash == std::string_view::npos ? path : path.substr(slash + 1);
    if (!part.empty() && part != "." && part != "..") out.emplace_back(part);
    path = slash == std::string_view::npos ? std::string_view() : path.substr(0, slash);
  }
  return out;
}

std::string joined(const std::vector<std::string>& from_end, std::size_t count) {
  std::string out;
  for (std::size_t i = 0; i < std::min(count, from_end.size()); ++i)
    out = out.empty() ? from_end[i] : from_end[i] + "/" + out;
  return out;
}

// Whether `inner` stands in `name` between ends or characters that are neither letters nor digits.
bool holds_word(const std::string& name, const std::string& inner) {
  const auto is_word = [&](std::size_t i) { return std::isalnum(static_cast<unsigned char>(name[i])) != 0; };
  for (std::size_t at = name.find(inner); at != std::string::npos; at = name.find(inner, at + 1)) {
    const std::size_t end = at + inner.size();
    if ((at == 0 || !is_word(at - 1)) && (end == name.size() || !is_word(end))) return true;
  }
  return false;
}

// Tells how many things belong to no frame, and names the first, with frames that have no labels and may be meant.
void report_strays(const std::vector<std::string>& strays, std::size_t all, const char* things,
                   const std::vector<const FrameInfo*>& unlabelled, const std::string& source,
                   Diagnostics& diagnostics) {
  if (strays.empty()) return;
  std::vector<std::string> guessed, others;
  for (std::size_t i = 0; i < std::min(strays.size(), kLookedAt) && guessed.size() < kNamed; ++i) {
    std::string likely;
    for (const FrameInfo* frame : unlabelled) {
      for (const std::string& name : {file_stem(frame->source), output_name(frame->name)})
        if (name.size() > likely.size() && holds_word(strays[i], name)) likely = name;
    }
    (likely.empty() ? others : guessed)
        .push_back("'" + strays[i] + "'" + (likely.empty() ? "" : ", meant for frame '" + likely + "'?"));
  }
  std::vector<std::string>& named = guessed.empty() ? others : guessed;
  named.resize(std::min(named.size(), kNamed));
  const std::string message = std::to_string(strays.size()) + " of " + std::to_string(all) + " " + things +
                              (strays.size() == 1 ? " belongs" : " belong") + " to no frame and " +
                              (strays.size() == 1 ? "is" : "are") + " left out: " + join(named, "; ") +
                              (strays.size() > named.size() ? "; ..." : "");
  if (guessed.empty()) {
    diagnostics.note("labels.frame.unmatched", source, message);
  } else {
    diagnostics.warning("labels.frame.unmatched", source, message,
                        "name them after the frames' images, without a prefix or suffix that a tool added");
  }
}

class Matching {
 public:
  Matching(const std::vector<PictureName>& pictures, const std::vector<FrameInfo>& frames) : frames_(frames) {
    for (std::size_t f = 0; f < frames.size(); ++f) {
      const std::string source = fs::path(frames[f].source).lexically_normal().string();
      of_frame_.push_back(parts_from_end(source));
      files_.emplace(source, f);
      std::vector<std::string>& parts = of_frame_.back();
      if (parts.empty()) parts.push_back(frames[f].name);
      take_folders(parts, frame_folders_, image_folders_);
      stems_.push_back(file_stem(parts[0]));
      ++frames_of_stem_[stems_[f]];
      for (const std::string& key : std::set<std::string>{parts[0], stems_[f]}) by_key_[key].push_back(f);
      for (const std::string& name : std::set<std::string>{frames[f].name, output_name(frames[f].name)})
        by_name_[name].push_back(f);
    }
    for (const PictureName& picture : pictures) {
      const std::vector<std::string> parts = parts_from_end(picture.path);
      take_folders(parts, told_folders_, picture_folders_);
      for (const std::size_t f : named(picture.path)) speaks_names_ = speaks_names_ || frames_[f].name != stems_[f];
    }
  }

  struct Found {
    std::vector<std::size_t> frames;  // equally likely ones
    int score = 0;
    bool other_folder = false;
  };

  Found find(const PictureName& picture) const {
    if (const auto same = files_.find(picture.file); !picture.file.empty() && same != files_.end())
      return {{same->second}, kSameFile};
    const Found found = find(picture.path);
    if (picture.other.empty() || found.frames.size() == 1) return found;
    Found other = find(picture.other);
    if (found.frames.empty()) return other;
    std::erase_if(other.frames, [&](std::size_t f) {
      return std::find(found.frames.begin(), found.frames.end(), f) == found.frames.end();
    });
    return other.frames.size() == 1 ? other : found;
  }

  /// All images lie in one folder, and so do all pictures.
  bool folders_tell_nothing() const { return image_folders_.size() == 1 && picture_folders_.size() == 1; }
  std::string shown(std::size_t frame) const { return "'" + joined(of_frame_[frame], 3) + "'"; }

 private:
  static void take_folders(const std::vector<std::string>& parts, std::set<std::string>& all,
                           std::set<std::string>& innermost) {
    if (parts.size() > 1) innermost.insert(parts[1]);
    for (std::size_t d = 1; d < parts.size(); ++d) all.insert(parts[d]);
  }

  // Frames that are called so, as a whole or up to an extension; without folders, those that are not called as their
  // image is.
  std::vector<std::size_t> named(const std::string& path) const {
    std::string name = path;
    std::replace(name.begin(), name.end(), '\\', '/');
    const std::size_t slash = name.rfind('/');
    const std::string last = slash == std::string::npos ? "" : name.substr(slash + 1);
    for (const std::string& one : {name, fs::path(name).replace_extension().string(), last, file_stem(last)}) {
      const auto found = by_name_.find(one);
      if (found == by_name_.end()) continue;
      std::vector<std::size_t> out = found->second;
      if (slash != std::string::npos && one.find('/') == std::string::npos)
        std::erase_if(out, [&](std::size_t f) { return frames_[f].name == stems_[f]; });
      if (!out.empty()) return out;
    }
    return {};
  }

  Found find(const std::string& path) const {
    const std::vector<std::string> parts = parts_from_end(path);
    if (parts.empty()) return {};
    // The name of a frame that is the stem of several images may as well be meant as a stem.
    for (const std::size_t f : named(path)) {
      if (frames_[f].name != stems_[f] || frames_of_stem_.at(stems_[f]) == 1 || speaks_names_) return {{f}, kSameName};
    }
    Found best;
    const std::string stem = file_stem(parts[0]);
    std::set<std::size_t> candidates;
    for (const std::string& key : {parts[0], stem})
      if (const auto found = by_key_.find(key); found != by_key_.end())
        candidates.insert(found->second.begin(), found->second.end());
    for (const std::size_t f : candidates) {
      // Folders that both have, in one order; a tool may leave some of them out.
      const std::vector<std::string>& own = of_frame_[f];
      std::size_t at = 1, shared = 0;
      bool gap = false;
      std::size_t part = 1;
      for (; part < parts.size(); ++part) {
        const auto next = std::find(own.begin() + static_cast<std::ptrdiff_t>(at), own.end(), parts[part]);
        if (next == own.end()) break;
        const auto place = static_cast<std::size_t>(next - own.begin());
        gap = gap || place != at;
        at = place + 1;
        ++shared;
      }
      const bool differs = part < parts.size() && at < own.size();
      if (differs && (frame_folders_.contains(parts[part]) || told_folders_.contains(own[at]))) continue;
      const int score = static_cast<int>(4 * shared) + (gap ? 0 : 2) + (parts[0] == own[0] ? 1 : 0) + 1;
      if (score > best.score) best = {{}, score, differs && shared == 0};
      if (score == best.score) best.frames.push_back(f);
    }
    return best;
  }

  const std::vector<FrameInfo>& frames_;
  std::vector<std::vector<std::string>> of_frame_;  // parts of the image's path, from the last
  std::vector<std::string> stems_;
  std::map<std::string, std::size_t> frames_of_stem_, files_;
  std::map<std::string, std::vector<std::size_t>> by_key_, by_name_;
  std::set<std::string> frame_folders_, told_folders_;     // of images, and those that pictures tell
  std::set<std::string> image_folders_, picture_folders_;  // the innermost of them
  bool speaks_names_ = false;                              // a picture is called by a name that only a frame has
};

constexpr const char* kFoldersRemedy =
    "name it with the folders that tell the images apart, or by the frame's name, which `semfield inspect` lists";

}  // namespace

std::map<std::string, std::size_t> match_frames(const std::vector<PictureName>& pictures,
                                                const std::vector<FrameInfo>& frames, const std::string& source,
                                                Diagnostics& diagnostics) {
  const Matching matching(pictures, frames);
  ProblemList problems(diagnostics);
  struct Claim {
    std::size_t picture = 0;
    int score = 0;
  };
  std::map<std::size_t, Claim> claims;  // by frame
  std::vector<char> lost(pictures.size());
  std::vector<std::string> elsewhere;
  for (std::size_t i = 0; i < pictures.size(); ++i) {
    const PictureName& picture = pictures[i];
    const Matching::Found found = matching.find(picture);
    lost[i] = found.frames.empty() && picture.labelled ? 1 : 0;
    if (found.frames.size() > 1 && picture.labelled) {
      std::vector<std::string> list;
      for (const std::size_t f : found.frames) list.push_back(matching.shown(f));
      if (list.size() > kNamed) {
        list.resize(kNamed);
        list.emplace_back("...");
      }
      problems.error("labels.frame.ambiguous", picture.place, "'" + picture.path + "' may be " + join(list, " or "),
                     kFoldersRemedy);
    }
    if (found.frames.size() != 1) continue;
    const std::size_t f = found.frames[0];
    const auto [claim, fresh] = claims.try_emplace(f, Claim{i, found.score});
    if (found.other_folder && picture.labelled) elsewhere.push_back("'" + picture.path + "' for " + matching.shown(f));
    if (fresh) continue;
    const PictureName& before = pictures[claim->second.picture];
    if (picture.labelled && before.labelled) {
      problems.error("labels.frame.twice", picture.place,
                     "'" + picture.path + "' is frame '" + frames[f].name + "', of which '" + before.path + "' (" +
                         before.place + ") is too",
                     "keep the labels of one of them");
      continue;
    }
    // The one with labels, or else the one that is called more alike, keeps the frame.
    if (picture.labelled || (!before.labelled && found.score > claim->second.score)) claim->second = {i, found.score};
  }
  std::map<std::string, std::size_t> out;
  std::vector<char> labelled(frames.size());
  for (const auto& [f, claim] : claims) {
    out.emplace(frames[f].name, claim.picture);
    labelled[f] = pictures[claim.picture].labelled ? 1 : 0;
  }
  std::vector<std::string> strays;
  std::vector<const FrameInfo*> unlabelled;
  for (std::size_t i = 0; i < pictures.size(); ++i)
    if (lost[i] != 0) strays.push_back(pictures[i].path);
  for (std::size_t f = 0; f < frames.size(); ++f)
    if (labelled[f] == 0) unlabelled.push_back(&frames[f]);
  const auto with_labels =
      std::count_if(pictures.begin(), pictures.end(), [](const PictureName& picture) { return picture.labelled; });
  report_strays(strays, static_cast<std::size_t>(with_labels), "pictures with labels", unlabelled, source, diagnostics);
  if (elsewhere.empty()) return out;
  const std::string told =
      std::to_string(elsewhere.size()) +
      " pictures are in folders with other names than those of the images, and were matched by file name alone: " +
      elsewhere.front() + (elsewhere.size() > 1 ? ", ..." : "");
  if (matching.folders_tell_nothing()) {
    diagnostics.note("labels.frame.folder", source, told);
  } else {
    diagnostics.warning("labels.frame.folder", source, told,
                        "check that they are the same pictures, and name their folders like those of the images");
  }
  return out;
}

std::map<std::string, std::string> match_files(const std::string& folder, const std::string& pattern,
                                               const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) {
  std::map<std::string, std::string> out;
  std::map<std::string, std::vector<const FrameInfo*>> frames_of;  // by path
  std::map<std::string, int> frames_of_stem;
  bool speaks_names = false;  // a file is called by a name that only a frame has
  std::vector<const FrameInfo*> as_stem, unlabelled;
  for (const FrameInfo& frame : frames) ++frames_of_stem[file_stem(frame.source)];
  for (const FrameInfo& frame : frames) {
    FrameInfo by_stem = frame;
    by_stem.name = file_stem(frame.source);
    std::string path;
    std::error_code unknown;
    std::vector<fs::path> folders = folders_like(folder, frame.source);
    folders.pop_back();
    for (const fs::path& like : folders) {
      if (!path.empty() || !is_folder(like) || !has_file(like.string(), pattern, by_stem)) continue;
      path = path_of(like.string(), pattern, by_stem);
      if (fs::equivalent(path, frame.source, unknown)) path.clear();
    }
    const bool beside = path.empty() && has_file(folder, pattern, frame);
    if (beside) path = path_of(folder, pattern, frame);
    if (beside && pattern.find("{name}") != std::string::npos) {
      if (frame.name != by_stem.name)
        speaks_names = true;
      else if (frames_of_stem[by_stem.name] > 1)
        as_stem.push_back(&frame);
    }
    if (path.empty()) {
      unlabelled.push_back(&frame);
      continue;
    }
    frames_of[path].push_back(&frame);
    out.emplace(frame.name, path);
  }
  ProblemList problems(diagnostics);
  const auto ambiguous = [&](const std::string& path, const std::string& a, const std::string& b) {
    problems.error("labels.frame.ambiguous", "'" + path + "'", "may be labels of '" + a + "' or of '" + b + "'",
                   "put label files into folders named like those of the images");
  };
  for (const auto& [path, of] : frames_of)
    if (of.size() > 1) ambiguous(path, of[0]->source, of[1]->source);
  for (const FrameInfo* frame : as_stem) {
    if (speaks_names || frames_of[out[frame->name]].size() > 1) continue;
    const auto twin = std::find_if(frames.begin(), frames.end(), [&](const FrameInfo& f) {
      return f.name != frame->name && file_stem(f.source) == file_stem(frame->source);
    });
    if (twin != frames.end()) ambiguous(out[frame->name], frame->source, twin->source);
  }
  // Files of the pattern beside those that are of a frame.
  if (pattern.find('/') == std::string::npos && !out.empty()) {
    const std::string before = pattern.substr(0, pattern.find('{')), after = pattern.substr(pattern.rfind('}') + 1);
    std::set<std::string> own;
    for (const FrameInfo& frame : frames) own.insert(frame.source);
    std::set<fs::path> folders;
    for (const auto& [path, of] : frames_of) folders.insert(fs::path(path).parent_path());
    std::vector<std::string> strays;
    for (const fs::path& where : folders) {
      for (const auto& entry : sorted_folder(where.string())) {
        const std::string path = entry.path().string(), name = entry.path().filename().string();
        if (name.size() > before.size() + after.size() && name.starts_with(before) && name.ends_with(after) &&
            !frames_of.contains(path) && !own.contains(path) && entry.is_regular_file())
          strays.push_back(name);
      }
    }
    report_strays(strays, strays.size() + frames_of.size(), "label files", unlabelled, folder, diagnostics);
  }
  return out;
}

void FramesFiles::match(const std::string& folder, const std::string& pattern, const std::vector<FrameInfo>& frames,
                        Diagnostics& diagnostics) {
  folder_ = folder;
  path_of_frame_ = match_files(folder, pattern, frames, diagnostics);
}

FramesFiles::File FramesFiles::of(const FrameInfo& shown, const std::string& what) const {
  const auto found = path_of_frame_.find(shown.name);
  if (found == path_of_frame_.end())
    refuse_labels("labels.frame.unlabelled", folder_, "no " + what + " of frame '" + shown.name + "'");
  const bool as_stored = folder_has_cameras(found->second);
  return {found->second, as_stored, as_stored ? as_shown(shown) : shown};
}

std::vector<std::string> picture_names(const std::vector<FrameInfo>& frames) {
  std::vector<std::vector<std::string>> parts;
  std::map<std::string, int> count;  // of the ends of paths
  const auto end_of = [&](std::size_t f, std::size_t depth) {
    std::vector<std::string> stems = parts[f];
    stems[0] = file_stem(stems[0]);
    return joined(stems, depth);
  };
  for (std::size_t f = 0; f < frames.size(); ++f) {
    const bool has_file = is_file(frames[f].source);
    parts.push_back(has_file ? parts_from_end(frames[f].source)
                             : std::vector<std::string>{output_name(frames[f].name) + ".png"});
    for (std::size_t depth = 1; depth <= parts[f].size(); ++depth) ++count[end_of(f, depth)];
  }
  std::vector<std::string> out;
  for (std::size_t f = 0; f < frames.size(); ++f) {
    std::size_t depth = 1;
    while (depth < parts[f].size() && count[end_of(f, depth)] > 1) ++depth;
    out.push_back(joined(parts[f], depth));
  }
  return out;
}

}  // namespace semfield
