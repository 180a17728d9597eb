// What a pipeline will hold, computed from its parts before anything of it is allocated.
#pragma once

#include <cstdint>
#include <vector>

#include "execution/pipeline.h"
#include "model/pass.h"

namespace semfield {

/// Rays per tile: `options.tile_rays`, or what the samplers' capacities ask for. `per_ray` gets the most samples per
/// ray after each pass.
template <class Real>
std::int64_t tile_rays_of(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options,
                          std::vector<std::int64_t>& per_ray);

/// Gradient slots for steps of `rays` rays: `options.lanes`, or what such a step has work for. Never from the thread
/// count, because they are the order of its sums.
template <class Real>
int lanes_of(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options, std::int64_t rays);

struct NetworkPlan {
  TensorBytes tensors;
  std::size_t activations = 0;  ///< arenas of all threads, without logits: samplers' capacities, so at most
  std::size_t logits = 0;       ///< class logits and their gradients, in the arenas too
  std::size_t step_rows = 0;    ///< a step's samples and encoded positions, and the scratch of their encoder
  std::size_t density = 0;      ///< scratch of threads that ask for densities
  std::size_t workspace() const { return activations + logits + step_rows; }
};

/// Samples of a tile that have hidden activations: those of its labelled rays. Runs label a third to all of their rays.
inline constexpr double kUsualLabelledShare = 0.6;

/// For steps of `rays` rays, `labelled` of which get logits, on `threads` threads.
template <class Real>
NetworkPlan plan_network(const std::vector<const PassParts<Real>*>& passes, const PipelineOptions& options,
                         std::int64_t rays, int threads, bool trainable, double labelled = kUsualLabelledShare);

}  // namespace semfield
