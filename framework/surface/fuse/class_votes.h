// Class probabilities of several views of one point, combined.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace semfield {

/// What a prediction without probabilities says: `confidence` for its label, the rest spread evenly over the other
/// classes.
struct HardLikelihood {
  double hit = 1, miss = 0;
  /// Throws Error(config) where the label would not be the most probable class: confidence <= 1 / classes.
  HardLikelihood(double confidence, int classes);
};

/// Sums over the views that see one point; clear() starts the next point. Both fusions are kept at once, since finding
/// the views costs more than adding.
class ClassVotes {
 public:
  /// `floor`: least probability of a class in one view, so that no view can rule out a class for all others.
  ClassVotes(int classes, double floor, HardLikelihood hard);

  void clear();
  /// Probabilities of a view [classes], some above 0. They need not sum to 1: what is missing belongs to no class of
  /// the table.
  void add(std::span<const double> probability);
  /// A label of a view, in [0, classes).
  void add(std::int16_t label);
  int views() const { return views_; }

  /// Product of the views' probabilities, renormalised: p_c = exp(s_c) / sum exp(s), s_c = sum over views of
  /// ln max(p_c(view), floor). Zeros without views. [classes]
  void bayesian(std::span<double> out) const;
  /// Mean of the views' probabilities; zeros without views. [classes]
  void average(std::span<double> out) const;

  /// Most probable class. `preferred` (or kVoid) wins where it is as probable up to rounding, then the least index;
  /// kVoid without views.
  std::int16_t bayesian_label(std::int16_t preferred) const;
  std::int16_t average_label(std::int16_t preferred) const;

 private:
  // Up to a term that all classes share.
  double log_sum(std::size_t c) const { return log_sum_[c] + label_views_[c] * log_hit_less_miss_; }
  double sum(std::size_t c) const { return sum_[c] + label_views_[c] * hit_less_miss_ + hard_views_ * hard_.miss; }
  template <class Score>
  std::int16_t best(std::int16_t preferred, double tie, Score&& score) const;

  double floor_;
  HardLikelihood hard_;
  double log_hit_less_miss_, hit_less_miss_;
  std::vector<double> log_sum_, sum_;  // of probabilities
  // Labels are counted, not summed: equal votes are equal numbers, whatever the order of views.
  std::vector<int> label_views_;
  int hard_views_ = 0, views_ = 0;
};

}  // namespace semfield
