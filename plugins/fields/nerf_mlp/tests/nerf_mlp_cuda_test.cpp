// The big network on the device: against the CPU's in float64 for every switch, output and width, and its fused
// kernels.

#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "fields/nerf_mlp/nerf_mlp_fused_kernels.cuh"
#include "plugins/fields/nerf_mlp/tests/fused_fixture.h"
#include "testkit/compare.h"
#include "tests/cuda/device_fixture.h"

namespace semfield {
namespace {

using testing::all_kernels;
using testing::DeviceField;
using testing::near_norm;
using namespace testkit;

struct Network {
  NerfMlpParams params;
  std::int32_t position_dims = 63, direction_dims = 27;
  bool fold = true, once = true;
  Precision precision = Precision::fp32;

  FieldBuild build(Device device) const {
    return FieldBuild{.device = device,
                      .position_dims = position_dims,
                      .direction_dims = direction_dims,
                      .savings = {.fold_feature_layer = fold, .direction_once_per_ray = once},
                      .precision = device == Device::cpu ? Precision::fp32 : precision};
  }
  std::string text() const {
    ::testing::Message text;
    text << params.depth << " x " << params.width << ", skip " << params.skip_at << ", view " << params.view_width
         << ", position " << position_dims << ", direction " << direction_dims << ", fold " << fold << ", once " << once
         << ", bf16 " << (precision == Precision::bf16);
    return text.GetString();
  }
};

const NerfMlpParams kSmall{4, 12, 2, 9};

/// With every saving, in bf16, as the fused kernels take it.
Network in_bf16(const NerfMlpParams& params = {}, std::int32_t position_dims = 63, std::int32_t direction_dims = 27) {
  return {params, position_dims, direction_dims, true, true, Precision::bf16};
}

std::string text_of(const Wanted& wanted) {
  return ", sigma " + std::to_string(wanted.sigma) + ", rgb " + std::to_string(wanted.rgb) + ", feature " +
         std::to_string(wanted.feature);
}

/// A float64 network on the CPU with its inputs, and the same on the device.
struct Pair {
  Pair(const Network& network, std::int64_t samples, std::int32_t padding = 0)
      : cpu(network.params, network.build(Device::cpu), all_kernels()),
        bench(cpu, network.build(Device::cpu), samples, 0, {}),
        gpu(network.params, network.build(Device::cuda), all_kernels()),
        device(gpu, bench, padding),
        bf16(network.precision == Precision::bf16) {
    bench.derive();
    device.derive();
  }
  // bf16: as the field laws of the CPU, whose reasons testkit/laws.h gives.
  double output() const { return bf16 ? 0.02 : 2e-5; }
  double gradient() const { return bf16 ? 0.25 : 2e-4; }

  void expect_outputs(Wanted wanted = {}) { testing::expect_outputs_near(device, bench, output(), 1e-30, wanted); }
  void expect_gradients(bool with_d_position) {
    if (with_d_position) {
      EXPECT_EQ(near_norm(*device.d_position, bench.d_position.view(), gradient()), "") << "d_position";
      EXPECT_EQ(device.d_position->surroundings(), "");
    }
    testing::expect_gradients_near(device, bench, gradient());
  }

