#include "labels/serve/view_pictures.h"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>

#include "compute/parallel.h"
#include "core/files.h"
#include "eval/photo_edges.h"
#include "formats/image_io.h"
#include "labels/segments.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kFineViews = 12;
constexpr std::size_t kKnownThings = 4;   // views
constexpr double kFinePixels = 100'000;   // of a view's own surface: more would make its labels slow
constexpr double kPhotoPixels = 800'000;  // of a photograph that labels cling to: more would make them slow
constexpr double kQuickPicture_s = 0.15;
constexpr double kLeastRays = 48.0 * 48;  // of a picture

std::int32_t fine_stride(const Camera& camera) {
  const double pixels = static_cast<double>(camera.width_px) * camera.height_px;
  return std::max(1, static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / kFinePixels))));
}

// From the frame's pixels to the picture's.
void scale_marks(Picture& picture, const Camera& frame) {
  for (SeenMark& mark : picture.seen)
    for (PixelPoint& p : mark.points)
      p = {p.x * picture.width_px / frame.width_px, p.y * picture.height_px / frame.height_px};
}

}  // namespace

ViewPictures::ViewPictures(Trainer& training, LabelLoop& loop, PhotoReader read_photo)
    : training_(training), loop_(loop), read_photo_(std::move(read_photo)) {}

Picture ViewPictures::make(const PictureRequest& request) {
  if (request.view < 0 || request.view >= std::ssize(loop_.views()))
    throw Error(ErrorKind::usage, "serve.picture.request",
                fmt::format("picture: view {} is none of the {}", request.view, loop_.views().size()),
                fmt::format("name one from 0 to {}", loop_.views().size() - 1));
  const Clock::time_point start = Clock::now();
  Picture made = request.thing                   ? thing(request.view, *request.thing)
                 : request.color || request.full ? rendered(request)
                                                 : labels_of_view(request);
  made.render_ms = 1e3 * seconds_since(start);
  return made;
}

Picture ViewPictures::labels_of_view(const PictureRequest& request) {
  const PoolView& view = loop_.view(request.view);
  const auto known = std::find_if(fine_.begin(), fine_.end(), [&](const Fine& f) { return f.view == request.view; });
  if (known == fine_.end()) {
    const Camera& camera = view.camera.camera;
    Fine& fresh = *fine_.insert(fine_.begin(), Fine{.view = request.view, .map = {}, .photo = {}});
    fresh.map.stride = fine_stride(camera);
    fresh.map.width_px = strided_px(camera.width_px, fresh.map.stride);
    fresh.map.height_px = strided_px(camera.height_px, fresh.map.stride);
    fresh.map.distance_m.assign(static_cast<std::size_t>(std::int64_t{fresh.map.width_px} * fresh.map.height_px), 0);
    if (fine_.size() > kFineViews) fine_.pop_back();
  } else {
    std::rotate(fine_.begin(), known, known + 1);
  }
  const Fine& fine = fine_.front();
  const bool larger = fine.photo && !fine.photo->pixels.empty();
  ViewLabels labels =
      loop_.labels_of(request.view, fine.map.step > 0 ? &fine.map : nullptr, larger ? &*fine.photo : nullptr);
  Picture picture;
  picture.width_px = labels.width_px;
  picture.height_px = labels.height_px;
  if (request.labels) {
    picture.label = std::move(labels.label);
    const bool is_fine = fine.complete() && fine.map.step > 0;
    picture.seen = seen_by(request.view, is_fine ? fine.map : view.map);
    scale_marks(picture, view.camera.camera);
  }
  if (request.entropy) picture.entropy = std::move(labels.entropy);
  return picture;
}

const ThingTree& ViewPictures::things_of(int number) {
  const PoolView& view = loop_.view(number);
  const auto known = std::find_if(things_.begin(), things_.end(),
                                  [&](const KnownThings& k) { return k.view == number && k.step == view.map.step; });
  if (known != things_.end()) {
    std::rotate(things_.begin(), known, known + 1);
    return things_.front().tree;
  }
  std::erase_if(things_, [&](const KnownThings& k) { return k.view == number; });
  if (things_.size() == kKnownThings) things_.pop_back();
  const StoredFrame& photo = *view.photo;
  Image<std::uint8_t> smaller;
  const double size = std::sqrt(kThingPixels / (double{1} * photo.width_px * photo.height_px));
  if (size < 1) {
    smaller = resize_area({photo.width_px, photo.height_px, 3, photo.rgb},
                          std::max(1, static_cast<std::int32_t>(photo.width_px * size)),
                          std::max(1, static_cast<std::int32_t>(photo.height_px * size)));
  }
  const SeenSurface seen = view.map.empty() ? SeenSurface{} : surface_seen_by(view, training_.session().limits);
  ThingPicture picture{.width_px = size < 1 ? smaller.width_px : photo.width_px,
                       .height_px = size < 1 ? smaller.height_px : photo.height_px,
                       .rgb = size < 1 ? smaller.pixels : photo.rgb,
                       .surface = view.map.empty() ? nullptr : &seen};
  std::vector<std::int32_t> segments;
  if (view.segments != nullptr)
    for (std::int32_t y = 0; y < picture.height_px; ++y)
      for (std::int32_t x = 0; x < picture.width_px; ++x)
        segments.push_back(view.segments->at(x, y, picture.width_px, picture.height_px));
  picture.segment = segments;
  things_.insert(things_.begin(), {number, view.map.step, ThingTree(picture)});
  return things_.front().tree;
}

