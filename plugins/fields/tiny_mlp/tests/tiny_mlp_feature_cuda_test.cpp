// The small network asked for its feature alone, in bf16 on the device: against the CPU's in float64 and in bf16,
// unused rows, and the same bits in every run.
#include <algorithm>

#include "fields/tiny_mlp/tiny_mlp.h"
#include "plugins/fields/tiny_mlp/tests/tiny_mlp_cuda_tables.h"

namespace semfield {
namespace {

using testing::DeviceField;
using testing::DeviceMatrix;
using namespace testkit;

constexpr Wanted kFeature{false, false, true};
using testing::tiny::cpu_tables;
using testing::tiny::device_tables;

struct Network {
  std::int32_t position_dims = 112;
  int width = 64, layers = 2;

  TinyMlpParams params() const { return TinyMlpParams{.hidden_width = width, .hidden_layers = layers}; }
  FieldBuild build(Device device) const {
    return FieldBuild{.device = device,
                      .position_dims = position_dims,
                      .feature_only = true,
                      .precision = device == Device::cpu ? Precision::fp32 : Precision::bf16};
  }
  std::string text() const {
    return std::to_string(position_dims) + " numbers, " + std::to_string(layers) + " x " + std::to_string(width);
  }
};

struct Held {
  TinyMlp<float> network;
};
class OnDevice : private Held, public DeviceField {
 public:
  OnDevice(const Network& shape, const KernelTables& tables, FieldBench<double>& bench, std::int32_t padding = 0)
      : Held{TinyMlp<float>(shape.params(), shape.build(Device::cuda), tables)}, DeviceField(network, bench, padding) {}
  void run(bool with_d_position = true) const {
    forward(kFeature);
    backward(kFeature, with_d_position);
  }
};

struct Oracle {
  Oracle(const Network& network, std::int64_t samples)
      : field(network.params(), network.build(Device::cpu), cpu_tables()),
        bench(field, network.build(Device::cpu), samples, 0, {}) {}
  TinyMlp<double> field;
  FieldBench<double> bench;
};

TEST(CudaTinyMlpFeature, IsTheCpuNetworkForEveryWidthDepthAndSize) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr double kOutput = 0.02, kSumOfTerms = 0.05, kGradient = 0.25;  // as tiny_mlp_test.cpp for bf16
  struct Case {
    Network network;
    std::int64_t samples;
    std::int32_t padding;
  };
  for (const Case& c : {Case{{112, 64, 2}, 4097, 0}, Case{{115, 128, 3}, 1000, 0}, Case{{103, 128, 2}, 1000, 1},
                        Case{{48, 64, 1}, 333, 4}, Case{{48, 128, 4}, 333, 0}, Case{{39, 40, 2}, 333, 3},
                        Case{{1, 3, 2}, 33, 0}, Case{{128, 128, 4}, 1, 0}, Case{{64, 64, 2}, 0, 0}}) {
    for (const bool with_d_position : {true, false}) {
      SCOPED_TRACE(c.network.text() + ", samples " + std::to_string(c.samples));
      Oracle oracle(c.network, c.samples);
      oracle.bench.forward(kFeature);
      oracle.bench.backward(kFeature, with_d_position);
      const OnDevice device(c.network, device_tables(), oracle.bench, c.padding);
      device.run(with_d_position);
      EXPECT_EQ(near(*device.feature, oracle.bench.feature.view(), kOutput, kSumOfTerms), "");
      if (with_d_position) {
        EXPECT_EQ(testing::near_norm(*device.d_position, oracle.bench.d_position.view(), kGradient), "");
      }
      for (std::size_t i = 0; i < oracle.bench.box.count(); ++i) {
        if (!oracle.bench.box.learned(i)) continue;
        EXPECT_EQ(testing::near_norm(*device.grads[i], oracle.bench.box.grad(i), kGradient), "")
            << oracle.bench.box.specs()[i].name;
      }
      EXPECT_EQ(device.feature->surroundings(), "");
      EXPECT_EQ(device.d_position->surroundings(), "");
    }
  }
}

// The same operands rounded alike and summed in another order: far closer than to float64.
TEST(CudaTinyMlpFeature, AgreesWithTheCpuInBf16) {
  SEMFIELD_NEEDS_DEVICE();
  constexpr double kOutput = 5e-3, kGradient = 5e-2;  // a bias's sum cancels
  for (const Network& network : {Network{112, 64, 2}, Network{115, 128, 3}, Network{48, 64, 1}, Network{39, 40, 4}}) {
    SCOPED_TRACE(network.text());
    Oracle oracle(network, 4097);
    const OnDevice fused(network, device_tables(), oracle.bench);
    fused.run();
    FieldBuild rounded = network.build(Device::cpu);
    rounded.precision = Precision::bf16;
    const TinyMlp<float> cpu(network.params(), rounded, cpu_tables());
    FieldBench<float> bench(cpu, rounded, 4097, 0, {});
    bench.forward(kFeature);
    bench.backward(kFeature);
    EXPECT_EQ(near_norm(*fused.feature, bench.feature.view(), kOutput), "");
    EXPECT_EQ(near_norm(*fused.d_position, bench.d_position.view(), kGradient), "");
    for (std::size_t i = 0; i < fused.grads.size(); ++i) {
      if (!bench.box.learned(i)) continue;
      EXPECT_EQ(near_norm(*fused.grads[i], bench.box.grad(i), kGradient), "") << bench.box.specs()[i].name;
    }
  }
}

TEST(CudaTinyMlpFeature, GivesTheSameWithoutASavedBatchAndWithoutAGradientNothing) {
  SEMFIELD_NEEDS_DEVICE();
  const Network network;
  Oracle oracle(network, 333);
  const OnDevice saved(network, device_tables(), oracle.bench), unsaved(network, device_tables(), oracle.bench);
  saved.forward(kFeature);
  unsaved.forward(kFeature, false);
  EXPECT_EQ(saved.feature->read(), unsaved.feature->read());
  saved.backward({false, false, false});
  for (const auto* matrix : {saved.d_position.get(), saved.grads[0].get()}) {
    const std::vector<float> values = matrix->read();
    EXPECT_TRUE(std::all_of(values.begin(), values.end(), [](float value) { return value == 0; }));
  }
}

TEST(CudaTinyMlpFeature, GradientsAreAddedAndHaveTheSameBitsInEveryRun) {
  SEMFIELD_NEEDS_DEVICE();
  const Network network{115, 128, 3};
  Oracle oracle(network, 50001);
  const OnDevice once(network, device_tables(), oracle.bench), twice(network, device_tables(), oracle.bench);
  for (const OnDevice* device : {&once, &twice}) device->run();
  for (std::size_t i = 0; i < once.grads.size(); ++i) EXPECT_EQ(once.grads[i]->read(), twice.grads[i]->read());
  twice.backward(kFeature);
  for (std::size_t i = 0; i < once.grads.size(); ++i) {
    std::vector<float> doubled = once.grads[i]->read();
    for (float& value : doubled) value += value;
    EXPECT_EQ(twice.grads[i]->read(), doubled) << oracle.bench.box.specs()[i].name;
  }
}

TEST(CudaTinyMlpFeature, RowsBehindTheLiveOnesAreZero) {
  SEMFIELD_NEEDS_DEVICE();
  const Network network;
  for (const std::int64_t live : {0, 1, 64, 200, 333}) {
    SCOPED_TRACE("live " + std::to_string(live));
    Oracle oracle(network, 333);
    OnDevice some(network, device_tables(), oracle.bench), all(network, device_tables(), oracle.bench);
    const DeviceMatrix<std::int32_t> count(std::vector<std::int32_t>{static_cast<std::int32_t>(live)}, 1);
    some.launch.set_live_rows(count.data());
    some.run();
    some.launch.set_live_rows(nullptr);
    std::vector<float> w = all.w_feature->read();  // the same gradient from all rows when those behind have none
    std::fill(w.begin() + live * network.width, w.end(), 0.0F);
    all.w_feature->write(w);
    all.run();
    for (const auto& [got, want] :
         {std::pair{some.feature.get(), all.feature.get()}, std::pair{some.d_position.get(), all.d_position.get()}}) {
      std::vector<float> expected = want->read();
      std::fill(expected.begin() + live * want->view().cols, expected.end(), 0.0F);
      EXPECT_EQ(got->read(), expected);
    }
    for (std::size_t i = 0; i < some.grads.size(); ++i)
      EXPECT_EQ(near_norm(*some.grads[i], *all.grads[i], 1e-6), "") << oracle.bench.box.specs()[i].name;
  }
}

}  // namespace
}  // namespace semfield
