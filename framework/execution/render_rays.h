// The walk of rendering through the passes, and density queries: on the stages of any device, with host memory at both
// ends.
#pragma once

#include <vector>

#include "model/pass.h"

namespace semfield {

/// Rays to render and where results go, host memory; R rows each, empty = not wanted.
template <class Real>
struct RenderJob {
  View<const double> origin, direction, near_far;
  View<const std::int16_t> truth;      ///< true classes; only to fill truth_probability
  View<Real> color;                    ///< [R, 3]
  View<Real> depth;                    ///< [R, 1] metres along the ray, not divided by opacity
  View<Real> opacity;                  ///< [R, 1]
  View<std::int16_t> label;            ///< [R, 1] argmax class
  View<Real> entropy;                  ///< [R, 1] nats
  View<Real> confidence;               ///< [R, 1] largest class probability
  View<Real> truth_probability;        ///< [R, 1] of the true class; 0 where void
  View<Real> probability;              ///< [R, K] of each of the K logits, softmax of the composited ones
  View<OpacityResolution> resolution;  ///< [R, 1]
  ChannelTable<Real> heads;            ///< [R, C] each, by the channel of a head beside that of class logits
  double footprint_per_m = 0;          ///< width of a pixel at a distance of 1 m, metres; for `resolution`

  RenderJob rows(std::int64_t begin, std::int64_t count) const;
};

/// ctx.workspace holds everything of the walk; the caller's scope gives it back. per_ray: most samples per ray after
/// each pass. On a device results are there once its stream has been waited for.
template <class Real>
void render_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                 const RenderJob<Real>& job, const StepContext& ctx);

/// sigma [N, 1] of the pass at world positions [N, 3], host memory both.
template <class Real>
void query_density(const Pass<Real>& pass, View<const double> positions, View<Real> sigma, const StepContext& ctx);

}  // namespace semfield
