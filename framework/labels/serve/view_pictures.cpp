#include "labels/serve/view_pictures.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <utility>

#include "compute/parallel.h"
#include "core/files.h"
#include "formats/image_io.h"
#include "labels/serve/label_loop.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kFineViews = 12;
constexpr double kFinePixels = 100'000;  // of a view's own surface: more would make its labels slow
constexpr double kQuickPicture_s = 0.15;
constexpr double kLeastRays = 48.0 * 48;  // of a picture

std::int32_t fine_stride(const Camera& camera) {
  const double pixels = static_cast<double>(camera.width_px) * camera.height_px;
  return std::max(1, static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / kFinePixels))));
}

}  // namespace

ViewPictures::ViewPictures(Trainer& training, LabelLoop& loop) : training_(training), loop_(loop) {}

Picture ViewPictures::make(const PictureRequest& request) {
  if (request.view < 0 || request.view >= std::ssize(loop_.views()))
    throw Error(ErrorKind::usage, "serve.picture.request",
                fmt::format("picture: view {} is none of the {}", request.view, loop_.views().size()),
                fmt::format("name one from 0 to {}", loop_.views().size() - 1));
  const Clock::time_point start = Clock::now();
  Picture made = request.color || request.full ? rendered(request) : labels_of_view(request);
  made.render_ms = 1e3 * seconds_since(start);
  return made;
}

Picture ViewPictures::labels_of_view(const PictureRequest& request) {
  const PoolView& view = loop_.view(request.view);
  const auto known = std::find_if(fine_.begin(), fine_.end(), [&](const Fine& f) { return f.view == request.view; });
  if (known == fine_.end()) {
    const Camera& camera = view.camera.camera;
    Fine& fresh = *fine_.insert(fine_.begin(), Fine{.view = request.view, .map = {}});
    fresh.map.stride = fine_stride(camera);
    fresh.map.width_px = strided_px(camera.width_px, fresh.map.stride);
    fresh.map.height_px = strided_px(camera.height_px, fresh.map.stride);
    fresh.map.distance_m.assign(static_cast<std::size_t>(std::int64_t{fresh.map.width_px} * fresh.map.height_px), 0);
    if (fine_.size() > kFineViews) fine_.pop_back();
  } else {
    std::rotate(fine_.begin(), known, known + 1);
  }
  const Fine& fine = fine_.front();
  ViewLabels labels = loop_.labels_of(request.view, fine.map.step > 0 ? &fine.map : nullptr);
  Picture picture;
  picture.width_px = labels.width_px;
  picture.height_px = labels.height_px;
  if (request.labels) {
    picture.label = std::move(labels.label);
    const bool is_fine = fine.complete() && fine.map.step > 0;
    picture.seen = seen_by(request.view, is_fine ? fine.map : view.map);
  }
  if (request.entropy) picture.entropy = std::move(labels.entropy);
  return picture;
}

std::vector<SeenMark> ViewPictures::seen_by(int view, const SurfaceMap& map) const {
  return marks_seen(marks_, map, view, loop_.views(), training_.session().limits, tolerance_m());
}

bool ViewPictures::refine(double budget_s) {
  if (fine_.empty() || !loop_.ready()) return false;
  Fine& fine = fine_.front();
  const bool stale = is_stale(fine.map, training_.step());
  if (fine.complete()) {
    if (!stale) return false;
    fine.done = 0;  // the old distances stay until the new ones are there
  }
  const Clock::time_point start = Clock::now();
  const RayCamera& camera = loop_.view(fine.view).camera;
  const auto total = static_cast<std::int64_t>(fine.map.distance_m.size());
  while (fine.done < total && seconds_since(start) < budget_s) {
    std::vector<PixelPlace> pixels;
    const std::int64_t end = std::min(total, fine.done + 4096);
    for (std::int64_t i = fine.done; i < end; ++i)
      pixels.push_back(strided_place(i, fine.map.width_px, fine.map.stride));
    const std::vector<float> found =
        surface_distances(*training_.session().pipeline, camera, training_.session().limits, pixels);
    std::copy(found.begin(), found.end(), fine.map.distance_m.begin() + fine.done);
    fine.done = end;
  }
  if (!fine.complete()) return false;
  fine.map.step = std::max<std::int64_t>(training_.step(), 1);
  return true;
}

