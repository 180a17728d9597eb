#include "serve/point_learner.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numbers>
#include <numeric>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"
#include "execution/point_network.h"

namespace semfield {

namespace {

constexpr const char* kChoice = "point_learner/choice";

// Labelled points by class.
class PointChoice {
 public:
  PointChoice(std::span<const std::int16_t> logit, std::span<const float> weight, std::int32_t classes, double power) {
    std::vector<std::vector<std::int32_t>> of(static_cast<std::size_t>(classes));
    for (std::size_t i = 0; i < logit.size(); ++i)
      if (logit[i] >= 0) of[static_cast<std::size_t>(logit[i])].push_back(static_cast<std::int32_t>(i));
    for (std::vector<std::int32_t>& points : of) {
      if (points.empty()) continue;
      Class entry;
      double sum = 0;
      for (const std::int32_t i : points) {
        sum += weight.empty() ? 1.0 : static_cast<double>(weight[static_cast<std::size_t>(i)]);
        entry.up_to.push_back(sum);
      }
      if (!(sum > 0)) continue;
      entry.points = std::move(points);
      classes_.push_back(std::move(entry));
      class_up_to_.push_back((class_up_to_.empty() ? 0 : class_up_to_.back()) + std::pow(sum, power));
    }
  }

  bool empty() const { return classes_.empty(); }

  std::int32_t draw(const RandomAddress& address, std::int64_t i) const {
    const auto index = 2 * static_cast<std::uint64_t>(i);
    const auto chosen = place_of(class_up_to_, static_cast<double>(uniform01(address, index)) * class_up_to_.back());
    const Class& from = classes_[chosen];
    const double at = static_cast<double>(uniform01(address, index + 1)) * from.up_to.back();
    return from.points[place_of(from.up_to, at)];
  }

 private:
  static std::size_t place_of(const std::vector<double>& up_to, double at) {
    const auto found = std::upper_bound(up_to.begin(), up_to.end(), at) - up_to.begin();
    return static_cast<std::size_t>(std::min(found, std::ssize(up_to) - 1));
  }
  struct Class {
    std::vector<std::int32_t> points;
    std::vector<double> up_to;  // sum of weights
  };
  std::vector<Class> classes_;
  std::vector<double> class_up_to_;
};

}  // namespace

PointLearner::PointLearner(Pipeline<float>& pipeline) : pipeline_(pipeline) {
  SEMFIELD_CHECK(pipeline.has_semantics(), "points are learned by a network with semantics");
  classes_ = pipeline.passes().back().parts().head->width();
  tensors_ = semantic_tensors(pipeline.store());
}

PointRows PointLearner::rows_at(std::span<const Vec3d> positions) {
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  PointRows rows;
  rows.dims = pipeline_.passes().back().point_dims();
  rows.values.resize(positions.size() * static_cast<std::size_t>(rows.dims));
  if (!positions.empty())
    pipeline_.executor().points().rows({&positions.data()->x, std::ssize(positions), 3}, rows.view());
  return rows;
}

void PointLearner::learn(const PointRows& rows, std::span<const std::int16_t> logit, std::span<const float> weight,
                         const PointLearning& options) {
  SEMFIELD_CHECK(rows.count() == std::ssize(logit), "a logit for every point");
  for (Tensor<float>* tensor : tensors_)
    if (tensor->learned()) pipeline_.store().restart(*tensor);
  const PointChoice choice(logit, weight, classes_, options.class_power);
  const std::int64_t steps = choice.empty() ? 0 : options.steps;
  std::vector<std::int32_t> points(static_cast<std::size_t>(steps * options.batch));
  std::vector<AdamStep> updates;
  for (std::int64_t n = 0; n < steps; ++n) {
    const RandomAddress address{options.seed, static_cast<std::uint64_t>(n), stream_id(kChoice)};
    for (std::int64_t b = 0; b < options.batch; ++b)
      points[static_cast<std::size_t>(n * options.batch + b)] = choice.draw(address, b);
    const double done = static_cast<double>(n) / static_cast<double>(options.steps);
    const double rate = options.learning_rate * (0.1 + 0.45 * (1 + std::cos(std::numbers::pi * done)));
    updates.push_back(adam_step(AdamParams{}, rate, n));
  }
  PointLessons<float> lessons;
  lessons.rows = rows.view();
  lessons.logit = logit;
  lessons.choice = points;
  lessons.batch = options.batch;
  lessons.updates = updates;
  lessons.weight_decay = options.weight_decay;
  pipeline_.executor().points().learn(lessons);
}

PointLearner::Kept PointLearner::keep() const {
  pipeline_.executor().points().read();
  Kept kept;
  for (const Tensor<float>* tensor : tensors_)
    for (const auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2})
      kept.emplace_back(part->data(), part->data() + part->size());
  return kept;
}

