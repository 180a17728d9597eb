// The small network on the device, whole and asked for its feature alone: against the CPU's in float64 for every switch
// and width, and in bf16; and what a device adds: unused rows, and the same bits in every run.

#include <cuda_bf16.h>

#include <algorithm>

#include "cuda/kernels/kernels.h"
#include "fields/tiny_mlp/tiny_mlp.h"
#include "tests/cuda/device_fixture.h"

namespace semfield {
namespace {

using testing::all_kernels;
using testing::DeviceField;
using testing::DeviceMatrix;
using namespace testkit;

struct Network {
  TinyMlpParams params;
  std::int32_t position_dims = 32, direction_dims = 16;
  bool once = true;
  Precision precision = Precision::fp32;
  bool feature_only = false;

  FieldBuild build(Device device) const {
    return FieldBuild{.device = device,
                      .position_dims = position_dims,
                      .direction_dims = direction_dims,
                      .feature_only = feature_only,
                      .savings = {.direction_once_per_ray = once},
                      .precision = device == Device::cpu ? Precision::fp32 : precision};
  }
  std::string text() const {
    return "hidden " + std::to_string(params.hidden_layers) + " x " + std::to_string(params.hidden_width) +
           ", geometry " + std::to_string(params.geometry_features) + ", colour " +
           std::to_string(params.color_layers) + " x " + std::to_string(params.color_width) + ", feature " +
           std::to_string(static_cast<int>(params.feature)) + ", position " + std::to_string(position_dims) +
           ", direction " + std::to_string(direction_dims) + ", once " + std::to_string(once) + ", bf16 " +
           std::to_string(precision == Precision::bf16) + ", feature alone " + std::to_string(feature_only);
  }
  Wanted outputs() const { return feature_only ? Wanted{false, false, true} : Wanted{}; }
};

/// Asked for its feature alone, as a semantic branch is.
Network branch(std::int32_t position_dims, int width, int layers) {
  return {TinyMlpParams{.hidden_width = width, .hidden_layers = layers}, position_dims, 0, true, Precision::bf16, true};
}

/// A float64 network on the CPU with its inputs.
struct Oracle {
  Oracle(const Network& network, std::int64_t samples)
      : field(network.params, network.build(Device::cpu), all_kernels()),
        bench(field, network.build(Device::cpu), samples, 0, {}) {}
  TinyMlp<double> field;
  FieldBench<double> bench;
};

struct Held {
  TinyMlp<float> network;
};
/// The network on the device with an oracle's inputs and tensors.
class OnDevice : private Held, public DeviceField {
 public:
  OnDevice(const Network& shape, Oracle& oracle, std::int32_t padding = 0)
      : Held{TinyMlp<float>(shape.params, shape.build(Device::cuda), all_kernels())},
        DeviceField(network, oracle.bench, padding) {}
};

struct Tolerances {
  double output, gradient;
};
// bf16: as the field laws of the CPU, whose reasons testkit/laws.h gives.
Tolerances tolerances(Precision precision) {
  return precision == Precision::bf16 ? Tolerances{0.02, 0.25} : Tolerances{1e-5, 1e-4};
}

void expect_oracle(const OnDevice& device, FieldBench<double>& bench, const Tolerances& t, const Wanted& outputs,
                   bool with_d_position) {
  constexpr double kSumOfTerms = 0.05;  // a single output may cancel; its terms do not
  testing::expect_outputs_near(device, bench, t.output, kSumOfTerms, outputs);
  if (with_d_position) {
    EXPECT_EQ(near_norm(*device.d_position, bench.d_position.view(), t.gradient), "") << "d_position";
  }
  testing::expect_gradients_near(device, bench, t.gradient);
  EXPECT_EQ(device.d_position->surroundings(), "");
}

void expect_like_the_oracle(const Network& network, std::int64_t samples, std::int32_t padding, Wanted gradients = {},
                            bool with_d_position = true) {
  SCOPED_TRACE(network.text() + ", samples " + std::to_string(samples) + ", padding " + std::to_string(padding));
  Oracle oracle(network, samples);
  oracle.bench.forward(network.outputs());
  oracle.bench.backward(gradients, with_d_position);
  const OnDevice device(network, oracle, padding);
  device.forward(network.outputs());
  device.backward(gradients, with_d_position);
  expect_oracle(device, oracle.bench, tolerances(network.precision), network.outputs(), with_d_position);
}

constexpr TinyFeature kHidden = TinyFeature::hidden, kGeometry = TinyFeature::geometry;

class CudaTinyMlp : public ::testing::TestWithParam<Precision> {};
INSTANTIATE_TEST_SUITE_P(Precisions, CudaTinyMlp, ::testing::Values(Precision::fp32, Precision::bf16),
                         [](const auto& each) { return each.param == Precision::bf16 ? "bf16" : "fp32"; });

TEST_P(CudaTinyMlp, IsTheCpuNetworkAtEverySizeAndStride) {
  SEMFIELD_NEEDS_DEVICE();
  for (const std::int64_t samples : {0, 1, 31, 33, 4097}) {
    for (const std::int32_t padding : {0, 1, 4}) {
      expect_like_the_oracle({{}, 32, 16, true, GetParam()}, samples, padding);
      expect_like_the_oracle({{12, 2, 5, 10, 2, kGeometry}, 7, 4, true, GetParam()}, samples, padding);
    }
  }
}

TEST_P(CudaTinyMlp, IsTheCpuNetworkForEverySwitchAndWidth) {
  SEMFIELD_NEEDS_DEVICE();
  for (const TinyFeature feature : {kHidden, kGeometry}) {
    for (const std::int32_t direction_dims : {16, 9, 0}) {
      for (const bool once : {true, false}) {
        expect_like_the_oracle({{64, 1, 15, 64, 2, feature}, 32, direction_dims, once, GetParam()}, 333, 0);
        expect_like_the_oracle({{24, 1, 7, 40, 2, feature}, 13, direction_dims, once, GetParam()}, 333, 3);
      }
    }
    for (const std::int32_t position_dims : {1, 16, 17, 48, 64, 65, 128})
      expect_like_the_oracle({{64, 1, 15, 64, 2, feature}, position_dims, 16, true, GetParam()}, 333, 0);
    expect_like_the_oracle({{128, 2, 31, 128, 3, feature}, 32, 27, true, GetParam()}, 333, 0);
    expect_like_the_oracle({{32, 3, 15, 70, 1, feature}, 20, 16, true, GetParam()}, 333, 0);
    expect_like_the_oracle({{200, 1, 1, 130, 2, feature}, 32, 16, false, GetParam()}, 333, 0);
  }
}

TEST_P(CudaTinyMlp, AbsentGradientsCountAsZero) {
  SEMFIELD_NEEDS_DEVICE();
  for (const TinyFeature feature : {kHidden, kGeometry}) {
    for (const Wanted gradients : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true},
                                   Wanted{true, false, true}, Wanted{false, false, false}}) {
      for (const bool with_d_position : {true, false}) {
        expect_like_the_oracle({{64, 1, 15, 64, 2, feature}, 32, 16, true, GetParam()}, 333, 0, gradients,
                               with_d_position);
        expect_like_the_oracle({{12, 2, 5, 10, 2, feature}, 7, 4, true, GetParam()}, 333, 0, gradients,
                               with_d_position);
      }
    }
  }
}

