#include "serve/view_pictures.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <numbers>
#include <utility>

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t kFineViews = 12;
constexpr double kFinePixels = 100'000;  // of a view's own surface: more would make its labels slow
constexpr double kMovingFrame_s = 0.15;  // of a camera that moves
constexpr std::int32_t kLeastSide = 48, kMostSide = 4096;

double since(Clock::time_point start) { return std::chrono::duration<double>(Clock::now() - start).count(); }

bool is_finite(const Pose& pose) {
  double sum = pose.t.x + pose.t.y + pose.t.z;
  for (const std::array<double, 3>& row : pose.r) sum += row[0] + row[1] + row[2];
  return std::isfinite(sum);
}

std::int32_t fine_stride(const Camera& camera) {
  const double pixels = static_cast<double>(camera.width_px) * camera.height_px;
  return std::max(1, static_cast<std::int32_t>(std::ceil(std::sqrt(pixels / kFinePixels))));
}

}  // namespace

ViewPictures::ViewPictures(Training& training, LabelLoop& loop) : training_(training), loop_(loop) {}

ViewPictures::Fine* ViewPictures::find_fine(int view) {
  const auto found = std::find_if(fine_.begin(), fine_.end(), [&](const Fine& f) { return f.view == view; });
  return found == fine_.end() ? nullptr : &*found;
}

RayCamera ViewPictures::camera_for(const PictureRequest& request) const {
  if (request.view >= 0) return loop_.views()[static_cast<std::size_t>(request.view)].camera;
  const Camera& like = loop_.views().front().camera.camera;
  const double most = request.most_px > 0 ? request.most_px : std::max(like.width_px, like.height_px);
  const double aspect = static_cast<double>(like.width_px) / like.height_px;
  RayCamera camera;
  camera.undistort = false;
  camera.world_from_camera = request.camera->world_from_camera;
  camera.camera.width_px = static_cast<std::int32_t>(aspect >= 1 ? most : most * aspect);
  camera.camera.height_px = static_cast<std::int32_t>(aspect >= 1 ? most / aspect : most);
  camera.camera.width_px = std::max(camera.camera.width_px, 1);
  camera.camera.height_px = std::max(camera.camera.height_px, 1);
  const double half = std::tan(request.camera->fov_deg / 360 * std::numbers::pi);
  camera.camera.fx = camera.camera.fy = camera.camera.width_px / (2 * half);
  camera.camera.cx = camera.camera.width_px / 2.0;
  camera.camera.cy = camera.camera.height_px / 2.0;
  return camera;
}

void ViewPictures::begin(const PictureRequest& request) {
  request_.reset();
  const auto refuse = [](const std::string& what, const std::string& remedy) {
    throw Error(ErrorKind::usage, "serve.picture.request", "picture: " + what, remedy);
  };
  if ((request.view < 0) != request.camera.has_value())
    refuse(request.camera ? "it is of both a view and a camera" : "it is of neither a view nor a camera",
           "name a view, or give a camera");
  if (request.view >= std::ssize(loop_.views()))
    refuse(fmt::format("view {} is none of the {}", request.view, loop_.views().size()),
           fmt::format("name one from 0 to {}", loop_.views().size() - 1));
  if (request.most_px != 0 && (request.most_px < kLeastSide || request.most_px > kMostSide))
    refuse(fmt::format("most_px {} is not in {} to {}", request.most_px, kLeastSide, kMostSide),
           "ask for another size");
  if (request.camera && !(request.camera->fov_deg >= 1 && request.camera->fov_deg <= 170))
    refuse("the field of view is not in 1 to 170 degrees", "give another one");
  if (request.camera && !is_finite(request.camera->world_from_camera))
    refuse("the camera has a number that is not finite", "give position and rotation as numbers");
  camera_ = camera_for(request);
  picture_ = {};
  distance_m_.clear();
  rows_done_ = 0;
  spent_s_ = 0;
  shows_labels_ = training_.session().pipeline->has_semantics() && loop_.learned();
  request_ = request;
  if (request.at || (request.view >= 0 && !request.color && !request.full)) return;
  Camera& camera = camera_.camera;
  if (!request.full) {  // small enough to be there soon
    const double rays = static_cast<double>(camera.width_px) * camera.height_px,
                 affordable = std::max(rays_per_s_ * kMovingFrame_s, 1.0 * kLeastSide * kLeastSide);
    if (rays > affordable) {
      const double scale = std::sqrt(affordable / rays);
      camera = camera.resized(std::max(1, static_cast<std::int32_t>(camera.width_px * scale)),
                              std::max(1, static_cast<std::int32_t>(camera.height_px * scale)));
    }
  }
  picture_.width_px = camera.width_px;
  picture_.height_px = camera.height_px;
}