Picture ViewPictures::rendered(const PictureRequest& request) {
  const Session& session = training_.session();
  const PoolView& view = loop_.view(request.view);
  RayCamera seen_from = view.camera;
  Camera& camera = seen_from.camera;
  const auto rays = [&] { return static_cast<double>(camera.width_px) * camera.height_px; };
  if (const double affordable = std::max(rays_per_s_ * kQuickPicture_s, kLeastRays);
      !request.full && rays() > affordable) {
    const double scale = std::sqrt(affordable / rays());
    camera = camera.resized(std::max(1, static_cast<std::int32_t>(camera.width_px * scale)),
                            std::max(1, static_cast<std::int32_t>(camera.height_px * scale)));
  }
  const Clock::time_point begun = Clock::now();
  const RenderedFrame frame = render_frame(*session.pipeline, seen_from, session.limits, session.plan.class_of_logit);
  rays_per_s_ = 0.7 * rays_per_s_ + 0.3 * rays() / std::max(seconds_since(begun), 1e-6);
  Picture picture;
  picture.width_px = camera.width_px;
  picture.height_px = camera.height_px;
  for (const float value : request.color ? frame.rgb : std::vector<float>())
    picture.rgb.push_back(static_cast<std::uint8_t>(std::lround(value * 255)));
  if (request.labels) {
    picture.seen = seen_by(request.view, view.map);
    for (SeenMark& mark : picture.seen)
      for (PixelPoint& p : mark.points)
        p = {p.x * camera.width_px / view.camera.camera.width_px,
             p.y * camera.height_px / view.camera.camera.height_px};
  }
  if (!session.pipeline->has_semantics() || !loop_.learned()) return picture;
  std::vector<bool> live(static_cast<std::size_t>(session.classes()), false);
  for (std::size_t l = 0; l < loop_.live().size(); ++l)
    if (loop_.live()[l]) live[static_cast<std::size_t>(session.plan.class_of_logit[l])] = true;
  const double most = loop_.most_entropy();
  for (std::size_t i = 0; i < frame.label.size(); ++i) {
    const std::int16_t label = frame.label[i];
    const bool known = label >= 0 && live[static_cast<std::size_t>(label)] && frame.opacity[i] >= kSurfaceOpacity;
    if (request.labels) picture.label.push_back(known ? label : kVoid);
    if (request.entropy)
      picture.entropy.push_back(static_cast<std::uint8_t>(
          std::lround(255 * std::clamp(static_cast<double>(frame.entropy[i]) / most, 0.0, 1.0))));
  }
  return picture;
}

namespace {

constexpr double kSameDistance = 0.03;   // of the distance
constexpr std::size_t kMarkPlaces = 8;   // of a stroke or an outline
constexpr std::size_t kMostSeen = 1000;  // clicks of other views in one picture

PixelPlace pixel_at(const Camera& camera, PixelPoint p) {
  return {std::clamp(static_cast<std::int32_t>(p.x), 0, camera.width_px - 1),
          std::clamp(static_cast<std::int32_t>(p.y), 0, camera.height_px - 1)};
}

}  // namespace

std::optional<PixelPoint> pixel_of(const RayCamera& camera, Vec3d place) {
  const std::optional<PixelHit> hit = project_point(camera.camera, camera.world_from_camera, place);
  if (!hit) return std::nullopt;
  return PixelPoint{hit->u, hit->v};
}

std::optional<PixelPoint> seen_at(const RayCamera& camera, const SurfaceMap& map, Vec3d place, double tolerance_m) {
  const std::optional<PixelPoint> at = pixel_of(camera, place);
  if (!at || map.empty()) return std::nullopt;
  const PixelPlace pixel = pixel_at(camera.camera, *at);
  const double surface = static_cast<double>(map.at(pixel.column, pixel.row)),
               own = length(place - camera.world_from_camera.t);
  const bool is_seen = surface > 0 && std::abs(own - surface) <= std::max(tolerance_m, kSameDistance * surface);
  return is_seen ? at : std::nullopt;
}

std::vector<SeenMark> marks_seen(std::span<const Annotations::Mark> marks, const SurfaceMap& map, int own,
                                 std::span<const PoolView> views, const RayLimits& limits, double tolerance_m) {
  const RayCamera& camera = views[static_cast<std::size_t>(own)].camera;
  std::vector<SeenMark> seen;
  for (auto mark = marks.rbegin(); mark != marks.rend() && seen.size() < kMostSeen; ++mark) {
    if (mark->class_index == kVoid) continue;  // what is ignored is so in its own view alone
    const auto view =
        std::find_if(views.begin(), views.end(), [&](const PoolView& v) { return v.frame == mark->frame; });
    if (view == views.end() || view - views.begin() == own || view->map.empty()) continue;
    std::vector<PixelPoint> points;
    const std::size_t count = std::min(mark->points.size(), kMarkPlaces);
    for (std::size_t i = 0; i < count; ++i) {
      const PixelPoint& p = mark->points[i * mark->points.size() / count];
      const PixelPlace pixel{static_cast<std::int32_t>(p.x), static_cast<std::int32_t>(p.y)};
      const double way = static_cast<double>(view->map.at(pixel.column, pixel.row));
      if (!(way > 0)) continue;
      if (const auto at = seen_at(camera, map, point_at(view->camera, limits, pixel, way), tolerance_m))
        points.push_back(*at);
    }
    if (!points.empty()) seen.push_back({mark->id, std::move(points)});
  }
  return seen;
}

