// What lies at the place that a scene is to be made of: a video, or photographs.
#pragma once

#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

struct Photograph {
  std::string path;
  std::string name;  ///< below the folder of images: "IMG_1.jpg", or "left/1.jpg" where each folder is a camera
};

struct CaptureSource {
  std::string path;
  bool video = false;
  bool camera_per_folder = false;
  std::vector<Photograph> photographs;  ///< in the order in which people count; none of a video
};

/// Whether `a` comes before `b` where runs of digits are numbers: "2.jpg" before "10.jpg".
bool comes_before(const std::string& a, const std::string& b);

/// A file is a video. Of a folder the photographs in it count, or in its folder `images`, or those of the folders in
/// it, each of one camera. Throws Error for what is neither.
CaptureSource look_at_source(const std::string& path);

/// Reports, by the headers alone: files that cannot be read, fewer than three photographs, and of one camera's
/// photographs two sizes or two lenses, by name. Notes those that viewers turn by their EXIF orientation: pixels count
/// as they are stored, as the sensor saw them.
void check_photographs(const CaptureSource& source, Diagnostics& diagnostics);

}  // namespace semfield
