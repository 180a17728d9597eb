// Frames into a video file through the program ffmpeg: no shell, raw RGB over a pipe.
#pragma once

#include <cstdint>
#include <span>
#include <string>

#include "system/files.h"

namespace semfield::app {

/// Path of ffmpeg in PATH. Throws Error(unavailable) with how to get it.
std::string find_ffmpeg();

/// ffmpeg's name for what the ending of `path` stands for. Throws Error(usage) for none and for one that is not known.
std::string video_format(const std::string& path);

/// One video. Frames go to ffmpeg as they come, into a temporary file of ours beside `path` (AtomicFile): the file of
/// that name is replaced when finish() has seen ffmpeg end well and the bytes on the disk. Without finish() ffmpeg is
/// stopped and nothing stays.
class VideoWriter {
 public:
  /// Throws Error(unavailable) when ffmpeg cannot be started, write_error where no file can be made.
  VideoWriter(const std::string& ffmpeg, const std::string& path, std::int32_t width_px, std::int32_t height_px,
              double fps);
  ~VideoWriter();
  VideoWriter(const VideoWriter&) = delete;
  VideoWriter& operator=(const VideoWriter&) = delete;

  /// rgb [height * width * 3]. Throws Error(io) when ffmpeg has ended, with the cause where the disk reports it.
  void add(std::span<const std::uint8_t> rgb);
  void finish();

 private:
  [[noreturn]] void fail(const std::string& what, int code);
  int wait();
  std::string path_;
  AtomicFile file_;
  int pid_ = -1, pipe_ = -1;
  void (*old_handler_)(int) = nullptr;
};

}  // namespace semfield::app
