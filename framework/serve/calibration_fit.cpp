// The temperature of a labelling session's class probabilities.
#include <algorithm>
#include <cmath>

#include "serve/label_loop.h"

namespace semfield {

namespace {

constexpr int kFolds = 5;
constexpr std::size_t kLeastClicks = 10;
constexpr double kLowest = 0.25, kHighest = 20;

// Mean negative log likelihood at a temperature; each click weighs the same.
double likelihood(std::span<const float> logits, std::span<const std::int16_t> truth, std::span<const float> weight,
                  const std::vector<std::vector<bool>>& live, std::span<const int> fold, double temperature) {
  const std::size_t width = live.front().size();
  double sum = 0, total = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const float* const row = &logits[i * width];
    const std::vector<bool>& has = live[static_cast<std::size_t>(fold[i])];
    if (!has[static_cast<std::size_t>(truth[i])]) continue;  // nobody else has named its class
    double most = -INFINITY, norm = 0;
    for (std::size_t c = 0; c < width; ++c)
      if (has[c]) most = std::max(most, static_cast<double>(row[c]) / temperature);
    for (std::size_t c = 0; c < width; ++c)
      if (has[c]) norm += std::exp(static_cast<double>(row[c]) / temperature - most);
    const auto own = static_cast<double>(row[static_cast<std::size_t>(truth[i])]) / temperature;
    sum += static_cast<double>(weight[i]) * (std::log(norm) + most - own);
    total += static_cast<double>(weight[i]);
  }
  return total > 0 ? sum / total : NAN;
}

}  // namespace

double LabelLoop::fit_temperature(std::span<const LabelledPixels> clicks) {
  if (clicks.size() < kLeastClicks) return 1;
  pipeline_.executor().download(training_.step());
  const Named named = named_points(clicks);
  const auto dims = static_cast<std::size_t>(named.rows.dims), width = static_cast<std::size_t>(classes());
  std::vector<float> logits(named.logit.size() * width);
  std::vector<int> fold_of(named.logit.size());
  std::vector<std::vector<bool>> live(kFolds, std::vector<bool>(width, false));
  for (int fold = 0; fold < kFolds; ++fold) {
    PointRows others, held;
    others.dims = held.dims = named.rows.dims;
    std::vector<std::int16_t> logit;
    std::vector<float> weight;
    std::vector<std::size_t> of_held;
    for (std::size_t i = 0; i < named.logit.size(); ++i) {
      const bool is_held = named.click[i] % kFolds == fold;
      PointRows& to = is_held ? held : others;
      const auto row = named.rows.values.begin() + static_cast<std::ptrdiff_t>(i * dims);
      to.values.insert(to.values.end(), row, row + static_cast<std::ptrdiff_t>(dims));
      if (is_held) {
        of_held.push_back(i);
        fold_of[i] = fold;
      } else {
        logit.push_back(named.logit[i]);
        weight.push_back(named.weight[i]);
        live[static_cast<std::size_t>(fold)][static_cast<std::size_t>(named.logit[i])] = true;
      }
    }
    learner_.learn(others, logit, weight, options_.learning);
    const std::vector<float> found = learner_.logits(held);
    for (std::size_t k = 0; k < of_held.size(); ++k) std::copy_n(&found[k * width], width, &logits[of_held[k] * width]);
  }
  learner_.learn(named.rows, named.logit, named.weight, options_.learning);  // as it was
  pipeline_.executor().upload(training_.step());
  // The likelihood has one minimum over log T: golden section.
  double low = std::log(kLowest), high = std::log(kHighest);
  const double golden = (std::sqrt(5.0) - 1) / 2;
  const auto value = [&](double at) {
    return likelihood(logits, named.logit, named.weight, live, fold_of, std::exp(at));
  };
  if (!std::isfinite(value(0))) return 1;
  for (int i = 0; i < 40; ++i) {
    const double a = high - golden * (high - low), b = low + golden * (high - low);
    if (value(a) < value(b)) {
      high = b;
    } else {
      low = a;
    }
  }
  return std::exp((low + high) / 2);
}

}  // namespace semfield
