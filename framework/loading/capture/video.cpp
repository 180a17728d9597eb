#include "loading/capture/video.h"

#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <new>
#include <nlohmann/json.hpp>
#include <span>

#include "core/text.h"
#include "loading/capture/sharpness.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::int32_t kSide = 256;  // of the small pictures that are compared
constexpr std::size_t kPixels = std::size_t{kSide} * kSide;
constexpr std::size_t kLooks = 8;            // frames of an interval that are looked at, at most
constexpr std::size_t kMostSelected = 2000;  // by one call of ffmpeg: a word of a command line holds 128 KiB

// All of a file that may be larger than memory.
class MappedFile {
 public:
  explicit MappedFile(const std::string& path) : size_(fs::file_size(path)) {
    if (size_ == 0) return;
    const int file = open_for_reading(path);
    data_ = mmap(nullptr, size_, PROT_READ, MAP_PRIVATE, file, 0);
    close(file);
    if (data_ == MAP_FAILED) throw std::bad_alloc();
  }
  MappedFile(const MappedFile&) = delete;
  MappedFile& operator=(const MappedFile&) = delete;
  ~MappedFile() {
    if (size_ > 0) munmap(data_, size_);
  }
  std::span<const std::uint8_t> bytes() const { return {static_cast<const std::uint8_t*>(data_), size_}; }

 private:
  std::size_t size_;
  void* data_ = nullptr;
};

double seconds_of(const std::string& video, const std::string& log, const Programs& programs) {
  const std::string remedy = "check that the file plays, or convert it: ffmpeg -i " + shell_word(video) + " video.mp4";
  std::vector<std::string> words{
      "-v", "error", "-select_streams", "v:0", "-show_entries", "stream=codec_type:format=duration", "-of", "json"};
  const std::vector<std::string> film = film_words(video);
  words.insert(words.end(), film.begin(), film.end());
  try {
    run_program(programs, "ffprobe", {.words = words, .log = log, .remedy = remedy});
  } catch (const Error&) {
    if (log_text(log).find("not on whitelist") == std::string::npos) throw;
    throw Error(ErrorKind::data, "capture.video.format",
                "'" + video + "' is no film in one file: " + last_lines(log, 1),
                "convert it to .mp4 yourself, where you trust what it names");
  }
  const std::string text = log_text(log);
  const std::size_t begin = text.find('{');
  const nlohmann::json told =
      nlohmann::json::parse(begin == std::string::npos ? "" : text.substr(begin), nullptr, false);
  double seconds = 0;
  const bool has_video = told.is_object() && told.contains("streams") && !told["streams"].empty();
  if (has_video && told.contains("format") && told["format"].contains("duration") &&
      told["format"]["duration"].is_string())
    (void)parse_number(told["format"]["duration"].get<std::string>(), seconds);
  if (!(seconds > 0 && seconds < 1e6))
    throw Error(ErrorKind::data, "capture.video.empty", "'" + video + "' holds no video of a known length", remedy);
  return seconds;
}

// For the name of a numbered file: ffmpeg takes a single '%' for the place of the number.
std::string pattern_of(const std::string& folder) {
  std::string out;
  for (const char c : folder) out += c == '%' ? "%%" : std::string(1, c);
  return out;
}

std::string rate_text(double frames, double seconds) {
  char text[64];
  std::snprintf(text, sizeof text, "%.6f", frames / seconds);
  return text;
}

}  // namespace

std::vector<std::string> film_words(const std::string& video) {
  return {
      "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf", "-i", video};
}

