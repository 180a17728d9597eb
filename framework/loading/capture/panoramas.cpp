#include "loading/capture/panoramas.h"

#include <fmt/format.h>

#include <filesystem>
#include <set>

#include "formats/image_io.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr int kViews = 8, kFieldDeg = 90;

void check_shape(const fs::path& file, const std::string& name, ImageSize size) {
  if (size.width_px == 2 * size.height_px && size.width_px >= 64) return;
  throw Error(ErrorKind::data, "capture.panoramas.shape",
              fmt::format("'{}' is {} x {}: an equirectangular panorama is twice as wide as high", file.string(),
                          size.width_px, size.height_px),
              fmt::format("take '{}' out, or do without --lens equirectangular", name));
}

// By what it holds, as the reader of photographs does.
const char* decoder_of(const std::string& file) {
  const std::string start = read_file_start(file, 4);
  return start == "\x89PNG"                                                     ? "png"
         : start == std::string("II*\0", 4) || start == std::string("MM\0*", 4) ? "tiff"
                                                                                : "mjpeg";
}

}  // namespace

std::vector<std::string> cut_panoramas(const PanoramaCut& cut, const Programs& programs,
                                       const CaptureProgress& progress) {
  for (const std::string& name : cut.names) {
    const fs::path file = fs::path(cut.from) / name;
    check_shape(file, name, image_size(file.string()));
  }
  fs::remove_all(cut.to);
  std::vector<std::string> out;
  std::set<std::string> taken;  // a.jpg and a.png are two
  for (std::size_t i = 0; i < cut.names.size(); ++i) {
    progress({"cutting", "panoramas"}, static_cast<double>(i), static_cast<double>(cut.names.size()));
    const fs::path panorama = fs::path(cut.from) / cut.names[i];
    const int side = image_size(panorama.string()).height_px / 2;
    fs::path stem = fs::path(cut.names[i]).replace_extension();
    if (!taken.insert(stem.string()).second) stem = cut.names[i];
    create_folders((fs::path(cut.to) / stem.parent_path()).string());
    std::string split = fmt::format("[0:v]split={}", kViews), bend;
    std::vector<std::string> outputs;
    for (int view = 0; view < kViews; ++view) {
      const int turn_deg = view * 360 / kViews;
      split += fmt::format("[in{}]", view);
      bend += fmt::format(";[in{0}]v360=e:flat:yaw={1}:h_fov={2}:v_fov={2}:w={3}:h={3}:interp=cubic[out{0}]", view,
                          turn_deg > 180 ? turn_deg - 360 : turn_deg, kFieldDeg, side);
      out.push_back(fmt::format("{}_{:03}.jpg", stem.string(), turn_deg));
      for (std::string word : {std::string("-map"), fmt::format("[out{}]", view), std::string("-frames:v"),
                               std::string("1"), std::string("-q:v"), std::string("2"), std::string("-update"),
                               std::string("1"), (fs::path(cut.to) / out.back()).string()})
        outputs.push_back(std::move(word));
    }
    // One image of this name, whatever the name looks like: with '%' it might be a pattern of many.
    std::vector<std::string> words{"-v",
                                   "error",
                                   "-nostdin",
                                   "-y",
                                   "-f",
                                   "image2",
                                   "-pattern_type",
                                   "none",
                                   "-c:v",
                                   decoder_of(panorama.string()),
                                   "-i",
                                   panorama.string(),
                                   "-filter_complex",
                                   split + bend};
    words.insert(words.end(), outputs.begin(), outputs.end());
    run_program(programs, "ffmpeg",
                {.words = std::move(words),
                 .log = (fs::path(cut.logs) / "ffmpeg_views.txt").string(),
                 .remedy = "check that the image can be opened; ffmpeg 5 is known to take these words"});
  }
  return out;
}

}  // namespace semfield