using CudaTinyMlpFused = testing::DeviceTest;

TEST_F(CudaTinyMlpFused, RowsDoNotDependOnTheirBatch) {
  const Network network{{}, 32, 16, true, Precision::bf16};
  Oracle oracle(network, 333);
  const OnDevice whole(network, oracle), split(network, oracle);
  whole.forward();
  whole.backward();
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 101}, {101, 232}}) {
    const auto part = [begin = begin, count = count](auto view) { return view.row_range(begin, count); };
    const FieldIn<float> in{part(split.in().position), split.in().direction, part(split.in().ray_of_sample)};
    const FieldOut<float> out{part(split.out().sigma), part(split.out().rgb), part(split.out().feature)};
    const FieldGrad<float> w{part(split.weights().sigma), part(split.weights().rgb), part(split.weights().feature)};
    split.field.forward(split.ctx, split.tensors(), in, out, split.space());
    split.field.backward(split.ctx, split.tensors(), in, out, w, split.space(), part(split.d_position->view()));
  }
  EXPECT_EQ(split.sigma->read(), whole.sigma->read());
  EXPECT_EQ(split.rgb->read(), whole.rgb->read());
  EXPECT_EQ(split.feature->read(), whole.feature->read());
  EXPECT_EQ(split.d_position->read(), whole.d_position->read());
}

TEST(CudaTinyMlpBits, GradientsAreAddedAndHaveTheSameBitsInEveryRun) {
  SEMFIELD_NEEDS_DEVICE();
  for (const Network& network : {Network{}, Network{{}, 32, 16, true, Precision::bf16}, branch(115, 128, 3)}) {
    SCOPED_TRACE(network.text());
    Oracle oracle(network, 50001);
    const OnDevice once(network, oracle), twice(network, oracle);
    for (const OnDevice* device : {&once, &twice}) {
      device->forward(network.outputs());
      device->backward(network.outputs());
    }
    EXPECT_EQ(once.gradients(), twice.gradients());
    twice.backward(network.outputs());
    for (std::size_t i = 0; i < once.grads.size(); ++i) {
      std::vector<float> doubled = once.grads[i]->read();
      for (float& value : doubled) value += value;
      EXPECT_EQ(twice.grads[i]->read(), doubled) << oracle.bench.box.specs()[i].name;
    }
  }
}

