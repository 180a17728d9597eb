#include "app/render/video.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <cctype>
#include <cerrno>
#include <csignal>
#include <cstring>
#include <filesystem>
#include <string_view>
#include <utility>
#include <vector>

#include "app/child_process.h"
#include "core/error.h"

namespace semfield::app {

namespace fs = std::filesystem;

std::string find_ffmpeg() {
  const std::string program = program_in_path("ffmpeg");
  if (!program.empty()) return program;
  throw Error(ErrorKind::unavailable, "render.video.ffmpeg", "--video: the program ffmpeg is not in PATH",
              "install it (Debian: apt-get install ffmpeg), or render images and join them elsewhere");
}

std::string video_format(const std::string& path) {
  static constexpr std::array<std::pair<std::string_view, std::string_view>, 8> kFormats{{{".mp4", "mp4"},
                                                                                          {".m4v", "mp4"},
                                                                                          {".mov", "mov"},
                                                                                          {".mkv", "matroska"},
                                                                                          {".webm", "webm"},
                                                                                          {".avi", "avi"},
                                                                                          {".ogv", "ogg"},
                                                                                          {".gif", "gif"}}};
  std::string ending = fs::path(path).extension().string(), known;
  for (char& c : ending) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  for (const auto& [name, format] : kFormats) {
    if (ending == name) return std::string(format);
    known += (known.empty() ? "" : ", ") + std::string(name);
  }
  throw Error(ErrorKind::usage, "render.video.format",
              path + (ending.empty() ? ": no file ending" : ": '" + ending + "' is not the ending of a video file"),
              "name a file such as room.mp4; known: " + known);
}

VideoWriter::VideoWriter(const std::string& ffmpeg, const std::string& path, std::int32_t width_px,
                         std::int32_t height_px, double fps)
    : path_(path), file_(path) {
  // -xerror: without it ffmpeg ends well even where the disk took less than it wrote. Planes of half the size need even
  // sides.
  const std::vector<std::string> words{ffmpeg,
                                       "-hide_banner",
                                       "-loglevel",
                                       "error",
                                       "-xerror",
                                       "-y",
                                       "-f",
                                       "rawvideo",
                                       "-pix_fmt",
                                       "rgb24",
                                       "-s",
                                       fmt::format("{}x{}", width_px, height_px),
                                       "-r",
                                       fmt::format("{}", fps),
                                       "-i",
                                       "pipe:0",
                                       "-an",
                                       "-vf",
                                       "pad=ceil(iw/2)*2:ceil(ih/2)*2",
                                       "-pix_fmt",
                                       "yuv420p",
                                       "-f",
                                       video_format(path),
                                       fmt::format("file:/proc/self/fd/{}", file_.descriptor())};
  std::vector<char*> argv;
  for (const std::string& word : words) argv.push_back(const_cast<char*>(word.c_str()));
  argv.push_back(nullptr);  // all before the fork: the child may not allocate
  std::array<int, 2> ends{};
  if (pipe2(ends.data(), O_CLOEXEC) != 0)
    throw Error(ErrorKind::unavailable, "system.process.limit", "cannot open a pipe to ffmpeg");
  old_handler_ = std::signal(SIGPIPE, SIG_IGN);  // a dead ffmpeg is an error of write(), not the end of this program
  pid_ = fork();
  if (pid_ == 0) {
    dup2(ends[0], STDIN_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO);  // our stdout is for results
    std::signal(SIGPIPE, SIG_DFL);
    fcntl(file_.descriptor(), F_SETFD, 0);
    execv(argv[0], argv.data());
    _exit(127);
  }
  close(ends[0]);
  pipe_ = ends[1];
  if (pid_ < 0) {
    close(pipe_);
    std::signal(SIGPIPE, old_handler_);
    throw Error(ErrorKind::unavailable, "render.video.ffmpeg", "cannot start '" + ffmpeg + "'");
  }
}

VideoWriter::~VideoWriter() {
  if (pid_ > 0) {
    kill(pid_, SIGKILL);  // what it has written is thrown away
    wait();
  }
  std::signal(SIGPIPE, old_handler_);
}

int VideoWriter::wait() {
  if (pipe_ >= 0) close(pipe_);
  pipe_ = -1;
  int status = 0;
  while (waitpid(pid_, &status, 0) < 0 && errno == EINTR) {
  }
  pid_ = -1;
  return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
}

void VideoWriter::fail(const std::string& what, int code) {
  // Where the disk is the cause it refuses us too, and then its words are ours.
  file_.count_written();
  const std::vector<std::byte> more(std::size_t{1} << 20);
  file_.append(more);
  throw Error(ErrorKind::io, "render.video.failed", fmt::format("{}: {} (exit code {})", path_, what, code),
              "its own message is above; try another file ending, or render images without --video");
}

void VideoWriter::add(std::span<const std::uint8_t> rgb) {
  while (!rgb.empty()) {
    const ssize_t n = write(pipe_, rgb.data(), rgb.size());
    if (n < 0 && errno == EINTR) continue;
    if (n <= 0) {
      const std::string cause = std::strerror(errno);
      fail("ffmpeg takes no more frames: " + cause, wait());
    }
    rgb = rgb.subspan(static_cast<std::size_t>(n));
  }
}

void VideoWriter::finish() {
  if (const int code = wait(); code != 0) fail("ffmpeg could not finish the video", code);
  file_.count_written();
  if (file_.size() == 0) fail("ffmpeg wrote nothing", 0);
  file_.commit();
}

}  // namespace semfield::app
