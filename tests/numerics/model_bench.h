// A small model of real parts: one pass of stratified samples, frequency encoding, a small network and a class head.
#pragma once

#include "core/small_math.h"
#include "execution/pipeline.h"
#include "ray_bench.h"

namespace semfield::numerics {

template <class Real, class Float, class Double, class Build>
auto make_part(const Float& make32, const Double& make64, const PluginEntry& entry, const testkit::Settings& settings,
               const Build& build, const Registry& registry) {
  const std::unique_ptr<PluginParams> params = testkit::make_params(entry, settings);
  if constexpr (std::is_same_v<Real, float>) {
    return make32(*params, build, registry.kernels());
  } else {
    return make64(*params, build, registry.kernels());
  }
}

/// 16 units, 5 classes; the encoder's own coordinates come from `domain`.
template <class Real>
PassParts<Real> small_pass(const Registry& registry, const std::string& samples = "128",
                           const std::string& encoding = "frequency",
                           const testkit::Settings& encoder_settings = {{"frequencies", "4"}},
                           const DomainMap& domain = {{0, 0, 0}, 0.2, 0}) {
  PassParts<Real> parts{.name = "main", .sampler = make_sampler<Real>(registry, "stratified", {{"samples", samples}})};
  const PluginEntry& encoder = registry.get(PluginKind::encoder, encoding);
  parts.position =
      make_part<Real>(encoder.encoder32, encoder.encoder64, encoder, encoder_settings, EncoderBuild{}, registry);
  FieldBuild build{.position_dims = parts.position->traits().out_dims};
  const PluginEntry& field = registry.get(PluginKind::field, "tiny_mlp");
  parts.field = make_part<Real>(field.field32, field.field64, field, {{"hidden_width", "16"}, {"color_width", "16"}},
                                build, registry);
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
