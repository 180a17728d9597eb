// Products and layers on the device against plain loops in float64; which epilogues cuBLASLt has; same bits every run.

#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "cuda/matmul.h"
#include "cuda/steps/batch_drawer.h"
#include "cuda/stream_executor.h"
#include "device_fixture.h"
#include "plugin/head.h"
#include "tests/conformance/rows.h"
#include "tests/session/train_testing.h"

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
using testing::random_floats;
using testing::widen;
using Bf16 = __nv_bfloat16;

double rounded(float x) { return static_cast<double>(__bfloat162float(Bf16(x))); }

// x [n, k] (or its transpose, with `turned`) times y [k, m] (or its transpose).
template <class X, class Y>
std::vector<double> plain_product(const std::vector<X>& x, const std::vector<Y>& y, std::int64_t n, std::int64_t k,
                                  std::int64_t m, bool turned = false, bool y_turned = false) {
  std::vector<double> sum(static_cast<std::size_t>(n * m));
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t t = 0; t < k; ++t) {
      const double a = x[turned ? t * n + i : i * k + t];
      for (std::int64_t j = 0; j < m; ++j) sum[i * m + j] += a * y[y_turned ? j * k + t : t * m + j];
    }
  }
  return sum;
}
void add(std::vector<double>& to, const std::vector<double>& more) {
  for (std::size_t i = 0; i < to.size(); ++i) to[i] += more[i % more.size()];
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
    want = plain_product(widen(a), widen(b), s.m, s.k, s.n, s.transpose_a, s.transpose_b);
    if (s.add) add(want, widen(d));
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
    SCOPED_TRACE(::testing::Message() << s.m << " x " << s.n << " x " << s.k << ", transposed " << s.transpose_a
                                      << s.transpose_b << ", add " << s.add << ", padding " << s.padding);
    Case<Act, Out> c(s);
    if (plain) {
      cuda::simple_product(c.product);
    } else {
      EXPECT_TRUE(cuda::product(c.product));
    }
    // Terms lie in [-1, 1]: a sum's error grows with the root of their number, its bf16 rounding with its size.
    const double floor = std::sqrt(static_cast<double>(std::max(1, s.k)));
    EXPECT_EQ(near(c.d, c.want, tolerance, floor) + c.d.surroundings(), "");
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
  EXPECT_EQ(near(first.d, first.want, 1e-6, 8), "");
  EXPECT_EQ(near(second.d, want, 1e-6, 11), "");
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
  EXPECT_EQ(near(many.d, many.want, 1e-6, 71), "");
  EXPECT_EQ(near(few.d, few.want, 1e-6, 11), "");
  EXPECT_EQ(many.d.surroundings() + few.d.surroundings(), "");
}

TEST(CudaProduct, OfBf16OperandsSumsInFp32) {
  SEMFIELD_ON_DEVICE(launch);
  expect_products<Bf16, float>(1e-5, false);  // matrix units cut the digits of a sum that they do not keep
  expect_products<Bf16, Bf16>(8e-3, false);   // cuBLASLt may round the product before it adds D
  expect_products<Bf16, Bf16>(4e-3, true);
}

