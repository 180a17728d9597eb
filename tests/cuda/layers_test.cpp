// Products and layers on the device against plain loops in float64; which epilogues cuBLASLt has; same bits every run.
#include <algorithm>
#include <cstdio>

#include "cuda/kernels/kernels.h"
#include "cuda/matmul.h"
#include "device_fixture.h"
#include "testkit/compare.h"

namespace semfield {
namespace {

using cuda::Activation;
using cuda::Epilogue;
using cuda::LinearBackward;
using cuda::LinearForward;
using cuda::Matrix;
using cuda::Product;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::host_view;
using testing::random_floats;
using Bf16 = __nv_bfloat16;

float number(float x) { return x; }
float number(Bf16 x) { return __bfloat162float(x); }
std::vector<double> rounded(const std::vector<float>& values, bool to_bf16) {
  std::vector<double> result;
  for (const float v : values) result.push_back(to_bf16 ? number(Bf16(v)) : v);
  return result;
}
template <class T>
std::vector<double> read(const DeviceMatrix<T>& m) {
  std::vector<double> result;
  for (const T& v : m.read()) result.push_back(number(v));
  return result;
}

struct Shape {
  std::int64_t m;
  std::int32_t n, k;
  bool transpose_a = false, transpose_b = false;
  bool add = false;
  std::int32_t padding = 0;
};

// a, b, d as stored; operands and D as the types say.
template <class Act, class Out>
struct Case {
  explicit Case(const Shape& s)
      : a(random_floats(s.m * s.k, 1, -1, 1), s.transpose_a ? static_cast<std::int32_t>(s.m) : s.k,
          (s.transpose_a ? static_cast<std::int32_t>(s.m) : s.k) + s.padding),
        b(random_floats(static_cast<std::int64_t>(s.k) * s.n, 2, -1, 1), s.transpose_b ? s.k : s.n,
          (s.transpose_b ? s.k : s.n) + s.padding),
        d(random_floats(s.m * s.n, 3, -1, 1), s.n, s.n + s.padding) {
    const std::vector<double> av = read(a), bv = read(b), dv = read(d);
    for (std::int64_t i = 0; i < s.m; ++i) {
      for (std::int32_t j = 0; j < s.n; ++j) {
        double sum = s.add ? dv[i * s.n + j] : 0;
        for (std::int32_t k = 0; k < s.k; ++k)
          sum += av[s.transpose_a ? k * s.m + i : i * s.k + k] * bv[s.transpose_b ? j * s.k + k : k * s.n + j];
        want.push_back(sum);
      }
    }
    product.a = Matrix(a.view(), s.transpose_a);
    product.b = Matrix(b.view(), s.transpose_b);
    product.d = Matrix(d.view());
    product.add = s.add;
  }
  DeviceMatrix<Act> a, b;
  DeviceMatrix<Out> d;
  Product product;
  std::vector<double> want;
};

const std::vector<Shape> kShapes{{1, 1, 1},
                                 {31, 33, 7},
                                 {33, 5, 70, false, true},
                                 {7, 9, 4097, true},
                                 {70, 12, 33, true, false, true, 3},
                                 {4097, 64, 16, false, false, true},
                                 {129, 128, 256, false, true, true, 8},
                                 {256, 128, 4097, true, false, true},
                                 {0, 3, 4},
                                 {3, 4, 0}};

template <class Act, class Out>
void expect_products(double tolerance, bool plain) {
  for (const Shape& s : kShapes) {
    SCOPED_TRACE(std::to_string(s.m) + " x " + std::to_string(s.n) + " x " + std::to_string(s.k) + ", transposed " +
                 std::to_string(s.transpose_a) + std::to_string(s.transpose_b) + ", add " + std::to_string(s.add) +
                 ", padding " + std::to_string(s.padding));
    Case<Act, Out> c(s);
    if (plain) {
      cuda::simple_product(c.product);
    } else {
      EXPECT_TRUE(cuda::product(c.product));
    }
    const std::vector<double> got = read(c.d);
    // Terms lie in [-1, 1]: a sum's error grows with the root of their number, its bf16 rounding with its size.
    const double floor = std::sqrt(static_cast<double>(std::max(1, s.k)));
    EXPECT_EQ((testkit::compare<double, double>(host_view(got, s.n), host_view(c.want, s.n), tolerance, floor)), "");
    EXPECT_EQ(c.d.surroundings(), "");
  }
}

TEST(CudaProduct, IsTheProductInFp32) {
  SEMFIELD_ON_DEVICE(launch);
  expect_products<float, float>(3e-6, false);  // TF32 would be off by 5e-4
  expect_products<float, float>(3e-6, true);
}

TEST(CudaProduct, SmallOnesRunSeveralInALaunch) {
  SEMFIELD_ON_DEVICE(launch);
  // D1 = A B; D2 = C + A2^T B2 + u v^T, added to what is there; D3 = C.
  const Case<float, float> first({70, 33, 65}), second({33, 40, 129, true, false, true, 3});
  const std::vector<float> u = random_floats(33, 5, -1, 1), v = random_floats(40, 6, -1, 1);
  const std::vector<float> c = random_floats(33 * 40, 7, -1, 1);
  const DeviceMatrix<float> column(u, 33), row(v, 40), start(c, 40), copy(33, 40);
  cuda::SmallProduct products[3];
  products[0].a = first.product.a, products[0].b = first.product.b, products[0].d = first.d.view();
  products[1].a = second.product.a, products[1].b = second.product.b, products[1].d = second.d.view();
  products[1].a2 = Matrix(column.view(), true), products[1].b2 = Matrix(row.view());
  products[1].c = start.view(), products[1].add = true;
  products[2].c = start.view(), products[2].d = copy.view();
  cuda::small_products(products);
  std::vector<double> want = second.want;
  for (std::size_t i = 0; i < want.size(); ++i) want[i] += double{c[i]} + double{u[i / 40]} * v[i % 40];
  const std::vector<double> got_first = read(first.d), got_second = read(second.d);
  EXPECT_EQ((testkit::compare<double, double>(host_view(got_first, 33), host_view(first.want, 33), 1e-6, 8)), "");
  EXPECT_EQ((testkit::compare<double, double>(host_view(got_second, 40), host_view(want, 40), 1e-6, 11)), "");
  EXPECT_EQ(copy.read(), c);
  for (const DeviceMatrix<float>* m : {&first.d, &second.d, &copy}) EXPECT_EQ(m->surroundings(), "");
}

TEST(CudaProduct, SmallOnesOfManyTermsAreSummedInParts) {
  SEMFIELD_ON_DEVICE(launch);
  // D1 += A^T B over 5,000 terms; D2 = A2 B2 over a few.
  Case<float, float> many({40, 29, 5000, true, false, true, 2}), few({33, 40, 129});
  cuda::SmallProduct products[2];
  products[0].a = many.product.a, products[0].b = many.product.b, products[0].d = many.d.view(), products[0].add = true;
  products[1].a = few.product.a, products[1].b = few.product.b, products[1].d = few.d.view();
  const std::vector<float> before = many.d.read();
  std::vector<float> first;
  for (int run = 0; run < 3; ++run) {
    many.d.write(before);
    cuda::small_products(products, &launch.arena());
    if (run == 0) first = many.d.read();
    EXPECT_EQ(many.d.read(), first) << "run " << run;
  }
  const std::vector<double> got_many = read(many.d), got_few = read(few.d);
  EXPECT_EQ((testkit::compare<double, double>(host_view(got_many, 29), host_view(many.want, 29), 1e-6, 71)), "");
  EXPECT_EQ((testkit::compare<double, double>(host_view(got_few, 40), host_view(few.want, 40), 1e-6, 11)), "");
  EXPECT_EQ(many.d.surroundings() + few.d.surroundings(), "");
}

TEST(CudaProduct, OfBf16OperandsSumsInFp32) {
  SEMFIELD_ON_DEVICE(launch);
  expect_products<Bf16, float>(1e-5, false);  // matrix units cut the digits of a sum that they do not keep
  expect_products<Bf16, Bf16>(8e-3, false);   // cuBLASLt may round the product before it adds D
  expect_products<Bf16, Bf16>(4e-3, true);
}

TEST(CudaProduct, RepeatsBitForBit) {
  SEMFIELD_ON_DEVICE(launch);
  constexpr std::int64_t kRows = 65536;
  const DeviceMatrix<Bf16> x(random_floats(kRows * 256, 1, -1, 1), 256), dz(random_floats(kRows * 256, 2, -1, 1), 256);
  std::vector<float> first, first_sums;
  for (int run = 0; run < 3; ++run) {
    const DeviceMatrix<float> d(std::vector<float>(256 * 256), 256), sums(std::vector<float>(256), 256);
    Product p{.a = Matrix(x.view(), true),
              .b = Matrix(dz.view()),
              .d = Matrix(d.view()),
              .add = true,
              .epilogue = Epilogue::column_sums,
              .sums = sums.data()};
    if (!cuda::product(p)) {
      p.epilogue = Epilogue::none;
      cuda::product(p);
    }
    if (run == 0) first = d.read(), first_sums = sums.read();
    EXPECT_EQ(d.read(), first);
    EXPECT_EQ(sums.read(), first_sums);
  }
}

// No assertion but that the calls are accepted: what cuBLASLt lacks is made up for by further passes, and costs time.
TEST(CudaProduct, TellsWhichEpiloguesCublasLtHas) {
  SEMFIELD_ON_DEVICE(launch);
  constexpr std::int64_t kRows = 4096;
  const DeviceMatrix<Bf16> x(random_floats(kRows * 256, 1, -1, 1), 256), w(random_floats(256 * 256, 2, -1, 1), 256);
  const DeviceMatrix<Bf16> y(kRows, 256), bias(random_floats(256, 3, -1, 1), 256);
  const DeviceMatrix<float> d(std::vector<float>(256 * 256), 256), sums(1, 256);
  const DeviceMatrix<std::uint32_t> mask(kRows, static_cast<std::int32_t>(cuda::mask_stride_bits(256) / 32));
  const char* const names[] = {"none",      "bias",           "relu",   "bias_relu",
                               "relu_mask", "bias_relu_mask", "masked", "column_sums"};
  for (int e = 0; e < 8; ++e) {
    Product p;
    p.epilogue = static_cast<Epilogue>(e);
    p.a = Matrix(x.view());
    p.b = Matrix(w.view());
    p.d = Matrix(y.view());
    if (p.epilogue == Epilogue::bias || p.epilogue == Epilogue::bias_relu || p.epilogue == Epilogue::bias_relu_mask)
      p.bias = bias.data();
    if (p.epilogue >= Epilogue::relu_mask && p.epilogue <= Epilogue::masked) p.mask = mask.data();
    if (p.epilogue == Epilogue::column_sums) {
      p.a = Matrix(x.view(), true);
      p.b = Matrix(x.view());
      p.d = Matrix(d.view());
      p.sums = sums.data();
    }
    const bool has = cuda::product(p);
    std::printf("cuBLASLt, bf16, %s: %s\n", names[e], has ? "yes" : "no");
    RecordProperty(names[e], has ? 1 : 0);
  }
  cuda::check(cudaDeviceSynchronize(), "products with epilogues");
}

// y = relu(x W + b), then its gradients, in one shape; `masks` through bits, else through y.
template <class Act, class Out>
void expect_layer(std::int64_t rows, std::int32_t in, std::int32_t out, bool masks, double tolerance) {
  SCOPED_TRACE(std::to_string(rows) + " rows, " + std::to_string(in) + " to " + std::to_string(out) + ", masks " +
               std::to_string(masks));
  constexpr bool kRounds = std::is_same_v<Out, Bf16>;  // the bias that an epilogue adds
  DeviceLaunch launch;
  const std::vector<float> bias_values = random_floats(out, 3, -1, 1);
  const DeviceMatrix<Act> x(random_floats(rows * in, 1, -1, 1), in), w(random_floats(in * out, 2, -1, 1), out);
  const DeviceMatrix<float> bias(bias_values, out);
  const DeviceMatrix<Out> rounded_bias(bias_values, out), y(rows, out);
  const auto words = static_cast<std::int32_t>(cuda::mask_stride_bits(out) / 32);
  const DeviceMatrix<std::uint32_t> mask(rows, words);
  LinearForward<Act, Out> forward;
  forward.x = x.view(), forward.weight = w.view(), forward.bias = bias.view(), forward.y = y.view();
  forward.activation = Activation::relu;
  if (masks) forward.rounded_bias = rounded_bias.view(), forward.mask = mask.data();
  linear_forward(forward);

  const std::vector<double> xv = read(x), wv = read(w), bv = rounded(bias_values, kRounds && masks);
  std::vector<double> want;
  for (std::int64_t i = 0; i < rows; ++i) {
    for (std::int32_t j = 0; j < out; ++j) {
      double sum = bv[j];
      for (std::int32_t k = 0; k < in; ++k) sum += xv[i * in + k] * wv[k * out + j];
      want.push_back(std::max(0.0, sum));
    }
  }
  const std::vector<double> got = read(y);
  const double floor = std::sqrt(static_cast<double>(in));
  EXPECT_EQ((testkit::compare<double, double>(host_view(got, out), host_view(want, out), tolerance, floor)), "");

  // The layer before it: gradients of x2 = y through a second product back to `out` columns, masked by y > 0.
  if constexpr (std::is_same_v<Act, Out>) {
    constexpr std::int32_t kNext = 24;
    const DeviceMatrix<Act> dz(random_floats(rows * kNext, 4, -1, 1), kNext),
        next(random_floats(out * kNext, 5, -1, 1), kNext);
    const DeviceMatrix<Act> dx(random_floats(rows * out, 6, -1, 1), out);
    const DeviceMatrix<float> d_weight(random_floats(out * kNext, 7, -1, 1), kNext),
        d_bias(random_floats(kNext, 8, -1, 1), kNext);
    const std::vector<double> start = read(dx);
    std::vector<double> want_weight = read(d_weight), want_bias = read(d_bias), want_dx;
    LinearBackward<Act, Act> backward;
    backward.x = y.view(), backward.dz = dz.view(), backward.weight = next.view();
    backward.d_weight = d_weight.view(), backward.d_bias = d_bias.view(), backward.dx = dx.view();
    backward.add_to_dx = true, backward.relu_input = true;
    if (masks) backward.mask = mask.data();
    linear_backward(backward, launch.arena());
    const std::vector<double> zv = read(dz), nv = read(next);
    for (std::int64_t i = 0; i < rows; ++i) {
      for (std::int32_t n = 0; n < kNext; ++n) {
        const double z = zv[i * kNext + n];
        want_bias[n] += z;
        for (std::int32_t j = 0; j < out; ++j) want_weight[j * kNext + n] += got[i * out + j] * z;
      }
      for (std::int32_t j = 0; j < out; ++j) {
        double sum = start[i * out + j];
        for (std::int32_t n = 0; n < kNext; ++n) sum += zv[i * kNext + n] * nv[j * kNext + n];
        want_dx.push_back(got[i * out + j] > 0 ? sum : 0);
      }
    }
    const auto near = [&](const std::vector<double>& is, const std::vector<double>& should, std::int32_t cols,
                          double limit) {
      return testkit::compare<double, double>(host_view(is, cols), host_view(should, cols), limit, 1);
    };
    EXPECT_EQ(near(read(dx), want_dx, out, tolerance), "");
    EXPECT_EQ(near(read(d_weight), want_weight, kNext, 1e-5), "");
    EXPECT_EQ(near(read(d_bias), want_bias, kNext, 1e-5), "");
  }
}

TEST(CudaLayers, ForwardAndGradientsFollowTheFormulas) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t rows : {0, 1, 31, 33, 4097}) {
    for (const bool masks : {false, true}) {
      expect_layer<float, float>(rows, 17, 40, masks, 3e-6);
      expect_layer<Bf16, float>(rows, 24, 40, masks, 3e-6);
      expect_layer<Bf16, Bf16>(rows, 24, 40, masks, 8e-3);
      expect_layer<Bf16, Bf16>(rows, 64, 256, masks, 8e-3);
    }
  }
}

