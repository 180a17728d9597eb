// Ways of building, and twins.
#include "testkit/law_builds.h"

#include "plugin/kernels.h"

namespace semfield::testkit {

std::vector<EncoderBuild> encoder_builds(Device device) {
  std::vector<EncoderBuild> builds(2);
  builds[1].is_direction = true;
  for (EncoderBuild& build : builds) {
    build.device = device;
    build.extent_m = 6.0;
    build.pixel_footprint_m = 0.01;
  }
  return builds;
}

std::vector<FieldBuild> field_builds(const Registry& registry, const std::string& name, Device device) {
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

SamplerBuild sampler_build(Device device) {
  SamplerBuild build;
  build.device = device;
  build.bounds = {{-3, -2, -1.2}, {3, 2, 1.2}};
  build.near_m = 0.1;
  build.far_m = 5.0;
  return build;
}

std::vector<HeadBuild> head_builds(Device device) { return {{device, 24, 7}, {device, 5, 1}}; }

std::string text_of(const EncoderBuild& build) { return build.is_direction ? "directions" : "positions"; }

std::string text_of(const FieldBuild& build) {
  std::string text = build.precision == Precision::bf16 ? "bf16" : "fp32";
  if (build.direction_dims == 0) text += ", no direction";
  if (!build.wants_feature) text += ", no feature";
  const ExactSavings& savings = build.savings;
  if (!savings.fold_feature_layer && !savings.direction_once_per_ray && !savings.deferred_class_layer)
    text += ", no savings";
  return text;
}

std::string text_of(const SamplerBuild&) { return {}; }

std::string text_of(const HeadBuild& build) { return build.width == 1 ? "one column" : "several columns"; }

Twins<Encoder<float>, Encoder<double>> make_twins(const Registry& registry, const std::string& name,
                                                  const Settings& settings, const EncoderBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::encoder, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  EncoderBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  return {entry.encoder32(*params, build, registry.kernels()), entry.encoder64(*params, on_cpu, registry.kernels())};
}

Twins<Field<float>, Field<double>> make_twins(const Registry& registry, const std::string& name,
                                              const Settings& settings, const FieldBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::field, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  FieldBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  on_cpu.precision = Precision::fp32;
  return {entry.field32(*params, build, registry.kernels()), entry.field64(*params, on_cpu, registry.kernels())};
}

Twins<Sampler<float>, Sampler<double>> make_twins(const Registry& registry, const std::string& name,
                                                  const Settings& settings, const SamplerBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::sampler, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  SamplerBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  return {entry.sampler32(*params, build, registry.kernels()), entry.sampler64(*params, on_cpu, registry.kernels())};
}

Twins<Head<float>, Head<double>> make_twins(const Registry& registry, const std::string& name, const Settings& settings,
                                            const HeadBuild& build) {
  const PluginEntry& entry = registry.get(PluginKind::head, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  HeadBuild on_cpu = build;
  on_cpu.device = Device::cpu;
  return {entry.head32(*params, build, registry.kernels()), entry.head64(*params, on_cpu, registry.kernels())};
}

}  // namespace semfield::testkit
