// Kernel table of the importance sampler.
#pragma once

#include "core/rng.h"
#include "core/workspace.h"
#include "plugin/quadrature.h"
#include "plugin/sampler.h"

namespace semfield {

class KernelTables;

struct ImportanceArgs {
  std::int64_t samples = 0;
  bool keep_previous = true;
  double floor = 1e-3;
  Quadrature quadrature = Quadrature::paper;
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
