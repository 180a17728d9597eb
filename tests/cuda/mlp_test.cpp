// Networks with every kind of layer, heads and forms of fields on the device, against the CPU's.
#include <algorithm>

#include "cuda/kernel_tables.h"
#include "cuda/stages.h"
#include "device_field.h"
#include "device_fixture.h"
#include "execution/device_library.h"
#include "plugin/head.h"
#include "testkit/compare.h"
#include "tests/conformance/builds.h"
#include "tests/plugin/mlp_network.h"

namespace semfield {
namespace {

using testing::DeviceField;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::host_view;
using testing::random_floats;
using testkit::Row;

using namespace testing_mlp;

template <class Real>
std::vector<Real> numbers(std::int64_t count, double phase) {
  std::vector<Real> values;
  for (std::int64_t i = 0; i < count; ++i)
    values.push_back(static_cast<float>(std::sin(phase + 1.7 * static_cast<double>(i))));
  return values;
}
template <class Real>
std::vector<double> flat(View<const Real> view) {
  return {view.data, view.data + view.size()};
}
template <class Real>
std::string near(const DeviceMatrix<float>& got, View<const Real> want, double tolerance) {
  const std::vector<double> values = flat<Real>(want);
  return testing::near_norm(got, host_view(values, want.cols), tolerance);
}

template <class T>
using Matrices = std::vector<std::unique_ptr<DeviceMatrix<T>>>;

/// Against the CPU's in float64, or in bf16, which rounds the same numbers.
template <class Real>
void expect_twin(bool fold, bool rays_once, std::int64_t samples, double output, double gradient) {
  constexpr Precision kPrecision = std::is_same_v<Real, float> ? Precision::bf16 : Precision::fp32;
  SCOPED_TRACE("fold " + std::to_string(fold) + ", once per ray " + std::to_string(rays_once) + ", " +
               std::to_string(samples) + " samples");
  static const KernelTables cpu = testing::tables_of({mlp_kernels}), gpu = testing::tables_of({cuda::add_mlp_kernels});
  const Mlp<Real> host = everything<Real>(build_of(fold, rays_once, kPrecision), cpu);
  const Mlp<float> device = everything<float>(build_of(fold, rays_once, kPrecision, Device::cuda), gpu);
  const testkit::TensorBox<Real> box(host, 1);
  if (kPrecision == Precision::bf16) {  // the device rounds biases too
    for (std::size_t i = 0; i < box.count(); ++i) {
      if (!box.specs()[i].name.ends_with("/bias")) continue;
      const View<Real> bias = box.value(i);
      for (std::int32_t c = 0; c < bias.cols; ++c)
        bias(0, c) = __bfloat162float(__float2bfloat16(static_cast<float>(bias(0, c))));
    }
  }
  const std::vector<Real> x = numbers<Real>(samples * kIn, 0), rays = numbers<Real>(kRays * kRay, 2);
  std::vector<std::int32_t> ray_of;
  for (std::int64_t m = 0; m < samples; ++m) ray_of.push_back(static_cast<std::int32_t>(m * kRays / samples));

  Workspace arena;
  std::vector<Real> outputs[3], weights[3], dx(x.size());
  std::vector<MlpOut<Real>> out(3);
  std::vector<MlpGrad<Real>> grad(3);
  for (std::size_t k = 0; k < 3; ++k) {
    outputs[k].resize(static_cast<std::size_t>(samples * kOut[k]));
    weights[k] = numbers<Real>(samples * kOut[k], 3 + static_cast<double>(k));
    for (Real& weight : weights[k]) weight += 1;  // all of one sign: sums that cancel are their roundings
    out[k].rows = {outputs[k].data(), samples, kOut[k]};
    grad[k].rows = {weights[k].data(), samples, kOut[k]};
  }
  const MlpIn<Real> in{{x.data(), samples, kIn}, {rays.data(), kRays, kRay}, {ray_of.data(), samples, 1}};
  const Saved saved(arena.take_bytes(host.saved_bytes(samples)), host.saved_bytes(samples));
  host.derive({}, box.tensors());
  host.forward(arena, box.tensors(), in, out, saved);
  host.backward(arena, box.tensors(), in, out, grad, saved, {dx.data(), samples, kIn});
  host.derive_backward({}, box.tensors());

  DeviceLaunch launch;
  Matrices<float> values, grads, outs, out_weights;
  std::vector<View<float>> value_views, grad_views;
  const testkit::TensorBox<float> specs(device, 1);
  for (std::size_t i = 0; i < specs.count(); ++i) {
    ASSERT_EQ(specs.specs()[i].name, box.specs()[i].name);
    values.push_back(std::make_unique<DeviceMatrix<float>>(flat<Real>(box.value(i)), box.value(i).cols));
    grads.push_back(std::make_unique<DeviceMatrix<float>>(
        std::vector<float>(static_cast<std::size_t>(box.value(i).size())), box.value(i).cols));
    value_views.push_back(values.back()->view());
    grad_views.push_back(grads.back()->view());
  }
  const Tensors<float> tensors{value_views, grad_views};
  const DeviceMatrix<float> x_there(flat<Real>(host_view(x, kIn)), kIn),
      rays_there(flat<Real>(host_view(rays, kRay)), kRay), dx_there(samples, kIn);
  const DeviceMatrix<std::int32_t> ray_there(ray_of, 1);
  const MlpIn<float> in_there{x_there.view(), rays_there.view(), ray_there.view()};
  std::vector<MlpOut<float>> out_there(3);
  std::vector<MlpGrad<float>> grad_there(3);
  for (std::size_t k = 0; k < 3; ++k) {
    outs.push_back(std::make_unique<DeviceMatrix<float>>(samples, kOut[k], kOut[k] + 3));
    out_weights.push_back(std::make_unique<DeviceMatrix<float>>(flat<Real>(host_view(weights[k], kOut[k])), kOut[k]));
    out_there[k].rows = outs[k]->view();
    grad_there[k].rows = out_weights[k]->view();
  }
  const std::size_t bytes = device.saved_bytes(samples);
  const Saved saved_there(launch.arena().take_bytes(bytes), bytes);
  device.derive({}, tensors);
  device.forward(launch.arena(), tensors, in_there, out_there, {});
  for (const auto& rows : outs) EXPECT_EQ(rows->surroundings(), "");
  device.forward(launch.arena(), tensors, in_there, out_there, saved_there);
  device.backward(launch.arena(), tensors, in_there, out_there, grad_there, saved_there, dx_there.view());
  device.derive_backward({}, tensors);

  for (std::size_t k = 0; k < 3; ++k) EXPECT_EQ(near<Real>(*outs[k], out[k].rows, output), "") << "output " << k;
  EXPECT_EQ(near<Real>(dx_there, host_view(dx, kIn), gradient), "");
  for (std::size_t i = 0; i < specs.count(); ++i) {
    if (!is_learned(specs.specs()[i].role)) continue;
    EXPECT_EQ(near<Real>(*grads[i], box.grad(i), gradient), "") << specs.specs()[i].name;
  }
}

TEST(CudaMlp, IsTheCpusForEverySwitchAndSize) {
  SEMFIELD_NEEDS_DEVICE();
  for (const bool fold : {true, false}) {
    for (const bool rays_once : {true, false}) {
      for (const std::int64_t samples : {1, 33, 1030}) {
        expect_twin<double>(fold, rays_once, samples, 2e-5, 2e-4);
        if (!fold) expect_twin<float>(fold, rays_once, samples, 5e-3, 5e-2);  // a product's bias is rounded there alone
      }
    }
  }
}

// The class layer once per ray on the device against plain sums in float64: few classes and many take different
// kernels.

// x [n, k] (or its transpose, with `turned`) times y [., m].
std::vector<double> product(const std::vector<float>& x, const std::vector<float>& y, std::int64_t n, std::int64_t k,
                            std::int64_t m, bool turned, bool y_turned) {
  std::vector<double> sum(static_cast<std::size_t>(n * m));
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t t = 0; t < k; ++t) {
      const double a = x[turned ? t * n + i : i * k + t];
      for (std::int64_t j = 0; j < m; ++j) sum[i * m + j] += a * y[y_turned ? j * k + t : t * m + j];
    }
  }
  return sum;
}

