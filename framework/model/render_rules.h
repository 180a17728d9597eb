// How passes render: the sections `rendering` and `semantics` of a configuration, as they stand there.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/small_math.h"
#include "core/view.h"
#include "model/compositor.h"
#include "model/losses/semantic_cross_entropy.h"
#include "plugin/encoder.h"

namespace semfield {

struct SemanticsParams {
  double weight = 0.04;
  bool stop_gradient_to_density = false;
  int hidden_width = 128;
  SemanticNormalisation normalisation = SemanticNormalisation::mean_labelled;
  bool balance_classes = false;
};

inline void describe(ParamVisitor& visit, SemanticsParams& p) {
  SEMFIELD_PARAM(visit, p, weight, "lambda, weight of the semantic loss relative to the colour loss [Zhi21, Eq. 7]",
                 {0, 1e6});
  SEMFIELD_PARAM(visit, p, stop_gradient_to_density, "true: the semantic loss does not shape geometry");
  SEMFIELD_PARAM(visit, p, hidden_width, "width of the semantic hidden layer [Zhi21: 128]", {1, 1024});
  SEMFIELD_PARAM(visit, p, normalisation, "what the summed cross-entropy of a batch is divided by");
  SEMFIELD_PARAM(visit, p, balance_classes, "weight classes by inverse log frequency [Paszke16]");
}

/// What lies outside the scene's bounds.
///   nothing     rays end there;
///   contracted  all of space, drawn in [Barron22]: rays go on to far.
enum class Outside : std::uint8_t { nothing, contracted };
SEMFIELD_CHOICES(Outside, "nothing", "contracted");

struct RenderingParams {
  DensityActivation density_activation = DensityActivation::relu;
  double density_bias = 0;
  FarMode far = FarMode::open;
  double density_noise = 0;
  std::vector<double> background{0, 0, 0};
  double early_stop = 1e-4;
  double training_stop = 0;
  double scene_scale = 0;
  double unit_m = 0;
  Outside outside = Outside::nothing;
};

inline void describe(ParamVisitor& visit, RenderingParams& p) {
  SEMFIELD_PARAM(visit, p, density_activation, "raw density to attenuation per unit_m");
  SEMFIELD_PARAM(visit, p, density_bias, "added to raw density; negative: training starts from thin fog", {-20, 20});
  SEMFIELD_PARAM(visit, p, far, "what a ray meets behind its last sample");
  SEMFIELD_PARAM(visit, p, density_noise, "standard deviation of the noise on raw density in training [Mildenhall20]",
                 {0, 1e3});
  SEMFIELD_PARAM(visit, p, background, "colour behind everything, three values in [0, 1]", {0, 1});
  SEMFIELD_PARAM(visit, p, early_stop,
                 "transmittance below which rendering stops a ray; the error is at most this share; 0: never",
                 {0, 0.1});
  SEMFIELD_PARAM(visit, p, training_stop,
                 "transmittance below which training leaves out a ray's further samples; it asks for densities "
                 "first, which is worth it where rays continue behind surfaces [Mueller22 App. E.2]; 0: never",
                 {0, 0.1});
  SEMFIELD_PARAM(visit, p, scene_scale,
                 "factor from metres to a metric encoder's coordinates [Zhi21: 0.1]; 0: from the scene's bounds",
                 {0, 1e6});
  SEMFIELD_PARAM(
      visit, p, unit_m,
      "length that density and the losses count as 1, so that results do not depend on a scene's unit; 0: half the "
      "distance at which cameras see things, at most a quarter of the bounds, and with contracted space the whole "
      "distance; run.yaml has the number",
      {0, 1e12});
  SEMFIELD_PARAM(
      visit, p, outside,
      "what lies outside the bounds: nothing, or all of space, contracted so that encoders hold it [Barron22]");
}

inline void validate(const RenderingParams& p, Diagnostics& diagnostics) {
  if (p.background.size() != 3) {
    diagnostics.error("config.value.length", "rendering.background",
                      "expected 3 values, got " + std::to_string(p.background.size()), "write [r, g, b]");
  }
}

/// What a branch is beside its plugins: a network of its own for what a head reads, smooth where the pass's field is
/// sharp, and run on the samples that weigh alone.
struct BranchRules {
  bool reads_feature = true;   ///< the field's feature beside the position; no gradient goes back into the field
  double least_weight = 1e-3;  ///< samples of a smaller compositing weight are left out
  double dropout = 0;          ///< share of feature values that a training step sets to 0 [Srivastava14]
  double learning_rate = 1;    ///< of branch and head, as a factor to the run's
  double weight_decay = 0;     ///< of branch and head: share of a value times the learning rate [Loshchilov19]
};

/// Most heads of a pass beside that of class logits.
inline constexpr std::size_t kMostHeads = 4;

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

// From world positions to an encoder's coordinates: one map, the same for every sample of a run.

/// x = (p - center) * scale + offset. With a radius, all of space fits: places outside the cube of half-side `radius`
/// about the centre are drawn into the cube of twice its side first, so that distances from its border count by their
/// inverse [Barron22, Eq. 10, with the largest coordinate for the norm: the cube stays a cube, where encoders live].
struct DomainMap {
  Vec3d center;
  double scale = 1;
  double offset = 0;
  double radius = 0;  ///< 0: space outside is not drawn in