  NerfMlp<double> cpu;
  FieldBench<double> bench;
  NerfMlp<float> gpu;
  DeviceField device;
  bool bf16;
};

void expect_twin(const Network& network, std::int64_t samples, std::int32_t padding = 0, bool with_d_position = true) {
  SCOPED_TRACE(network.text() + ", " + std::to_string(samples) + " samples, padding " + std::to_string(padding));
  Pair pair(network, samples, padding);
  pair.bench.forward();
  pair.bench.backward({}, with_d_position);
  pair.device.forward();
  pair.device.backward({}, with_d_position);
  if (samples == 0) return;
  pair.expect_outputs();
  pair.expect_gradients(with_d_position);
}

constexpr Precision kPrecisions[] = {Precision::fp32, Precision::bf16};

using CudaNerfMlp = testing::DeviceTest;

TEST_F(CudaNerfMlp, IsTheCpusNetworkForEverySwitchAndSize) {
  for (const Precision precision : kPrecisions) {
    for (const bool fold : {true, false}) {
      for (const bool once : {true, false}) expect_twin({kSmall, 7, 5, fold, once, precision}, 33, 3);
    }
    for (const std::int64_t samples : {0, 1, 31, 257}) expect_twin({kSmall, 7, 5, true, true, precision}, samples);
    expect_twin({kSmall, 7, 0, true, true, precision}, 33);
    expect_twin({{3, 8, 0, 5}, 6, 3, true, true, precision}, 33);
    expect_twin({{1, 8, 0, 4}, 6, 3, true, true, precision}, 33);
    expect_twin({{2, 70, 1, 33}, 9, 4, true, true, precision}, 65);
  }
}

TEST_F(CudaNerfMlp, IsTheCpusNetworkInThePapersShape) {
  for (const Precision precision : kPrecisions) {
    for (const std::int64_t samples : {1, 33, 257, 1025})
      expect_twin({{}, 63, 27, true, true, precision}, samples, 0, false);
    expect_twin({{}, 63, 27, true, true, precision}, 130, 1, true);
    expect_twin({{}, 63, 0, true, true, precision}, 130, 0, false);
    expect_twin({{}, 60, 16, false, false, precision}, 130, 4, false);
  }
}

TEST_F(CudaNerfMlp, OutputsAndGradientsThatAreAbsentChangeNoOther) {
  for (const Precision precision : kPrecisions) {
    for (const NerfMlpParams& params : {kSmall, NerfMlpParams{}}) {
      for (const Wanted wanted : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true},
                                  Wanted{true, true, false}, Wanted{false, false, false}}) {
        const Network network{params, 63, 27, true, true, precision};
        SCOPED_TRACE(network.text() + text_of(wanted));
        Pair pair(network, 130);
        pair.bench.forward();
        pair.device.forward(wanted, false);
        pair.expect_outputs(wanted);
        pair.device.forward();
        pair.bench.backward(wanted);
        pair.device.backward(wanted);
        pair.expect_gradients(true);
      }
    }
  }
}

// The big network through its fused kernels, against the CPU's and against the layers one by one.

using testing::DeviceMatrix;

const KernelTables& layer_tables() {
  static const KernelTables tables = [] {
    KernelTables layers;
    cuda::add_mlp_kernels(layers);
    return layers;
  }();
  return tables;
}

/// The fused kernels and the layers one by one, from the same inputs.
void expect_same_network(const Network& network, std::int64_t samples, const Wanted& wanted = {},
                         std::int32_t padding = 0) {
  SCOPED_TRACE(network.text() + ", " + std::to_string(samples) + " samples" + text_of(wanted));
  Pair pair(network, samples, padding);
  const DeviceField& fused = pair.device;
  const NerfMlp<float> layered(network.params, network.build(Device::cuda), layer_tables());
  const DeviceField layers(layered, pair.bench, padding);
  layers.derive();
  for (const DeviceField* one : {&fused, &layers}) {
    one->forward();
    one->backward(wanted);
  }
  // A unit within rounding of zero may fall on either side of its ReLU (testkit/laws.h), in either of the two.
  constexpr double kOutput = 0.02, kGradient = 0.25;
  EXPECT_EQ(near_norm(*fused.sigma, *layers.sigma, kOutput), "") << "sigma";
  EXPECT_EQ(near_norm(*fused.rgb, *layers.rgb, kOutput), "") << "rgb";
  EXPECT_EQ(near_norm(*fused.feature, *layers.feature, kOutput), "") << "feature";
  EXPECT_EQ(near_norm(*fused.d_position, *layers.d_position, kGradient), "") << "d_position";
  testing::expect_gradients_near(fused, pair.bench, kGradient,
                                 [&](std::size_t i) -> const DeviceMatrix<float>& { return *layers.grads[i]; });
  for (const auto* m : {&fused.sigma, &fused.rgb, &fused.feature, &fused.d_position})
    EXPECT_EQ((*m)->surroundings(), "");
}