// tolerance: 1e-6 for products of fp32 numbers; 2e-3 where they are cut to TF32's 10 bits of mantissa.
std::string near_product(const DeviceMatrix<float>& got, const std::vector<double>& want, std::int64_t terms,
                         double tolerance) {
  const std::vector<float> values = got.read();
  const auto cols = static_cast<std::int32_t>(got.view().cols);
  const double floor = std::sqrt(static_cast<double>(terms));  // terms lie in [-1, 1]
  return testkit::compare<float, double>(host_view(values, cols), host_view(want, cols), tolerance, floor) +
         got.surroundings();
}

TEST(CudaHead, ClassLayerAndItsGradients) {
  SEMFIELD_ON_DEVICE(launch);
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

    std::vector<double> want = product(h, w, s.rays, s.hidden, s.classes, false, false);
    for (std::size_t i = 0; i < want.size(); ++i) {
      const auto classes = static_cast<std::size_t>(s.classes);
      want[i] += double{share[i / classes]} * b[i % classes];
    }
    EXPECT_EQ(near_product(logits, want, s.hidden + 1, tolerance), "") << "logits";
    EXPECT_EQ(near_product(of_h, product(g, w, s.rays, s.classes, s.hidden, false, true), s.classes, tolerance), "")
        << "d_h";
    EXPECT_EQ(near_product(of_share, product(g, b, s.rays, s.classes, 1, false, true), s.classes, 1e-6), "")
        << "d_share";
    std::vector<double> of_w = product(h, g, s.hidden, s.rays, s.classes, true, false);
    std::vector<double> of_b = product(share, g, 1, s.rays, s.classes, true, false);
    for (double& x : of_w) x += 2;
    for (double& x : of_b) x += 3;
    EXPECT_EQ(near_product(grad_w, of_w, s.rays, tolerance), "") << "class weight";
    EXPECT_EQ(near_product(grad_b, of_b, s.rays, 1e-6), "") << "class bias";
  }
}

