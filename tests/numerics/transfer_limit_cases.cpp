// Group A: early stop, bad and extreme values, units.
#include <cstring>

#include "compute/parallel.h"
#include "eval/evaluator.h"
#include "model_bench.h"
#include "ray_bench.h"
#include "training_box.h"

namespace semfield::numerics {

namespace {

template <class T>
bool same_bits(View<T> a, View<T> b) {
  bool same = a.rows == b.rows && a.cols == b.cols;
  for (std::int64_t r = 0; same && r < a.rows; ++r)
    same = std::memcmp(a.row(r), b.row(r), sizeof(T) * static_cast<std::size_t>(a.cols)) == 0;
  return same;
}

}  // namespace

namespace {

// What is not looked at behind T < 1e-4 may change a value by at most 1e-4 of the largest one there. Where the last
// sample takes the rest, it takes it with the class layer's bias, which counts as a value.
template <class Real>
void measure_early_stop(CaseRun& run, FarMode far) {
  constexpr double kCut = 1e-4;
  const double rounding = tolerance_of<Real>(2e-6);
  RenderRules rules{.rendering = {.density_activation = DensityActivation::softplus,
                                  .density_bias = 3,
                                  .far = far,
                                  .background = {1, 1, 1},
                                  .early_stop = 0}};
  RenderRules cutting = rules, every_logit = rules;
  cutting.rendering.early_stop = kCut;
  every_logit.deferred_class_layer = false;
  ModelBench<Real> whole(run.registry(), rules), cut(run.registry(), cutting),
      sample_by_sample(run.registry(), every_logit);
  const PassTrace<Real> full = whole.forward(false), part = cut.forward(false),
                        single = sample_by_sample.forward(false);
  const Tensor<Real>* bias = cut.store.find("main/semantic/class/bias");
  run.expect(bias != nullptr && bias->size() == full.semantic.rows.cols, "the class layer has a bias per class");
  if (bias == nullptr) return;
  std::int64_t skipped = 0;
  for (std::int64_t m = 0; m < full.samples.count; ++m)
    skipped += part.sigma(m, 0) == 0 && full.sigma(m, 0) > 0 ? 1 : 0;
  run.expect(skipped > full.samples.count / 10, "a tenth of the samples and more is not evaluated");
  double worst_colour = 0, worst_logit = 0;
  for (std::int64_t r = 0; r < ModelBench<Real>::kRays; ++r) {
    for (int c = 0; c < 3; ++c) {
      const double error = std::abs(static_cast<double>(full.color(r, c)) - static_cast<double>(part.color(r, c)));
      run.measure(error, kCut + rounding, "colour");  // no colour exceeds 1
      worst_colour = std::max(worst_colour, error);
    }
    for (std::int32_t c = 0; c < full.semantic.rows.cols; ++c) {
      double largest = 0;
      for (std::int32_t m = single.samples.first(r, 0); m < single.samples.first(r + 1, 0); ++m)
        largest = std::max<double>(largest, std::abs(single.semantic.sample_rows(m, c)));
      const double error =
          std::abs(static_cast<double>(full.semantic.rows(r, c)) - static_cast<double>(part.semantic.rows(r, c)));
      const double rest = far == FarMode::background ? std::abs(bias->value.data()[c]) : 0.0;
      run.measure(error, (kCut + rounding) * (largest + rest), "logit");
      worst_logit = std::max(worst_logit, error / largest);
    }
    run.measure(std::max(0.0, static_cast<double>(part.opacity(r, 0)) - static_cast<double>(full.opacity(r, 0))),
                rounding, "what is cut is not made up for: opacity only falls");
    double sum = 0;
    for (std::int32_t m = part.samples.first(r, 0); m < part.samples.first(r + 1, 0); ++m)
      sum += static_cast<double>(part.weight(m, 0));
    run.measure(std::abs(sum - static_cast<double>(part.opacity(r, 0))), rounding, "opacity is the sum of weights");
  }
  if (far == FarMode::open)
    run.note(
        "not evaluated: " + figure(100.0 * static_cast<double>(skipped) / static_cast<double>(full.samples.count)) +
        " % of the samples; colour off by " + figure(worst_colour) + ", logits by " + figure(worst_logit) +
        " of the largest");
  const PassTrace<Real> trained = whole.forward(true), also = cut.forward(true);
  run.expect(same_bits(trained.color, also.color) && same_bits(trained.opacity, also.opacity) &&
                 same_bits(trained.semantic.rows, also.semantic.rows) && same_bits(trained.weight, also.weight),
             "training knows no early stop");
}

}  // namespace

void early_stop(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    measure_early_stop<Real>(run, FarMode::background);
    measure_early_stop<Real>(run, FarMode::open);
  });
}

