#include "labels/serve/calibration.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <tuple>

#include "labels/serve/label_loop.h"
#include "labels/serve/label_session.h"

namespace semfield {

namespace {

constexpr int kLeastOfClass = 4;       // clicks of a class of which one may be held back
constexpr std::size_t kLeastHeld = 8;  // clicks that say something of the temperature
constexpr double kLowest = 0.25, kHighest = 5;
constexpr double kPriorWidth = 0.5;   // standard deviation of log T
constexpr double kWrongClicks = 0.1;  // fraction that says nothing: slips, and places that no other click resembles

// Of the clicks at a temperature: weighted log likelihoods, as many as there are in effect, less the prior.
double misfit(std::span<const HeldBack> held, double temperature) {
  double sum = 0, total = 0, squares = 0;
  for (const HeldBack& click : held) {
    double norm = 0;
    std::size_t live = 0;
    for (const float p : click.probability) {
      if (!(p > 0)) continue;
      norm += std::pow(static_cast<double>(p), 1 / temperature);
      ++live;
    }
    const auto own = static_cast<double>(click.probability[click.truth]);
    const double share = own > 0 && norm > 0 ? std::pow(own, 1 / temperature) / norm : 0;
    sum -= click.counts *
           std::log((1 - kWrongClicks) * share + kWrongClicks / static_cast<double>(std::max<std::size_t>(1, live)));
    total += click.counts;
    squares += click.counts * click.counts;
  }
  const double off = std::log(temperature) / kPriorWidth;
  return sum / total * (total * total / squares) + off * off / 2;
}

}  // namespace

std::vector<int> calibration_folds(std::span<const std::int16_t> classes) {
  std::map<std::int16_t, int> all, dealt;
  for (const std::int16_t c : classes) ++all[c];
  std::vector<int> folds;
  for (const std::int16_t c : classes)
    folds.push_back(all[c] < kLeastOfClass ? -1 : (dealt[c]++ + c) % kCalibrationFolds);
  return folds;
}

std::optional<double> fit_temperature(std::span<const HeldBack> held) {
  if (held.size() < kLeastHeld) return std::nullopt;
  // One minimum over log T: golden section.
  const double bottom = std::log(kLowest), top = std::log(kHighest), golden = (std::sqrt(5.0) - 1) / 2;
  double low = bottom, high = top;
  for (int i = 0; i < 40; ++i) {
    const double a = high - golden * (high - low), b = low + golden * (high - low);
    if (misfit(held, std::exp(a)) < misfit(held, std::exp(b))) {
      high = b;
    } else {
      low = a;
    }
  }
  const double found = (low + high) / 2;
  if (found - bottom < 0.01 || top - found < 0.01) return std::nullopt;
  return std::exp(found);
}

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
  (void)find_places(clicks, INFINITY);
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
  const auto before = std::tuple(live_, seeds_, learned_);
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
  std::tie(live_, seeds_, learned_) = before;
  settle_seeds();
  return held;
}

namespace {

constexpr std::size_t kLeastToFit = 10;  // clicks; and half as many again as at the last fit

}  // namespace

// True when the temperature has changed.
bool LabelRun::fit_a_fold() {
  const std::size_t own = clicks_.size() - given_.size();
  if (own < kLeastToFit || own * 2 < fitted_at_ * 3) return false;
  for (HeldBack& held : loop_.hold_back(clicks_, fold_)) held_back_.push_back(std::move(held));
  if (++fold_ < kCalibrationFolds) return false;
  const std::optional<double> temperature = fit_temperature(held_back_);
  fold_ = 0;
  held_back_.clear();
  fitted_at_ = own;
  if (temperature) loop_.set_temperature(*temperature);
  return temperature.has_value();
}

}  // namespace semfield