// y = relu(x W + b), then gradients of a product behind it, in one shape; `in_one`: with the bias as an epilogue adds
// it.
template <class Act, class Out>
void expect_layer(std::int64_t rows, std::int32_t in, std::int32_t out, bool in_one, double tolerance) {
  SCOPED_TRACE(std::to_string(rows) + " rows, " + std::to_string(in) + " to " + std::to_string(out) + ", in one " +
               std::to_string(in_one));
  constexpr bool kRounds = std::is_same_v<Out, Bf16>;  // the bias that an epilogue adds
  DeviceLaunch launch;
  const std::vector<float> bias_values = random_floats(out, 3, -1, 1);
  const DeviceMatrix<Act> x(random_floats(rows * in, 1, -1, 1), in), w(random_floats(in * out, 2, -1, 1), out);
  const DeviceMatrix<float> bias(bias_values, out);
  const DeviceMatrix<Out> rounded_bias(bias_values, out), y(rows, out);
  LinearForward<Act, Out> forward;
  forward.x = x.view(), forward.weight = w.view(), forward.bias = bias.view(), forward.y = y.view();
  forward.activation = Activation::relu;
  if (in_one) forward.rounded_bias = rounded_bias.view();
  linear_forward(forward);

  std::vector<double> want = plain_product(widen(x), widen(w), rows, in, out);
  add(want, kRounds && in_one ? widen(rounded_bias) : widen(bias));
  for (double& v : want) v = std::max(0.0, v);
  EXPECT_EQ(near(y, want, tolerance, std::sqrt(static_cast<double>(in))), "");

  // Gradients of x2 = y through a second product back to `out` columns.
  if constexpr (std::is_same_v<Act, Out>) {
    constexpr std::int32_t kNext = 24;
    const DeviceMatrix<Act> dz(random_floats(rows * kNext, 4, -1, 1), kNext),
        next(random_floats(out * kNext, 5, -1, 1), kNext);
    const DeviceMatrix<Act> dx(random_floats(rows * out, 6, -1, 1), out);
    const DeviceMatrix<float> d_weight(random_floats(out * kNext, 7, -1, 1), kNext),
        d_bias(random_floats(kNext, 8, -1, 1), kNext);
    std::vector<double> want_dx = widen(dx), want_weight = widen(d_weight), want_bias = widen(d_bias);
    LinearBackward<Act, Act> backward;
    backward.x = y.view(), backward.dz = dz.view(), backward.weight = next.view();
    backward.d_weight = d_weight.view(), backward.d_bias = d_bias.view(), backward.dx = dx.view();
    backward.add_to_dx = true;
    linear_backward(backward, launch.arena());
    const std::vector<double> z = widen(dz), ones(static_cast<std::size_t>(rows), 1);
    add(want_dx, plain_product(z, widen(next), rows, kNext, out, false, true));
    add(want_weight, plain_product(widen(y), z, out, rows, kNext, true));
    add(want_bias, plain_product(ones, z, 1, rows, kNext));
    EXPECT_EQ(near(dx, want_dx, tolerance, 1), "");
    EXPECT_EQ(near(d_weight, want_weight, 1e-5, 1), "");
    EXPECT_EQ(near(d_bias, want_bias, 1e-5, 1), "");
  }
}

