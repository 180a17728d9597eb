// The class layer once a ray on the device against plain sums in float64: few classes and many take different kernels.
#include <cmath>
#include <vector>

#include "cuda/stages.h"
#include "device_fixture.h"
#include "plugin/head/one_layer_head.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::host_view;
using testing::random_floats;

// x [n, k] (or its transpose, with `turned`) times y [., m].
std::vector<double> product(const std::vector<float>& x, const std::vector<float>& y, std::int64_t n, std::int64_t k,
                            std::int64_t m, bool turned, bool y_turned) {
  std::vector<double> sum(static_cast<std::size_t>(n * m));
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t t = 0; t < k; ++t) {
      const double a = x[static_cast<std::size_t>(turned ? t * n + i : i * k + t)];
      for (std::int64_t j = 0; j < m; ++j) {
        sum[static_cast<std::size_t>(i * m + j)] += a * y[static_cast<std::size_t>(y_turned ? j * k + t : t * m + j)];
      }
    }
  }
  return sum;
}

// tolerance: 1e-6 for products of fp32 numbers; 2e-3 where they are cut to TF32's 10 bits of mantissa.
std::string near(const DeviceMatrix<float>& got, const std::vector<double>& want, std::int64_t terms,
                 double tolerance) {
  const std::vector<float> values = got.read();
  const auto cols = static_cast<std::int32_t>(got.view().cols);
  const double floor = std::sqrt(static_cast<double>(terms));  // terms lie in [-1, 1]
  return testkit::compare<float, double>(host_view(values, cols), host_view(want, cols), tolerance, floor) +
         got.surroundings();
}

TEST(CudaHead, ClassLayerAndItsGradients) {
  SEMFIELD_NEEDS_DEVICE();
  DeviceLaunch launch;
  constexpr std::int32_t kFeature = 16;
  struct Shape {
    std::int64_t rays;
    std::int32_t hidden, classes;
    Precision precision = Precision::fp32;
  };
  for (const Shape& s : {Shape{1, 1, 1}, Shape{1000, 128, 29}, Shape{3000, 64, 128}, Shape{700, 64, 129},
                         Shape{1000, 128, 512}, Shape{1000, 128, 29, Precision::bf16},
                         Shape{700, 64, 129, Precision::bf16}, Shape{1000, 128, 512, Precision::bf16}}) {
    const bool cut = s.precision == Precision::bf16 && s.classes > 128;
    const double tolerance = cut ? 2e-3 : 1e-6;
    SCOPED_TRACE(std::to_string(s.rays) + " rays, hidden " + std::to_string(s.hidden) + ", classes " +
                 std::to_string(s.classes) + (s.precision == Precision::bf16 ? ", bf16" : ""));
    const OneLayerHead<float> head({kFeature, s.hidden, s.classes, s.precision}, cuda::head_kernels());
    StepContext ctx;
    ctx.workspace = &launch.arena();
    const std::vector<float> h = random_floats(s.rays * s.hidden, 1, -1, 1), share = random_floats(s.rays, 2, 0, 1);
    const std::vector<float> w = random_floats(s.hidden * s.classes, 3, -1, 1), b = random_floats(s.classes, 4, -1, 1);
    const std::vector<float> g = random_floats(s.rays * s.classes, 5, -1, 1);
    const DeviceMatrix<float> d_h(h, s.hidden), d_share(share, 1), d_g(g, s.classes), d_w(w, s.classes),
        d_b(b, s.classes);
    const DeviceMatrix<float> hidden_weight(kFeature, s.hidden), hidden_bias(1, s.hidden);
    const DeviceMatrix<float> grad_w(std::vector<float>(w.size(), 2.0F), s.classes),
        grad_b(std::vector<float>(b.size(), 3.0F), s.classes);
    const DeviceMatrix<float> logits(s.rays, s.classes), of_h(s.rays, s.hidden), of_share(s.rays, 1);
    const std::vector<View<float>> values{hidden_weight.view(), hidden_bias.view(), d_w.view(), d_b.view()};
    const std::vector<View<float>> grads{hidden_weight.view(), hidden_bias.view(), grad_w.view(), grad_b.view()};
    const Tensors<float> tensors{values, grads};
    head.output_forward(ctx, tensors, d_h.view(), d_share.view(), logits.view());
    head.output_backward(ctx, tensors, d_h.view(), d_share.view(), d_g.view(), of_h.view(), of_share.view());

    std::vector<double> want = product(h, w, s.rays, s.hidden, s.classes, false, false);
    for (std::size_t i = 0; i < want.size(); ++i) {
      const auto classes = static_cast<std::size_t>(s.classes);
      want[i] += double{share[i / classes]} * b[i % classes];
    }
    EXPECT_EQ(near(logits, want, s.hidden + 1, tolerance), "") << "logits";
    EXPECT_EQ(near(of_h, product(g, w, s.rays, s.classes, s.hidden, false, true), s.classes, tolerance), "") << "d_h";
    EXPECT_EQ(near(of_share, product(g, b, s.rays, s.classes, 1, false, true), s.classes, 1e-6), "") << "d_share";
    std::vector<double> of_w = product(h, g, s.hidden, s.rays, s.classes, true, false);
    std::vector<double> of_b = product(share, g, 1, s.rays, s.classes, true, false);
    for (double& x : of_w) x += 2;
    for (double& x : of_b) x += 3;
    EXPECT_EQ(near(grad_w, of_w, s.rays, tolerance), "") << "class weight";
    EXPECT_EQ(near(grad_b, of_b, s.rays, 1e-6), "") << "class bias";
  }
}

}  // namespace
}  // namespace semfield
