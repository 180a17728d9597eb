// Rays through a registered sampler, a field given by formulas on its samples, and the integral along them.
#pragma once

#include <algorithm>
#include <utility>

#include "core/small_math.h"
#include "execution/pipeline.h"
#include "named_case.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "tests/encoder_box.h"
#include "tests/model/rays_of_slabs.h"

namespace semfield::numerics {

using testing::RayBuffers;
using testing::TestNumbers;

inline SamplerBuild unit_build() {
  return SamplerBuild{.bounds = {{-1, -1, -1}, {1, 1, 1}}, .near_m = 0.1, .far_m = 10};
}

/// One sampler and buffers for what it writes. Rays start at the origin along x unless `origin` is changed.
template <class Real>
struct RayBench {
  RayBench(const Registry& registry, const std::string& name, const testkit::Settings& settings,
           const SamplerBuild& build = unit_build())
      : RayBench(testkit::make_part<Real>(registry, name, settings, build)) {}
  explicit RayBench(std::unique_ptr<Sampler<Real>> of) : sampler(std::move(of)), box(*sampler, 1, 0.0) {
    ctx.seed = 1;
    ctx.workspace = &workspace;
  }
  /// `limits`: near and far of each ray.
  void set_rays(std::vector<double> limits) {
    near_far = std::move(limits);
    count = static_cast<std::int64_t>(near_far.size()) / 2;
    origin.assign(static_cast<std::size_t>(3 * count), 0.0);
    direction = origin;
    for (std::size_t r = 0; r < static_cast<std::size_t>(count); ++r) direction[3 * r] = 1;
  }
  void set_rays(std::int64_t rays, double near_m, double far_m) {
    std::vector<double> limits;
    for (std::int64_t r = 0; r < rays; ++r) limits.insert(limits.end(), {near_m, far_m});
    set_rays(std::move(limits));
  }
  void draw(const Proposal<Real>* previous = nullptr, std::int64_t previous_per_ray = 0) {
    const std::int64_t capacity = sampler->capacity(count, previous_per_ray, ctx.training);
    t.assign(static_cast<std::size_t>(capacity), Real(-1));
    delta = t;
    ray.assign(t.size(), -1);
    first.assign(static_cast<std::size_t>(count + 1), -1);
    out = {View<Real>(t.data(), capacity, 1), View<Real>(delta.data(), capacity, 1),
           View<std::int32_t>(ray.data(), capacity, 1), View<std::int32_t>(first.data(), count + 1, 1), 0};
    const Rays<Real> rays{View<const double>(origin.data(), count, 3), View<const double>(direction.data(), count, 3),
                          View<const double>(near_far.data(), count, 2)};
    sampler->sample(ctx, box.values_only(), rays, previous, out);
    t.resize(static_cast<std::size_t>(out.count));
    delta.resize(t.size());
  }
  /// The samples as rays to be composited.
  RayBuffers<Real> buffers(std::int32_t hidden_channels = 0) const {
    std::vector<int> counts;
    for (std::size_t r = 0; r < static_cast<std::size_t>(count); ++r) counts.push_back(first[r + 1] - first[r]);
    RayBuffers<Real> rays(counts, hidden_channels);
    std::copy(t.begin(), t.end(), rays.t.begin());
    std::copy(delta.begin(), delta.end(), rays.delta.begin());
    return rays;
  }

