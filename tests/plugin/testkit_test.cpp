// The testkit's instruments notice what they are for.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "testkit/compare.h"
#include "testkit/gradient_check.h"
#include "testkit/guarded.h"
#include "testkit/tensor_box.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield::testkit {
namespace {

TEST(Guarded, FindsUnwrittenElementsAndWritesOutside) {
  Guarded<float> buffer(3, 2, 1);
  EXPECT_EQ(buffer.unwritten(), "element (0, 0) was not written");
  buffer.fill(1.0F);
  EXPECT_EQ(buffer.unwritten(), "");
  EXPECT_EQ(buffer.broken_guard(), "");
  buffer(2, 1) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_EQ(buffer.unwritten(), "element (2, 1) is NaN");
  buffer.view().data[2] = 0;
  EXPECT_EQ(buffer.broken_guard(), "wrote into the padding of row 0");
  Guarded<double> before(1, 1);
  before.view().data[-3] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_EQ(before.broken_guard(), "wrote 3 elements before the buffer");
  Guarded<std::int32_t> after(1, 1);
  after.view().data[1] = 0;
  EXPECT_EQ(after.broken_guard(), "wrote 0 elements past the buffer");
}

TEST(Compare, NamesTheWorstElement) {
  Guarded<float> got(2, 2);
  Guarded<double> want(2, 2);
  got.fill(1);
  want.fill(1);
  EXPECT_EQ((compare<float, double>(got.view(), want.view(), 1e-6)), "");
  got(1, 0) = 1.5F;
  EXPECT_EQ((compare<float, double>(got.view(), want.view(), 1e-6)).find("element (1, 0) is 1.5, expected 1"), 0u);
  got(1, 0) = std::numeric_limits<float>::quiet_NaN();
  EXPECT_NE((compare<float, double>(got.view(), want.view(), 1e9)), "");
}

TEST(Compare, BitsTellZeroFromMinusZero) {
  Guarded<double> a(1, 1);
  Guarded<double> b(1, 1);
  a.fill(0.0);
  b.fill(-0.0);
  EXPECT_NE(compare_bits<double>(a.view(), b.view()), "");
  EXPECT_EQ(compare_bits<double>(a.view(), a.view()), "");
}

TEST(GradientCheck, AcceptsTheTruthAndRejectsOnePerMille) {
  Guarded<double> x(4, 3);
  Guarded<double> gradient(4, 3);
  for (std::int64_t i = 0; i < 12; ++i) x(i / 3, static_cast<std::int32_t>(i % 3)) = 0.1 * static_cast<double>(i);
  const auto loss = [&x] {
    double sum = 0;
    for (std::int64_t r = 0; r < 4; ++r) {
      for (std::int32_t c = 0; c < 3; ++c) sum += std::sin(3 * x(r, c)) + std::max(0.0, x(r, c) - 0.45);
    }
    return sum;
  };
  for (std::int64_t r = 0; r < 4; ++r) {
    for (std::int32_t c = 0; c < 3; ++c) gradient(r, c) = 3 * std::cos(3 * x(r, c)) + (x(r, c) > 0.45 ? 1 : 0);
  }
  EXPECT_EQ(check_gradient(loss, x.view(), gradient.view(), {}), "");
  gradient(3, 2) *= 1.001;
  EXPECT_EQ(check_gradient(loss, x.view(), gradient.view(), {}).find("gradient (3, 2) is "), 0u);
}

TEST(TensorBox, FloatAndDoubleHoldTheSameNumbers) {
  const KernelTables kernels;
  const toy::ToyEncoder<float> encoder32(toy::ToyParams{}, EncoderBuild{}, kernels);
  const toy::ToyEncoder<double> encoder64(toy::ToyParams{}, EncoderBuild{}, kernels);
  const TensorBox<float> single(encoder32, 5);
  const TensorBox<double> twin(encoder64, 5);
  const TensorBox<double> other(encoder64, 6);
  ASSERT_EQ(single.count(), 1u);
  EXPECT_EQ((difference<float, double>(single.value(0), twin.value(0)).max_abs), 0);
  EXPECT_NE(compare_bits<double>(twin.value(0), other.value(0)), "");
}

}  // namespace
}  // namespace semfield::testkit
