// Frames into a video file through the program ffmpeg: no shell, raw RGB over a pipe.
#pragma once

#include <cstdint>
#include <span>
#include <string>

namespace semfield::app {

/// Path of ffmpeg in PATH. Throws Error(unavailable) with how to get it.
std::string find_ffmpeg();

/// One video. Frames go to ffmpeg as they come; the file gets its name when finish() has seen ffmpeg end well. Without
/// finish() ffmpeg is stopped and nothing stays.
class VideoWriter {
 public:
  /// `path` ends with .mp4, .mkv, .webm or whatever else ffmpeg knows. Throws Error(unavailable) when it cannot be
  /// started.
  VideoWriter(const std::string& ffmpeg, std::string path, std::int32_t width_px, std::int32_t height_px, double fps);
  ~VideoWriter();
  VideoWriter(const VideoWriter&) = delete;
  VideoWriter& operator=(const VideoWriter&) = delete;

  /// rgb [height * width * 3]. Throws Error(io) when ffmpeg has ended; its own words stand on stderr.
  void add(std::span<const std::uint8_t> rgb);
  void finish();

 private:
  [[noreturn]] void fail(const std::string& what, int code);
  int wait();
  std::string path_, partial_;
  int pid_ = -1, pipe_ = -1;
  void (*old_handler_)(int) = nullptr;
};

}  // namespace semfield::app
