#include "surface/fuse/fusion.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

void check_view(const FusionView& view, std::size_t index, int classes) {
  const std::size_t pixels = view.seen.pixel(0, view.seen.camera.height_px);
  SEMFIELD_CHECK(view.seen.depth_m.size() == pixels && view.prediction != nullptr &&
                     (view.prediction->empty() || view.prediction->size() == pixels),
                 "depth and prediction of a view have the size of its camera");
  const TrainingLabels::Frame& prediction = *view.prediction;
  SEMFIELD_CHECK(prediction.soft.empty() || prediction.soft.classes() == classes,
                 "a view's probabilities are of the scene's classes");
  for (std::size_t i = 0; i < prediction.hard.size(); ++i) {
    if (prediction.hard[i] >= kVoid && prediction.hard[i] < classes) continue;
    throw Error(
        ErrorKind::data, "labels.class.range",
        fmt::format("view {}: pixel {} has class index {}, there are {}", index, i, prediction.hard[i], classes),
        "predict with the scene's class table");
  }
}

FusedFrame blank_frame(std::size_t pixels) {
  FusedFrame out;
  for (std::vector<std::int16_t>& label : out.label) label.assign(pixels, kVoid);
  return out;
}

std::vector<std::int16_t>& map_of(FusedFrame& frame, FusionMethod method) {
  return frame.label[static_cast<std::size_t>(method)];
}

}  // namespace

void FusionCounts::merge(const FusionCounts& other) {
  pixels += other.pixels;
  without_depth += other.without_depth;
  unlabelled += other.unlabelled;
  filled += other.filled;
  votes += other.votes;
}

double FusionCounts::views_mean() const {
  const std::int64_t with_depth = pixels - without_depth;
  return with_depth == 0 ? 0 : static_cast<double>(votes) / static_cast<double>(with_depth);
}

// Of one row: sums of the current point, a pixel's probabilities as stored, and those of a view.
struct LabelFusion::Scratch {
  ClassVotes votes;
  std::vector<float> stored;
  std::vector<double> pixel, view;
  FusionCounts counts;
};

LabelFusion::LabelFusion(std::span<const FusionView> views, int classes, const FusionParams& params)
    : views_(views), classes_(classes), params_(params), hard_(params.hard_confidence, classes) {
  for (std::size_t i = 0; i < views.size(); ++i) {
    check_view(views[i], i, classes);
    seen_.push_back(views[i].seen);
  }
}

// Probabilities of one pixel into scratch.pixel; false without a prediction.
bool LabelFusion::prediction_at(const FusionView& view, std::size_t pixel, Scratch& s) const {
  const TrainingLabels::Frame& prediction = *view.prediction;
  if (prediction.empty() || prediction[pixel] < 0) return false;
  if (prediction.soft.empty()) {
    std::fill(s.pixel.begin(), s.pixel.end(), hard_.miss);
    s.pixel[static_cast<std::size_t>(prediction[pixel])] = hard_.hit;
  } else {
    prediction.soft.row(pixel, s.stored);
    std::copy(s.stored.begin(), s.stored.end(), s.pixel.begin());
  }
  return true;
}

void LabelFusion::add_prediction(const FusionView& view, const PixelHit& hit, Scratch& s) const {
  const int reach = params_.neighbourhood / 2;
  if (reach == 0) {
    const std::size_t pixel = view.seen.pixel(hit.column, hit.row);
    if (!view.prediction->hard.empty()) {
      if (const std::int16_t label = view.prediction->hard[pixel]; label >= 0) s.votes.add(label);
    } else if (prediction_at(view, pixel, s)) {
      s.votes.add(s.pixel);
    }
    return;
  }
  // The window's pixels on the same surface, each with the same weight.
  std::fill(s.view.begin(), s.view.end(), 0.0);
  int pixels = 0;
  const Camera& camera = view.seen.camera;
  for (int row = std::max(hit.row - reach, 0); row <= std::min(hit.row + reach, camera.height_px - 1); ++row) {
    for (int column = std::max(hit.column - reach, 0); column <= std::min(hit.column + reach, camera.width_px - 1);
         ++column) {
      const std::size_t pixel = view.seen.pixel(column, row);
      if (!same_surface(view.seen, pixel, hit.z_m, params_) || !prediction_at(view, pixel, s)) continue;
      for (std::size_t c = 0; c < s.view.size(); ++c) s.view[c] += s.pixel[c];
      ++pixels;
    }
  }
  if (pixels == 0) return;
  for (double& p : s.view) p /= pixels;
  s.votes.add(s.view);
}

void LabelFusion::fuse_pixel(int target, std::span<const int> others, std::int32_t column, std::int32_t row, Scratch& s,
                             FusedFrame& out) const {
  const FusionView& own = views_[static_cast<std::size_t>(target)];
  const std::size_t pixel = own.seen.pixel(column, row);
  const std::int16_t label = own.prediction->empty() ? kVoid : (*own.prediction)[pixel];
  map_of(out, FusionMethod::monocular)[pixel] = label;
  ++s.counts.pixels;
  if (label == kVoid) ++s.counts.unlabelled;
  const std::optional<Vec3d> point = surface_point(own.seen, column, row);
  if (!point) {
    ++s.counts.without_depth;
    map_of(out, FusionMethod::bayesian)[pixel] = map_of(out, FusionMethod::average)[pixel] = label;
    return;
  }
  s.votes.clear();
  if (own.prediction->soft.empty()) {
    if (label >= 0) s.votes.add(label);
  } else if (prediction_at(own, pixel, s)) {
    s.votes.add(s.pixel);
  }
  for (const int other : others) {
    const FusionView& view = views_[static_cast<std::size_t>(other)];
    if (const std::optional<PixelHit> hit = seen_at(view.seen, *point, params_)) add_prediction(view, *hit, s);
  }
  s.counts.votes += s.votes.views();
  if (label == kVoid && s.votes.views() > 0) ++s.counts.filled;
  map_of(out, FusionMethod::bayesian)[pixel] = s.votes.bayesian_label(label);
  map_of(out, FusionMethod::average)[pixel] = s.votes.average_label(label);
}

FusedFrame LabelFusion::fuse(int target) const {
  std::vector<int> others;
  for (int view = 0; view < static_cast<int>(views_.size()); ++view) {
    if (view != target && !views_[static_cast<std::size_t>(view)].prediction->empty()) others.push_back(view);
  }
  others = choose_views(seen_, target, std::move(others), params_);
  const Camera& camera = seen_[static_cast<std::size_t>(target)].camera;
  FusedFrame out = blank_frame(seen_[static_cast<std::size_t>(target)].depth_m.size());
  std::vector<FusionCounts> counts(static_cast<std::size_t>(camera.height_px));
  const auto classes = static_cast<std::size_t>(classes_);
  parallel_for(camera.height_px, [&](std::int64_t row) {
    Scratch scratch{ClassVotes(classes_, params_.floor, hard_),
                    std::vector<float>(classes),
                    std::vector<double>(classes),
                    std::vector<double>(classes),
                    {}};
    for (std::int32_t column = 0; column < camera.width_px; ++column)
      fuse_pixel(target, others, column, static_cast<std::int32_t>(row), scratch, out);
    counts[static_cast<std::size_t>(row)] = scratch.counts;
  });
  for (const FusionCounts& row : counts) out.counts.merge(row);
  return out;
}

}  // namespace semfield