  std::unique_ptr<Sampler<Real>> sampler;
  testkit::TensorBox<Real> box;
  Workspace workspace;
  StepContext ctx;
  std::int64_t count = 0;
  std::vector<double> origin, direction, near_far;
  std::vector<Real> t, delta;
  std::vector<std::int32_t> ray, first;
  Samples<Real> out;
};

/// Colour channels of a rendered ray: the field's colour, what is seen of a white background, white light.
enum RayChannel : std::uint8_t { kColour, kTransmittance, kOpacity };

/// Fills density and colour from field(t) -> {sigma, c} and composites.
template <class Real, class Field>
void render(RayBuffers<Real>& rays, const Field& field) {
  for (std::size_t k = 0; k < rays.t.size(); ++k) {
    const auto [sigma, colour] = field(static_cast<double>(rays.t[k]));
    rays.sigma[k] = static_cast<Real>(sigma);
    rays.rgb[3 * k + kColour] = static_cast<Real>(colour);
    rays.rgb[3 * k + kTransmittance] = 0;
    rays.rgb[3 * k + kOpacity] = 1;
  }
  rays.far = FarMode::open;
  rays.background = {0, 1, 0};
  rays.forward();
}
template <class Real>
double channel(const RayBuffers<Real>& rays, std::size_t ray, RayChannel which) {
  return static_cast<double>(rays.color[3 * ray + which]);
}

/// `n` equal intervals of one ray, samples at `share` of them: 0 the near end, 1/2 the middle.
template <class Real>
RayBuffers<Real> lattice(int n, double near_m, double far_m, double share) {
  RayBuffers<Real> rays({n}, 0);
  const double h = (far_m - near_m) / n;
  for (int k = 0; k < n; ++k) {
    rays.t[k] = static_cast<Real>(near_m + (k + share) * h);
    rays.delta[k] = static_cast<Real>(h);
  }
  return rays;
}

/// The samples of one ray by a rule of the stratified sampler without jitter.
template <class Real>
RayBuffers<Real> sampled_ray(const Registry& registry, const std::string& rule, int n, double near_m, double far_m) {
  RayBench<Real> bench(registry, "stratified", {{"samples", std::to_string(n)}, {"quadrature", rule}});
  bench.set_rays(1, near_m, far_m);
  bench.draw();
  return bench.buffers();
}

/// "1.02", "4.8e-04": a measured figure for a note.
std::string figure(double value);

// A small model of real parts: one pass of stratified samples, frequency encoding, a small network and a class head.

/// 16 units, 5 classes; the encoder's own coordinates come from `domain`.
template <class Real>
PassParts<Real> small_pass(const Registry& registry, const std::string& samples = "128",
                           const std::string& encoding = "frequency",
                           const testkit::Settings& encoder_settings = {{"frequencies", "4"}},
                           const DomainMap& domain = {{0, 0, 0}, 0.2, 0}) {
  using testkit::make_part;
  PassParts<Real> parts{.name = "main",
                        .sampler = make_part<Real>(registry, "stratified", {{"samples", samples}}, unit_build())};
  parts.position = make_part<Real>(registry, encoding, encoder_settings, EncoderBuild{});
  parts.field = make_part<Real>(registry, "tiny_mlp", {{"hidden_width", "16"}, {"color_width", "16"}},
                                FieldBuild{.position_dims = parts.position->traits().out_dims});
  parts.head = std::make_unique<OneLayerHead<Real>>(HeadShape{parts.field->traits().feature_dims, 16, 5});
  parts.domain = domain;
  return parts;
}

/// The pass alone, with rays from the origin in all directions.
template <class Real>
struct ModelBench {
  static constexpr std::int64_t kRays = 64;
  ModelBench(const Registry& registry, const RenderRules& rules)
      : store(7, 1, true), pass(small_pass<Real>(registry), rules, store) {
    TestNumbers random{17};
    for (std::int64_t r = 0; r < kRays; ++r) {
      const Vec3d d = normalized(Vec3d{random.in(-1, 1), random.in(-1, 1), random.in(-1, 1)});
      for (int i = 0; i < 3; ++i) direction.push_back(d[i]);
      near_far.insert(near_far.end(), {0.1, 8.0});
    }
    origin.assign(3 * kRays, 0.0);
    ctx.seed = 7;
    ctx.workspace = &workspace;
    pass.derive(ctx);
  }
  /// The trace lives as long as the bench.
  PassTrace<Real> forward(bool training) {
    ctx.training = training;
    const Rays<Real> rays{View<const double>(origin.data(), kRays, 3), View<const double>(direction.data(), kRays, 3),
                          View<const double>(near_far.data(), kRays, 2)};
    return pass.forward(ctx, 0, rays, nullptr, 0, {kRays});
  }
  ParamStore<Real> store;
  Pass<Real> pass;
  Workspace workspace;
  StepContext ctx;
  std::vector<double> origin, direction, near_far;
};

}  // namespace semfield::numerics