TEST(CudaLayers, PassesOverMatrices) {
  SEMFIELD_ON_DEVICE(launch);
  for (const std::int64_t rows : {0, 1, 31, 33, 4097}) {
    for (const std::int32_t padding : {0, 3}) {
      SCOPED_TRACE(std::to_string(rows) + " rows, padding " + std::to_string(padding));
      const std::vector<float> values = random_floats(rows * 5, 1, -1, 1), others = random_floats(rows * 5, 2, -1, 1);
      const DeviceMatrix<float> in(values, 5, 5 + padding), sum(others, 5, 5 + padding);
      const DeviceMatrix<Bf16> wide(rows, 8, 8 + padding);
      cuda::convert<float, Bf16>(in.view(), wide.view());
      cuda::add_rows<float, float>(in.view(), sum.view());
      const std::vector<double> got = read(wide), added = read(sum);
      for (std::int64_t i = 0; i < rows * 8; ++i) {
        const auto from = static_cast<std::size_t>(i / 8 * 5 + i % 8);
        ASSERT_EQ(got[i], i % 8 < 5 ? number(Bf16(values[from])) : 0) << i;
      }
      for (std::size_t i = 0; i < added.size(); ++i) ASSERT_EQ(added[i], others[i] + values[i]) << i;
      cuda::relu_backward<float>(in.view(), sum.view());
      const std::vector<double> masked = read(sum);
      for (std::size_t i = 0; i < added.size(); ++i) ASSERT_EQ(masked[i], values[i] > 0 ? added[i] : 0) << i;
      const DeviceMatrix<float> turned(5, static_cast<std::int32_t>(rows));
      cuda::transpose(in.view(), turned.view());
      const std::vector<float> t = turned.read();
      for (std::size_t i = 0; i < t.size(); ++i)
        ASSERT_EQ(t[i], values[i % static_cast<std::size_t>(rows) * 5 + i / static_cast<std::size_t>(rows)]) << i;
      const DeviceMatrix<float> sums(std::vector<float>(5, 1.0F), 5);
      cuda::add_column_sums<float>(in.view(), sums.view(), launch.arena());
      std::vector<double> want(5, 1.0);
      for (std::size_t i = 0; i < values.size(); ++i) want[i % 5] += values[i];
      const std::vector<float> got_sums = sums.read();
      for (std::size_t c = 0; c < 5; ++c) EXPECT_NEAR(got_sums[c], want[c], 1e-4);
      for (const DeviceMatrix<float>* m : {&in, &sum, &turned, &sums}) EXPECT_EQ(m->surroundings(), "");
      EXPECT_EQ(wide.surroundings(), "");
    }
  }
}

TEST(CudaLayers, SumsOverRaysLeaveOutUnusedRows) {
  SEMFIELD_ON_DEVICE(launch);
  const std::vector<std::int32_t> rays{0, 0, 2, 2, 2, 4, 5, 5};  // 1 and 3 have none; the last two rows are not in use
  const DeviceMatrix<std::int32_t> of(rays, 1), live(std::vector<std::int32_t>{6}, 1);
  const DeviceMatrix<float> dz(std::vector<float>{1, 2, 3, 4, 5, 6, 7, 8}, 1), sums(6, 1);
  launch.set_live_rows(live.data());
  cuda::per_ray_backward<float>(dz.view(), of.view(), sums.view());
  EXPECT_EQ(sums.read(), (std::vector<float>{3, 0, 12, 0, 6, 0}));
}

}  // namespace
}  // namespace semfield