  /// unit_cube: the longest side of `bounds` spans [0, 1] (isotropic, so cells are cubes). metric: p * scene_scale when
  /// it is given [Zhi21, Sec. 4: 0.1]; scene_scale 0 derives centre and scale so that `bounds` fits [-1, 1].
  /// contracted: the cube about `bounds` takes half of that on every axis, the space outside it the rest; scene_scale
  /// is not read.
  static DomainMap make(Domain domain, const Box& bounds, double scene_scale, bool contracted = false) {
    const Vec3d size = bounds.size();
    const double longest = std::fmax(size.x, std::fmax(size.y, size.z));
    const double span = contracted ? 2 * longest : longest;
    const double radius = contracted ? 0.5 * longest : 0;
    if (domain == Domain::unit_cube) return {bounds.center(), 1 / span, 0.5, radius};
    if (scene_scale > 0 && !contracted) return {{0, 0, 0}, scene_scale, 0};
    return {bounds.center(), 2 / span, 0, radius};
  }

  /// One coordinate of a place that is inside, or of a map without radius.
  SEMFIELD_HD double along(int axis, double p) const { return (p - center[axis]) * scale + offset; }

  SEMFIELD_HD Vec3d operator()(Vec3d p) const {
    if (radius > 0) p = contract(p);
    return {along(0, p.x), along(1, p.y), along(2, p.z)};
  }

  /// The place in the cube of half-side 2 radius that stands for p.
  SEMFIELD_HD Vec3d contract(Vec3d p) const {
    const Vec3d q = p - center;
    const double reach = std::fmax(std::fabs(q.x), std::fmax(std::fabs(q.y), std::fabs(q.z)));
    if (!(reach > radius)) return p;
    const double shrunk = radius / reach;
    return center + q * ((2 - shrunk) * shrunk);
  }

  /// dL/dp from the gradient of operator().
  SEMFIELD_HD Vec3d gradient(Vec3d p, Vec3d d) const {
    d = d * scale;
    const Vec3d q = p - center;
    int widest = 0;
    for (int i = 1; i < 3; ++i)
      if (std::fabs(q[i]) > std::fabs(q[widest])) widest = i;
    const double reach = std::fabs(q[widest]);
    if (!(radius > 0) || !(reach > radius)) return d;
    const double shrunk = radius / reach;
    Vec3d out = d * ((2 - shrunk) * shrunk);
    out[widest] += dot(q, d) * (q[widest] < 0 ? -1 : 1) * 2 * shrunk * (shrunk - 1) / reach;
    return out;
  }

  /// The place that contract() takes to p; p must be in the open cube of half-side 2 radius.
  SEMFIELD_HD Vec3d expand(Vec3d p) const {
    const Vec3d q = p - center;
    const double reach = std::fmax(std::fabs(q.x), std::fmax(std::fabs(q.y), std::fabs(q.z)));
    if (!(reach > radius)) return p;
    const double grown = 1 / (2 - reach / radius);  // in radii
    return center + q * (grown * radius / reach);
  }
};

}  // namespace semfield
