#include "scene/loading/capture/photographs.h"

#include <fmt/format.h>
#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <fstream>
#include <map>
#include <new>
#include <nlohmann/json.hpp>
#include <optional>

#include "compute/parallel.h"
#include "core/files.h"
#include "core/non_copyable.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "scene/loading/frame_files.h"
#include "scene/survey/bundle.h"

namespace semfield {

std::string program_file(const Programs& programs, const std::string& name) {
  std::string file = programs.find(name);
  if (!file.empty()) return file;
  const std::string package = name == "colmap" ? "colmap" : "ffmpeg";
  throw Error(ErrorKind::unavailable, "capture.program.missing", "the program " + name + " is not in PATH",
              "install it: sudo apt install " + package);
}

std::string log_text(const std::string& log) {
  try {
    return read_text_file(log);
  } catch (const Error&) {
    return "";
  }
}

std::vector<std::string> all_words(std::initializer_list<std::vector<std::string>> lists) {
  std::vector<std::string> out;
  for (const std::vector<std::string>& list : lists) out.insert(out.end(), list.begin(), list.end());
  return out;
}

namespace {

// The last lines of a log that say something, at most `most` of them, joined by " | ".
std::string last_lines(const std::string& log, std::size_t most) {
  const std::string text = log_text(log);
  std::vector<std::string> lines;
  std::string_view rest = text;
  for (std::string_view line; next_line(rest, line);) {
    const std::size_t first = line.find_first_not_of(" \t=");
    if (first != std::string_view::npos && is_line_of_text(line)) lines.emplace_back(line.substr(first));
  }
  if (lines.size() > most) lines.erase(lines.begin(), lines.end() - static_cast<std::ptrdiff_t>(most));
  return join(lines, " | ");
}

// Where the disk is what a program failed for, it refuses us too, and then its words are ours.
void require_disk(const fs::path& folder) {
  AtomicFile file((folder / "room").string());
  file.append(std::vector<std::byte>(std::size_t{1} << 20));
}

}  // namespace

void run_program(const Programs& programs, const std::string& name, const ProgramRun& run) {
  const int code = programs.run(all_words({{program_file(programs, name)}, run.words}), run.log, run.tick);
  require_disk(fs::path(run.log).parent_path());
  if (code == 0) return;
  const std::string said = last_lines(run.log, 3);
  const std::string what = name == "colmap" && !run.words.empty() ? name + " " + run.words[0] : name;
  if (log_text(run.log).find(std::strerror(ENOSPC)) != std::string::npos)
    throw Error(ErrorKind::io, "files.write.failed",
                what + " found the disk full: " + said + "; its log is '" + run.log + "'",
                "free some space; the same command continues");
  throw Error(ErrorKind::failure, "capture.program.failed",
              fmt::format("{} failed ({} {}){}; its log is '{}'", what, code > 128 ? "signal" : "exit code",
                          code > 128 ? code - 128 : code, said.empty() ? "" : ": " + said, run.log),
              run.remedy);
}

namespace {

constexpr std::array<std::string_view, 10> kVideos{".mp4", ".mov", ".m4v", ".mkv", ".webm",
                                                   ".avi", ".3gp", ".mts", ".mpg", ".wmv"};
constexpr std::array<std::string_view, 2> kHeic{".heic", ".heif"};
constexpr std::size_t kFewest = 3;

using Endings = std::span<const std::string_view>;

bool is_heic(const std::string& path) { return std::ranges::find(kHeic, ending_of(path)) != kHeic.end(); }

void add_photographs(const fs::path& folder, const std::string& prefix, Endings endings, std::vector<Photograph>& out) {
  std::vector<std::string> files = files_with(folder.string(), endings);
  std::sort(files.begin(), files.end(), comes_before);
  for (std::string& file : files) {
    fs::path name = fs::path(file).filename();
    if (is_heic(file)) name.replace_extension(".png");
    out.push_back({std::move(file), prefix + name.string()});
  }
}

void find_photographs(const std::string& path, Endings endings, CaptureSource& out) {
  std::error_code unknown;
  add_photographs(path, "", endings, out.photographs);
  if (out.photographs.size() < kFewest) {
    std::vector<Photograph> inner;
    add_photographs(fs::path(path) / "images", "", endings, inner);
    if (inner.size() >= kFewest) out.photographs = inner;
  }
  if (!out.photographs.empty()) return;
  for (const fs::directory_entry& entry : sorted_folder(path))
    if (entry.is_directory(unknown))
      add_photographs(entry.path(), entry.path().filename().string() + "/", endings, out.photographs);
  out.camera_per_folder = !out.photographs.empty();
}

// "30 of 4032 x 3024 (a.jpg, b.jpg, ...)" of each kind.
std::string kinds_text(const std::map<std::string, std::vector<std::string>>& kinds) {
  std::vector<std::string> parts;
  for (const auto& [kind, names] : kinds) {
    std::vector<std::string> named = names;
    named.resize(std::min<std::size_t>(names.size(), 3));
    if (named.size() < names.size()) named.emplace_back("...");
    parts.push_back(fmt::format("{} of {} ({})", names.size(), kind, join(named)));
  }
  return join(parts, " and ");
}

std::string lens_text(const CameraTag& tag) {
  const std::string model = tag.model.empty() ? "an unnamed camera" : tag.model;
  const long hundredths = std::lround(100 * tag.focal_mm);
  return tag.focal_mm > 0 ? fmt::format("{} at {}.{:02} mm", model, hundredths / 100, hundredths % 100) : model;
}

}  // namespace

bool comes_before(const std::string& a, const std::string& b) {
  std::size_t i = 0, j = 0;
  while (i < a.size() && j < b.size()) {
    if (!is_digit(a[i]) || !is_digit(b[j])) {
      if (a[i] != b[j]) return a[i] < b[j];
      ++i;
      ++j;
      continue;
    }
    const auto number = [](const std::string& text, std::size_t& at) {
      while (at < text.size() && text[at] == '0') ++at;
      const std::size_t first = at;
      while (at < text.size() && is_digit(text[at])) ++at;
      return text.substr(first, at - first);
    };
    const std::string x = number(a, i), y = number(b, j);
    if (x.size() != y.size()) return x.size() < y.size();
    if (x != y) return x < y;
  }
  if ((i < a.size()) != (j < b.size())) return j < b.size();
  return a < b;  // "01" and "1"
}

CaptureSource look_at_source(const std::string& path) {
  CaptureSource out;
  out.path = fs::absolute(path).lexically_normal().string();
  if (out.path.size() > 1 && out.path.ends_with('/')) out.path.pop_back();
  const std::string remedy = "name a video, or a folder of photographs (.jpg, .png, .tif, .heic)";
  if (!is_there(path))
    throw Error(ErrorKind::no_input, "files.folder.missing", "'" + path + "' is not there", "check the path");
  if (!is_folder(path)) {
    if (std::find(kVideos.begin(), kVideos.end(), ending_of(path)) == kVideos.end())
      throw Error(ErrorKind::no_input, "capture.source.kind", "'" + path + "' is not a video, by its name", remedy);
    out.video = true;
    return out;
  }
  find_photographs(path, kPhotographs, out);
  if (out.photographs.empty()) find_photographs(path, kHeic, out);
  if (!out.photographs.empty()) return out;
  const std::vector<std::string> videos = files_with(path, kVideos);
  throw Error(ErrorKind::no_input, "capture.source.empty", "'" + path + "' holds no photographs",
              videos.empty() ? remedy : "name the video itself: " + shell_word(videos.front()));
}

void check_photographs(const CaptureSource& source, Diagnostics& diagnostics) {
  const std::vector<Photograph>& all = source.photographs;
  if (source.video) return;
  if (all.size() < kFewest)
    diagnostics.error("capture.photographs.few", source.path,
                      std::to_string(all.size()) + " photographs are too few for poses",
                      "take at least 20, each sharing two thirds of what the one before shows");
  std::vector<ImageSize> sizes(all.size());
  std::vector<CameraTag> tags(all.size());
  std::vector<std::optional<Error>> errors(all.size());
  parallel_for(static_cast<std::int64_t>(all.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    try {
      sizes[i] = image_size(all[i].path);
      tags[i] = camera_tag(all[i].path);
    } catch (const Error& e) {
      errors[i] = e;
    }
  });
  using Kinds = std::map<std::string, std::vector<std::string>>;
  std::map<std::string, Kinds> by_size, by_lens;  // of each folder that is a camera
  std::size_t turned = 0;
  for (std::size_t i = 0; i < all.size(); ++i) {
    if (errors[i] && is_heic(all[i].path)) {
      diagnostics.error("capture.photographs.heic", "", errors[i]->message(),
                        "install a decoder (sudo apt install libheif-plugin-libde265; it is part of libheif1 on Debian "
                        "12), or make JPEG of them with `heif-convert IMG.heic IMG.jpg` (libheif-examples)");
      continue;
    }
    if (errors[i]) {
      diagnostics.error(errors[i]->code(), "", errors[i]->message(),
                        errors[i]->remedy() + "; or take the file out of the folder");
      continue;
    }
    const std::string folder = source.camera_per_folder ? all[i].name.substr(0, all[i].name.find('/')) : "";
    by_size[folder][size_text(sizes[i].width_px, sizes[i].height_px)].push_back(all[i].name);
    by_lens[folder][lens_text(tags[i])].push_back(all[i].name);
    turned += sizes[i].orientation != 1 ? 1 : 0;
  }
  const std::string apart = "take the few out, or put those of each camera into a folder of its own inside '" +
                            source.path + "': each folder is then one camera";
  for (const auto& [folder, kinds] : by_size) {
    const std::string place = folder.empty() ? source.path : source.path + "/" + folder;
    if (kinds.size() > 1)
      diagnostics.error("capture.photographs.sizes", place, "photographs of several sizes: " + kinds_text(kinds),
                        apart);
    else if (by_lens[folder].size() > 1)
      diagnostics.error("capture.photographs.cameras", place,
                        "photographs of several cameras or zooms: " + kinds_text(by_lens[folder]), apart);
  }
  if (turned > 0)
    diagnostics.note(
        "scene.image.orientation", source.path,
        fmt::format("{} of {} photographs have an EXIF orientation by which viewers turn them; here pixels "
                    "count as they are stored, as the sensor saw them",
                    turned, all.size()));
}

double sharpness(std::span<const std::uint8_t> grey, std::int32_t width) {
  const auto w = static_cast<std::size_t>(width), rows = grey.size() / w;
  if (w < 3 || rows < 3) return 0;
  double sum = 0, squares = 0, of_laplacian = 0, squares_of_laplacian = 0;
  for (std::size_t y = 1; y + 1 < rows; ++y) {
    for (std::size_t x = 1; x + 1 < w; ++x) {
      const std::uint8_t* p = grey.data() + y * w + x;
      const double here = *p, laplacian = 4.0 * here - p[-1] - p[1] - *(p - w) - *(p + w);
      sum += here;
      squares += here * here;
      of_laplacian += laplacian;
      squares_of_laplacian += laplacian * laplacian;
    }
  }
  const double count = static_cast<double>((w - 2) * (rows - 2));
  const double variance = squares / count - sum / count * (sum / count);
  const double of_edges = squares_of_laplacian / count - of_laplacian / count * (of_laplacian / count);
  return variance > 0 ? of_edges / variance : 0;
}

double sharpness_of(const std::string& photograph) {
  Image<std::uint8_t> image = read_rgb(photograph);
  constexpr std::int32_t kLongest = 1024;
  const std::int32_t longest = std::max(image.width_px, image.height_px);
  if (longest > kLongest)
    image = resize_area(image, std::max(1, image.width_px * kLongest / longest),
                        std::max(1, image.height_px * kLongest / longest));
  std::vector<std::uint8_t> grey;
  grey.reserve(image.pixels.size() / 3);
  for (std::size_t i = 0; i + 2 < image.pixels.size(); i += 3)
    grey.push_back(static_cast<std::uint8_t>((image.pixels[i] + 2 * image.pixels[i + 1] + image.pixels[i + 2]) / 4));
  return sharpness(grey, image.width_px);
}

FrameChoice choose_frames(std::span<const std::uint8_t> frames, std::size_t pixels, std::int32_t width,
                          std::size_t intervals) {
  constexpr double kStill = 2;
  const std::size_t count = frames.size() / pixels;
  std::vector<double> sharp(count);
  parallel_for(static_cast<std::int64_t>(count), [&](std::int64_t i) {
    sharp[static_cast<std::size_t>(i)] = sharpness(frames.subspan(static_cast<std::size_t>(i) * pixels, pixels), width);
  });
  std::vector<std::size_t> best;
  std::vector<double> of_best;
  const std::size_t parts = std::min(intervals, count);
  for (std::size_t k = 0; k < parts; ++k) {
    const auto first = sharp.begin() + static_cast<std::ptrdiff_t>(k * count / parts);
    const auto last = sharp.begin() + static_cast<std::ptrdiff_t>((k + 1) * count / parts);
    const auto top = std::max_element(first, last);
    best.push_back(static_cast<std::size_t>(top - sharp.begin()));
    of_best.push_back(*top);
  }
  const double least = kBlurredShare * median_of(of_best);
  FrameChoice out;
  for (const std::size_t frame : best) {
    if (sharp[frame] < least) {
      ++out.blurred;
      continue;
    }
    if (!out.kept.empty()) {
      double off = 0;
      for (std::size_t p = 0; p < pixels; ++p)
        off += std::abs(frames[frame * pixels + p] - frames[out.kept.back() * pixels + p]);
      if (off < kStill * static_cast<double>(pixels)) {
        ++out.still;
        continue;
      }
    }
    out.kept.push_back(frame);
  }
  return out;
}

namespace {

constexpr std::int32_t kSide = 256;  // of the small pictures that are compared
constexpr std::size_t kPixels = std::size_t{kSide} * kSide;
constexpr std::size_t kLooks = 8;            // frames of an interval that are looked at, at most
constexpr std::size_t kMostSelected = 2000;  // by one call of ffmpeg: a word of a command line holds 128 KiB

// All of a file that may be larger than memory.
class MappedFile : NonCopyable {
 public:
  explicit MappedFile(const std::string& path) : size_(fs::file_size(path)) {
    if (size_ == 0) return;
    data_ = mmap(nullptr, size_, PROT_READ, MAP_PRIVATE, open_for_reading(path), 0);
    if (data_ == MAP_FAILED) throw std::bad_alloc();
  }
  ~MappedFile() {
    if (size_ > 0) munmap(data_, size_);
  }
  std::span<const std::uint8_t> bytes() const { return {static_cast<const std::uint8_t*>(data_), size_}; }

