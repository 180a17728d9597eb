// Tests of the identity encoder.
#include "encoders/identity/identity.h"

#include "tests/says.h"

namespace semfield {
namespace {

template <class Real>
Identity<Real> make(std::int32_t dims) {
  static const KernelTables tables = [] {
    KernelTables t;
    identity_kernels(t);
    return t;
  }();
  EncoderBuild build{.in_dims = dims};
  return Identity<Real>({}, build, tables);
}

TEST(Identity, RoundsToTheOutputAndHonoursStrides) {
  const auto encoder = make<float>(2);
  EXPECT_EQ(encoder.traits().out_dims, 2);
  const std::vector<double> x{0.1, 1e10, -7, 2, 3, -7};
  std::vector<float> y(8, -1.f);
  encoder.forward({}, {}, View<const double>(x.data(), 2, 2, 3), View<float>(y.data(), 2, 2, 4));
  EXPECT_EQ(y, (std::vector<float>{0.1f, 1e10f, -1, -1, 2, 3, -1, -1}));
}

TEST(Identity, NamesARowThatIsNotFinite) {
  const auto encoder = make<float>(1);
  const std::vector<double> x{0, 1, INFINITY};
  std::vector<float> y(3);
  EXPECT_HAS(
      error_of([&] { encoder.forward({}, {}, View<const double>(x.data(), 3, 1), View<float>(y.data(), 3, 1)); }),
      "row 2");
}

}  // namespace
}  // namespace semfield