// The class that most of the thing's surface has so far.
int ViewPictures::guessed_class(int number, const Thing& thing, const ThingTree& tree) const {
  const std::vector<float>& probability = loop_.pool_probability();
  const auto v = static_cast<std::size_t>(number);
  if (probability.empty() || v >= loop_.pool().point_of_pixel.size()) return -1;
  const SurfaceMap& map = loop_.view(number).map;
  const std::vector<std::int32_t>& points = loop_.pool().point_of_pixel[v];
  const auto width = static_cast<std::size_t>(loop_.classes());
  std::vector<double> sum(width, 0);
  for (std::size_t i = 0; i < points.size() && points.size() == map.distance_m.size(); ++i) {
    if (points[i] < 0) continue;
    const auto x = static_cast<std::int64_t>(i) % map.width_px, y = static_cast<std::int64_t>(i) / map.width_px;
    const std::int64_t at = (2 * y + 1) * tree.height_px() / (2 * map.height_px) * tree.width_px() +
                            (2 * x + 1) * tree.width_px() / (2 * map.width_px);
    if (!thing.mask[static_cast<std::size_t>(at)]) continue;
    for (std::size_t c = 0; c < width; ++c)
      sum[c] += static_cast<double>(probability[static_cast<std::size_t>(points[i]) * width + c]);
  }
  const auto best = std::max_element(sum.begin(), sum.end());
  return *best > 0 ? training_.session().plan.class_of_logit[static_cast<std::size_t>(best - sum.begin())] : -1;
}

Picture ViewPictures::thing(int number, const ThingRequest& request) {
  const ThingTree& tree = things_of(number);
  const StoredFrame& photo = *loop_.view(number).photo;
  const auto places = [&](const std::vector<PixelPoint>& points) {
    std::vector<PixelPlace> out;
    for (const PixelPoint& p : points)
      out.push_back(
          {std::clamp(static_cast<std::int32_t>(p.x * tree.width_px() / photo.width_px), 0, tree.width_px() - 1),
           std::clamp(static_cast<std::int32_t>(p.y * tree.height_px() / photo.height_px), 0, tree.height_px() - 1)});
    return out;
  };
  const Thing thing = tree.choose(places(request.also), places(request.without), request.level);
  Picture picture;
  picture.width_px = tree.width_px();
  picture.height_px = tree.height_px();
  for (const bool is_in : thing.mask) picture.label.push_back(is_in ? 0 : kVoid);
  picture.thing = {thing.level, thing.least, thing.most, thing.share, guessed_class(number, thing, tree)};
  return picture;
}

std::vector<SeenMark> ViewPictures::seen_by(int view, const SurfaceMap& map) const {
  return marks_seen(marks_, map, view, loop_.views(), training_.session().limits, tolerance_m());
}

// Without pixels where the one that trains is as large, or where it cannot be read: the page shows that one then too.
Image<std::uint8_t> ViewPictures::larger_photo(int view) const {
  const StoredFrame& trained = *loop_.view(view).photo;
  const double side = std::max(trained.width_px, trained.height_px);
  const double shape = static_cast<double>(trained.width_px) * trained.height_px / (side * side);
  const auto most_px = static_cast<std::int32_t>(std::sqrt(kPhotoPixels / shape));
  try {
    Image<std::uint8_t> photo = read_photo_(view, most_px);
    if (std::max(photo.width_px, photo.height_px) > most_px) {
      const double scale = static_cast<double>(most_px) / std::max(photo.width_px, photo.height_px);
      photo = resize_area(photo, std::max(1, static_cast<std::int32_t>(photo.width_px * scale)),
                          std::max(1, static_cast<std::int32_t>(photo.height_px * scale)));
    }
    if (photo.width_px > trained.width_px) return photo;
  } catch (const Error&) {
  }
  return {};
}

bool ViewPictures::refine(double budget_s) {
  if (fine_.empty() || !loop_.ready()) return false;
  Fine& fine = fine_.front();
  if (!fine.photo) {
    fine.photo = larger_photo(fine.view);
    if (!fine.photo->pixels.empty()) return true;
  }
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
  const bool semantics = session.pipeline->has_semantics() && loop_.learned();
  FrameOptions wanted;
  wanted.probability = semantics && request.full && request.labels;
  wanted.classes = session.classes();
  RenderedFrame frame =
      render_frame(*session.pipeline, seen_from, session.limits, session.plan.class_of_logit, {}, wanted);
  if (wanted.probability)
    frame.label = labels_on_photo(frame, wanted.classes, view.photo->rgb, frame.width_px, frame.height_px).label;
  rays_per_s_ = 0.7 * rays_per_s_ + 0.3 * rays() / std::max(seconds_since(begun), 1e-6);
  Picture picture;
  picture.width_px = camera.width_px;
  picture.height_px = camera.height_px;
  for (const float value : request.color ? frame.rgb : std::vector<float>())
    picture.rgb.push_back(static_cast<std::uint8_t>(std::lround(value * 255)));
  if (request.labels) {
    picture.seen = seen_by(request.view, view.map);
    scale_marks(picture, view.camera.camera);
  }
  if (!semantics) return picture;
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

constexpr double kSameShape = 0.02;  // of the ratio of the sides: sizes are rounded to pixels

}  // namespace

std::optional<StoredSize> stored_size_of(const FrameInfo& frame) {
  if (!is_file(frame.source)) return std::nullopt;
  const ImageSize stored = image_size(frame.source);
  const Camera& camera = frame.camera;
  const double x = static_cast<double>(stored.width_px) / camera.width_px,
               y = static_cast<double>(stored.height_px) / camera.height_px;
  if (std::abs(x / y - 1) > kSameShape || (stored.width_px <= camera.width_px && stored.height_px <= camera.height_px))
    return std::nullopt;
  return StoredSize{camera.resized(stored.width_px, stored.height_px),
                    std::max(1, static_cast<std::int32_t>(std::lround(std::sqrt(x * y))))};
}

}  // namespace semfield