TEST(CudaNerfMlpFused, IsTheNetworkOfTheLayersOneByOne) {
  SEMFIELD_NEEDS_FUSED();
  for (const std::int64_t samples : {1, 63, 257, 40000}) expect_same_network(in_bf16(), samples);
  expect_same_network(in_bf16({}, 60, 0), 257);
  expect_same_network(in_bf16({2, 256, 0, 128}, 64, 16), 130, {}, 3);
  expect_same_network(in_bf16({3, 256, 1, 128}, 7, 3), 130);
  expect_same_network(in_bf16({15, 256, 14, 128}), 130);
  for (const Wanted& wanted : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true}})
    expect_same_network(in_bf16(), 130, wanted);
}

TEST(CudaNerfMlpFused, IsTheCpusNetworkAndRepeatsBitForBit) {
  SEMFIELD_NEEDS_FUSED();
  Pair pair(in_bf16(), 1025);
  pair.bench.forward();
  pair.bench.backward({}, false);
  const DeviceField& device = pair.device;
  std::vector<std::vector<float>> first;
  std::vector<float> sigma, rgb;
  for (int run = 0; run < 3; ++run) {
    device.clear_gradients();
    device.forward();
    device.backward({}, false);
    if (run == 0) first = device.gradients(), sigma = device.sigma->read(), rgb = device.rgb->read();
    EXPECT_EQ(device.gradients(), first) << "run " << run;
  }
  pair.expect_outputs();
  pair.expect_gradients(false);
  // Rows are the same alone as in the batch, and with nothing saved.
  device.forward({}, false);
  EXPECT_EQ(device.sigma->read(), sigma);
  EXPECT_EQ(device.rgb->read(), rgb);
  FieldIn<float> in = device.in();
  in.position = in.position.row_range(200, 300);
  in.ray_of_sample = in.ray_of_sample.row_range(200, 300);
  const DeviceMatrix<float> few(300, 1);
  FieldOut<float> out{.sigma = few.view()};
  pair.gpu.forward(device.ctx, device.tensors(), in, out, {});
  EXPECT_EQ(few.read(), std::vector<float>(sigma.begin() + 200, sigma.begin() + 500));
}

// The fused kernels of the big network, one by one: every layer against plain loops over what the layer before left.
// Only GPUs of compute capability 9.0 run them.

using testing::DeviceLaunch;
using testing::random_floats;
using Bf16 = __nv_bfloat16;

double rounded(double x) { return __bfloat162float(Bf16(static_cast<float>(x))); }

/// Rows of a blocked matrix: 8 x 8 blocks one behind the other.
std::vector<double> rows_of(const std::vector<Bf16>& blocked, std::int64_t rows, int cols) {
  std::vector<double> result;
  for (std::int64_t m = 0; m < rows; ++m) {
    for (int c = 0; c < cols; ++c)
      result.push_back(__bfloat162float(blocked[(m / 8 * (cols / 8) + c / 8) * 64 + m % 8 * 8 + c % 8]));
  }
  return result;
}
std::vector<Bf16> part(const DeviceMatrix<Bf16>& all, std::int64_t begin, std::int64_t count) {
  const std::vector<Bf16> values = all.read();
  return {values.begin() + begin, values.begin() + begin + count};
}

