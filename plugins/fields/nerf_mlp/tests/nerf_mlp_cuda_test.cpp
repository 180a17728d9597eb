// The big network on the device against the CPU's in float64: every switch, output and width; the same bits every run.

#include "cuda/kernel_tables.h"
#include "fields/nerf_mlp/nerf_mlp.h"
#include "tests/cuda/device_field.h"

namespace semfield {
namespace {

using testing::DeviceField;
using testing::near;
using testing::near_norm;
using namespace testkit;

const KernelTables& cpu_tables() {
  static const KernelTables tables = testing::tables_of({mlp_kernels});
  return tables;
}
const KernelTables& device_tables() {
  static const KernelTables tables = testing::tables_of({cuda::add_plugin_kernels});
  return tables;
}

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
    return std::to_string(params.depth) + " x " + std::to_string(params.width) + ", skip " +
           std::to_string(params.skip_at) + ", view " + std::to_string(params.view_width) + ", position " +
           std::to_string(position_dims) + ", direction " + std::to_string(direction_dims) + ", fold " +
           std::to_string(fold) + ", once " + std::to_string(once) + ", bf16 " +
           std::to_string(precision == Precision::bf16);
  }
};

const NerfMlpParams kSmall{4, 12, 2, 9};

/// A float64 network on the CPU with its inputs, and the same on the device.
struct Pair {
  Pair(const Network& network, std::int64_t samples, std::int32_t padding = 0)
      : cpu(network.params, network.build(Device::cpu), cpu_tables()),
        bench(cpu, network.build(Device::cpu), samples, 0, {}),
        gpu(network.params, network.build(Device::cuda), device_tables()),
        device(gpu, bench, padding),
        bf16(network.precision == Precision::bf16) {
    bench.derive();
    device.derive();
  }
  // bf16: as the field laws of the CPU, whose reasons testkit/laws.h gives.
  double output() const { return bf16 ? 0.02 : 2e-5; }
  double gradient() const { return bf16 ? 0.25 : 2e-4; }

  void expect_outputs() const {
    EXPECT_EQ(near(*device.sigma, bench.sigma.view(), output()), "") << "sigma";
    EXPECT_EQ(near(*device.rgb, bench.rgb.view(), output()), "") << "rgb";
    EXPECT_EQ(near(*device.feature, bench.feature.view(), output()), "") << "feature";
    for (const auto* m : {&device.sigma, &device.rgb, &device.feature}) EXPECT_EQ((*m)->surroundings(), "");
  }
  void expect_gradients(bool with_d_position) const {
    if (with_d_position) {
      EXPECT_EQ(near_norm(*device.d_position, bench.d_position.view(), gradient()), "") << "d_position";
      EXPECT_EQ(device.d_position->surroundings(), "");
    }
    for (std::size_t i = 0; i < bench.box.count(); ++i) {
      if (!bench.box.learned(i)) continue;
      EXPECT_EQ(near_norm(*device.grads[i], bench.box.grad(i), gradient()), "") << bench.box.specs()[i].name;
    }
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

TEST(CudaNerfMlp, IsTheCpusNetworkForEverySwitchAndSize) {
  SEMFIELD_NEEDS_DEVICE();
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

TEST(CudaNerfMlp, IsTheCpusNetworkInThePapersShape) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Precision precision : kPrecisions) {
    for (const std::int64_t samples : {1, 33, 257, 1025})
      expect_twin({{}, 63, 27, true, true, precision}, samples, 0, false);
    expect_twin({{}, 63, 27, true, true, precision}, 130, 1, true);
    expect_twin({{}, 63, 0, true, true, precision}, 130, 0, false);
    expect_twin({{}, 60, 16, false, false, precision}, 130, 4, false);
  }
}

TEST(CudaNerfMlp, OutputsAndGradientsThatAreAbsentChangeNoOther) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Precision precision : kPrecisions) {
    for (const NerfMlpParams& params : {kSmall, NerfMlpParams{}}) {
      for (const Wanted wanted : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true},
                                  Wanted{true, true, false}, Wanted{false, false, false}}) {
        const Network network{params, 63, 27, true, true, precision};
        SCOPED_TRACE(network.text() + ", sigma " + std::to_string(wanted.sigma) + ", rgb " +
                     std::to_string(wanted.rgb) + ", feature " + std::to_string(wanted.feature));
        Pair pair(network, 130);
        pair.bench.forward();
        pair.device.forward(wanted, false);
        if (wanted.sigma) {
          EXPECT_EQ(near(*pair.device.sigma, pair.bench.sigma.view(), pair.output()), "");
        }
        if (wanted.rgb) {
          EXPECT_EQ(near(*pair.device.rgb, pair.bench.rgb.view(), pair.output()), "");
        }
        if (wanted.feature) {
          EXPECT_EQ(near(*pair.device.feature, pair.bench.feature.view(), pair.output()), "");
        }
        pair.device.forward();
        pair.bench.backward(wanted);
        pair.device.backward(wanted);
        pair.expect_gradients(true);
      }
    }
  }
}

TEST(CudaNerfMlp, RowsDoNotDependOnTheBatch) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Precision precision : kPrecisions) {
    const Network network{{}, 63, 27, true, true, precision};
    Pair pair(network, 4097);
    pair.device.forward();
    const std::vector<float> sigma = pair.device.sigma->read(), rgb = pair.device.rgb->read();
    // Without anything saved, and the first 1,000 rows alone: within rounding, since a product of another shape may use
    // another algorithm.
    pair.device.forward({}, false);
    EXPECT_EQ(pair.device.sigma->read(), sigma);
    EXPECT_EQ(pair.device.rgb->read(), rgb);
    FieldIn<float> in = pair.device.in();
    in.position = in.position.row_range(0, 1000);
    in.ray_of_sample = in.ray_of_sample.row_range(0, 1000);
    FieldOut<float> out{.sigma = pair.device.sigma->view().row_range(0, 1000),
                        .rgb = pair.device.rgb->view().row_range(0, 1000)};
    pair.gpu.forward(pair.device.ctx, pair.device.tensors(), in, out, {});
    const std::vector<double> before = testing::widen(sigma);
    EXPECT_EQ(near(*pair.device.sigma, testing::host_view(before, 1), pair.output()), "");
  }
}

TEST(CudaNerfMlp, RepeatsBitForBit) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Precision precision : kPrecisions) {
    Pair pair({{}, 63, 27, true, true, precision}, 4097);
    std::vector<float> first;
    for (int run = 0; run < 3; ++run) {
      for (const auto& grad : pair.device.grads)
        grad->write(std::vector<float>(static_cast<std::size_t>(grad->view().size())));
      pair.device.forward();
      pair.device.backward({}, false);
      if (run == 0) first = pair.device.all_grads();
      EXPECT_EQ(pair.device.all_grads(), first) << "run " << run;
    }
  }
}

TEST(CudaNerfMlp, ASteadyStateAllocatesNothing) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Precision precision : kPrecisions) {
    Pair pair({{}, 63, 27, true, true, precision}, 300);
    pair.device.forward();
    pair.device.backward();
    pair.device.forward();
    pair.device.backward();
    const std::int64_t growths = pair.device.launch.arena().growth_count();
    pair.device.forward();
    pair.device.backward();
    EXPECT_EQ(pair.device.launch.arena().growth_count(), growths);
  }
}

}  // namespace
}  // namespace semfield
