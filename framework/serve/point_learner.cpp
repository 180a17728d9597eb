#include "serve/point_learner.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "compute/float_mode.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"
#include "losses/semantic_cross_entropy.h"

namespace semfield {

namespace {

constexpr std::int64_t kTile = 64;         // rows of a batch that one lane takes
constexpr std::int64_t kPredicted = 1024;  // rows of a unit of work that only evaluates
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

struct PointLearner::Batch {
  std::int64_t number = 0;
  std::vector<float> rows;          // [B, dims]
  std::vector<std::int16_t> logit;  // [B]
};

PointLearner::PointLearner(Pipeline<float>& pipeline) : pipeline_(pipeline) {
  SEMFIELD_CHECK(pipeline.has_semantics(), "points are learned by a network with semantics");
  classes_ = pass().parts().head->width();
  for (Tensor<float>& tensor : pipeline.store().all())
    if (tensor.rule.semantic && tensor.grad.size() > 0) tensors_.push_back(&tensor);
}

StepContext PointLearner::context(std::int64_t number, bool training, Workspace& arena) const {
  StepContext ctx;
  ctx.seed = pipeline_.options().seed;
  ctx.step = number;
  ctx.training = training;
  ctx.pass = pass().parts().number;
  ctx.workspace = &arena;
  return ctx;
}

PointRows PointLearner::rows_at(std::span<const Vec3d> positions) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  PointRows rows;
  rows.dims = pass().point_dims();
  rows.values.resize(positions.size() * static_cast<std::size_t>(rows.dims));
  const auto total = static_cast<std::int64_t>(positions.size());
  const View<const double> places(positions.empty() ? nullptr : &positions.data()->x, total, 3);
  arenas_.for_units((total + kPredicted - 1) / kPredicted, [&](Workspace& arena, std::int64_t unit) {
    const std::int64_t begin = unit * kPredicted, count = std::min(kPredicted, total - begin);
    const Workspace::Scope taken(arena);
    pass().point_rows(context(0, false, arena), places.row_range(begin, count), rows.view().row_range(begin, count));
  });
  return rows;
}

void PointLearner::gradients(const Batch& batch) {
  const auto rows = static_cast<std::int64_t>(batch.logit.size());
  const auto dims = static_cast<std::int32_t>(static_cast<std::int64_t>(batch.rows.size()) / rows);
  const std::int64_t tiles = (rows + kTile - 1) / kTile;
  const int lanes = static_cast<int>(std::min<std::int64_t>(pipeline_.store().lanes(), tiles));
  const View<float> input(const_cast<float*>(batch.rows.data()), rows, dims);
  arenas_.for_units(lanes, [&](Workspace& arena, std::int64_t lane) {
    for (std::int64_t tile = lane; tile < tiles; tile += lanes) {
      const std::int64_t begin = tile * kTile, count = std::min(kTile, rows - begin);
      const Workspace::Scope taken(arena);
      StepContext ctx = context(batch.number, true, arena);
      ctx.first_ray = begin;
      const View<float> logits = arena.take<float>(count, classes_), d_logits = arena.take<float>(count, classes_);
      const PointTrace<float> trace =
          pass().point_forward(ctx, static_cast<int>(lane), input.row_range(begin, count), logits);
      SemanticTargets targets;
      targets.hard = {batch.logit.data() + begin, count, 1};
      semantic_cross_entropy<float>(logits, targets, {}, static_cast<double>(rows), 1, d_logits, begin);
      pass().point_backward(ctx, static_cast<int>(lane), trace, d_logits);
    }
  });
  for (Tensor<float>* tensor : tensors_) {  // in lane order
    const auto size = static_cast<std::size_t>(tensor->size());
    for (int lane = 0; lane < lanes; ++lane) {
      float* const from = tensor->lanes.data() + static_cast<std::size_t>(lane) * size;
      for (std::size_t i = 0; i < size; ++i) tensor->grad.data()[i] += from[i];
      std::fill_n(from, size, 0.0F);
    }
  }
}

void PointLearner::update(const PointLearning& options, std::int64_t number) {
  const double done = static_cast<double>(number) / static_cast<double>(std::max<std::int64_t>(options.steps, 1));
  const double rate = options.learning_rate * (0.1 + 0.45 * (1 + std::cos(std::numbers::pi * done)));
  AdamParams params;
  AdamStep step = adam_step(params, rate, number);
  for (Tensor<float>* tensor : tensors_) {
    if (tensor->learned()) {
      step.decay = tensor->spec.rows > 1 ? rate * options.weight_decay : 0;  // weights, not biases
      adam_dense<float>(step, tensor->view(tensor->value), tensor->view(tensor->grad), tensor->view(tensor->moment1),
                        tensor->view(tensor->moment2), 0, tensor->spec.rows);
    }
    std::fill_n(tensor->grad.data(), tensor->grad.size(), 0.0F);
  }
}

void PointLearner::learn(const PointRows& rows, std::span<const std::int16_t> logit, std::span<const float> weight,
                         const PointLearning& options) {
  SEMFIELD_CHECK(rows.count() == std::ssize(logit), "a logit for every point");
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  for (Tensor<float>* tensor : tensors_) {
    if (tensor->learned()) pipeline_.store().restart(*tensor);
    std::fill_n(tensor->grad.data(), tensor->grad.size(), 0.0F);  // of the last step of training
  }
  const PointChoice choice(logit, weight, classes_, options.class_power);
  const auto dims = static_cast<std::size_t>(rows.dims);
  Batch batch;
  batch.rows.resize(static_cast<std::size_t>(options.batch) * dims);
  batch.logit.resize(static_cast<std::size_t>(options.batch));
  for (std::int64_t n = 0; n < options.steps && !choice.empty(); ++n) {
    const StepContext ctx = context(n, true, arenas_.own());
    pass().derive(ctx);
    const RandomAddress address{options.seed, static_cast<std::uint64_t>(n), stream_id(kChoice)};
    for (std::size_t b = 0; b < batch.logit.size(); ++b) {
      const auto i = static_cast<std::size_t>(choice.draw(address, static_cast<std::int64_t>(b)));
      std::copy_n(&rows.values[i * dims], dims, &batch.rows[b * dims]);
      batch.logit[b] = logit[i];
    }
    batch.number = n;
    gradients(batch);
    pass().derive_backward(ctx);
    update(options, n);
  }
  for (Tensor<float>* tensor : tensors_) {
    std::fill_n(tensor->moment1.data(), tensor->moment1.size(), 0.0F);
    std::fill_n(tensor->moment2.data(), tensor->moment2.size(), 0.0F);
  }
  pass().derive(context(options.steps, true, arenas_.own()));
}

PointLearner::Kept PointLearner::keep() const {
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
  pass().derive(context(0, true, arenas_.own()));
}

std::vector<float> PointLearner::logits(const PointRows& rows) {
  const WorkScope scope(pipeline_.options().work);
  const ComputeFloatMode mode;
  const std::int64_t total = rows.count();
  std::vector<float> out(static_cast<std::size_t>(total * classes_));
  const View<float> all(out.data(), total, classes_);
  const View<float> input(const_cast<float*>(rows.values.data()), total, rows.dims);
  arenas_.for_units((total + kPredicted - 1) / kPredicted, [&](Workspace& arena, std::int64_t unit) {
    const std::int64_t begin = unit * kPredicted, count = std::min(kPredicted, total - begin);
    const Workspace::Scope taken(arena);
    (void)pass().point_forward(context(0, false, arena), kMainGradient, input.row_range(begin, count),
                               all.row_range(begin, count));
  });
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
