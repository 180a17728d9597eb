#include "serve/calibration_fit.h"

#include <algorithm>
#include <cmath>
#include <map>

namespace semfield {

namespace {

constexpr int kLeastOfClass = 4;       // clicks of a class of which one may be held back
constexpr std::size_t kLeastHeld = 8;  // clicks that say something of the temperature
constexpr double kLowest = 0.25, kHighest = 5;
constexpr double kPriorWidth = 0.5;  // standard deviation of log T
constexpr double kWrongClicks =
    0.1;  // fraction of clicks that say nothing: slips, and places that no other click resembles

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

}  // namespace semfield