TEST(CudaLayers, ForwardAndGradientsFollowTheFormulas) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t rows : {0, 1, 31, 33, 4097}) {
    for (const bool in_one : {false, true}) {
      expect_layer<float, float>(rows, 17, 40, in_one, 3e-6);
      expect_layer<Bf16, float>(rows, 24, 40, in_one, 3e-6);
      expect_layer<Bf16, Bf16>(rows, 24, 40, in_one, 8e-3);
      expect_layer<Bf16, Bf16>(rows, 64, 256, in_one, 8e-3);
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
      const std::vector<double> got = widen(wide), added = widen(sum);
      for (std::int64_t i = 0; i < rows * 8; ++i) {
        const auto from = static_cast<std::size_t>(i / 8 * 5 + i % 8);
        ASSERT_EQ(got[i], i % 8 < 5 ? rounded(values[from]) : 0) << i;
      }
      for (std::size_t i = 0; i < added.size(); ++i) ASSERT_EQ(added[i], others[i] + values[i]) << i;
      cuda::relu_backward<float>(in.view(), sum.view());
      const std::vector<double> masked = widen(sum);
      for (std::size_t i = 0; i < added.size(); ++i) ASSERT_EQ(masked[i], values[i] > 0 ? added[i] : 0) << i;
      const DeviceMatrix<float> sums(std::vector<float>(5, 1.0F), 5);
      cuda::add_column_sums<float>(in.view(), sums.view(), launch.arena());
      std::vector<double> want(5, 1.0);
      for (std::size_t i = 0; i < values.size(); ++i) want[i % 5] += values[i];
      const std::vector<float> got_sums = sums.read();
      for (std::size_t c = 0; c < 5; ++c) EXPECT_NEAR(got_sums[c], want[c], 1e-4);
      for (const DeviceMatrix<float>* m : {&in, &sum, &sums}) EXPECT_EQ(m->surroundings(), "");
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

// Heads and forms of fields on the device, against the CPU's.

using testing::DeviceField;
using testkit::Row;

// The class layer once per ray on the device against plain sums in float64: few classes and many take different
// kernels.

// tolerance: 1e-6 for products of fp32 numbers; 2e-3 where they are cut to TF32's 10 bits of mantissa.
std::string near_product(const DeviceMatrix<float>& got, const std::vector<double>& want, std::int64_t terms,
                         double tolerance) {
  return near(got, want, tolerance, std::sqrt(static_cast<double>(terms))) + got.surroundings();  // terms in [-1, 1]
}

TEST(CudaHead, ClassLayerAndItsGradients) {
  SEMFIELD_ON_DEVICE(launch);
  constexpr std::int32_t kFeature = 16;
  struct HeadShape {
    std::int64_t rays;
    std::int32_t hidden, classes;
    Precision precision = Precision::fp32;
  };
  for (const HeadShape& s :
       {HeadShape{1, 1, 1}, HeadShape{1000, 128, 29}, HeadShape{3000, 64, 128}, HeadShape{700, 64, 129},
        HeadShape{1000, 128, 512}, HeadShape{1000, 128, 29, Precision::bf16}, HeadShape{700, 64, 129, Precision::bf16},
        HeadShape{1000, 128, 512, Precision::bf16}}) {
    const bool cut = s.precision == Precision::bf16 && s.classes > 128;
    const double tolerance = cut ? 2e-3 : 1e-6;
    SCOPED_TRACE(std::to_string(s.rays) + " rays, hidden " + std::to_string(s.hidden) + ", classes " +
                 std::to_string(s.classes) + (s.precision == Precision::bf16 ? ", bf16" : ""));
    const OneLayerHead<float> head({kFeature, s.hidden, s.classes, s.precision}, cuda::head_kernels());
    StepContext ctx{.workspace = &launch.arena()};
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

    std::vector<double> want = plain_product(h, w, s.rays, s.hidden, s.classes);
    add(want, plain_product(share, b, s.rays, 1, s.classes));
    EXPECT_EQ(near_product(logits, want, s.hidden + 1, tolerance), "") << "logits";
    EXPECT_EQ(near_product(of_h, plain_product(g, w, s.rays, s.classes, s.hidden, false, true), s.classes, tolerance),
              "")
        << "d_h";
    EXPECT_EQ(near_product(of_share, plain_product(g, b, s.rays, s.classes, 1, false, true), s.classes, 1e-6), "")
        << "d_share";
    std::vector<double> of_w = plain_product(h, g, s.hidden, s.rays, s.classes, true);
    std::vector<double> of_b = plain_product(share, g, 1, s.rays, s.classes, true);
    add(of_w, {2});
    add(of_b, {3});
    EXPECT_EQ(near_product(grad_w, of_w, s.rays, tolerance), "") << "class weight";
    EXPECT_EQ(near_product(grad_b, of_b, s.rays, 1e-6), "") << "class bias";
  }
}

// Every form in which a field on the device hands its feature on, against the feature in full.

constexpr std::int64_t kRows = 333, kSemanticRows = 250;
constexpr std::int32_t kHidden = 128;

void expect_forms(const Field<float>& field, testkit::FieldBench<double>& bench) {
  const DeviceField plain(field, bench), other(field, bench);
  plain.derive();
  other.derive();
  plain.forward();
  std::vector<double> feature;
  for (const float value : plain.feature->read()) feature.push_back(rounded(value));
  const std::int32_t width = plain.feature->view().cols;
  ASSERT_NE(field.feature_form(kHidden), FeatureForm::full);
  FieldOut<float> out = other.out({true, true, false});
  {
    const DeviceMatrix<Bf16> room(kRows, width);
    out.fused.feature = testing::as_rounded(room.view());
    field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
    ASSERT_EQ(widen(room), feature);
    EXPECT_EQ(other.sigma->read(), plain.sigma->read());
    EXPECT_EQ(other.rgb->read(), plain.rgb->read());
    out.fused.feature = {};
  }
  if (field.feature_form(kHidden) != FeatureForm::hidden_layer) return;
  const std::vector<float> weights = random_floats(std::int64_t{width} * kHidden, 7, -0.1, 0.1);
  const std::vector<float> biases = random_floats(kHidden, 8, -0.1, 0.1);
  const DeviceMatrix<float> weight(weights, kHidden), bias(biases, kHidden);
  const DeviceMatrix<Bf16> hidden(kSemanticRows, kHidden);
  out.fused.hidden = testing::as_rounded(hidden.view());
  out.fused.layer.weight = weight.view();
  out.fused.layer.bias = bias.view();
  field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
  // [N, F] [F, H] of the rounded feature, plus the bias, cut at 0.
  std::vector<double> want = plain_product(feature, weights, kSemanticRows, width, kHidden);
  add(want, widen(biases));
  for (double& v : want) v = std::max(v, 0.0);
  EXPECT_EQ(near(hidden, want, 0.02) + hidden.surroundings(), "");
  EXPECT_EQ(other.sigma->read(), plain.sigma->read());
  EXPECT_EQ(other.rgb->read(), plain.rgb->read());
}

TEST(CudaFieldForms, AreTheFeatureInFull) {
  SEMFIELD_NEEDS_DEVICE();
  const KernelTables& tables = testing::all_kernels();
  int with_forms = 0;
  std::vector<Row> rows = testkit::rows_of(PluginKind::field);
  for (const std::string& name : testkit::linked_registry().names(PluginKind::field))
    rows.push_back({PluginKind::field, name, Device::cuda, -1, {}});  // as it ships: its fastest kernels
  for (const Row& row : rows) {
    if (!tables.has(Device::cuda, "field '" + row.name + "'", Precision::bf16)) continue;  // CudaConformance names it
    const PluginEntry& entry = testkit::linked_registry().get(PluginKind::field, row.name);
    const std::unique_ptr<PluginParams> params = testkit::make_params(entry, row.settings);
    FieldBuild build{.position_dims = 63, .direction_dims = 16};
    const std::unique_ptr<Field<double>> oracle = entry.field64(*params, build, tables);
    testkit::FieldBench<double> bench(*oracle, build, kRows, 0, {});
    build.device = Device::cuda;
    build.precision = Precision::bf16;
    const std::unique_ptr<Field<float>> field = entry.field32(*params, build, tables);
    if (field->feature_form(kHidden) == FeatureForm::full) continue;
    SCOPED_TRACE(row.text());
    expect_forms(*field, bench);
    ++with_forms;
  }
  EXPECT_GE(with_forms, 2);
}

// Hidden channels along rays on the device, kept as fp32 or bf16, against plain sums in float64; room for samples.

template <class Act>
class CudaHiddenChannels : public ::testing::Test {};
using Acts = ::testing::Types<float, Bf16>;
TYPED_TEST_SUITE(CudaHiddenChannels, Acts);

struct Rays {
  explicit Rays(const std::vector<int>& counts) : first{0} {
    for (const int count : counts) {
      ray.insert(ray.end(), static_cast<std::size_t>(count), static_cast<std::int32_t>(first.size()) - 1);
      first.push_back(static_cast<std::int32_t>(ray.size()));
    }
    used = static_cast<std::int64_t>(ray.size());
    ray.resize(ray.size() + kUnused, static_cast<std::int32_t>(counts.size()) - 1);
    rows = static_cast<std::int64_t>(ray.size());
    weight = random_floats(rows, 1, -0.5, 1);
    for (float& w : weight) w = w < 0 ? 0.F : w;  // a third has none
  }
  static constexpr std::size_t kUnused = 21;
  std::vector<std::int32_t> first, ray;
  std::vector<float> weight;
  std::int64_t used = 0, rows = 0;
};

// Sums of the first `labelled` rays, and gradients behind a ReLU or not.
template <class Act>
void expect_same(const Rays& rays, std::int32_t channels, int gap, std::int64_t labelled, bool relu_output) {
  SCOPED_TRACE(std::to_string(channels) + " channels, gap " + std::to_string(gap) + ", labelled " +
               std::to_string(labelled) + ", relu " + std::to_string(relu_output));
  const DeviceMatrix<std::int32_t> first(rays.first, 1), ray(rays.ray, 1);
  const DeviceMatrix<float> weight(rays.weight, 1, 2),
      d_out(random_floats(labelled * channels, 3, -1, 1), channels, channels + gap);
  const DeviceMatrix<Act> hidden(random_floats(rays.rows * channels, 2, -1, 1), channels, channels + gap);
  const DeviceMatrix<float> out(labelled, channels, channels + gap), dots(rays.rows, 1, 3);
  const DeviceMatrix<Act> d_hidden(rays.rows, channels, channels + gap);
  Samples<float> samples;
  samples.first = first.view();
  samples.ray_of_sample = ray.view();
  samples.count = rays.rows;
  cuda::HiddenBackward<Act> call{weight.read_only(), hidden.read_only(), d_out.read_only(),
                                 dots.view(),        d_hidden.view(),    relu_output};
  cuda::hidden_forward<Act>(samples, weight.read_only(), hidden.read_only(), out.view());
  cuda::hidden_backward<Act>(samples, call);

  const std::vector<double> h = widen(hidden), g = widen(d_out);
  std::vector<double> want_out(static_cast<std::size_t>(labelled * channels)), want_d(h.size());
  const std::vector<float> got_dots = dots.read();
  const std::int64_t live = rays.first[labelled];
  for (std::int64_t m = 0; m < live; ++m) {
    const auto r = static_cast<std::size_t>(rays.ray[m]);
    const auto w = static_cast<double>(rays.weight[m]);
    double dot = 0, terms = 0;
    for (std::int32_t c = 0; c < channels; ++c) {
      const auto at = static_cast<std::size_t>(m * channels + c);
      const auto of_ray = r * static_cast<std::size_t>(channels) + static_cast<std::size_t>(c);
      want_out[of_ray] += w * h[at];
      dot += g[of_ray] * h[at];
      terms += std::abs(g[of_ray] * h[at]);
      want_d[at] = relu_output && h[at] <= 0 ? 0 : w * g[of_ray];
    }
    ASSERT_NEAR(got_dots[m], dot, 3e-7 * terms) << m;
  }
  for (std::int64_t m = live; m < rays.rows; ++m)
    ASSERT_TRUE(std::isnan(got_dots[m])) << "row " << m << " is left alone";
  const std::vector<double> got_d = widen(d_hidden);
  EXPECT_EQ(near(out, want_out, 5e-6), "");
  const double rounding =
      std::is_same_v<Act, Bf16> ? 1.0 / 256 : 1e-7;  // half of a last bit: 2^-8 of a number just above a power of two
  for (std::size_t i = 0; i < got_d.size(); ++i)
    ASSERT_NEAR(got_d[i], want_d[i], rounding * std::abs(want_d[i])) << "element " << i;
  EXPECT_EQ(out.surroundings() + dots.surroundings() + d_hidden.surroundings(), "");
}

TYPED_TEST(CudaHiddenChannels, SumsAndGradients) {
  SEMFIELD_ON_DEVICE(launch);
  const Rays rays({31, 0, 1, 32, 33, 0, 0, 64, 127, 128, 129, 5, 300, 0});
  for (const std::int32_t channels : {1, 4, 29, 32, 36, 64, 100, 128, 132, 300}) {
    for (const int gap : {0, 1, 4, 8}) {
      for (const std::int64_t labelled : {0, 7, 14}) {
        for (const bool relu_output : {false, true}) expect_same<TypeParam>(rays, channels, gap, labelled, relu_output);
      }
    }
  }
}

TYPED_TEST(CudaHiddenChannels, GradientsInBlocksAreTheSame) {
  SEMFIELD_ON_DEVICE(launch);
  const Rays rays({31, 0, 64, 129, 5, 300});
  constexpr std::int32_t kChannels = 128;
  constexpr std::int64_t kLabelled = 4, kMore = 768;  // rows of gradients, more than of samples
  const DeviceMatrix<std::int32_t> first(rays.first, 1), ray(rays.ray, 1);
  const DeviceMatrix<float> weight(rays.weight, 1), d_out(random_floats(kLabelled * kChannels, 3, -1, 1), kChannels);
  const DeviceMatrix<TypeParam> hidden(random_floats(rays.rows * kChannels, 2, -1, 1), kChannels);
  const DeviceMatrix<TypeParam> in_rows(kMore, kChannels), in_blocks(kMore, kChannels);
  Samples<float> samples;
  samples.first = first.view();
  samples.ray_of_sample = ray.view();
  samples.count = rays.rows;
  cuda::HiddenBackward<TypeParam> call{
      weight.read_only(), hidden.read_only(), d_out.read_only(), {}, in_rows.view(), true};
  cuda::hidden_backward<TypeParam>(samples, call);
  call.d_hidden = in_blocks.view();
  call.blocked = true;
  cuda::hidden_backward<TypeParam>(samples, call);
  const std::vector<double> want = widen(in_rows), got = widen(in_blocks);
  for (std::int64_t m = 0; m < kMore; ++m) {
    for (std::int32_t c = 0; c < kChannels; ++c)
      ASSERT_EQ(got[(m / 8 * (kChannels / 8) + c / 8) * 64 + m % 8 * 8 + c % 8], want[m * kChannels + c])
          << m << ", " << c;
  }
  EXPECT_EQ(in_blocks.surroundings(), "");
}

TYPED_TEST(CudaHiddenChannels, ASampleWithoutWeightIsNotRead) {
  SEMFIELD_ON_DEVICE(launch);
  const std::vector<std::int32_t> offsets{0, 3};
  std::vector<float> values(3 * 64, 2.F);
  for (std::size_t i = 64; i < 128; ++i) values[i] = std::numeric_limits<float>::infinity();
  const DeviceMatrix<std::int32_t> first(offsets, 1);
  const DeviceMatrix<float> weight(std::vector<float>{0.25F, 0, 0.5F}, 1), out(1, 64);
  const DeviceMatrix<TypeParam> hidden(values, 64);
  Samples<float> samples{.first = first.view()};
  cuda::hidden_forward<TypeParam>(samples, weight.read_only(), hidden.read_only(), out.view());
  EXPECT_EQ(out.read(), std::vector<float>(64, 1.5F));
}

// Room for samples on a device: how it follows what steps use, and that a step with too little of it is made again.

using namespace testing_train;
using cuda::SampleRoom;

TEST(SampleRoom, FollowsWhatStepsUseWithAQuarterToSpare) {
  constexpr std::int64_t kMost = 8192 * 1024;
  SampleRoom room;
  room.begin(kMost);
  EXPECT_EQ(room.rows(), 0);
  EXPECT_FALSE(room.saw(kMost));
  EXPECT_EQ(room.rows(), 0);
  EXPECT_TRUE(room.saw(200'000));
  const std::int64_t first = room.rows();
  EXPECT_GE(first, 250'000);
  EXPECT_LE(first, 285'000);
  EXPECT_FALSE(room.saw(180'000));  // hardly less
  EXPECT_FALSE(room.saw(230'000));
  EXPECT_EQ(room.rows(), first);
  EXPECT_TRUE(room.saw(first - 1000));  // the next step might need more
  EXPECT_GT(room.rows(), first);
  EXPECT_TRUE(room.saw(100));
  EXPECT_EQ(room.rows(), 8192);
  EXPECT_TRUE(room.saw(kMost - 1));
  EXPECT_EQ(room.rows(), 0);
}

TEST(SampleRoom, OfASamplerThatUsesItAllIsNeverLess) {
  SampleRoom room;
  room.begin(0);
  EXPECT_FALSE(room.saw(10));
  EXPECT_EQ(room.rows(), 0);
}

std::string roomy_config() {
  std::string yaml = hash_config();
  return yaml.replace(yaml.find("max_samples: 96"), 15, "max_samples: 512, step_m: 0.1");
}

struct Subject : TestRun {
  Subject(const std::string& more, Registry& registry)
      : TestRun(roomy_config() + "runtime: {device: cuda" + more + "}\n", registry) {}
  SampleRoom& room() { return dynamic_cast<cuda::StreamExecutor&>(session.pipeline->executor()).sample_room(); }
};

// Several steps are queued; room is short from the first, and later ones change nothing until it is made again.
TEST(CudaSampleRoom, AStepWithTooLittleIsMadeAgainToTheSameBits) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject plain(", deterministic: true", registry), limited(", deterministic: true", registry);
  for (const std::int64_t given : {64, 300}) {
    limited.room().give(given);
    const std::span<const StepLosses> a = plain.trainer.advance(2);
    const std::vector<StepLosses> want(a.begin(), a.end());
    const std::span<const StepLosses> got = limited.trainer.advance(2);
    ASSERT_EQ(got.size(), want.size());
    for (std::size_t i = 0; i < got.size(); ++i) {
      EXPECT_GT(want[i].samples, 8 * given);
      EXPECT_EQ(got[i].samples, want[i].samples);
      EXPECT_EQ(got[i].total, want[i].total);
    }
    EXPECT_EQ(limited.trainer.step(), plain.trainer.step());
    limited.trainer.collect();
    plain.trainer.collect();
    EXPECT_EQ(limited.bits(), plain.bits());
    EXPECT_EQ(limited.room().rows(), 0);
  }
}

TEST(CudaSampleRoom, ShrinksWhereMostIsUnusedAndTrainingGoesOn) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  Subject run(", precision: bf16", registry), exact(", precision: bf16, deterministic: true", registry);
  double color = 0, same = 0;
  while (run.trainer.step() < 160) {
    for (const StepLosses& losses : run.trainer.advance(160 - run.trainer.step())) color = losses.color;
    for (const StepLosses& losses : exact.trainer.advance(run.trainer.step() - exact.trainer.step()))
      same = losses.color;
  }
  EXPECT_GT(run.room().rows(), 0);
  EXPECT_LT(run.room().rows(), 192 * 512);
  EXPECT_EQ(exact.room().rows(), 0);
  EXPECT_LT(std::abs(color - same), 0.3 * same);
}

// Most samples lie in the dark; light is left out below rounding. What steps see is then what all samples make.
TEST(CudaSampleRoom, SamplesInTheDarkAreLeftOutAndHaveRoomOfTheirOwn) {
  SEMFIELD_NEEDS_DEVICE();
  Registry registry = make_registry();
  const std::string dense = replaced(roomy_config(), "rendering: {", "rendering: {density_bias: 15, unit_m: 0.25, ");
  TestRun all(dense + "runtime: {device: cuda}\n", registry);
  TestRun reached(replaced(dense, "rendering: {", "rendering: {training_stop: 1e-9, ") + "runtime: {device: cuda}\n",
                  registry);
  const StepLosses want = all.to(1), got = reached.to(1);
  EXPECT_NEAR(got.total, want.total, 1e-5 * want.total);
  EXPECT_LT(2 * got.samples, want.samples);
  const StepLosses later = reached.to(160), without = all.to(160);
  EXPECT_LT(std::abs(later.color - without.color), 0.3 * without.color);
}

}  // namespace
}  // namespace semfield