void bad_density(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double infinity = std::numeric_limits<double>::infinity();
    for (const double bad : {-1.0, -1e-30, std::numeric_limits<double>::quiet_NaN(), infinity, -infinity}) {
      RayBuffers<Real> rays({3, 4}, 0);
      rays.space_evenly(1);
      std::fill(rays.sigma.begin(), rays.sigma.end(), Real(0.5));
      run.expect((check_density<Real>(rays.samples, rays.col(rays.sigma), 100), true), "good densities pass");
      rays.sigma[5] = static_cast<Real>(bad);
      rays.forward();  // what a guard is there to see
      const auto before = rays;
      run.expect_error(ErrorKind::failure, {"ray 101", "sample 2", "m is"},
                       [&] { check_density<Real>(rays.samples, rays.col(rays.sigma), 100); });
      const auto same = [](const std::vector<Real>& a, const std::vector<Real>& b) {
        return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(Real)) == 0;
      };
      run.expect(same(rays.sigma, before.sigma) && same(rays.t, before.t) && same(rays.delta, before.delta) &&
                     same(rays.color, before.color) && same(rays.weight, before.weight),
                 "densities, samples and results are as before the error");
      RayBuffers<Real> beside({3, 4}, 0);
      beside.space_evenly(1);
      std::fill(beside.sigma.begin(), beside.sigma.end(), Real(0.5));
      beside.forward();
      run.measure(std::abs(rays.opacity[0] - beside.opacity[0]), 0, "the ray beside it");
    }
    const Real largest = std::numeric_limits<Real>::max();
    RayBuffers<Real> edge({1}, 0);
    edge.sigma = {largest};
    check_density<Real>(edge.samples, edge.col(edge.sigma), 0);
    edge.sigma = {Real(-0.0)};
    check_density<Real>(edge.samples, edge.col(edge.sigma), 0);
    run.expect(true, "the largest number and -0 are densities");
    // The same of a whole pass, whose raw densities become infinite.
    RenderRules rules{.rendering = {.density_bias = infinity}};
    ModelBench<Real> model(run.registry(), rules);
    const auto values = [&] {
      std::vector<Real> all;
      for (const Tensor<Real>& tensor : model.store.all())
        all.insert(all.end(), tensor.value.data(), tensor.value.data() + tensor.value.size());
      return all;
    };
    const std::vector<Real> before = values();
    for (const bool training : {false, true}) {
      run.expect_error(ErrorKind::failure, {"density", "ray 100", "sample 0"}, [&] {
        model.ctx.first_ray = 100;
        model.forward(training);
      });
    }
    run.expect(before == values(), "parameters are as before the error");
  });
}

namespace {

#if defined(__SSE2__) || defined(__aarch64__)
constexpr bool kFlushes = true;
#else
constexpr bool kFlushes = false;
#endif

// Values, gradients and moments of dense tensors that are subnormal.
int subnormal_count(TrainingBox& box) {
  int found = 0;
  for (const Tensor<float>& tensor : box.pipeline().store().all()) {
    if (tensor.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&tensor.value, &tensor.grad, &tensor.moment1, &tensor.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); ++i)
        found += std::fpclassify(buffer->data()[i]) == FP_SUBNORMAL ? 1 : 0;
    }
  }
  return found;
}

