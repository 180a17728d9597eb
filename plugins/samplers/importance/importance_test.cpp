// The laws of the importance sampler; cases B01 to B08 of tests/numerics have the inverse CDF and the union.
#include "samplers/importance/importance.h"

#include <gtest/gtest.h>

#include "testkit/laws.h"

namespace semfield {
namespace {

SamplerBuild room() { return SamplerBuild{.bounds = {{-2, -2, -1}, {3, 2, 2}}, .near_m = 0.1, .far_m = 6}; }

template <class Real>
Importance<Real> make(const ImportanceParams& params) {
  static const KernelTables tables = [] {
    KernelTables t;
    importance_kernels(t);
    return t;
  }();
  return Importance<Real>(params, room(), tables);
}

TEST(Importance, Laws) {
  for (const bool keep : {false, true}) {
    for (const auto rule : {Quadrature::paper, Quadrature::midpoint}) {
      ImportanceParams params{.samples = 20, .keep_previous = keep, .quadrature = rule};
      const auto failures = testkit::sampler_laws(make<float>(params), make<double>(params), room());
      EXPECT_TRUE(failures.empty()) << testkit::to_text(failures);
    }
  }
}

}  // namespace
}  // namespace semfield
