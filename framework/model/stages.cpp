// The stages of a pass on the CPU.
#include "model/stages.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <type_traits>

#include "compute/layers.h"
#include "compute/math_functions.h"
#include "core/check.h"
#include "model/camera_corrections.h"
#include "model/losses/semantic_cross_entropy.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

// Row of the first value that is not finite, or -1.
template <class T>
std::int64_t first_bad_row(View<const T> values) {
  if (values.empty() || values.rows == 0) return -1;
  if (values.contiguous() && all_finite(values.data, values.size())) return -1;
  for (std::int64_t r = 0; r < values.rows; ++r) {
    if (!all_finite(values.row(r), values.cols)) return r;
  }
  return -1;
}

// "is nan", or "is nan in column 4" for several columns.
template <class T>
std::string first_in_row(const T* row, std::int32_t cols) {
  std::int32_t c = 0;
  while (c + 1 < cols && std::isfinite(row[c])) ++c;
  return cols > 1 ? fmt::format("is {:.6g} in column {}", row[c], c) : fmt::format("is {:.6g}", row[c]);
}

constexpr std::int64_t kDensityBatch = 1024;

void copy(View<const std::byte> from, View<std::byte> to) {
  for (std::int64_t r = 0; r < to.rows; ++r) std::copy_n(from.row(r), to.cols, to.row(r));
}

template <class Real>
void locate(const GuardPlace<Real>& place, const Rays<Real>& rays, const DomainMap& map, View<double> x) {
  const Samples<Real>& samples = *place.samples;
  for (std::int64_t m = 0; m < samples.count; ++m) {
    const std::int64_t r = samples.ray_of_sample(m, 0);
    const double t = static_cast<double>(samples.t(m, 0));
    Vec3d p;
    for (int i = 0; i < 3; ++i) p[i] = rays.origin(r, i) + t * rays.direction(r, i);
    const Vec3d at = map(p);
    for (int i = 0; i < 3; ++i) x(m, i) = at[i];
  }
  guard_samples(place, View<const double>(x));
}

template <class Real>
void locate_backward(const Rays<Real>& rays, const Samples<Real>& samples, const DomainMap& map, View<const Real> dx,
                     View<Real> d_ray) {
  for (std::int64_t r = 0; r < d_ray.rows; ++r) {
    Vec3d d_origin, d_direction;
    for (std::int32_t m = samples.first(r, 0); m < samples.first(r + 1, 0); ++m) {
      const double t = static_cast<double>(samples.t(m, 0));
      Vec3d p, d;
      for (int i = 0; i < 3; ++i) {
        p[i] = rays.origin(r, i) + t * rays.direction(r, i);
        d[i] = static_cast<double>(dx(m, i));
      }
      const Vec3d d_place = map.gradient(p, d);
      d_origin = d_origin + d_place;
      d_direction = d_direction + d_place * t;
    }
    for (int i = 0; i < 3; ++i) {
      d_ray(r, i) += static_cast<Real>(d_origin[i]);
      d_ray(r, 3 + i) += static_cast<Real>(d_direction[i]);
    }
  }
}

void map_positions(View<const double> positions, const DomainMap& map, View<double> x) {
  for (std::int64_t m = 0; m < positions.rows; ++m) {
    const Vec3d at = map({positions(m, 0), positions(m, 1), positions(m, 2)});
    for (int i = 0; i < 3; ++i) x(m, i) = at[i];
  }
}

template <class Real>
void fill(View<Real> values, Real value) {
  for (std::int64_t r = 0; r < values.rows; ++r) std::fill_n(values.row(r), values.cols, value);
}

void count_up(View<std::int32_t> numbers) { std::iota(numbers.data, numbers.data + numbers.rows, 0); }

template <class Real>
void add(View<const Real> from, View<Real> to) {
  for (std::int64_t r = 0; r < to.rows; ++r) {
    for (std::int32_t c = 0; c < to.cols; ++c) to(r, c) += from(r, c);
  }
}