/// x [M, k] times the k rows of w [any, n] from `first` on, rounded to bf16, added to `sum`.
void add_product(const std::vector<double>& x, int k, const std::vector<float>& w, int n, int first, bool transposed,
                 std::vector<double>& sum) {
  const std::size_t rows = x.size() / static_cast<std::size_t>(k);
  for (std::size_t m = 0; m < rows; ++m) {
    for (int i = 0; i < k; ++i) {
      const double value = x[m * static_cast<std::size_t>(k) + static_cast<std::size_t>(i)];
      if (value == 0) continue;
      const auto out = static_cast<int>(sum.size() / rows);
      for (int j = 0; j < out; ++j) {
        const auto at = transposed ? (first + j) * n + i : (first + i) * n + j;
        sum[m * static_cast<std::size_t>(out) + static_cast<std::size_t>(j)] += value * rounded(w[at]);
      }
    }
  }
}

/// A network of three layers, the position again at the last, with every buffer that forward and backward use.
struct Small {
  static constexpr int kDepth = 3, kRays = 9;
  static constexpr std::int64_t kRows = 300, kBlocks = 8, kAll = kBlocks * 64;
  static constexpr std::int64_t kSemantic = 201, kSemanticBlocks = 4;  // rows that have the semantic layer
  std::vector<float> x = random_floats(kRows * 63, 1, -1, 1);
  std::vector<float> w[kDepth] = {random_floats(63 * 256, 2, -0.2, 0.2), random_floats(256 * 256, 3, -0.1, 0.1),
                                  random_floats(319 * 256, 4, -0.1, 0.1)};
  std::vector<float> b[kDepth] = {random_floats(256, 5, -0.1, 0.1), random_floats(256, 6, -0.1, 0.1),
                                  random_floats(256, 7, -0.1, 0.1)};
  std::vector<float> wv = random_floats(256 * 128, 8, -0.1, 0.1), wc = random_floats(128 * 3, 9, -0.2, 0.2);
  std::vector<float> bc = random_floats(3, 10, -1, 1), wd = random_floats(256, 11, -0.1, 0.1);
  std::vector<float> ws = random_floats(256 * 128, 14, -0.1, 0.1), bs = random_floats(128, 15, -0.3, 0.3);
  std::vector<float> bd = random_floats(1, 12, -1, 1), terms = random_floats(kRays * 128, 13, -0.2, 0.2);
  std::vector<std::int32_t> ray;

  DeviceLaunch launch;
  DeviceMatrix<float> d_x{x, 63}, d_w0{w[0], 256}, d_w1{w[1], 256}, d_w2{w[2], 256}, d_wv{wv, 128}, d_wc{wc, 3};
  DeviceMatrix<float> d_b0{b[0], 256}, d_b1{b[1], 256}, d_b2{b[2], 256}, d_bc{bc, 3}, d_wd{wd, 1}, d_bd{bd, 1};
  DeviceMatrix<float> d_terms{terms, 128}, d_ws{ws, 128}, d_bs{bs, 128};
  DeviceMatrix<Bf16> semantic{kSemantic, 128};
  DeviceMatrix<Bf16> position{kAll, 64}, trunk{kDepth * kAll, 256}, hidden{kAll, 128}, d_trunk{kDepth * kAll, 256};
  DeviceMatrix<Bf16> d_hidden{kAll, 128};
  DeviceMatrix<std::uint32_t> trunk_mask{kDepth * kBlocks * 128, 4}, hidden_mask{kBlocks * 128, 2};
  DeviceMatrix<float> sigma{kRows, 1}, rgb{kRows, 3}, feature{kRows, 256};
  DeviceMatrix<Bf16> rounded_feature{kRows, 256};
  DeviceMatrix<std::byte> slabs{std::int64_t{1} << 21, 1};