// Every form in which a field on the device hands its feature on, against the feature in full.

constexpr std::int64_t kRows = 333, kSemanticRows = 250;
constexpr std::int32_t kHidden = 128;

double value_of(__nv_bfloat16 number) { return static_cast<double>(__bfloat162float(number)); }

// [N, F] [F, H] of the rounded feature, plus the bias, cut at 0.
std::vector<double> hidden_of(const std::vector<float>& feature, const std::vector<float>& weight,
                              const std::vector<float>& bias) {
  const std::size_t width = weight.size() / kHidden;
  std::vector<double> out;
  for (std::size_t m = 0; m < kSemanticRows; ++m) {
    for (std::size_t h = 0; h < kHidden; ++h) {
      double sum = static_cast<double>(bias[h]);
      for (std::size_t f = 0; f < width; ++f)
        sum += value_of(__float2bfloat16(feature[m * width + f])) * static_cast<double>(weight[f * kHidden + h]);
      out.push_back(std::max(sum, 0.0));
    }
  }
  return out;
}

void expect_forms(const Field<float>& field, testkit::FieldBench<double>& bench) {
  const DeviceField plain(field, bench), other(field, bench);
  plain.derive();
  other.derive();
  plain.forward();
  const std::vector<float> feature = plain.feature->read();
  const std::int32_t width = plain.feature->view().cols;
  ASSERT_NE(field.feature_form(kHidden), FeatureForm::full);
  FieldOut<float> out = other.out({true, true, false});
  {
    const DeviceMatrix<__nv_bfloat16> room(kRows, width);
    out.fused.feature = testing::as_rounded(room.view());
    field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
    const std::vector<__nv_bfloat16> got = room.read();
    for (std::size_t i = 0; i < got.size(); ++i)
      ASSERT_EQ(value_of(got[i]), value_of(__float2bfloat16(feature[i]))) << i;
    EXPECT_EQ(other.sigma->read(), plain.sigma->read());
    EXPECT_EQ(other.rgb->read(), plain.rgb->read());
    out.fused.feature = {};
  }
  if (field.feature_form(kHidden) != FeatureForm::hidden_layer) return;
  const std::vector<float> weights = testing::random_floats(std::int64_t{width} * kHidden, 7, -0.1, 0.1);
  const std::vector<float> biases = testing::random_floats(kHidden, 8, -0.1, 0.1);
  const DeviceMatrix<float> weight(weights, kHidden), bias(biases, kHidden);
  const DeviceMatrix<__nv_bfloat16> hidden(kSemanticRows, kHidden);
  out.fused.hidden = testing::as_rounded(hidden.view());
  out.fused.layer.weight = weight.view();
  out.fused.layer.bias = bias.view();
  field.forward(other.ctx, other.tensors(), other.in(), out, other.space());
  std::vector<double> got;
  for (const __nv_bfloat16 number : hidden.read()) got.push_back(value_of(number));
  const std::vector<double> want = hidden_of(feature, weights, biases);
  const double largest = *std::max_element(want.begin(), want.end());
  for (std::size_t i = 0; i < want.size(); ++i) ASSERT_NEAR(got[i], want[i], 0.02 * largest) << i;
  EXPECT_EQ(hidden.surroundings(), "");
  EXPECT_EQ(other.sigma->read(), plain.sigma->read());
  EXPECT_EQ(other.rgb->read(), plain.rgb->read());
}

TEST(CudaFieldForms, AreTheFeatureInFull) {
  SEMFIELD_NEEDS_DEVICE();
  KernelTables tables = testkit::linked_registry().kernels();
  cuda_library().add_kernels(tables);
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

}  // namespace
}  // namespace semfield
