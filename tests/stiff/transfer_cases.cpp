// Group A: the transfer equation and compositing.
#include <vector>

#include "model/compositor.h"
#include "stiff_case.h"
#include "tests/model_compositor/rays_of_slabs.h"

namespace semfield::stiff {

namespace {

using testing::RayBuffers;

void vacuum(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const int count : {1, 2, 7, 64, 1024}) {
      RayBuffers<Real> rays({count}, 0);
      for (int k = 0; k < count; ++k) {
        rays.t[static_cast<std::size_t>(k)] = Real(k + 0.5);
        rays.delta[static_cast<std::size_t>(k)] = Real(1);
      }
      composite_forward(rays.in(), rays.out());
      run.measure(std::abs(static_cast<double>(rays.opacity[0])), 0, "opacity");
      run.measure(std::abs(static_cast<double>(rays.depth[0])), 0, "depth");
      for (const Real weight : rays.weight) run.measure(std::abs(static_cast<double>(weight)), 0, "weight");
    }
  });
}

constexpr Case kCases[] = {
    {"A01", "vacuum", "density 0, 1 to 1,024 samples", "exact", vacuum},
};

}  // namespace

std::span<const Case> transfer_cases() { return kCases; }

}  // namespace semfield::stiff