  static std::vector<std::int32_t> rays() {
    std::vector<std::int32_t> values;
    for (std::int64_t m = 0; m < kRows; ++m) values.push_back(static_cast<std::int32_t>(m / 50 + (m >= 100 ? 2 : 0)));
    return values;
  }
  Small() : ray(rays()), rays_on_device(ray, 1) {
    cuda::fused::pack_position(d_x.view(), kBlocks, position.data());
    std::array<cuda::fused::Slabs, cuda::fused::kMostSlabs> all;
    all[0] = {d_w0.view(), false, 256, 1};
    all[1] = {d_w1.view(), false, 256, 4};
    all[2] = {d_w2.view().row_range(0, 63), false, 256, 1};
    all[3] = {d_w2.view().row_range(63, 256), false, 256, 4};
    all[4] = {d_wv.view(), false, 256, 4, d_ws.view()};
    EXPECT_LE(cuda::fused::slab_bytes(all, 5), static_cast<std::size_t>(slabs.view().rows));
    cuda::fused::pack_slabs(all, 5, slabs.data());
    cuda::fused::Forward call;
    call.rows = kRows, call.blocks = kBlocks, call.depth = kDepth, call.skip_at = 2;
    call.weights = slabs.data(), call.position = position.data();
    call.bias = {d_b0.data(), d_b1.data(), d_b2.data()};
    call.density_weight = d_wd.data(), call.density_bias = d_bd.data();
    call.color_weight = d_wc.data(), call.color_bias = d_bc.data();
    call.ray_term = d_terms.view(), call.ray_of_sample = rays_on_device.view();
    call.trunk = trunk.data(), call.hidden = hidden.data();
    call.trunk_mask = reinterpret_cast<uint4*>(trunk_mask.data());
    call.hidden_mask = reinterpret_cast<uint2*>(hidden_mask.data());
    call.sigma = sigma.view(), call.rgb = rgb.view(), call.feature = feature.view();
    call.rounded_feature = rounded_feature.view();
    call.semantic = semantic.view(), call.semantic_bias = d_bs.data();
    cuda::fused::forward(call);
    cuda::check(cudaDeviceSynchronize(), "the fused forward");
  }
  std::vector<double> layer(const DeviceMatrix<Bf16>& of, int i) const {
    return rows_of(part(of, i * kAll * 256, kAll * 256), kRows, 256);
  }
  DeviceMatrix<std::int32_t> rays_on_device;
};

std::string compare(const std::vector<double>& got, const std::vector<double>& want, int cols, double tolerance) {
  return testkit::compare<double, double>(testing::host_view(got, cols), testing::host_view(want, cols), tolerance);
}

TEST(CudaNerfMlpFused, EveryLayerFollowsFromTheOneBefore) {
  SEMFIELD_NEEDS_FUSED();
  const Small net;
  std::vector<double> x;
  for (const float v : net.x) x.push_back(rounded(v));
  const std::vector<double> position = rows_of(net.position.read(), net.kAll, 64);
  for (std::int64_t m = 0; m < net.kAll; ++m) {
    for (int c = 0; c < 64; ++c) {
      const double want = m < net.kRows && c < 63 ? x[m * 63 + c] : 0;
      ASSERT_EQ(position[m * 64 + c], want) << m << ", " << c;
    }
  }
  std::vector<double> below, exact;
  for (int i = 0; i < net.kDepth; ++i) {
    exact.clear();
    for (std::int64_t m = 0; m < net.kRows; ++m) exact.insert(exact.end(), net.b[i].begin(), net.b[i].end());
    if (i == 0 || i == 2) add_product(x, 63, net.w[i], 256, 0, false, exact);
    if (i > 0) add_product(below, 256, net.w[i], 256, i == 2 ? 63 : 0, false, exact);
    for (double& v : exact) v = std::max(v, 0.0);
    below = net.layer(net.trunk, i);
    EXPECT_EQ(compare(below, exact, 256, 4e-3), "") << "layer " << i;
  }
  EXPECT_EQ(near(net.feature, exact, 1e-5), "") << "feature";
  EXPECT_EQ(testing::widen(net.rounded_feature), below);
  EXPECT_EQ(net.rounded_feature.surroundings(), "");
  std::vector<double> want;
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    want.push_back(net.bd[0]);
    for (int c = 0; c < 256; ++c) want.back() += exact[m * 256 + c] * net.wd[c];
  }
  EXPECT_EQ(near(net.sigma, want, 1e-5), "") << "sigma";

  std::vector<double> view, color;
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    const auto begin = net.terms.begin() + net.ray[m] * 128;
    view.insert(view.end(), begin, begin + 128);
  }
  add_product(below, 256, net.wv, 128, 0, false, view);
  for (double& v : view) v = std::max(v, 0.0);
  EXPECT_EQ(compare(rows_of(net.hidden.read(), net.kRows, 128), view, 128, 4e-3), "") << "view layer";
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    for (int c = 0; c < 3; ++c) {
      double logit = net.bc[c];
      for (int n = 0; n < 128; ++n) logit += view[m * 128 + n] * net.wc[n * 3 + c];
      color.push_back(1 / (1 + std::exp(-logit)));
    }
  }
  EXPECT_EQ(near(net.rgb, color, 1e-5), "") << "colour";

  std::vector<double> semantic;
  for (std::int64_t m = 0; m < net.kSemantic; ++m) semantic.insert(semantic.end(), net.bs.begin(), net.bs.end());
  below.resize(static_cast<std::size_t>(net.kSemantic * 256));
  add_product(below, 256, net.ws, 128, 0, false, semantic);
  for (double& v : semantic) v = std::max(v, 0.0);
  EXPECT_EQ(near(net.semantic, semantic, 4e-3), "") << "semantic layer";
  EXPECT_EQ(net.semantic.surroundings(), "");
}

