#include "app/serve/page_pictures.h"

#include <turbojpeg.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>

#include "app/serve/page_server.h"
#include "core/check.h"
#include "core/error.h"
#include "eval/photo_edges.h"
#include "labels/mask_outlines.h"

namespace semfield::app {

namespace {

constexpr int kQuick = 1;                                         // zlib's level: a picture is sent once
constexpr std::array<std::uint8_t, 3> kUnnamed{{128, 128, 128}};  // a class that the state does not list yet

std::string_view text_of(const std::vector<std::uint8_t>& bytes) {
  return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
}

}  // namespace

Json points_json(const std::vector<PixelPoint>& points) {
  Json out = Json::array();
  for (const PixelPoint& p : points) out.push_back({p.x, p.y});
  return out;
}

std::vector<std::uint8_t> label_png(std::int32_t width_px, std::int32_t height_px, std::span<const std::int16_t> label,
                                    const std::vector<ClassState>& classes) {
  int most = kVoid;
  for (const std::int16_t index : label) most = std::max<int>(most, index);
  for (const ClassState& c : classes) most = std::max(most, c.index);
  if (most >= kMostPageClasses)
    throw Error(ErrorKind::data, "serve.classes.limit",
                "the page shows at most " + std::to_string(kMostPageClasses) + " classes",
                "give the scene a table of fewer classes: scene.classes");
  std::vector<std::uint8_t> palette, index(label.size());
  for (int entry = 0; entry < most + 2; ++entry) palette.insert(palette.end(), kUnnamed.begin(), kUnnamed.end());
  for (const ClassState& c : classes)
    std::copy(c.color.begin(), c.color.end(), palette.begin() + 3 * (static_cast<std::ptrdiff_t>(c.index) + 1));
  std::transform(label.begin(), label.end(), index.begin(),
                 [](std::int16_t value) { return static_cast<std::uint8_t>(value + 1); });
  const std::array<std::uint8_t, 1> clear{{0}};
  return encode_png(width_px, height_px, 3, 8, index, {palette, clear}, kQuick);
}

std::string picture_bytes(const Picture& picture, const std::vector<ClassState>& classes) {
  Json marks = Json::array();
  for (const SeenMark& mark : picture.seen) marks.push_back({{"id", mark.id}, {"points", points_json(mark.points)}});
  const Json facts{
      {"width", picture.width_px},      {"height", picture.height_px}, {"overlay_revision", picture.overlay_revision},
      {"render_ms", picture.render_ms}, {"stale", picture.stale},      {"marks", marks}};
  const std::int32_t w = picture.width_px, h = picture.height_px;
  using Bytes = std::vector<std::uint8_t>;
  const Bytes color = picture.rgb.empty() ? Bytes() : encode_jpeg(w, h, picture.rgb);
  const Bytes labels = picture.label.empty() ? Bytes() : label_png(w, h, picture.label, classes);
  const Bytes entropy = picture.entropy.empty() ? Bytes() : encode_png(w, h, 0, 8, picture.entropy, {}, kQuick);
  return joined_parts({facts.dump(), text_of(color), text_of(labels), text_of(entropy)});
}

namespace {

constexpr double kMostMask = 1.5e6;      // pixels
constexpr std::int64_t kSpeckle = 5000;  // smaller pieces and holes than the picture by this have no outline
constexpr double kLeastPart = 0.02;      // of the thing

// A thing's mask at about the size of its photograph, along its edges.
ViewLabels at_size_of(const Picture& picture, const Image<std::uint8_t>& photo) {
  const std::int32_t width = picture.width_px, height = picture.height_px;
  ViewLabels mask{width, height, picture.label, {}};
  if (photo.width_px > width) {
    const double less = std::sqrt(kMostMask / (double{1} * photo.width_px * photo.height_px));
    const auto side = [&](std::int32_t px) { return std::max(1, static_cast<std::int32_t>(px * less)); };
    const Image<std::uint8_t> guide =
        less < 1 ? resize_area(photo, side(photo.width_px), side(photo.height_px)) : photo;
    mask.width_px = guide.width_px;
    mask.height_px = guide.height_px;
    std::vector<float> rows;
    for (const std::int16_t label : picture.label)
      for (const bool is_in : {true, false}) rows.push_back(is_in == (label != kVoid) ? 1.0F : 0.0F);
    mask.label = labels_on_photo({1, width, height, rows, {0, kVoid}, width, height}, guide.pixels, guide.width_px,
                                 guide.height_px)
                     .label;
  }
  fill_small_regions(mask.label, mask.width_px, mask.height_px,
                     std::max<std::int64_t>(2, std::ssize(mask.label) / kSpeckle));
  return mask;
}

}  // namespace

std::string thing_bytes(const Picture& picture, const Image<std::uint8_t>& photo, std::int32_t view_px) {
  const ThingFacts thing = picture.thing.value_or(ThingFacts{});
  Json facts{{"stale", picture.stale},   {"level", thing.level}, {"least", thing.least},
             {"most", thing.most},       {"share", thing.share}, {"class_guess", thing.class_guess},
             {"outlines", Json::array()}};
  std::vector<std::uint8_t> png;
  if (!picture.stale) {
    const ViewLabels mask = at_size_of(picture, photo);
    facts["width"] = mask.width_px;
    facts["height"] = mask.height_px;
    const double scale = double{1} * view_px / mask.width_px;
    for (const MaskRegion& region : mask_regions(mask.label, mask.width_px, mask.height_px)) {
      if (static_cast<double>(region.area_px) < kLeastPart * thing.share * static_cast<double>(mask.label.size()))
        continue;
      Outline outline = region.outline;
      for (PixelPoint& p : outline) p = {p.x * scale, p.y * scale};
      facts["outlines"].push_back(points_json(outline));
    }
    std::vector<std::uint8_t> grey(mask.label.size());
    std::transform(mask.label.begin(), mask.label.end(), grey.begin(),
                   [](std::int16_t label) { return static_cast<std::uint8_t>(label == kVoid ? 0 : 255); });
    png = encode_png(mask.width_px, mask.height_px, 0, 8, grey, {}, kQuick);
  }
  return joined_parts({facts.dump(), text_of(png)});
}

std::vector<std::uint8_t> photo_jpeg(const Image<std::uint8_t>& photo, std::int32_t most_px) {
  const std::int32_t longest = std::max(photo.width_px, photo.height_px);
  if (most_px <= 0 || longest <= most_px) return encode_jpeg(photo.width_px, photo.height_px, photo.pixels);
  const auto shorter = [&](std::int32_t side) {
    return std::max<std::int32_t>(1, static_cast<std::int32_t>(std::lround(double{1} * side * most_px / longest)));
  };
  const Image<std::uint8_t> small = resize_area(photo, shorter(photo.width_px), shorter(photo.height_px));
  return encode_jpeg(small.width_px, small.height_px, small.pixels);
}

std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality) {
  SEMFIELD_CHECK(
      width_px > 0 && height_px > 0 &&
          rgb.size() == std::size_t{3} * static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px),
      "a picture's colours do not match its size");
  const std::unique_ptr<void, int (*)(tjhandle)> encoder(tjInitCompress(), tjDestroy);
  if (!encoder)
    throw Error(ErrorKind::internal, "internal.jpeg.failed",
                std::string("TurboJPEG cannot start: ") + tjGetErrorStr2(nullptr));
  std::vector<std::uint8_t> out(tjBufSize(width_px, height_px, TJSAMP_420));
  unsigned char* at = out.data();
  unsigned long bytes = out.size();
  // The buffer is large enough for any picture, so it is never replaced by another.
  if (tjCompress2(encoder.get(), rgb.data(), width_px, 0, height_px, TJPF_RGB, &at, &bytes, TJSAMP_420, quality,
                  TJFLAG_NOREALLOC) != 0)
    throw Error(ErrorKind::internal, "internal.jpeg.failed",
                std::string("TurboJPEG: ") + tjGetErrorStr2(encoder.get()));
  out.resize(bytes);
  return out;
}

}  // namespace semfield::app