void PointLearner::put_back(const Kept& kept) {
  std::size_t next = 0;
  for (Tensor<float>* tensor : tensors_)
    for (auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2}) {
      std::copy(kept[next].begin(), kept[next].end(), part->data());
      ++next;
    }
  pipeline_.executor().points().write();
}

std::vector<float> PointLearner::logits(const PointRows& rows) {
  std::vector<float> out(static_cast<std::size_t>(rows.count() * classes_));
  if (!out.empty()) pipeline_.executor().points().logits(rows.view(), {out.data(), rows.count(), classes_});
  return out;
}

void softmax_live(std::span<float> logits, std::int32_t classes, const std::vector<bool>& live) {
  const auto width = static_cast<std::size_t>(classes);
  for (std::size_t begin = 0; begin < logits.size(); begin += width) {
    const std::span<float> row = logits.subspan(begin, width);
    float most = -INFINITY, sum = 0;
    for (std::size_t c = 0; c < width; ++c)
      if (live[c]) most = std::max(most, row[c]);
    for (std::size_t c = 0; c < width; ++c) {
      row[c] = live[c] ? std::exp(row[c] - most) : 0.0F;
      sum += row[c];
    }
    if (sum > 0)
      for (float& p : row) p /= sum;
  }
}

std::vector<float> PointLearner::probabilities(const PointRows& rows, const std::vector<bool>& live) {
  std::vector<float> values = logits(rows);
  softmax_live(values, classes_, live);
  return values;
}

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

