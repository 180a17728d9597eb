// Sampler: where along each ray the field is evaluated.
#pragma once

#include <functional>

#include "core/small_math.h"
#include "plugin/parametric.h"

namespace semfield {

/// R rays with unit directions. Distances are metres along the ray.
template <class Real>
struct Rays {
  View<const double> origin;     ///< [R, 3] world, metres
  View<const double> direction;  ///< [R, 3] unit
  View<const double> near_far;   ///< [R, 2] metres along the ray, near <= far; near == far is an empty ray
};

/// Ragged samples in CSR form: ray r owns samples first[r] .. first[r+1]-1, t ascending.
template <class Real>
struct Samples {
  View<Real> t;                      ///< [capacity, 1] metres along the ray
  View<Real> delta;                  ///< [capacity, 1] metres, length of the sample's interval
  View<std::int32_t> ray_of_sample;  ///< [capacity, 1]
  View<std::int32_t> first;          ///< [R+1, 1]
  std::int64_t count = 0;            ///< samples written
};

/// What a later pass may learn from an earlier one.
template <class Real>
struct Proposal {
  const Samples<Real>* samples = nullptr;
  View<const Real> weight;  ///< [count, 1] compositing weights, no gradient flows through them
};

/// What becomes of the part of a ray that a sampler takes for empty.
enum class EmptySpace : std::uint8_t {
  sampled,    ///< it gets samples like any other
  certified,  ///< passed over; the opacity that a ray can lose by it is bounded
  threshold   ///< passed over by a rule that bounds no error
};

struct SamplerTraits {
  bool needs_previous = false;  ///< reads a Proposal: cannot be the first pass
  bool single_pass = false;     ///< finds the surface itself: no second network is needed after it
  bool observes = false;        ///< wants observe() after each training step
  EmptySpace empty_space = EmptySpace::sampled;
  /// On a device sample() takes views of fewer than `capacity` rows; where samples are more, it notes a fault of
  /// Stage::room and leaves out the last ones.
  bool keeps_to_room = false;
};

/// sigma (after activation, 1/m) [N,1] at world positions [N,3]. Called outside parallel regions; one large call is
/// better than many: its rows are shared by threads and by the processes of a run.
template <class Real>
using DensityQuery = std::function<void(View<const double> positions, View<Real> sigma)>;

template <class Real>
class Sampler : public Parametric<Real> {
 public:
  virtual SamplerTraits traits() const noexcept = 0;
  /// Most samples that sample() can give for `rays` rays after a previous pass with at most `previous_per_ray` samples
  /// per ray, with ctx.training or without it.
  virtual std::int64_t capacity(std::int64_t rays, std::int64_t previous_per_ray, bool training) const noexcept = 0;

  /// Fills out (views of at least capacity rows, or of fewer: SamplerTraits::keeps_to_room). Random values are
  /// addressed by (ctx.first_ray + ray, sample). Without ctx.training there is no jitter.
  void sample(const StepContext& ctx, const Tensors<Real>& tensors, const Rays<Real>& rays,
              const Proposal<Real>* previous, Samples<Real>& out) const;

  /// After an optimiser step: refresh state tensors. Outside parallel regions.
  virtual void observe(const StepContext&, const Tensors<Real>&, const DensityQuery<Real>&) const {}

 protected:
  virtual void do_sample(const StepContext&, const Tensors<Real>&, const Rays<Real>&, const Proposal<Real>*,
                         Samples<Real>&) const = 0;
};

struct SamplerBuild {
  Device device = Device::cpu;
  Box bounds;                    ///< scene bounds in world metres
  double near_m = 0, far_m = 0;  ///< limits along the ray, as configured
};

extern template class Sampler<float>;
extern template class Sampler<double>;

}  // namespace semfield
