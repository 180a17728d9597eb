// Kernel table of the stratified sampler.
#pragma once

#include <array>

#include "core/rng.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield {

class KernelTables;

/// What the bins of a ray have in common.
///   linear     their length in metres;
///   disparity  their length in 1 / t: fine near the camera, coarse far away.
enum class SampleSpacing : std::uint8_t { linear, disparity };
template <>
struct ChoiceNames<SampleSpacing> {
  static constexpr std::array<std::string_view, 2> names{"linear", "disparity"};
};

struct StratifiedArgs {
  std::int64_t samples = 0;  ///< N, bins a ray
  Quadrature quadrature = Quadrature::paper;
  SampleSpacing spacing = SampleSpacing::linear;
  bool jitter = false;  ///< false: the middle of each bin
  RandomAddress random;
  std::int64_t first_ray = 0;
};

template <class Real>
struct StratifiedKernels {
  /// Fills out.t, delta, ray_of_sample, first and count from near_far [R, 2].
  void (*sample)(const StratifiedArgs& args, View<const double> near_far, Samples<Real>& out) = nullptr;
};

void stratified_kernels(KernelTables& tables);

}  // namespace semfield