namespace {

constexpr const char* kRandom = "proposals/candidates";
// Classes that have a probability anywhere.
std::ptrdiff_t named_classes(const ProposalInput& in) {
  std::vector<bool> named(static_cast<std::size_t>(in.classes), false);
  for (std::size_t i = 0; i < in.probability.size(); ++i)
    if (in.probability[i] > 0) named[i % named.size()] = true;
  return std::count(named.begin(), named.end(), true);
}

// [N] entropy as a fraction of the largest there can be; all 1 while nothing is learned.
std::vector<double> entropies(const ProposalInput& in) {
  const std::size_t count = in.pool->points.size();
  std::vector<double> out(count, 1.0);
  if (in.probability.empty()) return out;
  const auto width = static_cast<std::size_t>(in.classes);
  const auto live = named_classes(in);
  if (live < 2) return out;  // a single class is sure of everything
  const double most = std::log(static_cast<double>(live));
  for (std::size_t i = 0; i < count; ++i) {
    double sum = 0;
    for (const float p : in.probability.subspan(i * width, width))
      if (p > 0) sum -= static_cast<double>(p) * std::log(static_cast<double>(p));
    out[i] = std::min(1.0, sum / most);
  }
  return out;
}

bool is_barred(const ProposalInput& in, std::size_t point) {
  return in.barred != nullptr && !in.barred->empty() && (*in.barred)[point];
}

// How little is known of each point, 0 to 1: far from every click by way of the surface, or doubted by the network.
std::vector<float> doubts(const ProposalInput& in) {
  const std::vector<double> entropy = entropies(in);
  std::vector<float> doubt(entropy.size());
  for (std::size_t i = 0; i < doubt.size(); ++i) {
    const float way = std::min(1.0F, in.graph->settled()[i].cost[0] / in.rules.unseen);
    if (is_barred(in, i)) continue;
    doubt[i] = static_cast<float>((1 - in.rules.entropy_share) * static_cast<double>(way) +
                                  in.rules.entropy_share * static_cast<double>(way) * entropy[i]);
  }
  std::vector<SurfaceGraph::Near> near;
  SurfaceGraph::Scratch scratch;
  for (const std::int32_t point : in.passed) {
    in.graph->around(point, in.rules.reach, in.rules.most, scratch, near);
    for (const SurfaceGraph::Near& n : near) doubt[static_cast<std::size_t>(n.point)] = 0;
  }
  return doubt;
}

// Points drawn in proportion to their doubt, and not beside a border.
std::vector<std::int32_t> candidates_of(const ProposalInput& in, std::span<const float> doubt) {
  std::vector<double> up_to;
  std::vector<std::int32_t> may;
  double sum = 0;
  for (std::size_t i = 0; i < doubt.size(); ++i) {
    if (!in.pool->points[i].interior || is_barred(in, i)) continue;
    may.push_back(static_cast<std::int32_t>(i));
    up_to.push_back(sum += static_cast<double>(doubt[i]) + 1e-9);
  }
  std::vector<std::int32_t> out;
  if (may.empty()) return out;
  const RandomAddress address{in.seed, in.round, stream_id(kRandom)};
  for (std::int64_t k = 0; k < in.rules.candidates; ++k) {
    const double at =
        (static_cast<double>(k) + static_cast<double>(uniform01(address, static_cast<std::uint64_t>(k)))) /
        static_cast<double>(in.rules.candidates) * sum;
    const auto found = std::upper_bound(up_to.begin(), up_to.end(), at) - up_to.begin();
    out.push_back(may[static_cast<std::size_t>(std::min(found, std::ssize(may) - 1))]);
  }
  return out;
}

}  // namespace

std::optional<Asked> choose_click(const ProposalInput& in) {
  if (in.pool->points.empty()) return std::nullopt;
  const std::vector<float> doubt = doubts(in);
  const std::vector<std::int32_t> candidates = candidates_of(in, doubt);
  if (candidates.empty()) return Asked{0, 0, "unseen"};
  std::vector<double> gain(candidates.size());
  constexpr std::int64_t kBlock = 16;
  parallel_for((std::ssize(candidates) + kBlock - 1) / kBlock, [&](std::int64_t block) {
    SurfaceGraph::Scratch scratch;
    std::vector<SurfaceGraph::Near> near;
    for (std::int64_t k = block * kBlock; k < std::min(std::ssize(candidates), (block + 1) * kBlock); ++k) {
      in.graph->around(candidates[static_cast<std::size_t>(k)], in.rules.reach, in.rules.most, scratch, near);
      double settled = 0, area = 0;
      for (const SurfaceGraph::Near& n : near) {
        const double share = 1 - static_cast<double>(n.cost / in.rules.reach);
        settled += share * static_cast<double>(doubt[static_cast<std::size_t>(n.point)]);
        area += share;
      }
      gain[static_cast<std::size_t>(k)] = settled / std::pow(area, 1 - in.rules.area_power);
    }
  });
  const auto best = static_cast<std::size_t>(std::max_element(gain.begin(), gain.end()) - gain.begin());
  const std::int32_t point = candidates[best];
  const float way = in.graph->settled()[static_cast<std::size_t>(point)].cost[0];
  return Asked{point, gain[best], way >= in.rules.unseen ? "unseen" : "uncertain"};
}

}  // namespace semfield