template <class Real>
ChosenSamples<Real> reached(Workspace& arena, const Samples<Real>& samples, View<const Real> sigma,
                            const ReachedBy& rule, std::int64_t most) {
  ChosenSamples<Real> chosen;
  Samples<Real>& out = chosen.samples;
  out.first = arena.take<std::int32_t>(samples.first.rows, 1);
  out.t = arena.take<Real>(most, 1);
  out.delta = arena.take<Real>(most, 1);
  out.ray_of_sample = arena.take<std::int32_t>(most, 1);
  chosen.source = arena.take<std::int32_t>(most, 1);
  const double deepest = -std::log(rule.least);
  for (std::int64_t r = 0; r + 1 < samples.first.rows; ++r) {
    out.first(r, 0) = static_cast<std::int32_t>(out.count);
    const std::int64_t begin = samples.first(r, 0),
                       end = std::min<std::int64_t>(samples.first(r + 1, 0), begin + rule.end);
    double depth = 0;
    for (std::int64_t m = begin; m < end && depth <= deepest; ++m) {
      if (m - begin >= rule.begin) {
        SEMFIELD_CHECK(out.count < most, "more samples than there is room for");
        out.t(out.count, 0) = samples.t(m, 0);
        out.delta(out.count, 0) = samples.delta(m, 0);
        out.ray_of_sample(out.count, 0) = static_cast<std::int32_t>(r);
        chosen.source(out.count++, 0) = static_cast<std::int32_t>(m);
      }
      depth += optical_depth(sigma(m, 0), samples.delta(m, 0));
    }
  }
  out.first(samples.first.rows - 1, 0) = static_cast<std::int32_t>(out.count);
  return chosen;
}

template <class Real>
void spread(const ChosenSamples<Real>& chosen, View<const Real> from, View<Real> to) {
  for (std::int64_t k = 0; k < chosen.samples.count; ++k) to(chosen.source(k, 0), 0) = from(k, 0);
}

template <class Real>
void keep(Workspace& arena, const Samples<Real>& samples, View<const Real> weight, Real least, std::int64_t,
          BranchTrace<Real>& trace) {
  const std::int64_t rays = trace.share.rows;
  const std::int32_t all = samples.first(rays, 0);
  Samples<Real>& kept = trace.samples;
  kept.count = std::count_if(weight.data, weight.data + all, [least](Real w) { return w >= least && w > 0; });
  kept.t = arena.take<Real>(kept.count, 1);
  kept.delta = arena.take<Real>(kept.count, 1);
  kept.ray_of_sample = arena.take<std::int32_t>(kept.count, 1);
  trace.source = arena.take<std::int32_t>(kept.count, 1);
  trace.weight = arena.take<Real>(kept.count, 1);
  std::int32_t k = 0;
  for (std::int64_t r = 0; r < rays; ++r) {
    kept.first(r, 0) = k;
    Real share = 0;
    for (std::int32_t m = samples.first(r, 0); m < samples.first(r + 1, 0); ++m) {
      const Real w = weight(m, 0);
      if (!(w >= least && w > 0)) continue;
      kept.t(k, 0) = samples.t(m, 0);
      kept.delta(k, 0) = samples.delta(m, 0);
      kept.ray_of_sample(k, 0) = static_cast<std::int32_t>(r);
      trace.source(k, 0) = m;
      trace.weight(k, 0) = w;
      share += w;
      ++k;
    }
    trace.share(r, 0) = share;
  }
  kept.first(rays, 0) = k;
}

template <class Real>
void join(const BranchTrace<Real>& trace, View<const Real> position, View<const Real> feature) {
  for (std::int64_t k = 0; k < trace.samples.count; ++k) {
    std::copy_n(position.row(k), position.cols, trace.input.row(k));
    if (!feature.empty())
      std::copy_n(feature.row(trace.source(k, 0)), feature.cols, trace.input.row(k) + position.cols);
  }
}

template <class Real>
void drop_out(const Dropout& rule, const Samples<Real>& samples, View<const Real> from, View<Real> to) {
  for (std::int64_t k = 0; k < samples.count; ++k) {
    const std::int32_t ray = samples.ray_of_sample(k, 0);
    const std::int64_t of_ray = k - samples.first(ray, 0);
    for (std::int32_t c = 0; c < to.cols; c += kDropoutGroup) {
      const DropoutFactors factors =
          dropout_factors(rule.random, rule.share, rule.first_ray + ray, of_ray, c / kDropoutGroup, to.cols);
      for (std::int32_t i = 0; i < std::min(kDropoutGroup, to.cols - c); ++i)
        to(k, c + i) = from(k, c + i) * static_cast<Real>(factors.of[i]);
    }
  }
}

template <class Real>
void sum_by_weight(const Samples<Real>& samples, View<const Real> weight, View<const Real> values, View<Real> out) {
  for (std::int64_t r = 0; r < out.rows; ++r) {
    Real* const sum = out.row(r);
    std::fill_n(sum, out.cols, Real(0));
    for (std::int32_t k = samples.first(r, 0); k < samples.first(r + 1, 0); ++k) {
      const Real* const value = values.row(k);
      const Real w = weight(k, 0);
      for (std::int32_t c = 0; c < out.cols; ++c) sum[c] += w * value[c];
    }
  }
}

template <class Real>
void sum_by_weight_backward(const Samples<Real>& samples, View<const Real> weight, View<const Real> d_out,
                            View<Real> d_values) {
  for (std::int64_t k = 0; k < samples.count; ++k) {
    const Real* const d = d_out.row(samples.ray_of_sample(k, 0));
    const Real w = weight(k, 0);
    for (std::int32_t c = 0; c < d_values.cols; ++c) d_values(k, c) = w * d[c];
  }
}

