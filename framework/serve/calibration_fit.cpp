// The temperature of a labelling session's class probabilities.
#include <algorithm>
#include <cmath>

#include "serve/label_loop.h"

namespace semfield {

namespace {

constexpr int kFolds = 5;
constexpr std::size_t kLeastClicks = 10;
constexpr double kLowest = 0.25, kHighest = 20;

// A held-back point: its class probabilities by what was learned from the other clicks, and what it stands for.
struct HeldBack {
  std::vector<float> probability;
  std::size_t truth = 0;
  double counts = 0;
};

// Mean negative log likelihood at a temperature; NAN where there is nothing to compare.
double likelihood(const std::vector<HeldBack>& held, double temperature) {
  double sum = 0, total = 0;
  for (const HeldBack& point : held) {
    double norm = 0;
    for (const float p : point.probability)
      if (p > 0) norm += std::pow(static_cast<double>(p), 1 / temperature);
    const double own = std::max(1e-12, static_cast<double>(point.probability[point.truth]));
    sum += point.counts * (std::log(norm) - std::log(own) / temperature);
    total += point.counts;
  }
  return total > 0 ? sum / total : NAN;
}

}  // namespace

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

double LabelLoop::fit_temperature(std::span<const LabelledPixels> clicks) {
  if (clicks.size() < kLeastClicks || !ready()) return 1;
  pipeline_.executor().download(training_.step());
  const Named named = named_points(clicks);
  // Clicks lie where there was doubt: each counts for the surface that it stands for.
  const std::vector<double> area = areas_of(clicks.size(), named);
  std::vector<HeldBack> held;
  for (int fold = 0; fold < kFolds; ++fold) {
    std::vector<LabelledPixels> others;
    for (std::size_t k = 0; k < clicks.size(); ++k)
      if (static_cast<int>(k % kFolds) != fold) others.push_back(clicks[k]);
    learn_from(others, options_.learning.steps);
    std::vector<Vec3d> places;
    std::vector<HeldBack> of_fold;
    for (std::size_t i = 0; i < named.logit.size(); ++i) {
      const auto click = static_cast<std::size_t>(named.click[i]);
      const bool first = i == 0 || named.click[i] != named.click[i - 1];  // a click's first point stands for it
      if (!first || static_cast<int>(click % kFolds) != fold) continue;
      if (!live_[static_cast<std::size_t>(named.logit[i])]) continue;  // nobody else has named its class
      places.push_back(named.position[i]);
      of_fold.push_back({{}, static_cast<std::size_t>(named.logit[i]), area[click]});
    }
    const std::vector<float> found = probabilities(learner_.rows_at(places), places, 1);
    const auto width = static_cast<std::ptrdiff_t>(classes());
    for (std::size_t k = 0; k < of_fold.size(); ++k) {
      const auto row = found.begin() + static_cast<std::ptrdiff_t>(k) * width;
      of_fold[k].probability.assign(row, row + width);
      held.push_back(std::move(of_fold[k]));
    }
  }
  learn_from(clicks, options_.learning.steps);
  pipeline_.executor().upload(training_.step());
  predict_pool();
  if (!std::isfinite(likelihood(held, 1))) return 1;
  // One minimum over log T: golden section.
  double low = std::log(kLowest), high = std::log(kHighest);
  const double golden = (std::sqrt(5.0) - 1) / 2;
  for (int i = 0; i < 40; ++i) {
    const double a = high - golden * (high - low), b = low + golden * (high - low);
    if (likelihood(held, std::exp(a)) < likelihood(held, std::exp(b))) {
      high = b;
    } else {
      low = a;
    }
  }
  return std::exp((low + high) / 2);
}

}  // namespace semfield
