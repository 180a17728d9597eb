// Tests of the identity encoder; case C06 of tests/numerics has what it refuses.

#include "tests/conformance/rows.h"
#include "tests/encoder_box.h"

namespace semfield {
namespace {

TEST(Identity, RoundsToTheOutputAndHonoursStrides) {
  testkit::EncoderBox<float> box(testkit::linked_registry(), "identity", {}, 2);
  EXPECT_EQ(box.out_dims(), 2);
  const std::vector<double> x{0.1, 1e10, -7, 2, 3, -7};
  std::vector<float> y(8, -1.f);
  box.encoder().forward({}, {}, View<const double>(x.data(), 2, 2, 3), View<float>(y.data(), 2, 2, 4));
  EXPECT_EQ(y, (std::vector<float>{0.1f, 1e10f, -1, -1, 2, 3, -1, -1}));
}

}  // namespace
}  // namespace semfield