VideoFrames cut_video(const VideoCut& cut, const Programs& programs, const CaptureProgress& progress) {
  VideoFrames out;
  out.seconds = seconds_of(cut.video, (fs::path(cut.logs) / "ffprobe.txt").string(), programs);
  out.intervals =
      cut.wanted > 0 ? cut.wanted : std::clamp<std::size_t>(static_cast<std::size_t>(3 * out.seconds), 30, 300);
  // The same filter gives the same frames to look at and to keep, so that a frame is known by its number.
  const std::string rate = "fps=" + rate_text(static_cast<double>(kLooks * out.intervals), out.seconds);
  fs::remove_all(cut.folder);
  create_folders(cut.folder);
  const std::string small = (fs::path(cut.folder) / "small.grey").string();
  const std::string remedy = "check that the file plays to its end";
  const auto total = static_cast<double>(kLooks * out.intervals);
  const auto size_of = [](const std::string& file) {
    std::error_code unknown;
    const auto bytes = fs::file_size(file, unknown);
    return unknown ? 0.0 : static_cast<double>(bytes);
  };
  const auto words_of_film = [&](const std::vector<std::string>& more) {
    std::vector<std::string> words{"-v", "error", "-nostdin", "-y"};
    for (const std::vector<std::string>& part : {film_words(cut.video), more})
      words.insert(words.end(), part.begin(), part.end());
    return words;
  };
  run_program(programs, "ffmpeg",
              {.words = words_of_film(
                   {"-an", "-vf",
                    rate + ",scale=" + std::to_string(kSide) + ":" + std::to_string(kSide) + ":flags=area,format=gray",
                    "-f", "rawvideo", small}),
               .log = (fs::path(cut.logs) / "ffmpeg_look.txt").string(),
               .tick =
                   [&] {
                     progress({"looking at", "frames"}, std::min(size_of(small) / kPixels, total), total);
                   },
               .remedy = remedy});
  FrameChoice choice;
  {
    const MappedFile frames(small);
    out.looked_at = frames.bytes().size() / kPixels;
    choice = choose_frames(frames.bytes().first(out.looked_at * kPixels), kPixels, kSide, out.intervals);
  }
  fs::remove(small);
  out.still = choice.still;
  out.blurred = choice.blurred;
  if (choice.kept.size() < 3) {
    throw Error(ErrorKind::data, "capture.video.still",
                "'" + cut.video + "' has " + std::to_string(choice.kept.size()) + " different frames of " +
                    std::to_string(out.looked_at) + " looked at: " + std::to_string(choice.still) +
                    " intervals are still, " + std::to_string(choice.blurred) + " blurred",
                "walk around the scene slowly while filming");
  }
  const auto kept = static_cast<double>(choice.kept.size());
  const auto file_of = [&](std::size_t number) {
    char name[32];
    std::snprintf(name, sizeof name, "%06zu.jpg", number);
    return (fs::path(cut.folder) / name).string();
  };
  std::size_t written = 0;
  for (std::size_t first = 0; first < choice.kept.size(); first += kMostSelected) {
    const std::size_t last = std::min(first + kMostSelected, choice.kept.size());
    std::string select = "select=";
    for (std::size_t i = first; i < last; ++i)
      select += (i == first ? "eq(n\\," : "+eq(n\\,") + std::to_string(choice.kept[i]) + ")";
    run_program(programs, "ffmpeg",
                {.words = words_of_film({"-an", "-vf", rate + "," + select, "-fps_mode", "passthrough", "-frames:v",
                                         std::to_string(last - first), "-q:v", "2", "-start_number",
                                         std::to_string(first + 1), pattern_of(cut.folder) + "/%06d.jpg"}),
                 .log = (fs::path(cut.logs) / "ffmpeg_keep.txt").string(),
                 .tick =
                     [&] {
                       while (fs::exists(file_of(written + 1))) ++written;
                       progress({"writing", "frames"}, static_cast<double>(written), kept);
                     },
                 .remedy = remedy});
  }
  for (std::size_t i = 0; i < choice.kept.size(); ++i) {
    char name[32];
    std::snprintf(name, sizeof name, "frame_%06zu.jpg", choice.kept[i]);
    std::error_code failed;
    fs::rename(file_of(i + 1), fs::path(cut.folder) / name, failed);
    if (failed)
      throw Error(ErrorKind::data, "capture.video.short",
                  "ffmpeg wrote " + std::to_string(i) + " of " + std::to_string(choice.kept.size()) + " frames of '" +
                      cut.video + "'",
                  remedy);
    out.names.emplace_back(name);
  }
  return out;
}

}  // namespace semfield