// Some CPUs take 25 times as long over subnormal numbers. Compute threads meet none: whatever a step begins with,
// it leaves none behind.
void count_subnormals_of_a_step(CaseRun& run) {
  TrainingBox box(run.registry(), small_config());
  for (Tensor<float>& tensor : box.pipeline().store().all()) {
    if (tensor.spec.role != TensorRole::dense) continue;
    for (const AlignedBuffer<float>* buffer : {&tensor.value, &tensor.moment1, &tensor.moment2}) {
      for (std::size_t i = 0; i < buffer->size(); i += 2) buffer->data()[i] = 1e-40F;
    }
  }
  const int before = subnormal_count(box);
  box.trainer().advance();
  run.expect(before > 1000, "the step began with subnormal numbers");
  const int left = subnormal_count(box);
  run.measure(left, 0, "subnormal numbers that a step leaves");
  run.note("a training step began with " + std::to_string(before) + " subnormal numbers and left " +
           std::to_string(left));
}

}  // namespace

void denormal(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const double small = std::is_same_v<Real, float> ? 1e-20 : 1e-155;
    const double least_normal = static_cast<double>(std::numeric_limits<Real>::min());
    for (const bool flush : {false, true}) {
      RayBuffers<Real> rays({4096}, 0);
      rays.space_evenly(1);
      std::fill(rays.delta.begin(), rays.delta.end(), static_cast<Real>(small));
      std::fill(rays.sigma.begin(), rays.sigma.end(), static_cast<Real>(small));
      if (flush) {
        parallel_for(1, [&](std::int64_t) { rays.forward(); });
      } else {
        rays.forward();
      }
      const long double tau = static_cast<long double>(rays.sigma[0]) * static_cast<long double>(rays.delta[0]);
      for (const Real weight : rays.weight) {
        const long double off = static_cast<long double>(weight) - tau;
        run.measure(static_cast<double>(off < 0 ? -off : off) / least_normal, 1.03, "weight, in least normal numbers");
        if (flush && kFlushes) run.expect(weight == 0, "a compute thread has no subnormal weight");
      }
      if (!flush) run.expect(rays.weight[0] > 0, "a subnormal weight is kept");
      run.expect(
          static_cast<double>(rays.opacity[0]) >= 0 && static_cast<double>(rays.opacity[0]) <= 2 * least_normal * 4096,
          "and so is its sum");
    }
    if constexpr (kFlushes && std::is_same_v<Real, float>) count_subnormals_of_a_step(run);
  });
}

void split_invariance(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const int m : {2, 4, 8, 64}) {
      RayBuffers<Real> whole({16}, 2), parts({16 * m}, 2);
      whole.space_evenly(2);
      parts.space_evenly(2);
      TestNumbers random{23};
      for (std::size_t k = 0; k < 16; ++k) {
        whole.sigma[k] = static_cast<Real>(random.in(0, 4));
        for (std::size_t c = 0; c < 2; ++c) whole.hidden[2 * k + c] = static_cast<Real>(random.in(-1, 1));
        for (std::size_t j = k * static_cast<std::size_t>(m); j < (k + 1) * static_cast<std::size_t>(m); ++j) {
          parts.sigma[j] = whole.sigma[k];
          parts.t[j] = whole.t[k];
          for (std::size_t c = 0; c < 2; ++c) parts.hidden[2 * j + c] = whole.hidden[2 * k + c];
        }
      }
      whole.forward();
      parts.forward();
      const double tolerance = tolerance_of<Real>(1e-6) * std::sqrt(m);
      const auto off = [](Real a, Real b) { return std::abs(static_cast<double>(a) - static_cast<double>(b)); };
      run.measure(off(whole.opacity[0], parts.opacity[0]), tolerance, "opacity");
      run.measure(off(whole.depth[0], parts.depth[0]), 2 * tolerance, "depth, up to 2 m");
      for (std::size_t c = 0; c < 2; ++c)
        run.measure(off(whole.out_hidden[c], parts.out_hidden[c]), tolerance, "hidden");
      whole.g_hidden = parts.g_hidden = {1, -0.5};
      whole.backward();
      parts.backward();
      for (std::size_t k = 0; k < 16; ++k) {
        double sum = 0;
        for (std::size_t j = k * static_cast<std::size_t>(m); j < (k + 1) * static_cast<std::size_t>(m); ++j)
          sum += static_cast<double>(parts.d_sigma[j]);
        run.measure(std::abs(sum - static_cast<double>(whole.d_sigma[k])), tolerance, "gradient of an interval");
      }
    }
  });
}

