// What lies at the place that a scene is to be made of: a video, or photographs.
#pragma once

#include <cstdint>
#include <functional>
#include <initializer_list>
#include <span>
#include <string>
#include <vector>

#include "core/error.h"

namespace semfield {

// Programs of others that capture starts: ffmpeg, ffprobe and colmap.

/// What is counted while a step goes on: "matching 200/595 pairs".
struct CaptureStep {
  const char* doing;
  const char* unit;
};
/// How far a step is. It may throw to stop the work.
using CaptureProgress = std::function<void(const CaptureStep& step, double done, double total)>;

/// What starts programs; a test replaces it.
struct Programs {
  /// File of the program of that name; "" where there is none.
  std::function<std::string(const std::string& name)> find;
  /// Runs words[0] with the rest as its arguments, no shell between, and waits for its end; what it prints goes into
  /// `log`, anew. `tick` is called now and then. Returns the exit code, or 128 and the number of a signal. Throws
  /// where no process can be had, and whatever stops the work, when the program has ended.
  std::function<int(const std::vector<std::string>& words, const std::string& log, const std::function<void()>& tick)>
      run;
};

/// The program's file. Throws Error(unavailable) with the command that installs it.
std::string program_file(const Programs& programs, const std::string& name);

struct ProgramRun {
  std::vector<std::string> words;  ///< without the program
  std::string log;                 ///< file
  std::function<void()> tick = [] {};
  std::string remedy = "the log says more; COLMAP 3.8 is known to take these words";  ///< for one that fails
};
/// Runs the program `name`. Throws Error(failure) that quotes the last lines of its log where it does not end with 0,
/// and Error(io) where the disk is full, which some programs do not say by their end.
void run_program(const Programs& programs, const std::string& name, const ProgramRun& run);

/// All of a log; "" while there is none.
std::string log_text(const std::string& log);
/// The words of several lists as one.
std::vector<std::string> all_words(std::initializer_list<std::vector<std::string>> lists);

struct Photograph {
  std::string path;
  std::string name;  ///< below the folder of images: "IMG_1.jpg", or "left/1.jpg" where each folder is a camera;
                     ///< of HEIC, which COLMAP does not read, "IMG_1.png"
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
/// it, each of one camera; HEIC where there are no others. Throws Error for what is neither.
CaptureSource look_at_source(const std::string& path);

/// Reports, by the headers alone: files that cannot be read, fewer than three photographs, and of one camera's
/// photographs two sizes or two lenses, by name. Notes those that viewers turn by their EXIF orientation: pixels count
/// as they are stored, as the sensor saw them.
void check_photographs(const CaptureSource& source, Diagnostics& diagnostics);

// How sharp pictures are, and which frames of a film are worth a pose.

/// Variance of the Laplacian over that of the picture [Pertuz13]: a blurred copy of the same picture has less. Grey
/// values, row by row, `width` of them; 0 of an even picture.
double sharpness(std::span<const std::uint8_t> grey, std::int32_t width);
/// Of a photograph, at 1,024 pixels of its longer side. Throws as read_rgb does.
double sharpness_of(const std::string& photograph);
/// Below this share of the median, a picture is called blurred.
inline constexpr double kBlurredShare = 0.3;

/// Frames of a film that are kept, and why others were not.
struct FrameChoice {
  std::vector<std::size_t> kept;  ///< ascending
  std::size_t still = 0;          ///< intervals whose sharpest frame shows what the kept one before it shows
  std::size_t blurred = 0;        ///< intervals whose sharpest frame is blurred
};
/// Of `frames`, small grey pictures of `pixels` values each, the sharpest of each of `intervals` intervals of one
/// length. A frame is still where it differs from the last one kept by less than two grey levels in the mean, and
/// blurred below kBlurredShare of the median of the sharpest.
FrameChoice choose_frames(std::span<const std::uint8_t> frames, std::size_t pixels, std::int32_t width,
                          std::size_t intervals);

// Photographs out of a video, by ffmpeg.

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

/// Writes the sharpest frame of each of `wanted` intervals (choose_frames), upright and at full size. Throws Error for
/// a file that ffmpeg finds no video in, and for a film of fewer than three different frames.
VideoFrames cut_video(const VideoCut& cut, const Programs& programs, const CaptureProgress& progress);

}  // namespace semfield