std::optional<Picture> ViewPictures::work(double budget_s) {
  if (!request_) return std::nullopt;
  if (request_->at || (request_->view >= 0 && !request_->color && !request_->full)) {
    const Clock::time_point start = Clock::now();
    Picture made = request_->at ? spot_of(*request_) : labels_of_view(*request_);
    made.render_ms = 1e3 * since(start);
    request_.reset();
    return made;
  }
  render_rows(budget_s);
  if (rows_done_ < picture_.height_px) return std::nullopt;
  if (request_->labels) picture_.seen = seen_in_picture();
  picture_.render_ms = 1e3 * spent_s_;
  request_.reset();
  return std::move(picture_);
}

Picture ViewPictures::labels_of_view(const PictureRequest& request) {
  Fine* fine = find_fine(request.view);
  if (fine == nullptr) {
    const PoolView& view = loop_.views()[static_cast<std::size_t>(request.view)];
    Fine fresh;
    fresh.view = request.view;
    fresh.map.stride = fine_stride(view.camera.camera);
    fresh.map.width_px = strided_px(view.camera.camera.width_px, fresh.map.stride);
    fresh.map.height_px = strided_px(view.camera.camera.height_px, fresh.map.stride);
    fresh.map.distance_m.assign(static_cast<std::size_t>(std::int64_t{fresh.map.width_px} * fresh.map.height_px), 0);
    fine_.push_front(std::move(fresh));
    if (fine_.size() > kFineViews) fine_.pop_back();
    fine = &fine_.front();
  } else {
    const auto at = std::find_if(fine_.begin(), fine_.end(), [&](const Fine& f) { return &f == fine; });
    fine_.splice(fine_.begin(), fine_, at);
  }
  ViewLabels labels = loop_.labels_of(request.view, fine->map.step > 0 ? &fine->map : nullptr);
  Picture picture;
  picture.width_px = labels.width_px;
  picture.height_px = labels.height_px;
  if (request.labels) {
    picture.label = std::move(labels.label);
    const PoolView& view = loop_.views()[static_cast<std::size_t>(request.view)];
    const bool is_fine = fine->complete() && fine->map.step > 0;
    picture.seen = seen_by(view.camera, distance_in(is_fine ? fine->map : view.map), request.view);
  }
  if (request.entropy) picture.entropy = std::move(labels.entropy);
  return picture;
}

std::vector<SeenMark> ViewPictures::seen_by(const RayCamera& camera, const SurfaceDistance& distance, int own) {
  return places_.seen_by(camera, distance, own, loop_.views(), training_.session().limits, tolerance_m());
}

std::vector<SeenMark> ViewPictures::seen_in_picture() {
  const auto width = static_cast<std::size_t>(picture_.width_px);
  if (request_->view < 0) {
    const SurfaceDistance distance = [&](std::int32_t column, std::int32_t row) {
      return static_cast<double>(distance_m_[static_cast<std::size_t>(row) * width + static_cast<std::size_t>(column)]);
    };
    return seen_by(camera_, distance, -1);
  }
  const PoolView& view = loop_.views()[static_cast<std::size_t>(request_->view)];
  std::vector<SeenMark> seen = seen_by(view.camera, distance_in(view.map), request_->view);
  for (SeenMark& mark : seen)
    for (PixelPoint& p : mark.points)
      p = {p.x * picture_.width_px / view.camera.camera.width_px,
           p.y * picture_.height_px / view.camera.camera.height_px};
  return seen;
}

