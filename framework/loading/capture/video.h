// Photographs out of a video, by ffmpeg.
#pragma once

#include <string>
#include <vector>

#include "loading/capture/programs.h"

namespace semfield {

struct VideoFrames {
  std::vector<std::string> names;  ///< of the files written, in the order of time
  double seconds = 0;              ///< of the video
  std::size_t looked_at = 0, intervals = 0, still = 0, blurred = 0;
};

struct VideoCut {
  std::string video;
  std::string folder;      ///< gets the frames as "frame_000123.jpg"; replaced
  std::string logs;        ///< folder of the logs
  std::size_t wanted = 0;  ///< frames to keep at most; 0: three a second, 30 to 300
};

/// The file as words of ffmpeg and ffprobe that take a film of one file and nothing else: a playlist would have them
/// read what it names.
std::vector<std::string> film_words(const std::string& video);

/// Writes the sharpest frame of each of `wanted` intervals (choose_frames), upright and at full size. Throws Error for
/// a file that ffmpeg finds no video in, and for a film of fewer than three different frames.
VideoFrames cut_video(const VideoCut& cut, const Programs& programs, const CaptureProgress& progress);

}  // namespace semfield
