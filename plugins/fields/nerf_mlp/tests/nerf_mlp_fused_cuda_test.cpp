// The big network through its fused kernels, against the CPU's and against the layers one by one.

#include "cuda/kernel_tables.h"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "plugins/fields/nerf_mlp/tests/fused_fixture.h"
#include "tests/cuda/device_field.h"

namespace semfield {
namespace {

using testing::DeviceField;
using testing::DeviceMatrix;
using testing::host_view;
using testing::near;
using namespace testkit;

const KernelTables& cpu_tables() {
  static const KernelTables tables = testing::tables_of({mlp_kernels});
  return tables;
}
const KernelTables& layer_tables() {
  static const KernelTables tables = testing::tables_of({cuda::add_mlp_kernels});
  return tables;
}
const KernelTables& device_tables() {
  static const KernelTables tables = testing::tables_of({cuda::add_plugin_kernels});
  return tables;
}

FieldBuild build_of(Device device, std::int32_t position_dims, std::int32_t direction_dims) {
  return FieldBuild{.device = device,
                    .position_dims = position_dims,
                    .direction_dims = direction_dims,
                    .precision = device == Device::cpu ? Precision::fp32 : Precision::bf16};
}

std::string near_norm(const DeviceMatrix<float>& got, const DeviceMatrix<float>& want, double tolerance) {
  const std::vector<double> values = testing::widen(want.read());
  return testing::near_norm(got, host_view(values, want.view().cols), tolerance);
}

/// The fused kernels and the layers one by one, from the same inputs.
void expect_same_network(const NerfMlpParams& params, std::int32_t position_dims, std::int32_t direction_dims,
                         std::int64_t samples, const Wanted& wanted = {}, std::int32_t padding = 0) {
  SCOPED_TRACE(std::to_string(samples) + " samples, depth " + std::to_string(params.depth) + ", skip " +
               std::to_string(params.skip_at) + ", position " + std::to_string(position_dims) + ", direction " +
               std::to_string(direction_dims) + ", wanted " + std::to_string(wanted.sigma) +
               std::to_string(wanted.rgb) + std::to_string(wanted.feature));
  const NerfMlp<double> cpu(params, build_of(Device::cpu, position_dims, direction_dims), cpu_tables());
  FieldBench<double> bench(cpu, build_of(Device::cpu, position_dims, direction_dims), samples, 0, {});
  const NerfMlp<float> gpu(params, build_of(Device::cuda, position_dims, direction_dims), device_tables());
  const DeviceField fused(gpu, bench, padding);
  fused.derive();
  fused.forward();
  fused.backward(wanted);
  const NerfMlp<float> layered(params, build_of(Device::cuda, position_dims, direction_dims), layer_tables());
  const DeviceField layers(layered, bench, padding);
  layers.derive();
  layers.forward();
  layers.backward(wanted);
  // A unit within rounding of zero may fall on either side of its ReLU (testkit/laws.h), in either of the two.
  constexpr double kOutput = 0.02, kGradient = 0.25;
  EXPECT_EQ(near_norm(*fused.sigma, *layers.sigma, kOutput), "") << "sigma";
  EXPECT_EQ(near_norm(*fused.rgb, *layers.rgb, kOutput), "") << "rgb";
  EXPECT_EQ(near_norm(*fused.feature, *layers.feature, kOutput), "") << "feature";
  EXPECT_EQ(near_norm(*fused.d_position, *layers.d_position, kGradient), "") << "d_position";
  for (std::size_t i = 0; i < fused.grads.size(); ++i) {
    if (!bench.box.learned(i)) continue;
    EXPECT_EQ(near_norm(*fused.grads[i], *layers.grads[i], kGradient), "") << bench.box.specs()[i].name;
  }
  for (const auto* m : {&fused.sigma, &fused.rgb, &fused.feature, &fused.d_position})
    EXPECT_EQ((*m)->surroundings(), "");
}

TEST(CudaNerfMlpFused, IsTheNetworkOfTheLayersOneByOne) {
  SEMFIELD_NEEDS_FUSED();
  for (const std::int64_t samples : {1, 63, 257, 40000}) expect_same_network({}, 63, 27, samples);
  expect_same_network({}, 60, 0, 257);
  expect_same_network({2, 256, 0, 128}, 64, 16, 130, {}, 3);
  expect_same_network({3, 256, 1, 128}, 7, 3, 130);
  expect_same_network({15, 256, 14, 128}, 63, 27, 130);
  for (const Wanted& wanted : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true}})
    expect_same_network({}, 63, 27, 130, wanted);
}

TEST(CudaNerfMlpFused, IsTheCpusNetworkAndRepeatsBitForBit) {
  SEMFIELD_NEEDS_FUSED();
  const NerfMlp<double> cpu({}, build_of(Device::cpu, 63, 27), cpu_tables());
  FieldBench<double> bench(cpu, build_of(Device::cpu, 63, 27), 1025, 0, {});
  bench.forward();
  bench.backward({}, false);
  const NerfMlp<float> gpu({}, build_of(Device::cuda, 63, 27), device_tables());
  const DeviceField device(gpu, bench);
  device.derive();
  std::vector<float> first, sigma, rgb;
  for (int run = 0; run < 3; ++run) {
    for (const auto& grad : device.grads)
      grad->write(std::vector<float>(static_cast<std::size_t>(grad->view().size())));
    device.forward();
    device.backward({}, false);
    if (run == 0) first = device.all_grads(), sigma = device.sigma->read(), rgb = device.rgb->read();
    EXPECT_EQ(device.all_grads(), first) << "run " << run;
  }
  EXPECT_EQ(near(*device.sigma, bench.sigma.view(), 0.02), "") << "sigma";
  EXPECT_EQ(near(*device.rgb, bench.rgb.view(), 0.02), "") << "rgb";
  EXPECT_EQ(near(*device.feature, bench.feature.view(), 0.02), "") << "feature";
  for (std::size_t i = 0; i < bench.box.count(); ++i) {
    if (!bench.box.learned(i)) continue;
    EXPECT_EQ(testing::near_norm(*device.grads[i], bench.box.grad(i), 0.25), "") << bench.box.specs()[i].name;
  }
  // Rows are the same alone as in the batch, and with nothing saved.
  device.forward({}, false);
  EXPECT_EQ(device.sigma->read(), sigma);
  EXPECT_EQ(device.rgb->read(), rgb);
  FieldIn<float> in = device.in();
  in.position = in.position.row_range(200, 300);
  in.ray_of_sample = in.ray_of_sample.row_range(200, 300);
  const DeviceMatrix<float> few(300, 1);
  FieldOut<float> out{.sigma = few.view()};
  gpu.forward(device.ctx, device.tensors(), in, out, {});
  EXPECT_EQ(few.read(), std::vector<float>(sigma.begin() + 200, sigma.begin() + 500));
}

}  // namespace
}  // namespace semfield
