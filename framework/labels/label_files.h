// What readers of label files share: frames by the names of files, places in patterns, and a bounded list of problems.
#pragma once

#include <functional>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "labels/label_steps.h"
#include "scene/classes/class_names.h"

namespace semfield {

/// File name without folder and extension; '\' counts as a slash, as in files from Windows.
std::string file_stem(std::string_view path);

/// Names by which label files may call a frame: its name, its name with slashes turned into '_', the stem of its
/// source. Several frames may share the last: match_frames (frame_match.h) knows better.
std::vector<std::string> names_of(const FrameInfo& frame);

/// The entry of a frame under any of its names, or nullptr.
template <class T>
const T* entry_of(const std::map<std::string, T>& entries, const FrameInfo& frame) {
  for (const std::string& name : names_of(frame)) {
    if (const auto found = entries.find(name); found != entries.end()) return &found->second;
  }
  return nullptr;
}

/// The frame with a camera of the size of its picture as viewers show it; the other way round too.
FrameInfo as_shown(FrameInfo frame);

/// "{name}" and "{stem}" are the frame's name and the stem of its source, "{number}" the digits at the end of its name,
/// with or without zeros before them. Reports any other place in braces, and a pattern without one.
void check_pattern(const std::string& pattern, Diagnostics& diagnostics);
/// Path of the frame's file, or "" for a frame whose name ends in no digit where the pattern asks for a number.
std::string path_of(const std::string& folder, const std::string& pattern, const FrameInfo& frame);
bool has_file(const std::string& folder, const std::string& pattern, const FrameInfo& frame);

/// Throws Error(data) for labels of another shape than the frame's image (half a pixel of rounding an axis is allowed),
/// or of over 64 times its width, the most that frames are made smaller by: labels of another image. Readers call it
/// with the size that a file states before they make a raster of that size.
void check_label_shape(std::int64_t width, std::int64_t height, const Camera& frame);

/// Whether the folder of the file has a cameras.json, as maps that `semfield render` wrote: they are of the cameras'
/// pixels, which are those of images as stored.
bool folder_has_cameras(const std::string& path);

/// Reports a folder that is not named or is none; true when it is one.
bool check_folder(const std::string& folder, Diagnostics& diagnostics);
/// The same, and reports a folder in which no file can belong to the pattern, with a name that is there.
bool check_folder(const std::string& folder, const std::string& pattern, Diagnostics& diagnostics);

/// Passes problems on to `diagnostics`, the first 20 of them; the rest are counted in one line at the end.
class ProblemList {
 public:
  explicit ProblemList(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}
  ~ProblemList();
  ProblemList(const ProblemList&) = delete;
  ProblemList& operator=(const ProblemList&) = delete;

  void error(Code code, const std::string& where, const std::string& message, const std::string& remedy);
  /// Runs `body`; an Error that it throws becomes a problem.
  void collect(const std::function<void()>& body);
  int count() const { return count_; }

 private:
  Diagnostics& diagnostics_;
  int count_ = 0;
};

/// The table for names found in files, each with the place where it stood first: names that `known` lacks are problems;
/// without a known table one is built from the names in sorted order.
ClassTable table_for(const std::map<std::string, std::string>& place_of_name, const ClassTable& known,
                     ProblemList& problems);

}  // namespace semfield
