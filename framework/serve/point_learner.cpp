#include "serve/point_learner.h"

#include <algorithm>
#include <cmath>
#include <numbers>

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

}  // namespace semfield
