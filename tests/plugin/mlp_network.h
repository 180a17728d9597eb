// A network with every kind of layer, for the tests of every device.
#pragma once

#include "plugin/mlp/mlp.h"

namespace semfield::testing_mlp {

inline constexpr std::int32_t kIn = 5, kRay = 3, kWidth = 32;
inline constexpr std::int64_t kRays = 4;

inline MlpBuild build_of(bool fold = true, bool rays_once = true, Precision precision = Precision::fp32,
                         Device device = Device::cpu) {
  return {device, precision, kIn, kRay, fold, rays_once};
}

/// Every kind of layer: a chain with a skip, a sine of two inputs, columns that are read and an output, two linear
/// layers with nothing between them, a ray input, a sigmoid, an output that is read on, and a layer that nobody needs.
template <class Real>
Mlp<Real> everything(const MlpBuild& build, const KernelTables& tables) {
  using enum LayerActivation;
  Mlp<Real> net(build, tables, "test 'mlp'");
  const Rows h = net.chain({"trunk", {net.samples()}, kWidth}, 3, 2);
  const Rows waves = net.layer({"waves", {h, net.samples()}, kWidth, sine, 3});
  const Rows geometry = net.layer({"geometry", {waves}, 4, none});
  net.layer({"unneeded", {waves}, 7});
  const Rows linear = net.layer({"linear", {geometry.columns(1, 3)}, 6, none});
  const Rows view = net.layer({"view", {linear, net.rays(), h}, kWidth});
  net.output(geometry.columns(0, 1));
  net.output(net.layer({"color", {view}, 3, sigmoid}));
  net.output(h);
  net.seal();
  return net;
}
inline constexpr std::int32_t kOut[] = {1, 3, kWidth};

}  // namespace semfield::testing_mlp