// Fused kernels skip them. Layer by layer they are computed; nobody reads them, and they have no gradient.
TEST_F(CudaTinyMlpFused, RowsBehindTheLiveOnesAreZero) {
  for (const Network& network :
       {Network{{}, 32, 16, true, Precision::bf16}, Network{{12, 1, 5, 10, 2, kHidden}, 7, 4, true, Precision::bf16},
        branch(112, 64, 2)}) {
    for (const std::int64_t live : {0, 1, 64, 200, 333}) {
      SCOPED_TRACE(network.text() + ", live " + std::to_string(live));
      Oracle oracle(network, 333);
      OnDevice some(network, oracle), all(network, oracle);
      const DeviceMatrix<std::int32_t> count(std::vector<std::int32_t>{static_cast<std::int32_t>(live)}, 1);
      some.launch.set_live_rows(count.data());
      some.forward(network.outputs());
      some.backward(network.outputs());
      some.launch.set_live_rows(nullptr);
      // The same gradient from all rows when those behind have none.
      for (const auto* weight : {&all.w_sigma, &all.w_rgb, &all.w_feature}) {
        std::vector<float> w = (*weight)->read();
        std::fill(w.begin() + live * (*weight)->view().cols, w.end(), 0.0f);
        (*weight)->write(w);
      }
      all.forward(network.outputs());
      all.backward(network.outputs());
      using Output = std::unique_ptr<DeviceMatrix<float>> OnDevice::*;
      std::vector<Output> outputs{&OnDevice::feature, &OnDevice::d_position};
      if (!network.feature_only) outputs.insert(outputs.end(), {&OnDevice::sigma, &OnDevice::rgb});
      for (const Output output : outputs) {
        const auto &got = some.*output, &want = all.*output;
        std::vector<float> expected = want->read();
        std::fill(expected.begin() + live * want->view().cols, expected.end(), 0.0f);
        EXPECT_EQ(got->read(), expected);
      }
      for (std::size_t i = 0; i < some.grads.size(); ++i)
        EXPECT_EQ(near_norm(*some.grads[i], *all.grads[i], 1e-6), "") << oracle.bench.box.specs()[i].name;
    }
  }
}

// The same operands rounded alike and summed in another order: far closer than to float64, so that a wrong element
// shows which the tolerance of bf16 would hide.
TEST_F(CudaTinyMlpFused, AgreesWithTheCpuInBf16) {
  constexpr double kOutput = 5e-3;
  std::vector<Network> networks{branch(112, 64, 2), branch(115, 128, 3), branch(48, 64, 1), branch(39, 40, 4)};
  for (const TinyFeature feature : {kHidden, kGeometry}) {
    networks.push_back({{64, 1, 15, 64, 2, feature}, 32, 16, true, Precision::bf16});
    networks.push_back({{64, 1, 15, 64, 2, feature}, 16, 9, true, Precision::bf16});
    networks.push_back({{64, 1, 15, 64, 2, feature}, 64, 0, true, Precision::bf16});
    networks.push_back({{24, 1, 7, 40, 2, feature}, 13, 5, false, Precision::bf16});
  }
  for (const Network& network : networks) {
    SCOPED_TRACE(network.text());
    // A bias's sum cancels, and the CPU adds the rounded gradients, the device those that products round later. The CPU
    // does not round directions.
    const double weight = network.feature_only ? 0.05 : 0.1, bias = network.feature_only ? 0.05 : 0.15;
    Oracle oracle(network, 4097);
    const OnDevice fused(network, oracle);
    fused.forward(network.outputs());
    fused.backward(network.outputs());
    FieldBuild rounded = network.build(Device::cpu);
    rounded.precision = Precision::bf16;
    const TinyMlp<float> cpu(network.params, rounded, all_kernels());
    FieldBench<float> bench(cpu, rounded, 4097, 0, {});
    bench.forward(network.outputs());
    bench.backward(network.outputs());
    if (!network.feature_only) {
      EXPECT_EQ(near_norm(*fused.sigma, bench.sigma.view(), kOutput), "") << "sigma";
      EXPECT_EQ(near_norm(*fused.rgb, bench.rgb.view(), kOutput), "") << "rgb";
    }
    EXPECT_EQ(near_norm(*fused.feature, bench.feature.view(), kOutput), "") << "feature";
    EXPECT_EQ(near_norm(*fused.d_position, bench.d_position.view(), weight), "") << "d_position";
    for (std::size_t i = 0; i < fused.grads.size(); ++i) {
      if (!bench.box.learned(i)) continue;
      const std::string& name = bench.box.specs()[i].name;
      EXPECT_EQ(near_norm(*fused.grads[i], bench.box.grad(i), name.ends_with("/bias") ? bias : weight), "") << name;
    }
  }
}