void rounded_sum(const Samples<float>& samples, View<const float> weight, View<const Bf16> hidden, View<float> out) {
  for (std::int64_t r = 0; r < out.rows; ++r) {
    const std::int32_t begin = samples.first(r, 0), count = samples.first(r + 1, 0) - begin;
    weighted_row_sum(weight.row_range(begin, count), hidden.row_range(begin, count), out.row_range(r, 1));
  }
}

void rounded_sum_backward(const Samples<float>& samples, const RoundedSumBackward<float>& sum) {
  SEMFIELD_CHECK(!sum.blocked, "hidden activations of a CPU lie in rows");
  for (std::int64_t r = 0; r < sum.d_out.rows; ++r) {
    const std::int32_t begin = samples.first(r, 0), count = samples.first(r + 1, 0) - begin;
    weighted_row_sum_backward(sum.weight.row_range(begin, count), sum.hidden.row_range(begin, count),
                              sum.d_out.row_range(r, 1), sum.dots.row_range(begin, count),
                              sum.d_hidden.row_range(begin, count));
  }
}

template <class Real>
void class_results(View<Real> logits, const ClassResults<Real>& results) {
  if (!results.entropy.empty()) softmax_entropy<Real>(logits, results.entropy);
  softmax<Real>(logits, logits);
  for (std::int64_t r = 0; r < logits.rows; ++r) {
    const Real* const p = logits.row(r);
    const Real* const best = std::max_element(p, p + logits.cols);
    if (!results.label.empty()) results.label(r, 0) = static_cast<std::int16_t>(best - p);
    if (!results.confidence.empty()) results.confidence(r, 0) = *best;
    if (!results.probability.empty()) std::copy_n(p, logits.cols, results.probability.row(r));
    if (results.truth_probability.empty()) continue;
    const std::int16_t truth = results.truth(r, 0);
    results.truth_probability(r, 0) = truth == kVoid ? Real(0) : p[truth];
  }
}

template <class Real>
void opacity_resolutions(const Samples<Real>& samples, View<const Real> weight, FarMode far, double footprint_per_m,
                         View<OpacityResolution> result) {
  for (std::int64_t r = 0; r < result.rows; ++r)
    result(r, 0) = opacity_resolution<Real>(samples, weight, far, r, footprint_per_m);
}

template <class Real>
void guard_density(const GuardPlace<Real>& place, View<const Real> sigma) {
  check_density<Real>(*place.samples, sigma, place.first_ray);
}

// Densities asked for by position belong to no ray: the message names the place.
template <class Real>
void guard_density_at(View<const double> positions, View<const Real> raw, View<const Real> sigma) {
  for (std::int64_t m = 0; m < sigma.rows; ++m) {
    if (std::isfinite(raw(m, 0)) && std::isfinite(sigma(m, 0))) continue;
    throw Error(ErrorKind::failure, "train.density.invalid",
                "density at (" + std::to_string(positions(m, 0)) + ", " + std::to_string(positions(m, 1)) + ", " +
                    std::to_string(positions(m, 2)) + ") m is not finite (raw value " + std::to_string(raw(m, 0)) + ")",
                std::string(fault_remedy()));
  }
}

template <class Real>
Stages<Real> make_stages() {
  Stages<Real> s;
  s.head = &cpu_head_kernels<Real>();
  s.cameras = &cpu_camera_kernels<Real>();
  s.density_batch = kDensityBatch;
  s.copy = copy;
  s.locate = locate<Real>;
  s.locate_backward = locate_backward<Real>;
  s.map_positions = map_positions;
  s.density_forward = density_forward<Real>;
  s.density_backward = density_backward<Real>;
  s.composite_forward = composite_forward<Real>;
  s.composite_backward = composite_backward<Real>;
  s.fill = fill<Real>;
  s.count_up = count_up;
  s.add = add<Real>;
  s.reached = reached<Real>;
  s.spread = spread<Real>;
  s.keep = keep<Real>;
  s.join = join<Real>;
  s.drop_out = drop_out<Real>;
  s.sum_by_weight = sum_by_weight<Real>;
  s.sum_by_weight_backward = sum_by_weight_backward<Real>;
  if constexpr (std::is_same_v<Real, float>) {
    s.rounded_sum = rounded_sum;
    s.rounded_sum_backward = rounded_sum_backward;
  }
  s.class_results = class_results<Real>;
  s.opacity_resolutions = opacity_resolutions<Real>;
  s.adam = adam_update<Real>;
  s.guard = guard_values<Real>;
  s.guard_density = guard_density<Real>;
  s.guard_density_at = guard_density_at<Real>;
  return s;
}

}  // namespace

