// How the plugin of a row is built for its laws, and its twin in double on the CPU.
#pragma once

#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <vector>

#include "testkit/laws.h"
#include "tests/conformance/rows.h"

namespace semfield::testkit {

/// A plugin in float on a device, and its oracle.
template <class Float, class Double>
struct Twins {
  std::unique_ptr<Float> single;
  std::unique_ptr<Double> oracle;
};

inline std::vector<EncoderBuild> encoder_builds(Device device) {
  std::vector<EncoderBuild> builds(2);
  builds[1].is_direction = true;
  for (EncoderBuild& build : builds) {
    build.device = device;
    build.extent_m = 6.0;
    build.pixel_footprint_m = 0.01;
  }
  return builds;
}

/// In fp32 with all inputs and outputs, and with one left out at a time; the same in bf16 where the field has such
/// kernels for the device.
inline std::vector<FieldBuild> field_builds(const Registry& registry, const std::string& name, Device device) {
  FieldBuild all;
  all.device = device;
  all.position_dims = 39;
  all.direction_dims = 16;
  FieldBuild no_direction = all;
  no_direction.direction_dims = 0;
  FieldBuild no_feature = all;
  no_feature.wants_feature = false;
  FieldBuild no_savings = all;
  no_savings.savings = {false, false, false};
  std::vector<FieldBuild> builds{all, no_direction, no_feature, no_savings};
  const std::string tables = registry.kernels().devices_of("field '" + name + "'");
  if (tables.find(std::string(device_name(device)) + " bf16") != std::string::npos) {
    for (FieldBuild build : {all, no_direction, no_savings}) {
      build.precision = Precision::bf16;
      builds.push_back(build);
    }
  }
  return builds;
}

/// "", or "encoder 'waves' has no cuda kernels": a plugin of the processor alone is left out of a device's laws by
/// name.
inline std::string lacks_kernels(const Registry& registry, PluginKind kind, const std::string& name, Device device) {
  const std::string owner = std::string(kind_name(kind)) + " '" + name + "'";
  if (registry.kernels().has(device, owner)) return {};
  return owner + " has no " + std::string(device_name(device)) + " kernels";
}

inline SamplerBuild sampler_build(Device device) {
  SamplerBuild build;
  build.device = device;
  build.bounds = {{-3, -2, -1.2}, {3, 2, 1.2}};
  build.near_m = 0.1;
  build.far_m = 5.0;
  return build;
}

inline Twins<Encoder<float>, Encoder<double>> make_twins(const Registry& registry, const Row& row,
                                                         const EncoderBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::encoder, row.name);
  const std::unique_ptr<PluginParams> params = make_params(entry, row.settings);
  EncoderBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  return {entry.encoder32(*params, build, registry.kernels()), entry.encoder64(*params, on_cpu, registry.kernels())};
}

inline Twins<Field<float>, Field<double>> make_twins(const Registry& registry, const Row& row,
                                                     const FieldBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::field, row.name);
  const std::unique_ptr<PluginParams> params = make_params(entry, row.settings);
  FieldBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  on_cpu.precision = Precision::fp32;
  return {entry.field32(*params, build, registry.kernels()), entry.field64(*params, on_cpu, registry.kernels())};
}

inline Twins<Sampler<float>, Sampler<double>> make_twins(const Registry& registry, const Row& row,
                                                         const SamplerBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::sampler, row.name);
  const std::unique_ptr<PluginParams> params = make_params(entry, row.settings);
  SamplerBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  return {entry.sampler32(*params, build, registry.kernels()), entry.sampler64(*params, on_cpu, registry.kernels())};
}

/// Ways of building that a factory may refuse with an Error; at least one must be accepted. `laws` gets the twins of
/// each that is.
template <class Build, class Laws>
void hold_for_any_accepted(const Registry& registry, const Row& row, const std::vector<Build>& builds,
                           const Laws& laws) {
  int accepted = 0;
  std::string refusals;
  for (const Build& build : builds) {
    decltype(make_twins(registry, row, build)) twins;
    try {
      twins = make_twins(registry, row, build);
    } catch (const Error& error) {
      refusals += std::string(error.what()) + "\n";
      continue;
    }
    ++accepted;
    SCOPED_TRACE("variant " + std::to_string(&build - builds.data()));
    const Failures failures = laws(*twins.single, *twins.oracle, build);
    EXPECT_TRUE(failures.empty()) << to_text(failures);
  }
  EXPECT_GT(accepted, 0) << "every way of building was refused:\n" << refusals;
}

}  // namespace semfield::testkit
