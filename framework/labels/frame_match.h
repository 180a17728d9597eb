// Which frame a label file means: pictures as tools name them against the images of the frames.
#pragma once

#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "scene/scene.h"

namespace semfield {

/// A picture that a label file has labels of.
struct PictureName {
  std::string path;        ///< as the file names it, with as many folders as it tells; '\' counts as '/'
  std::string place;       ///< for messages
  std::string other = {};  ///< another name, which decides where `path` does not; or ""
  std::string file = {};   ///< path of the picture on this machine, where the label file's own place tells it; or ""
  bool labelled = true;    ///< false: nothing is lost where it belongs to no frame
};

/// Frames by name, each with the index of its picture. A picture belongs to the frame whose image has its name, with or
/// without an extension, and most of its folders, from the last; or to that whose FrameInfo::name it is, which goes
/// before. It does not belong to a frame in a folder of another name where other frames or pictures have that folder,
/// or the picture's own: left/0001 is never right/0001. Reported under `source`: pictures that may be of several
/// frames, and two of one frame (errors); pictures with labels of no frame, counted and named with the frame that they
/// may be meant for (a warning, or a note where none is like them); folders that differ (a warning).
std::map<std::string, std::size_t> match_frames(const std::vector<PictureName>& pictures,
                                                const std::vector<FrameInfo>& frames, const std::string& source,
                                                Diagnostics& diagnostics);

/// One file a frame, found by a pattern (label_files.h): by frame's name, its path. A file in a folder under `folder`
/// that is called as that of the frame's image goes before one in `folder` itself. Reported as by match_frames: files
/// that are of several frames, and files of no frame beside those that are of one.
std::map<std::string, std::string> match_files(const std::string& folder, const std::string& pattern,
                                               const std::vector<FrameInfo>& frames, Diagnostics& diagnostics);

/// The label files of a reader whose frames have a file each.
class FramesFiles {
 public:
  void clear() { path_of_frame_.clear(); }
  /// As match_files.
  void match(const std::string& folder, const std::string& pattern, const std::vector<FrameInfo>& frames,
             Diagnostics& diagnostics);
  bool has(const FrameInfo& frame) const { return path_of_frame_.contains(frame.name); }

  struct File {
    std::string path;
    bool as_stored = false;  ///< of the image's pixels as stored (folder_has_cameras), not as shown
    FrameInfo frame;         ///< with a camera of the picture that the labels are of
  };
  /// `shown`: as_shown() of the frame, as readers get it. Throws Error(data): there is no `what` of it.
  File of(const FrameInfo& shown, const std::string& what) const;

 private:
  std::string folder_;
  std::map<std::string, std::string> path_of_frame_;
};

/// For each frame the name of its image with as few folders as tell it from the others, by which match_frames finds it
/// again; the name of the frame where it has no image file.
std::vector<std::string> picture_names(const std::vector<FrameInfo>& frames);

}  // namespace semfield
