// What a labelling session returns between steps: labels of a view, the next question, clicks held back.
#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "serve/label_loop.h"
#include "serve/label_upsampling.h"

namespace semfield {

std::vector<double> LabelLoop::areas_of(std::size_t clicks, const Named& named) const {
  std::vector<double> area(clicks, 1);
  for (const PoolPoint& point : pool_.points) {
    double least = INFINITY;
    std::size_t nearest = 0;
    for (std::size_t i = 0; i < named.position.size(); ++i) {
      if (i > 0 && named.click[i] == named.click[i - 1]) continue;  // a click's first point stands for it
      const Vec3d way = point.position - named.position[i];
      const double square = dot(way, way);
      if (square >= least) continue;
      least = square;
      nearest = static_cast<std::size_t>(named.click[i]);
    }
    if (std::isfinite(least)) area[nearest] += 1;
  }
  return area;
}

std::vector<HeldBack> LabelLoop::hold_back(std::span<const LabelledPixels> clicks, int fold) {
  (void)places_.find(clicks, surface(), INFINITY);
  std::vector<std::int16_t> of_clicks;  // classes; given labels are never held back
  for (const LabelledPixels& click : clicks)
    if (click.weight >= 1) of_clicks.push_back(click.class_index);
  const std::vector<int> folds = calibration_folds(of_clicks);
  std::vector<bool> left_out(clicks.size(), false);
  auto next = folds.begin();
  for (std::size_t k = 0; k < clicks.size(); ++k)
    if (clicks[k].weight >= 1) left_out[k] = *next++ == fold;
  std::vector<HeldBack> held;
  if (std::count(left_out.begin(), left_out.end(), true) == 0) return held;
  const Named named = named_points(clicks);
  // Clicks lie where there was doubt: each counts for the surface that it stands for.
  const std::vector<double> area = areas_of(clicks.size(), named);
  const PointLearner::Kept kept = learner_.keep();
  const std::vector<bool> live = live_;
  const std::vector<Seed> seeds = seeds_;
  const std::vector<Vec3d> answered = answered_;
  const bool learned = learned_;
  learn_from(named_points(clicks, left_out), options_.learning.steps);
  std::vector<Vec3d> places;
  for (std::size_t i = 0; i < named.logit.size(); ++i) {
    const auto click = static_cast<std::size_t>(named.click[i]);
    const bool first = i == 0 || named.click[i] != named.click[i - 1];  // a click's first point stands for it
    if (!first || !left_out[click]) continue;
    if (!live_[static_cast<std::size_t>(named.logit[i])]) continue;  // nobody else has named its class
    places.push_back(named.position[i]);
    held.push_back({{}, static_cast<std::size_t>(named.logit[i]), area[click]});
  }
  const std::vector<float> found = probabilities(learner_.rows_at(places), places, 1);
  for (std::size_t i = 0; i < held.size(); ++i) {
    const auto row = found.begin() + static_cast<std::ptrdiff_t>(i) * classes();
    held[i].probability.assign(row, row + classes());
  }
  learner_.put_back(kept);
  live_ = live;
  seeds_ = seeds;
  learned_ = learned;
  answered_ = answered;
  settle_seeds();
  return held;
}

ViewLabels LabelLoop::labels_of(int v, const SurfaceMap* fine) {
  PoolView& view = views_[static_cast<std::size_t>(v)];
  if (static_cast<std::size_t>(v) >= pooled_ && ready() && due(view)) view.map = map_of(v, stride_);
  const SurfaceMap& map = fine != nullptr ? *fine : view.map;
  CoarseLabels coarse{map.stride, map.width_px, map.height_px, {}, {}};
  coarse.label.assign(map.distance_m.size(), kVoid);
  coarse.entropy.assign(map.distance_m.size(), 0);
  if (learned_ && !map.empty()) {
    std::vector<Vec3d> positions;
    std::vector<std::size_t> where;
    for (std::size_t i = 0; i < map.distance_m.size(); ++i) {
      if (map.distance_m[i] > 0) where.push_back(i);
    }
    positions.resize(where.size());
    parallel_for((std::ssize(where) + 1023) / 1024, [&](std::int64_t block) {
      for (auto k = static_cast<std::size_t>(block * 1024);
           k < std::min(where.size(), static_cast<std::size_t>((block + 1) * 1024)); ++k) {
        const PixelPlace pixel = strided_place(static_cast<std::int64_t>(where[k]), map.width_px, map.stride);
        positions[k] =
            point_at(view.camera, training_.session().limits, pixel, static_cast<double>(map.distance_m[where[k]]));
      }
    });
    const std::vector<float> probability = probabilities(learner_.rows_at(positions), positions, temperature_);
    const std::vector<int>& class_of_logit = training_.session().plan.class_of_logit;
    const auto width = static_cast<std::size_t>(classes());
    const double most =
        std::log(static_cast<double>(std::max<std::ptrdiff_t>(2, std::count(live_.begin(), live_.end(), true))));
    parallel_for((std::ssize(where) + 1023) / 1024, [&](std::int64_t block) {
      for (auto k = static_cast<std::size_t>(block * 1024);
           k < std::min(where.size(), static_cast<std::size_t>((block + 1) * 1024)); ++k) {
        const float* const row = &probability[k * width];
        double entropy = 0;
        for (std::size_t c = 0; c < width; ++c)
          if (row[c] > 0) entropy -= static_cast<double>(row[c]) * std::log(static_cast<double>(row[c]));
        const std::ptrdiff_t best = std::max_element(row, row + width) - row;
        coarse.label[where[k]] = static_cast<std::int16_t>(class_of_logit[static_cast<std::size_t>(best)]);
        coarse.entropy[where[k]] = static_cast<std::uint8_t>(std::lround(255 * std::min(1.0, entropy / most)));
      }
    });
  }
  ViewLabels labels = upsampled(coarse, *view.photo);
  for (const LabelledPixels& click : clicks_) {
    if (click.view != v) continue;
    for (const PixelPlace& pixel : click.pixels) {
      const auto at = static_cast<std::size_t>(std::int64_t{pixel.row} * labels.width_px + pixel.column);
      labels.label[at] = click.class_index;
      labels.entropy[at] = 0;
    }
  }
  const std::vector<bool>& ignored = ignored_[static_cast<std::size_t>(v)];
  for (std::size_t p = 0; p < ignored.size(); ++p) {
    if (!ignored[p]) continue;
    labels.label[p] = kVoid;
    labels.entropy[p] = 0;
  }
  return labels;
}

std::optional<Asked> LabelLoop::propose(Acquisition how, std::uint64_t seed, std::uint64_t round) const {
  ProposalInput input;
  input.pool = &pool_;
  input.graph = &graph_;
  input.probability = pool_probability_;
  input.classes = learner_.classes();
  input.answered = answered_;
  std::vector<std::int32_t> passed;
  for (const Vec3d& place : skipped_)
    if (const std::int32_t point = pool_.cells.near(place); point >= 0) passed.push_back(point);
  input.passed = passed;
  std::vector<bool> barred;
  if (std::any_of(ignored_.begin(), ignored_.end(), [](const auto& pixels) { return !pixels.empty(); })) {
    for (const PoolPoint& point : pool_.points) {
      const auto v = static_cast<std::size_t>(point.view);
      const std::int64_t pixel = std::int64_t{point.pixel.row} * views_[v].photo->width_px + point.pixel.column;
      barred.push_back(!ignored_[v].empty() && ignored_[v][static_cast<std::size_t>(pixel)]);
    }
  }
  input.barred = &barred;
  input.seed = seed;
  input.round = round;
  input.rules = options_.proposals;
  const WorkScope scope(pipeline_.options().work);
  return choose_click(how, input);
}

void LabelLoop::set_skipped(std::vector<LabelledPixels> skipped) {
  skipped_.clear();
  const RayLimits& limits = training_.session().limits;
  for (const LabelledPixels& place : skipped) {
    const RayCamera& camera = views_[static_cast<std::size_t>(place.view)].camera;
    const std::vector<float> distance = surface_distances(pipeline_, camera, limits, place.pixels);
    if (!distance.empty() && distance[0] > 0)
      skipped_.push_back(point_at(camera, limits, place.pixels[0], static_cast<double>(distance[0])));
  }
}

}  // namespace semfield
