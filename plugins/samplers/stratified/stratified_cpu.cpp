// CPU kernels of the stratified sampler: a ray after the other; one Philox block a jittered sample is nearly all of the
// time.
#include "compute/isa.h"
#include "plugin/kernels.h"
#include "samplers/stratified/stratified_kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

template <class Real>
void sample(const StratifiedArgs& args, View<const double> near_far, Samples<Real>& out) {
  const std::int64_t n = args.samples;
  std::int64_t count = 0;
  for (std::int64_t r = 0; r < near_far.rows; ++r) {
    *out.first.row(r) = static_cast<std::int32_t>(count);
    double near_m = 0, far_m = 0;
    if (!ray_span(near_far, r, args.first_ray, near_m, far_m)) continue;
    const auto first_index = static_cast<std::uint64_t>((args.first_ray + r) * n);
    double previous = 0;
    for (std::int64_t k = 0; k < n; ++k, ++count) {
      const double u =
          args.jitter ? static_cast<double>(uniform01(args.random, first_index + static_cast<std::uint64_t>(k))) : 0.5;
      const double t = point_of_bin(args.spacing, near_m, far_m, k, u, n);
      *out.t.row(count) = round_inside<Real>(t, near_m, far_m);
      *out.delta.row(count) = static_cast<Real>(length_of_bin(args.spacing, near_m, far_m, k, n));
      *out.ray_of_sample.row(count) = static_cast<std::int32_t>(r);
      if (args.quadrature == Quadrature::paper && k > 0) *out.delta.row(count - 1) = static_cast<Real>(t - previous);
      previous = t;
    }
    if (args.quadrature == Quadrature::paper) *out.delta.row(count - 1) = static_cast<Real>(far_m - previous);
  }
  *out.first.row(near_far.rows) = static_cast<std::int32_t>(count);
  out.count = count;
}

template <class Real>
const StratifiedKernels<Real> kTable{sample<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(stratified, "sampler 'stratified'", kTable)

}  // namespace semfield::SEMFIELD_ISA
