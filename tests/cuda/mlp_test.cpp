// A network with every kind of layer on the device, against the CPU's in float64.
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "cuda/kernel_tables.h"
#include "device_fixture.h"
#include "testkit/compare.h"
#include "testkit/tensor_box.h"
#include "tests/plugin/mlp_network.h"

namespace semfield {
namespace {

using namespace testing_mlp;
using testing::DeviceLaunch;
using testing::DeviceMatrix;
using testing::host_view;

std::vector<double> numbers(std::int64_t count, double phase) {
  std::vector<double> values;
  for (std::int64_t i = 0; i < count; ++i)
    values.push_back(static_cast<float>(std::sin(phase + 1.7 * static_cast<double>(i))));
  return values;
}
std::vector<double> flat(View<const double> view) { return {view.data, view.data + view.size()}; }

template <class T>
using Matrices = std::vector<std::unique_ptr<DeviceMatrix<T>>>;

std::string near(const DeviceMatrix<float>& got, View<const double> want, double tolerance) {
  const std::vector<float> values = got.read();
  return testkit::compare_norms<float, double>(host_view(values, want.cols), want, tolerance);
}

void expect_twin(bool fold, bool rays_once, std::int64_t samples) {
  SCOPED_TRACE("fold " + std::to_string(fold) + ", once per ray " + std::to_string(rays_once) + ", " +
               std::to_string(samples) + " samples");
  static const KernelTables cpu = testing::tables_of({mlp_kernels}), gpu = testing::tables_of({cuda::add_mlp_kernels});
  const Mlp<double> host = everything<double>(build_of(fold, rays_once), cpu);
  const Mlp<float> device = everything<float>(build_of(fold, rays_once, Precision::fp32, Device::cuda), gpu);
  const testkit::TensorBox<double> box(host, 1);
  const std::vector<double> x = numbers(samples * kIn, 0), rays = numbers(kRays * kRay, 2);
  std::vector<std::int32_t> ray_of;
  for (std::int64_t m = 0; m < samples; ++m) ray_of.push_back(static_cast<std::int32_t>(m * kRays / samples));

  Workspace arena;
  std::vector<double> outputs[3], weights[3], dx(x.size());
  std::vector<MlpOut<double>> out(3);
  std::vector<MlpGrad<double>> grad(3);
  for (std::size_t k = 0; k < 3; ++k) {
    outputs[k].resize(static_cast<std::size_t>(samples * kOut[k]));
    weights[k] = numbers(samples * kOut[k], 3 + static_cast<double>(k));
    out[k].rows = {outputs[k].data(), samples, kOut[k]};
    grad[k].rows = {weights[k].data(), samples, kOut[k]};
  }
  const MlpIn<double> in{{x.data(), samples, kIn}, {rays.data(), kRays, kRay}, {ray_of.data(), samples, 1}};
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
    values.push_back(std::make_unique<DeviceMatrix<float>>(flat(box.value(i)), box.value(i).cols));
    grads.push_back(std::make_unique<DeviceMatrix<float>>(
        std::vector<float>(static_cast<std::size_t>(box.value(i).size())), box.value(i).cols));
    value_views.push_back(values.back()->view());
    grad_views.push_back(grads.back()->view());
  }
  const Tensors<float> tensors{value_views, grad_views};
  const DeviceMatrix<float> x_there(x, kIn), rays_there(rays, kRay), dx_there(samples, kIn);
  const DeviceMatrix<std::int32_t> ray_there(ray_of, 1);
  const MlpIn<float> in_there{x_there.view(), rays_there.view(), ray_there.view()};
  std::vector<MlpOut<float>> out_there(3);
  std::vector<MlpGrad<float>> grad_there(3);
  for (std::size_t k = 0; k < 3; ++k) {
    outs.push_back(std::make_unique<DeviceMatrix<float>>(samples, kOut[k], kOut[k] + 3));
    out_weights.push_back(std::make_unique<DeviceMatrix<float>>(weights[k], kOut[k]));
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

  for (std::size_t k = 0; k < 3; ++k) EXPECT_EQ(near(*outs[k], out[k].rows, 2e-5), "") << "output " << k;
  EXPECT_EQ(near(dx_there, {dx.data(), samples, kIn}, 2e-4), "");
  for (std::size_t i = 0; i < specs.count(); ++i) {
    if (!is_learned(specs.specs()[i].role)) continue;
    EXPECT_EQ(near(*grads[i], box.grad(i), 2e-4), "") << specs.specs()[i].name;
  }
}

TEST(CudaMlp, IsTheCpusForEverySwitchAndSize) {
  SEMFIELD_NEEDS_DEVICE();
  for (const bool fold : {true, false}) {
    for (const bool rays_once : {true, false}) {
      for (const std::int64_t samples : {1, 33, 1030}) expect_twin(fold, rays_once, samples);
    }
  }
}

}  // namespace
}  // namespace semfield