// The semantic head may take the hidden layer in bf16 and give its gradient in bf16, of the first rows alone: the same
// numbers as in fp32 give the same bits.
TEST_F(CudaTinyMlpFused, ExchangesItsFeatureInBf16) {
  constexpr std::int64_t kRows = 333, kSemanticRows = 250;
  const Network network{{}, 32, 16, true, Precision::bf16};
  Oracle oracle(network, kRows);
  const OnDevice plain(network, oracle), sharing(network, oracle);
  const std::int32_t width = plain.feature->view().cols;
  std::vector<float> weights = plain.w_feature->read();
  for (std::size_t i = 0; i < weights.size(); ++i) {
    const bool semantic = static_cast<std::int64_t>(i) < kSemanticRows * width;
    weights[i] = semantic ? __bfloat162float(__float2bfloat16(weights[i])) : 0.0f;
  }
  plain.w_feature->write(weights);
  weights.resize(static_cast<std::size_t>(kSemanticRows * width));
  const DeviceMatrix<__nv_bfloat16> d_feature(weights, width);
  plain.forward();
  plain.backward();

  const DeviceMatrix<__nv_bfloat16> room(kRows, width);
  ASSERT_EQ(sharing.field.feature_form(64), FeatureForm::rounded);
  FieldOut<float> out = sharing.out({true, true, false});
  out.fused.feature = testing::as_rounded(room.view());
  sharing.field.forward(sharing.ctx, sharing.tensors(), sharing.in(), out, sharing.space());
  const std::vector<__nv_bfloat16> got = room.read();
  const std::vector<float> want = plain.feature->read();
  for (std::size_t i = 0; i < got.size(); ++i)
    ASSERT_EQ(__bfloat162float(got[i]), __bfloat162float(__float2bfloat16(want[i]))) << i;

  FieldGrad<float> grad = sharing.weights({true, true, false});
  grad.fused.feature = testing::as_rounded(d_feature.view());
  sharing.field.backward(sharing.ctx, sharing.tensors(), sharing.in(), out, grad, sharing.space(),
                         sharing.d_position->view());
  EXPECT_EQ(sharing.d_position->read(), plain.d_position->read());
  EXPECT_EQ(sharing.gradients(), plain.gradients());
}

using CudaTinyMlpFeature = testing::DeviceTest;

TEST_F(CudaTinyMlpFeature, IsTheCpuNetworkForEveryWidthDepthAndSize) {
  struct Case {
    Network network;
    std::int64_t samples;
    std::int32_t padding;
  };
  for (const Case& c :
       {Case{branch(112, 64, 2), 4097, 0}, Case{branch(115, 128, 3), 1000, 0}, Case{branch(103, 128, 2), 1000, 1},
        Case{branch(48, 64, 1), 333, 4}, Case{branch(48, 128, 4), 333, 0}, Case{branch(39, 40, 2), 333, 3},
        Case{branch(1, 3, 2), 33, 0}, Case{branch(128, 128, 4), 1, 0}, Case{branch(64, 64, 2), 0, 0}}) {
    for (const bool with_d_position : {true, false})
      expect_like_the_oracle(c.network, c.samples, c.padding, c.network.outputs(), with_d_position);
  }
}

TEST_F(CudaTinyMlpFeature, GivesTheSameWithoutASavedBatchAndWithoutAGradientNothing) {
  const Network network = branch(112, 64, 2);
  Oracle oracle(network, 333);
  const OnDevice saved(network, oracle), unsaved(network, oracle);
  saved.forward(network.outputs());
  unsaved.forward(network.outputs(), false);
  EXPECT_EQ(saved.feature->read(), unsaved.feature->read());
  saved.backward({false, false, false});
  for (const auto* matrix : {saved.d_position.get(), saved.grads[0].get()}) {
    const std::vector<float> values = matrix->read();
    EXPECT_TRUE(std::all_of(values.begin(), values.end(), [](float value) { return value == 0; }));
  }
}

}  // namespace
}  // namespace semfield