namespace {

constexpr float kColorSigma = 16;    // of 255
constexpr double kSameShape = 0.02;  // of the ratio of the sides: sizes are rounded to pixels

// exp(-d^2 / 2 s^2) of a squared difference of colours, by its root.
std::array<float, 512> color_weights() {
  std::array<float, 512> table{};
  for (std::size_t i = 0; i < table.size(); ++i) {
    const auto d = static_cast<float>(i);
    table[i] = std::exp(-0.5F * d * d / (kColorSigma * kColorSigma)) + 1e-6F;
  }
  return table;
}

}  // namespace

ViewLabels upsampled(const CoarseLabels& coarse, const StoredFrame& photo) {
  ViewLabels out;
  out.width_px = photo.width_px;
  out.height_px = photo.height_px;
  const std::int32_t width = photo.width_px, stride = coarse.stride;
  const auto size = static_cast<std::size_t>(std::int64_t{width} * photo.height_px);
  out.label.assign(size, kVoid);
  out.entropy.assign(size, 0);
  if (coarse.label.empty()) return out;
  if (stride == 1) {
    out.label = coarse.label;
    out.entropy = coarse.entropy;
    return out;
  }
  static const std::array<float, 512> weights = color_weights();
  const auto color = [&](std::int32_t x, std::int32_t y) {
    return &photo.rgb[3 * static_cast<std::size_t>(std::int64_t{y} * width + x)];
  };
  parallel_for(photo.height_px, [&](std::int64_t row) {
    const auto y = static_cast<std::int32_t>(row);
    const float v = (static_cast<float>(y) - static_cast<float>(stride / 2)) / static_cast<float>(stride);
    const auto y0 = static_cast<std::int32_t>(std::floor(v));
    for (std::int32_t x = 0; x < width; ++x) {
      const float u = (static_cast<float>(x) - static_cast<float>(stride / 2)) / static_cast<float>(stride);
      const auto x0 = static_cast<std::int32_t>(std::floor(u));
      const std::uint8_t* const own = color(x, y);
      std::array<std::int16_t, 4> label{};
      std::array<float, 4> weight{};
      float entropy = 0, sum = 0;
      for (int k = 0; k < 4; ++k) {
        const std::int32_t cx = std::clamp(x0 + (k & 1), 0, coarse.width_px - 1),
                           cy = std::clamp(y0 + (k >> 1), 0, coarse.height_px - 1);
        const std::uint8_t* const other = color(cx * stride + stride / 2, cy * stride + stride / 2);
        float square = 0;
        for (int c = 0; c < 3; ++c) {
          const auto d = static_cast<float>(int{own[c]} - int{other[c]});
          square += d * d;
        }
        const float near_x = 1 - std::abs(u - static_cast<float>(x0 + (k & 1))),
                    near_y = 1 - std::abs(v - static_cast<float>(y0 + (k >> 1)));
        const auto at = static_cast<std::size_t>(std::int64_t{cy} * coarse.width_px + cx);
        const auto n = static_cast<std::size_t>(k);
        weight[n] = (near_x * near_y + 0.02F) * weights[static_cast<std::size_t>(std::sqrt(square))];
        label[n] = coarse.label[at];
        entropy += weight[n] * static_cast<float>(coarse.entropy[at]);
        sum += weight[n];
      }
      float best = -1;
      std::int16_t chosen = kVoid;
      for (std::size_t a = 0; a < 4; ++a) {
        float votes = 0;
        for (std::size_t b = 0; b < 4; ++b) votes += label[b] == label[a] ? weight[b] : 0.0F;
        if (votes > best) {
          best = votes;
          chosen = label[a];
        }
      }
      const auto at = static_cast<std::size_t>(std::int64_t{y} * width + x);
      out.label[at] = chosen;
      out.entropy[at] = static_cast<std::uint8_t>(std::lround(entropy / sum));
    }
  });
  return out;
}

std::optional<StoredSize> stored_size_of(const FrameInfo& frame) {
  if (!is_file(frame.source)) return std::nullopt;
  const ImageSize stored = image_size(frame.source);
  const Camera& camera = frame.camera;
  const double x = static_cast<double>(stored.width_px) / camera.width_px,
               y = static_cast<double>(stored.height_px) / camera.height_px;
  if (std::abs(x / y - 1) > kSameShape || (stored.width_px <= camera.width_px && stored.height_px <= camera.height_px))
    return std::nullopt;
  return StoredSize{camera.resized(stored.width_px, stored.height_px),
                    std::max(1, static_cast<std::int32_t>(std::lround(std::sqrt(x * y)))), frame.source};
}

std::vector<std::int16_t> labels_at(const StoredSize& size, RenderedFrame rendered) {
  if (size.stride == 1) return std::move(rendered.label);
  StoredFrame photo;
  Image<std::uint8_t> image = read_rgb(size.image);
  photo.width_px = image.width_px;
  photo.height_px = image.height_px;
  photo.rgb = std::move(image.pixels);
  CoarseLabels coarse{size.stride, rendered.width_px, rendered.height_px, std::move(rendered.label), {}};
  coarse.entropy.assign(coarse.label.size(), 0);
  return upsampled(coarse, photo).label;
}

}  // namespace semfield