 private:
  std::size_t size_;
  void* data_ = nullptr;
};

// Words of ffmpeg and ffprobe that take a film of one file and nothing else: a playlist would have them read what it
// names.
std::vector<std::string> film_words(const std::string& video) {
  return {
      "-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts,mpeg,mpegvideo,asf", "-i", video};
}

double seconds_of(const std::string& video, const std::string& log, const Programs& programs) {
  const std::string remedy = "check that the file plays, or convert it: ffmpeg -i " + shell_word(video) + " video.mp4";
  const std::string asked = "-v error -select_streams v:0 -show_entries stream=codec_type:format=duration -of json";
  try {
    run_program(programs, "ffprobe",
                {.words = all_words({word_list(asked), film_words(video)}), .log = log, .remedy = remedy});
  } catch (const Error&) {
    // Since version 7 ffmpeg calls a playlist with another ending invalid, and names no whitelist.
    std::string begin(7, ' ');
    std::ifstream(video).read(begin.data(), std::ssize(begin));
    if (log_text(log).find("not on whitelist") == std::string::npos && begin != "#EXTM3U") throw;
    throw Error(ErrorKind::data, "capture.video.format",
                "'" + video + "' is not a film in a single file: " + last_lines(log, 1),
                "if you trust the files that it names, convert it to .mp4");
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

}  // namespace

VideoFrames cut_video(const VideoCut& cut, const Programs& programs, const CaptureProgress& progress) {
  VideoFrames out;
  out.seconds = seconds_of(cut.video, (fs::path(cut.logs) / "ffprobe.txt").string(), programs);
  out.intervals =
      cut.wanted > 0 ? cut.wanted : std::clamp<std::size_t>(static_cast<std::size_t>(3 * out.seconds), 30, 300);
  // The same filter gives the same frames to look at and to keep, so that a frame is known by its number.
  const auto total = static_cast<double>(kLooks * out.intervals);
  const std::string rate = fmt::format("fps={:.6f}", total / out.seconds);
  fs::remove_all(cut.folder);
  create_folders(cut.folder);
  const std::string small = (fs::path(cut.folder) / "small.grey").string();
  const std::string remedy = "check that the file plays to its end";
  const auto size_of = [](const std::string& file) {
    std::error_code unknown;
    const auto bytes = fs::file_size(file, unknown);
    return unknown ? 0.0 : static_cast<double>(bytes);
  };
  const auto ffmpeg = [&](const std::vector<std::string>& more, const char* log, std::function<void()> tick) {
    run_program(programs, "ffmpeg",
                {.words = all_words({word_list("-v error -nostdin -y"), film_words(cut.video), more}),
                 .log = (fs::path(cut.logs) / log).string(),
                 .tick = std::move(tick),
                 .remedy = remedy});
  };
  ffmpeg(
      {"-an", "-vf", fmt::format("{},scale={}:{}:flags=area,format=gray", rate, kSide, kSide), "-f", "rawvideo", small},
      "ffmpeg_look.txt", [&] {
        progress({"looking at", "frames"}, std::min(size_of(small) / kPixels, total), total);
      });
  FrameChoice choice;
  {
    const MappedFile frames(small);
    out.looked_at = frames.bytes().size() / kPixels;
    choice = choose_frames(frames.bytes().first(out.looked_at * kPixels), kPixels, kSide, out.intervals);
  }
  fs::remove(small);
  out.still = choice.still;
  out.blurred = choice.blurred;
  if (choice.kept.size() < 3)
    throw Error(ErrorKind::data, "capture.video.still",
                fmt::format("'{}' has {} different frames of {} looked at: {} intervals are still, {} blurred",
                            cut.video, choice.kept.size(), out.looked_at, choice.still, choice.blurred),
                "walk around the scene slowly while filming");
  const auto kept = static_cast<double>(choice.kept.size());
  const auto file_of = [&](std::size_t number) { return fmt::format("{}/{:06}.jpg", cut.folder, number); };
  std::size_t written = 0;
  for (std::size_t first = 0; first < choice.kept.size(); first += kMostSelected) {
    const std::size_t last = std::min(first + kMostSelected, choice.kept.size());
    std::string select = "select=";
    for (std::size_t i = first; i < last; ++i)
      select += (i == first ? "eq(n\\," : "+eq(n\\,") + std::to_string(choice.kept[i]) + ")";
    ffmpeg({"-an", "-vf", rate + "," + select, "-fps_mode", "passthrough", "-frames:v", std::to_string(last - first),
            "-q:v", "2", "-start_number", std::to_string(first + 1), pattern_of(cut.folder) + "/%06d.jpg"},
           "ffmpeg_keep.txt", [&] {
             while (fs::exists(file_of(written + 1))) ++written;
             progress({"writing", "frames"}, static_cast<double>(written), kept);
           });
  }
  for (std::size_t i = 0; i < choice.kept.size(); ++i) {
    out.names.push_back(fmt::format("frame_{:06}.jpg", choice.kept[i]));
    std::error_code failed;
    fs::rename(file_of(i + 1), fs::path(cut.folder) / out.names.back(), failed);
    if (failed)
      throw Error(ErrorKind::data, "capture.video.short",
                  fmt::format("ffmpeg wrote {} of {} frames of '{}'", i, choice.kept.size(), cut.video), remedy);
  }
  return out;
}

}  // namespace semfield