TEST(CudaNerfMlpFused, EveryGradientFollowsFromTheLayerAbove) {
  SEMFIELD_NEEDS_FUSED();
  Small net;
  const std::vector<float> g_sigma = random_floats(net.kRows, 21, -1, 1),
                           g_rgb = random_floats(net.kRows * 3, 22, -9, 9);
  const std::vector<float> g_feature = random_floats(net.kRows * 256, 23, -1, 1);
  const DeviceMatrix<float> d_sigma(g_sigma, 1), d_rgb(g_rgb, 3), d_feature(g_feature, 256);
  const DeviceMatrix<Bf16> d_semantic(random_floats(net.kSemanticBlocks * 64 * 128, 24, -1, 1), 128);
  std::array<cuda::fused::Slabs, cuda::fused::kMostSlabs> all;
  all[0] = {net.d_ws.view(), true, 256, 2};
  all[1] = {net.d_wv.view(), true, 256, 2};
  all[2] = {net.d_w2.view().row_range(63, 256), true, 256, 4};
  all[3] = {net.d_w1.view(), true, 256, 4};
  cuda::fused::pack_slabs(all, 4, net.slabs.data());
  cuda::fused::InputGradient call;
  call.rows = net.kRows, call.blocks = net.kBlocks, call.depth = net.kDepth, call.weights = net.slabs.data();
  call.density_weight = net.d_wd.data(), call.color_weight = net.d_wc.data();
  call.trunk_mask = reinterpret_cast<const uint4*>(net.trunk_mask.data());
  call.hidden_mask = reinterpret_cast<const uint2*>(net.hidden_mask.data());
  call.rgb = net.rgb.view(), call.d_rgb = d_rgb.view(), call.d_sigma = d_sigma.view();
  call.d_feature = d_feature.view();
  call.d_semantic = d_semantic.data(), call.semantic_blocks = net.kSemanticBlocks;
  call.d_trunk = net.d_trunk.data(), call.d_hidden = net.d_hidden.data();
  cuda::fused::input_gradient(call);

  const std::vector<double> hidden = rows_of(net.hidden.read(), net.kRows, 128);
  const std::vector<float> rgb = net.rgb.read();
  std::vector<double> d_logit, want;
  for (std::size_t i = 0; i < rgb.size(); ++i) d_logit.push_back(g_rgb[i] * double{rgb[i]} * (1 - double{rgb[i]}));
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    for (int n = 0; n < 128; ++n) {
      double sum = 0;
      for (int c = 0; c < 3; ++c) sum += d_logit[m * 3 + c] * net.wc[n * 3 + c];
      want.push_back(hidden[m * 128 + n] > 0 ? sum : 0);
    }
  }
  const std::vector<double> dv = rows_of(net.d_hidden.read(), net.kRows, 128);
  EXPECT_EQ(compare(dv, want, 128, 4e-3), "") << "view layer";

  std::vector<double> above = dv;
  for (int i = net.kDepth - 1; i >= 0; --i) {
    want.assign(static_cast<std::size_t>(net.kRows * 256), 0);
    if (i == 2) {
      add_product(above, 128, net.wv, 128, 0, true, want);
      std::vector<double> of_semantic = rows_of(d_semantic.read(), net.kSemanticBlocks * 64, 128);
      of_semantic.resize(static_cast<std::size_t>(net.kRows * 128));
      add_product(of_semantic, 128, net.ws, 128, 0, true, want);
      for (std::size_t k = 0; k < want.size(); ++k)
        want[k] += g_feature[k] + double{g_sigma[k / 256]} * net.wd[k % 256];
    } else {
      add_product(above, 256, net.w[i + 1], 256, i == 1 ? 63 : 0, true, want);
    }
    const std::vector<double> h = net.layer(net.trunk, i);
    for (std::size_t k = 0; k < want.size(); ++k) want[k] = h[k] > 0 ? want[k] : 0;
    above = net.layer(net.d_trunk, i);
    EXPECT_EQ(compare(above, want, 256, 4e-3), "") << "layer " << i;
  }
  const std::vector<double> behind = rows_of(part(net.d_trunk, 0, net.kAll * 256), net.kAll, 256);
  for (std::size_t k = static_cast<std::size_t>(net.kRows * 256); k < behind.size(); ++k) ASSERT_EQ(behind[k], 0) << k;

  // Sums over rows: of each ray, and with the heads' activations.
  const DeviceMatrix<float> d_term(net.kRays, 128);
  cuda::fused::per_ray_sums(net.d_hidden.data(), net.rays_on_device.view(), d_term.view());
  std::vector<double> sums(static_cast<std::size_t>(net.kRays * 128), 0);
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    for (int n = 0; n < 128; ++n) sums[net.ray[m] * 128 + n] += dv[m * 128 + n];
  }
  EXPECT_EQ(near(d_term, sums, 1e-5), "") << "rays";

  const DeviceMatrix<float> d_wc(std::vector<float>(128 * 3, 1.0F), 3), d_bc(std::vector<float>(3, 1.0F), 3);
  cuda::fused::HeadGradient color;
  color.x = net.hidden.data(), color.d = d_rgb.view(), color.y = net.rgb.view();
  color.d_weight = d_wc.view(), color.d_bias = d_bc.view();
  cuda::fused::head_gradients({}, color, net.launch.arena());
  std::vector<double> weight(128 * 3, 1), bias(3, 1);
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    for (int c = 0; c < 3; ++c) {
      const double g = d_logit[m * 3 + c];
      bias[c] += g;
      for (int n = 0; n < 128; ++n) weight[n * 3 + c] += g * hidden[m * 128 + n];
    }
  }
  EXPECT_EQ(near(d_wc, weight, 1e-5), "") << "colour weight";
  EXPECT_EQ(near(d_bc, bias, 1e-5), "") << "colour bias";

  const DeviceMatrix<float> d_wd(std::vector<float>(256, 1.0F), 1), d_bd(std::vector<float>(1, 1.0F), 1);
  cuda::fused::HeadGradient density;
  density.x = net.trunk.data() + 2 * net.kAll * 256, density.d = d_sigma.view();
  density.d_weight = d_wd.view(), density.d_bias = d_bd.view();
  cuda::fused::head_gradients(density, {}, net.launch.arena());
  const std::vector<double> h = net.layer(net.trunk, 2);
  weight.assign(256, 1);
  bias.assign(1, 1);
  for (std::int64_t m = 0; m < net.kRows; ++m) {
    bias[0] += g_sigma[m];
    for (int n = 0; n < 256; ++n) weight[n] += double{g_sigma[m]} * h[m * 256 + n];
  }
  EXPECT_EQ(near(d_wd, weight, 1e-5), "") << "density weight";
  EXPECT_EQ(near(d_bd, bias, 1e-5), "") << "density bias";
}

