// The small network on the device beside its float64 twin on the processor, as its tests use them.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "cuda/kernel_tables.h"
#include "device_fixture.h"
#include "fields/tiny_mlp/tiny_mlp.h"
#include "fields/tiny_mlp/tiny_mlp_layers.cuh"
#include "testkit/field_bench.h"

namespace semfield::testing {

using testkit::FieldBench;
using testkit::Wanted;

inline const KernelTables& cpu_tables() {
  static const KernelTables tables = [] {
    KernelTables t;
    tiny_mlp_kernels(t);
    return t;
  }();
  return tables;
}
inline const KernelTables& device_tables() {
  static const KernelTables tables = [] {
    KernelTables t;
    cuda::add_plugin_kernels(t);
    return t;
  }();
  return tables;
}
/// Layer by layer whatever the widths.
inline const KernelTables& layer_tables() {
  static const TinyMlpKernels<float> table{cuda::tiny::layers_forward, cuda::tiny::layers_backward,
                                           [](const TinyMlpShape&, const Tensors<float>&) {},
                                           cuda::tiny::layers_saved_bytes};
  static const KernelTables tables = [] {
    KernelTables t;
    t.add(Device::cuda, "field 'tiny_mlp'", &table);
    t.add(Device::cuda, "field 'tiny_mlp'", &table, Precision::bf16);
    return t;
  }();
  return tables;
}

struct Network {
  TinyMlpParams params;
  std::int32_t position_dims = 32, direction_dims = 16;
  bool once = true;
  Precision precision = Precision::fp32;

  FieldBuild build(Device device) const {
    FieldBuild b;
    b.device = device;
    b.position_dims = position_dims;
    b.direction_dims = direction_dims;
    b.savings.direction_once_per_ray = once;
    b.precision = device == Device::cpu ? Precision::fp32 : precision;
    return b;
  }
  std::string text() const {
    return "hidden " + std::to_string(params.hidden_layers) + " x " + std::to_string(params.hidden_width) +
           ", geometry " + std::to_string(params.geometry_features) + ", colour " +
           std::to_string(params.color_layers) + " x " + std::to_string(params.color_width) + ", feature " +
           std::to_string(static_cast<int>(params.feature)) + ", position " + std::to_string(position_dims) +
           ", direction " + std::to_string(direction_dims) + ", once " + std::to_string(once) + ", bf16 " +
           std::to_string(precision == Precision::bf16);
  }
};

inline std::vector<float> flat(View<const double> view) {
  std::vector<float> values;
  for (std::int64_t r = 0; r < view.rows; ++r) {
    for (std::int32_t c = 0; c < view.cols; ++c) values.push_back(static_cast<float>(view(r, c)));
  }
  return values;
}

/// Inputs, tensors and outputs of a float64 bench, in device memory.
class OnDevice {
 public:
  OnDevice(const Network& network, const KernelTables& tables, FieldBench<double>& bench, std::int32_t padding)
      : field(network.params, network.build(Device::cuda), tables) {
    const std::int64_t rows = bench.position.rows();
    const auto copy = [&](const testkit::Guarded<double>& from) {
      return std::make_unique<DeviceMatrix<float>>(flat(from.view()), from.cols(), from.cols() + padding);
    };
    const auto space = [&](std::int32_t cols) {
      return std::make_unique<DeviceMatrix<float>>(rows, cols, cols + padding);
    };
    position = copy(bench.position);
    if (bench.direction.cols() > 0) direction = copy(bench.direction);
    std::vector<std::int32_t> rays;
    for (std::int64_t m = 0; m < rows; ++m) rays.push_back(bench.ray_of_sample(m, 0));
    ray_of_sample = std::make_unique<DeviceMatrix<std::int32_t>>(rays, 1);
    w_sigma = copy(bench.w_sigma), w_rgb = copy(bench.w_rgb), w_feature = copy(bench.w_feature);
    sigma = space(1), rgb = space(3), feature = space(bench.feature.cols()), d_position = space(network.position_dims);
    for (std::size_t i = 0; i < bench.box.count(); ++i) {
      const View<double> value = bench.box.value(i);
      values.push_back(std::make_unique<DeviceMatrix<float>>(flat(value), value.cols));
      grads.push_back(std::make_unique<DeviceMatrix<float>>(std::vector<float>(static_cast<std::size_t>(value.size())),
                                                            value.cols));
      value_views.push_back(values.back()->view());
      grad_views.push_back(grads.back()->view());
    }
    saved = std::make_unique<DeviceMatrix<std::byte>>(
        static_cast<std::int64_t>(field.saved_bytes(rows, direction ? direction->view().rows : 0)), 1);
    ctx.training = true;
    ctx.workspace = &launch.arena();
  }

  FieldIn<float> in() const {
    FieldIn<float> inputs;
    inputs.position = position->view();
    if (direction) inputs.direction = direction->view();
    inputs.ray_of_sample = ray_of_sample->view();
    return inputs;
  }
  FieldOut<float> out(Wanted wanted = {}) const {
    FieldOut<float> outputs;
    if (wanted.sigma) outputs.sigma = sigma->view();
    if (wanted.rgb) outputs.rgb = rgb->view();
    if (wanted.feature) outputs.feature = feature->view();
    return outputs;
  }
  FieldGrad<float> weights(Wanted wanted = {}) const {
    FieldGrad<float> w;
    if (wanted.sigma) w.sigma = w_sigma->view();
    if (wanted.rgb) w.rgb = w_rgb->view();
    if (wanted.feature) w.feature = w_feature->view();
    return w;
  }
  Tensors<float> tensors() const { return {value_views, grad_views}; }
  Saved space() const { return Saved(saved->data(), static_cast<std::size_t>(saved->view().rows)); }
  void forward(Wanted wanted = {}) const { field.forward(ctx, tensors(), in(), out(wanted), space()); }
  void backward(Wanted wanted = {}, bool with_d_position = true) const {
    field.backward(ctx, tensors(), in(), out(), weights(wanted), space(),
                   with_d_position ? d_position->view() : View<float>());
  }

  DeviceLaunch launch;
  TinyMlp<float> field;
  StepContext ctx;
  std::unique_ptr<DeviceMatrix<float>> position, direction, w_sigma, w_rgb, w_feature, sigma, rgb, feature, d_position;
  std::unique_ptr<DeviceMatrix<std::int32_t>> ray_of_sample;
  std::unique_ptr<DeviceMatrix<std::byte>> saved;
  std::vector<std::unique_ptr<DeviceMatrix<float>>> values, grads;
  std::vector<View<float>> value_views, grad_views;
};

/// A float64 network on the CPU with its inputs.
struct Oracle {
  Oracle(const Network& network, std::int64_t samples)
      : field(network.params, network.build(Device::cpu), cpu_tables()),
        bench(field, network.build(Device::cpu), samples, 0, {}) {}
  TinyMlp<double> field;
  FieldBench<double> bench;
};

}  // namespace semfield::testing