RayFault::RayFault(std::int64_t ray, ErrorKind kind, Code code, std::string message, std::string remedy)
    : Error(kind, code, std::move(message), std::move(remedy)), ray_(ray) {}

std::string_view fault_remedy() {
  return "lower train.adam.learning_rate, or resume from the last checkpoint with another runtime.seed";
}

template <class Real>
void guard_rays(const Rays<Real>& rays, View<const float> target, std::int64_t first_ray) {
  const auto check = [&](const char* name, const auto& values) {
    const std::int64_t bad = first_bad_row(values);
    if (bad < 0) return;
    throw RayFault(first_ray + bad, ErrorKind::failure, "scene.rays.invalid",
                   fmt::format("{} of ray {} {}", name, first_ray + bad, first_in_row(values.row(bad), values.cols)),
                   "check the camera poses, the intrinsics and the near and far distances of the scene");
  };
  check("origin", rays.origin);
  check("direction", rays.direction);
  check("near and far distance", rays.near_far);
  check("true colour", target);
}

namespace {

template <class Real>
[[noreturn]] void fail(const GuardPlace<Real>& place, const char* name, std::int64_t row, const std::string& what) {
  const Samples<Real>& samples = *place.samples;
  const std::int64_t r = samples.ray_of_sample(row, 0);
  std::string where = fmt::format("ray {}", place.first_ray + r);
  if (!samples.t.empty()) {
    where += fmt::format(", sample {}", row - samples.first(r, 0));
    if (std::isfinite(samples.t(row, 0))) where += fmt::format(" at {:.4g} m", samples.t(row, 0));
  }
  throw RayFault(place.first_ray + r, ErrorKind::failure, "train.value.not_finite",
                 fmt::format("pass '{}': {} of {} {}", place.pass, name, where, what), std::string(fault_remedy()));
}

}  // namespace

template <class Real>
void guard_samples(const GuardPlace<Real>& place, View<const double> x) {
  constexpr Real kLargest = std::numeric_limits<Real>::max();
  const Samples<Real>& samples = *place.samples;
  const auto bad_interval = [](Real delta) { return !(delta >= 0) || !(delta <= kLargest); };
  int bad = 0;
  for (std::int64_t m = 0; m < samples.count; ++m)
    bad |= !(std::abs(samples.t.data[m]) <= kLargest) || bad_interval(samples.delta.data[m]) ? 1 : 0;
  for (std::int64_t m = 0; m < samples.count && bad != 0; ++m) {
    const Real t = samples.t.data[m], delta = samples.delta.data[m];
    if (!std::isfinite(t)) fail(place, "distance", m, fmt::format("is {}", t));
    if (bad_interval(delta))
      fail(place, "interval", m, fmt::format("is {}; it must be finite and not negative", delta));
  }
  const std::int64_t row = first_bad_row(x);
  if (row >= 0) fail(place, "position", row, first_in_row(x.row(row), x.cols));
}

template <class Real>
void guard_values(const GuardPlace<Real>& place, Guarded value, View<const Real> values) {
  // By Guarded.
  static constexpr struct {
    const char* name;
    bool per_ray;
  } kValues[] = {{"encoded position", false},
                 {"encoded direction", true},
                 {"raw density", false},
                 {"colour", false},
                 {"feature", false},
                 {"semantic feature", false},
                 {"colour", true},
                 {"depth", true},
                 {"opacity", true},
                 {"logits", true},
                 {"channel of a head", true},
                 {"gradient of the encoded position", false}};
  const auto& of = kValues[static_cast<std::size_t>(value)];
  const std::int64_t row = first_bad_row(values);
  if (row < 0) return;
  const std::string what = first_in_row(values.row(row), values.cols);
  if (!of.per_ray) fail(place, of.name, row, what);
  throw RayFault(place.first_ray + row, ErrorKind::failure, "train.value.not_finite",
                 fmt::format("pass '{}': {} of ray {} {}", place.pass, of.name, place.first_ray + row, what),
                 std::string(fault_remedy()));
}

#define SEMFIELD_INSTANTIATE(Real)                                                      \
  template void guard_samples<Real>(const GuardPlace<Real>&, View<const double>);       \
  template void guard_values<Real>(const GuardPlace<Real>&, Guarded, View<const Real>); \
  template void guard_rays<Real>(const Rays<Real>&, View<const float>, std::int64_t);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

template <class Real>
const Stages<Real>& cpu_stages() {
  static const Stages<Real> stages = make_stages<Real>();
  return stages;
}

template const Stages<float>& cpu_stages<float>();
template const Stages<double>& cpu_stages<double>();

}  // namespace semfield
