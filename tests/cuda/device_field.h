// A field on the device with the inputs, tensors and output weights of a float64 bench on the CPU, its oracle.
#pragma once

#include <cuda_bf16.h>

#include "device_fixture.h"
#include "plugin/field.h"
#include "testkit/compare.h"
#include "testkit/field_bench.h"

namespace semfield::testing {

using testkit::FieldBench;
using testkit::Wanted;

/// bf16 numbers of the device as the field contract names them.
inline View<Bf16> as_rounded(View<__nv_bfloat16> v) {
  return {reinterpret_cast<Bf16*>(v.data), v.rows, v.cols, v.row_stride, v.device};
}

class DeviceField {
 public:
  /// `padding`: columns between the rows of inputs and outputs.
  DeviceField(const Field<float>& of, FieldBench<double>& bench, std::int32_t padding = 0) : field(of) {
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
    sigma = space(1), rgb = space(3), feature = space(bench.feature.cols()), d_position = space(bench.position.cols());
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
    FieldIn<float> inputs{.position = position->view()};
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

  void derive() const { field.derive(ctx, tensors()); }
  void forward(Wanted wanted = {}, bool for_backward = true) const {
    field.forward(ctx, tensors(), in(), out(wanted), for_backward ? space() : Saved());
  }
  void backward(Wanted wanted = {}, bool with_d_position = true) const {
    field.backward(ctx, tensors(), in(), out(), weights(wanted), space(),
                   with_d_position ? d_position->view() : View<float>());
    field.derive_backward(ctx, tensors());
  }
  /// Gradients of all tensors one behind the other.
  std::vector<float> all_grads() const {
    std::vector<float> all;
    for (const auto& grad : grads) {
      const std::vector<float> values_of_one = grad->read();
      all.insert(all.end(), values_of_one.begin(), values_of_one.end());
    }
    return all;
  }

  DeviceLaunch launch;
  const Field<float>& field;
  StepContext ctx;
  std::unique_ptr<DeviceMatrix<float>> position, direction, w_sigma, w_rgb, w_feature, sigma, rgb, feature, d_position;
  std::unique_ptr<DeviceMatrix<std::int32_t>> ray_of_sample;
  std::unique_ptr<DeviceMatrix<std::byte>> saved;
  std::vector<std::unique_ptr<DeviceMatrix<float>>> values, grads;
  std::vector<View<float>> value_views, grad_views;

 private:
  static std::vector<float> flat(View<const double> view) {
    std::vector<float> values_of_one;
    for (std::int64_t r = 0; r < view.rows; ++r) {
      for (std::int32_t c = 0; c < view.cols; ++c) values_of_one.push_back(static_cast<float>(view(r, c)));
    }
    return values_of_one;
  }
};

/// floor: what sums of terms are like whose total may cancel (testkit/compare.h).
inline std::string near(const DeviceMatrix<float>& got, View<const double> want, double tolerance,
                        double floor = 1e-30) {
  const std::vector<float> values = got.read();
  return testkit::compare<float, double>(host_view(values, want.cols), want, tolerance, floor);
}
inline std::string near_norm(const DeviceMatrix<float>& got, View<const double> want, double tolerance) {
  const std::vector<float> values = got.read();
  return testkit::compare_norms<float, double>(host_view(values, want.cols), want, tolerance);
}

}  // namespace semfield::testing
