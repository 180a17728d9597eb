// Parameters and kernel table of the importance sampler.
#pragma once

#include <algorithm>
#include <cstdint>

#include "core/rng.h"
#include "core/view.h"
#include "core/workspace.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield {

/// Walks the inverse CDF of a piecewise constant density for ascending u. Cell k spans [begin, end] and holds `mass` of
/// `total`. The last cell ends at 1 by decree, not by what the sum came to.
struct CdfWalk {
  double below = 0;  ///< CDF at the cell's begin
  double mass = 0;   ///< of the cell, normalised
  double begin = 0, end = 0;
  bool is_last = false;

  SEMFIELD_HD bool holds(double u) const { return is_last || u < below + mass; }
  /// t = begin + (u - CDF(begin)) / mass * (end - begin), kept inside the cell.
  SEMFIELD_HD double point(double u) const {
    double share = mass > 0 ? (u - below) / mass : 0.5;
    share = share < 0 ? 0 : share > 1 ? 1 : share;
    const double t = begin + share * (end - begin);
    return t < end ? t : end;
  }
};

/// One ray of the previous pass: `count` samples from row `begin` of t and weight.
template <class Real>
struct RayProposal {
  View<const Real> previous_t, previous_weight;
  std::int64_t begin = 0, count = 0;
  double near_m = 0, far_m = 0;

  SEMFIELD_HD double t(std::int64_t k) const { return static_cast<double>(*previous_t.row(begin + k)); }
  SEMFIELD_HD double weight(std::int64_t k) const { return static_cast<double>(*previous_weight.row(begin + k)); }
  /// t(k), not outside [near, far].
  SEMFIELD_HD double inside(std::int64_t k) const { return std::clamp(t(k), near_m, far_m); }
  /// Border before cell k; a previous sample outside [near, far] does not move a border out of it.
  SEMFIELD_HD double border(std::int64_t k) const {
    if (k == 0) return near_m;
    if (k >= count) return far_m;
    return std::clamp(0.5 * (t(k - 1) + t(k)), near_m, far_m);
  }
  /// A ray without previous samples is one cell.
  SEMFIELD_HD std::int64_t cells() const { return count > 0 ? count : 1; }
  /// Cell k of weight `w`, whose mass is (w + floor * share of the ray) / total.
  SEMFIELD_HD CdfWalk cell(std::int64_t k, double w, double floor, double total) const {
    CdfWalk walk = place(k);
    walk.mass = (w + floor * (walk.end - walk.begin) / (far_m - near_m)) / total;
    return walk;
  }
  /// Cell k without its mass.
  SEMFIELD_HD CdfWalk place(std::int64_t k) const {
    CdfWalk walk;
    walk.begin = border(k);
    walk.end = border(k + 1);
    walk.is_last = k + 1 == cells();
    return walk;
  }
};

class KernelTables;

struct ImportanceParams {
  std::int64_t samples = 128;
  bool keep_previous = true;
  double floor = 1e-3;
  Quadrature quadrature = Quadrature::paper;
};

struct ImportanceArgs : ImportanceParams {
  bool jitter = false;
  RandomAddress random;
  std::int64_t first_ray = 0;
  Workspace* workspace = nullptr;
};

template <class Real>
struct ImportanceKernels {
  void (*sample)(const ImportanceArgs& args, View<const double> near_far, const Proposal<Real>& previous,
                 Samples<Real>& out) = nullptr;
};

void importance_kernels(KernelTables& tables);

/// Throws Error(failure) that names the ray, the sample and the weight.
[[noreturn]] void bad_proposal_weight(std::int64_t ray, std::int64_t sample, double weight);

}  // namespace semfield
