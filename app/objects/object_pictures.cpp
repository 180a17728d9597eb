#include "app/objects/object_pictures.h"

#include <algorithm>
#include <array>
#include <map>

#include "formats/image_io.h"

namespace semfield::app {

namespace {

using Color = std::array<std::uint8_t, 3>;

constexpr Color kNothing{72, 72, 72};
constexpr std::int32_t kGap_px = 4;
constexpr std::int32_t kOwnColor = 65536;  // behind the numbers of true objects

// 0 is no object.
Color color_of(std::int32_t id) { return id == 0 ? kNothing : ClassTable::default_color(id); }

// The true object that shares most pixels with each found one; one that shares none keeps a number of its own.
std::map<std::int32_t, std::int32_t> true_objects(std::span<const std::int32_t> found,
                                                  std::span<const std::int32_t> truth) {
  std::map<std::int32_t, std::map<std::int32_t, std::int64_t>> shared;
  for (std::size_t i = 0; i < found.size(); ++i)
    if (found[i] != 0) shared[found[i]][truth[i]] += truth[i] != 0 ? 1 : 0;
  std::map<std::int32_t, std::int32_t> out{{0, 0}};
  for (const auto& [id, of_truth] : shared) {
    const auto best = std::max_element(of_truth.begin(), of_truth.end(),
                                       [](const auto& a, const auto& b) { return a.second < b.second; });
    out[id] = best->second > 0 ? best->first : kOwnColor + id;
  }
  return out;
}

}  // namespace

void write_object_strip(const std::string& path, const StoredFrame& frame, const FrameSegments& given,
                        std::span<const std::int32_t> id, const std::vector<bool>& stuff) {
  const std::int32_t width = frame.width_px, height = frame.height_px;
  const std::vector<std::int16_t> label = frame.label.expand();
  std::vector<std::int32_t> truth(label.size());
  for (std::size_t i = 0; i < label.size(); ++i)
    truth[i] = label[i] == kVoid || stuff[static_cast<std::size_t>(label[i])] ? 0 : frame.instance[i];
  const std::map<std::int32_t, std::int32_t> true_object = true_objects(id, truth);
  const std::int32_t panels = given.empty() ? 3 : 4, all = panels * width + (panels - 1) * kGap_px;
  std::vector<std::uint8_t> rgb(static_cast<std::size_t>(3 * std::int64_t{all} * height), 255);
  for (std::int32_t y = 0; y < height; ++y) {
    for (std::int32_t x = 0; x < width; ++x) {
      const auto i = static_cast<std::size_t>(std::int64_t{y} * width + x);
      std::int32_t panel = 0;
      const auto put = [&](const Color& color) {
        const std::int64_t at = std::int64_t{y} * all + panel++ * (width + kGap_px) + x;
        std::copy(color.begin(), color.end(), rgb.begin() + 3 * at);
      };
      put({frame.rgb[3 * i], frame.rgb[3 * i + 1], frame.rgb[3 * i + 2]});
      if (!given.empty()) put(color_of(given.at(x, y, width, height)));
      put(color_of(true_object.at(id[i])));
      put(color_of(truth[i]));
    }
  }
  write_png_rgb(path, all, height, rgb);
}

}  // namespace semfield::app