// The photograph that shows what the free camera has at a point.
Picture ViewPictures::spot_of(const PictureRequest& request) {
  const RayLimits& limits = training_.session().limits;
  const Camera& camera = camera_.camera;
  const auto pixel_in = [](double share, std::int32_t length) {
    return std::clamp(static_cast<std::int32_t>(share * length), 0, length - 1);
  };
  const PixelPlace pixel{pixel_in(request.at->x, camera.width_px), pixel_in(request.at->y, camera.height_px)};
  const float distance = surface_distances(*training_.session().pipeline, camera_, limits, {{pixel}})[0];
  Picture answer;
  answer.meets_surface = distance > 0;
  const double scale_m = distance > 0 ? static_cast<double>(distance) : limits.far_m / 4;
  answer.nearest_view = nearest_view(loop_.pooled(), camera_.world_from_camera, scale_m);
  if (distance > 0) answer.spot = best_spot(loop_.pooled(), point_at(camera_, limits, pixel, scale_m), tolerance_m());
  return answer;
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
  const RayCamera& camera = loop_.views()[static_cast<std::size_t>(fine.view)].camera;
  const auto total = static_cast<std::int64_t>(fine.map.distance_m.size());
  while (fine.done < total && since(start) < budget_s) {
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

void ViewPictures::render_rows(double budget_s) {
  const Clock::time_point start = Clock::now();
  const Session& session = training_.session();
  const std::int32_t width = picture_.width_px, height = picture_.height_px;
  const double most = std::log(
      static_cast<double>(std::max<std::ptrdiff_t>(2, std::count(loop_.live().begin(), loop_.live().end(), true))));
  std::vector<bool> live(static_cast<std::size_t>(std::max(session.classes(), 1)), false);
  for (std::size_t l = 0; l < loop_.live().size(); ++l)
    if (loop_.live()[l]) live[static_cast<std::size_t>(session.plan.class_of_logit[l])] = true;
  const auto rows_at_once =
      static_cast<std::int32_t>(std::clamp(rays_per_s_ * 0.04 / std::max(width, 1), 1.0, static_cast<double>(height)));
  while (rows_done_ < height && (rows_done_ == 0 || since(start) < budget_s)) {
    RayCamera band = camera_;
    band.camera.height_px = std::min(rows_at_once, height - rows_done_);
    band.camera.cy -= rows_done_;
    const Clock::time_point begun = Clock::now();
    const RenderedFrame frame = render_frame(*session.pipeline, band, session.limits, session.plan.class_of_logit);
    const double rays = static_cast<double>(width) * band.camera.height_px;
    rays_per_s_ = 0.7 * rays_per_s_ + 0.3 * rays / std::max(since(begun), 1e-6);
    for (std::size_t i = 0; request_->camera && i < frame.depth_m.size(); ++i) {
      const double x = (static_cast<double>(i % static_cast<std::size_t>(width)) + 0.5 - band.camera.cx) /
                       band.camera.fx,
                   y = (static_cast<double>(i / static_cast<std::size_t>(width)) + 0.5 - band.camera.cy) /
                       band.camera.fy;
      const float z = frame.opacity[i] < kSurfaceOpacity ? 0 : frame.depth_m[i] / frame.opacity[i];
      distance_m_.push_back(z * static_cast<float>(std::sqrt(x * x + y * y + 1)));
    }
    if (request_->color)
      for (const float value : frame.rgb) picture_.rgb.push_back(static_cast<std::uint8_t>(std::lround(value * 255)));
    for (std::size_t i = 0; shows_labels_ && i < frame.label.size(); ++i) {
      const std::int16_t label = frame.label[i];
      const bool known = label >= 0 && live[static_cast<std::size_t>(label)] && frame.opacity[i] >= kSurfaceOpacity;
      if (request_->labels) picture_.label.push_back(known ? label : kVoid);
      if (request_->entropy)
        picture_.entropy.push_back(static_cast<std::uint8_t>(
            std::lround(255 * std::clamp(static_cast<double>(frame.entropy[i]) / most, 0.0, 1.0))));
    }
    rows_done_ += band.camera.height_px;
  }
  spent_s_ += since(start);
}

}  // namespace semfield