void inf_delta(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const Real infinity = std::numeric_limits<Real>::infinity();
    RayBuffers<Real> rays({2, 2, 2}, 0);
    rays.delta = {infinity, 1, 10, 1, infinity, 1};
    rays.sigma = {0, 1, static_cast<Real>(3e38), 1, static_cast<Real>(1e-30), 1};
    rays.t = {1, 2, 1, 2, 1, 2};
    rays.forward();
    run.measure(std::abs(rays.weight[0]), 0, "0 over an infinite interval");
    run.measure(relative_error(rays.weight[1], -std::expm1(-1.0L)), tolerance_of<Real>(1e-6),
                "what is behind it is seen");
    run.measure(std::abs(static_cast<double>(rays.weight[2]) - 1), 0, "3e38 over 10 m");
    run.measure(std::abs(rays.weight[3]), 0, "behind it");
    run.measure(std::abs(static_cast<double>(rays.weight[4]) - 1), 0, "1e-30 over an infinite interval");
    run.measure(std::abs(static_cast<double>(rays.depth[2]) - 1), 0, "its depth");
    rays.g_opacity = rays.g_depth = {1, 1, 1};
    rays.backward();
    for (const Real d : rays.d_sigma) run.expect(std::isfinite(d), "gradients are finite");
    run.measure(std::abs(rays.d_sigma[3]), 0, "the gradient behind an opaque sample");
  });
}

// Fog between two planes across the camera's axis, 1 m and 2 m away: a pixel whose direction (x, y, 1) has length s
// looks through s metres of it. And a scene in other units, with densities in theirs, is the same scene.
void nonunit_dirs(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const auto measure_opacity = [&](double near_m, double far_m, double sigma, long double tau) {
      RayBuffers<Real> rays = sampled_ray<Real>(run.registry(), "midpoint", 64, near_m, far_m);
      render(rays, [&](double) { return std::pair(sigma, 1.0); });
      run.measure(relative_error(rays.opacity[0], -std::expm1(-tau)), tolerance_of<Real>(2e-6), "opacity");
      return static_cast<double>(rays.depth[0]);
    };
    for (const double across : {0.0, 0.75, 10.0, 100.0, 1000.0}) {
      RayCamera camera{.camera = {.width_px = 1, .height_px = 1, .fx = 0.5, .fy = 0.5}};
      camera.camera.cx = 0.5 - 0.5 * across;  // the pixel's centre is seen at x / z = across
      camera.camera.cy = 0.5;
      RayLimits limits{.near_m = 1, .far_m = 2, .z_depth = true};
      double origin[3], direction[3], near_far[2];
      cast_ray(camera, limits, 0, 0, origin, direction, near_far);
      const long double length = std::sqrt(1 + static_cast<long double>(across) * static_cast<long double>(across));
      const double norm =
          std::sqrt(direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2]);
      run.measure(std::abs(norm - 1), 1e-15, "length of the ray's direction");
      run.measure(relative_error(near_far[1] - near_far[0], length), 1e-12, "metres through the fog");
      const double sigma = 0.7 / static_cast<double>(length);
      measure_opacity(near_far[0], near_far[1], sigma, 0.7L);
      measure_opacity(near_far[0], near_far[1], 0.01, 0.01L * length);
    }
    const double depth = measure_opacity(1, 3, 0.35, 0.7L);
    for (int exponent = -3; exponent <= 3; ++exponent) {
      const double unit = std::pow(10.0, exponent);
      const double scaled = measure_opacity(1 * unit, 3 * unit, 0.35 / unit, 0.7L);
      run.measure(std::abs(scaled / (depth * unit) - 1), tolerance_of<Real>(2e-6), "depth in the scene's unit");
    }
  });
}

}  // namespace semfield::numerics
