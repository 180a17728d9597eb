#include "surface/fuse/class_votes.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "core/error.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {
// Sums of the same terms in another order differ by less; predictions that differ by less count as equal.
constexpr double kTie = 1e-9;
}  // namespace

HardLikelihood::HardLikelihood(double confidence, int classes) : hit(confidence) {
  if (classes > 1) miss = (1 - confidence) / (classes - 1);
  if (classes > 1 && !(hit > miss)) {
    throw Error(ErrorKind::config, "config.value.range",
                fmt::format("fuse.hard_confidence: {} says nothing among {} classes, each has {:.3g}", confidence,
                            classes, miss),
                fmt::format("write more than {:.3g}", 1.0 / classes));
  }
}

ClassVotes::ClassVotes(int classes, double floor, HardLikelihood hard)
    : floor_(floor),
      hard_(hard),
      log_hit_less_miss_(std::log(std::max(hard.hit, floor)) - std::log(std::max(hard.miss, floor))),
      hit_less_miss_(hard.hit - hard.miss),
      log_sum_(static_cast<std::size_t>(classes)),
      sum_(static_cast<std::size_t>(classes)),
      label_views_(static_cast<std::size_t>(classes)) {}

void ClassVotes::clear() {
  std::fill(log_sum_.begin(), log_sum_.end(), 0.0);
  std::fill(sum_.begin(), sum_.end(), 0.0);
  std::fill(label_views_.begin(), label_views_.end(), 0);
  hard_views_ = views_ = 0;
}

void ClassVotes::add(std::span<const double> probability) {
  for (std::size_t c = 0; c < sum_.size(); ++c) {
    log_sum_[c] += std::log(std::max(probability[c], floor_));
    sum_[c] += probability[c];
  }
  ++views_;
}

void ClassVotes::add(std::int16_t label) {
  ++label_views_[static_cast<std::size_t>(label)];
  ++hard_views_;
  ++views_;
}

void ClassVotes::bayesian(std::span<double> out) const {
  std::fill(out.begin(), out.end(), 0.0);
  if (views_ == 0 || out.empty()) return;
  double most = log_sum(0);
  for (std::size_t c = 1; c < out.size(); ++c) most = std::max(most, log_sum(c));
  double total = 0;  // at least 1: the largest term is exp(0)
  for (std::size_t c = 0; c < out.size(); ++c) total += out[c] = std::exp(log_sum(c) - most);
  for (double& p : out) p /= total;
}

void ClassVotes::average(std::span<double> out) const {
  for (std::size_t c = 0; c < out.size(); ++c) out[c] = views_ == 0 ? 0 : sum(c) / views_;
}

template <class Score>
std::int16_t ClassVotes::best(std::int16_t preferred, double tie, Score&& score) const {
  if (views_ == 0 || sum_.empty()) return kVoid;
  double most = score(0);
  for (std::size_t c = 1; c < sum_.size(); ++c) most = std::max(most, score(c));
  if (preferred >= 0 && score(static_cast<std::size_t>(preferred)) >= most - tie) return preferred;
  for (std::size_t c = 0; c < sum_.size(); ++c) {
    if (score(c) >= most - tie) return static_cast<std::int16_t>(c);
  }
  return kVoid;
}

std::int16_t ClassVotes::bayesian_label(std::int16_t preferred) const {
  return best(preferred, kTie * views_, [this](std::size_t c) { return log_sum(c); });
}

std::int16_t ClassVotes::average_label(std::int16_t preferred) const {
  return best(preferred, kTie * views_, [this](std::size_t c) { return sum(c); });
}

}  // namespace semfield