TEST(CudaNerfMlpFused, WeightGradientsAreSumsOverAllRows) {
  SEMFIELD_NEEDS_FUSED();
  DeviceLaunch launch;
  for (const std::int64_t blocks : {4, 44}) {
    SCOPED_TRACE(std::to_string(blocks) + " blocks");
    const std::int64_t rows = blocks * 64;
    // Values whose products and sums are exact in fp32, so that any order gives the same.
    const auto whole = [&](std::int64_t count, std::uint64_t seed) {
      std::vector<float> values = random_floats(count, seed, -3, 3);
      for (float& v : values) v = std::round(v);
      return values;
    };
    const DeviceMatrix<Bf16> a(whole(rows * 256, 1), 256), p(whole(rows * 64, 2), 64), b(whole(rows * 256, 3), 256);
    const DeviceMatrix<Bf16> v(whole(rows * 128, 4), 128);
    const DeviceMatrix<float> ab(std::vector<float>(256 * 256, 1.0F), 256), pb(std::vector<float>(63 * 256, 2.0F), 256);
    const DeviceMatrix<float> avw(std::vector<float>(256 * 128, 3.0F), 128), b_sum(std::vector<float>(256), 256);
    const DeviceMatrix<float> p_sum(std::vector<float>(256), 256), v_sum(std::vector<float>(128), 128);
    cuda::fused::WeightGradients call;
    call.count = 3;
    const std::int64_t fewer = blocks - 4;  // of the last matrix
    call.all[0] = {a.data(), b.data(), 256, 256, ab.view(), b_sum.view(), blocks};
    call.all[1] = {p.data(), b.data(), 64, 256, pb.view(), p_sum.view(), blocks};
    call.all[2] = {a.data(), v.data(), 256, 128, avw.view(), v_sum.view(), fewer};
    cuda::fused::weight_gradients(call, launch.arena());
    const std::vector<double> ar = rows_of(a.read(), rows, 256), pr = rows_of(p.read(), rows, 64);
    const std::vector<double> br = rows_of(b.read(), rows, 256), vr = rows_of(v.read(), rows, 128);
    const auto want = [&](const std::vector<double>& x, int k, int taken, const std::vector<double>& y, int n,
                          double start, std::int64_t count) {
      std::vector<double> sum(static_cast<std::size_t>(taken * n), start);
      for (std::int64_t m = 0; m < count; ++m) {
        for (int i = 0; i < taken; ++i) {
          for (int j = 0; j < n; ++j) sum[i * n + j] += x[m * k + i] * y[m * n + j];
        }
      }
      return sum;
    };
    EXPECT_EQ(near(ab, want(ar, 256, 256, br, 256, 1, rows), 0), "");
    EXPECT_EQ(near(pb, want(pr, 64, 63, br, 256, 2, rows), 0), "");
    EXPECT_EQ(near(avw, want(ar, 256, 256, vr, 128, 3, fewer * 64), 0), "");
    const std::vector<double> ones(static_cast<std::size_t>(rows), 1);
    EXPECT_EQ(near(b_sum, want(ones, 1, 1, br, 256, 0, rows), 0), "");
    EXPECT_EQ(near(p_sum, want(ones, 1, 1, br, 256, 0, rows), 0), "");
    EXPECT_EQ(near(v_sum, want(ones, 1, 1, vr, 128, 0, fewer * 64), 0), "");
    for (const DeviceMatrix<float>* m : {&ab, &pb, &avw, &b_sum, &p_sum, &v_sum}) EXPECT_EQ(m->surroundings(), "");
  }
}

}  // namespace
}  // namespace semfield
