// CPU kernels of the importance sampler: a ray after the other, CDF and new points in one walk, then a merge.
#include <algorithm>
#include <cmath>

#include "compute/isa.h"
#include "core/check.h"
#include "plugin/kernels.h"
#include "samplers/importance/importance_kernels.h"

namespace semfield::SEMFIELD_ISA {

namespace {

template <class Real>
double total_weight(const RayProposal<Real>& ray, std::int64_t ray_number) {
  double total = 0;
  for (std::int64_t k = 0; k < ray.count; ++k) {
    const double w = ray.weight(k);
    if (!(w >= 0) || std::isinf(w)) bad_proposal_weight(ray_number, k, w);
    total += w;
  }
  return total;
}

// Fills `points` with the ascending new samples of one ray.
template <class Real>
void draw(const ImportanceArgs& args, const RayProposal<Real>& ray, std::int64_t ray_number, double* points) {
  const double total = total_weight(ray, ray_number) + args.floor;
  const auto enter = [&](std::int64_t k, double below) {
    CdfWalk cell = ray.cell(k, ray.count > 0 ? ray.weight(k) : 0.0, args.floor, total);
    cell.below = below;
    return cell;
  };
  std::int64_t k = 0;
  CdfWalk cell = enter(0, 0);
  const auto first_index = static_cast<std::uint64_t>(ray_number * args.samples);
  for (std::int64_t j = 0; j < args.samples; ++j) {
    const double jitter =
        args.jitter ? static_cast<double>(uniform01(args.random, first_index + static_cast<std::uint64_t>(j))) : 0.5;
    const double u = (static_cast<double>(j) + jitter) / static_cast<double>(args.samples);
    while (!cell.holds(u)) {
      k += 1;
      cell = enter(k, cell.below + cell.mass);
    }
    points[j] = cell.point(u);
  }
}

// Ascending union in place: `points` holds `fresh` new samples and has room for ray.count more. Merged from the back;
// at equal distance the previous sample comes first.
template <class Real>
std::int64_t merge_previous(const RayProposal<Real>& ray, std::int64_t fresh, double* points) {
  std::int64_t j = fresh - 1, k = ray.count - 1;
  for (std::int64_t to = fresh + ray.count - 1; k >= 0; --to) {
    const double old = ray.inside(k);
    if (j >= 0 && points[j] >= old) {
      points[to] = points[j];
      --j;
    } else {
      points[to] = old;
      --k;
    }
  }
  return fresh + ray.count;
}

template <class Real>
void sample(const ImportanceArgs& args, View<const double> near_far, const Proposal<Real>& previous,
            Samples<Real>& out) {
  SEMFIELD_CHECK(args.workspace != nullptr, "the importance sampler needs scratch memory");
  const View<const std::int32_t> first = previous.samples->first;
  std::int64_t most = 0;
  for (std::int64_t r = 0; r < near_far.rows; ++r)
    most = std::max<std::int64_t>(most, *first.row(r + 1) - *first.row(r));
  Workspace::Scope scope(*args.workspace);
  double* points = args.workspace->take<double>(args.samples + most, 1).data;
  std::int64_t count = 0;
  for (std::int64_t r = 0; r < near_far.rows; ++r) {
    *out.first.row(r) = static_cast<std::int32_t>(count);
    RayProposal<Real> ray{previous.samples->t, previous.weight, *first.row(r), *first.row(r + 1) - *first.row(r)};
    if (!ray_span(near_far, r, args.first_ray, ray.near_m, ray.far_m)) continue;
    draw(args, ray, args.first_ray + r, points);
    const std::int64_t n = args.keep_previous ? merge_previous(ray, args.samples, points) : args.samples;
    for (std::int64_t k = 0; k < n; ++k, ++count) {
      *out.t.row(count) = round_inside<Real>(points[k], ray.near_m, ray.far_m);
      *out.delta.row(count) = static_cast<Real>(interval_of(args.quadrature, points, n, k, ray.near_m, ray.far_m));
      *out.ray_of_sample.row(count) = static_cast<std::int32_t>(r);
    }
  }
  *out.first.row(near_far.rows) = static_cast<std::int32_t>(count);
  out.count = count;
}

template <class Real>
const ImportanceKernels<Real> kTable{sample<Real>};

}  // namespace

SEMFIELD_CPU_KERNELS(importance, "sampler 'importance'", kTable)

}  // namespace semfield::SEMFIELD_ISA
