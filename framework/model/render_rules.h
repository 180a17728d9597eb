// How passes render: the sections `rendering` and `semantics` of a configuration, as they stand there.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "losses/semantic_cross_entropy.h"
#include "model/compositor.h"
#include "model/density_activation.h"

namespace semfield {

struct SemanticsParams {
  double weight = 0.04;
  bool stop_gradient_to_density = false;
  int hidden_width = 128;
  SemanticNormalisation normalisation = SemanticNormalisation::mean_labelled;
  bool balance_classes = false;
};
void describe(ParamVisitor& visit, SemanticsParams& params);

/// What lies outside the scene's bounds.
///   nothing     rays end there;
///   contracted  all of space, drawn in [Barron22]: rays go on to far.
enum class Outside : std::uint8_t { nothing, contracted };
template <>
struct ChoiceNames<Outside> {
  static constexpr std::array<std::string_view, 2> names{"nothing", "contracted"};
};

struct RenderingParams {
  DensityActivation density_activation = DensityActivation::relu;
  double density_bias = 0;
  FarMode far = FarMode::open;
  double density_noise = 0;
  std::vector<double> background{0, 0, 0};
  double early_stop = 1e-4;
  double scene_scale = 0;
  double unit_m = 0;
  Outside outside = Outside::nothing;
};
void describe(ParamVisitor& visit, RenderingParams& params);
void validate(const RenderingParams& params, Diagnostics& diagnostics);

/// The same for every pass.
struct RenderRules {
  RenderingParams rendering;
  SemanticsParams semantics;
  bool deferred_class_layer = true;
  double unit_m = 1;  ///< rendering.unit_m, resolved: density is per this length, and losses measure in it

  /// Added to colour only.
  std::array<double, 3> background() const {
    return {rendering.background[0], rendering.background[1], rendering.background[2]};
  }
};

}  // namespace semfield
