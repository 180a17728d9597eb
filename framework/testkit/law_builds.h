// The ways in which plugins are built for their laws, and their twins in double on the CPU.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "testkit/laws.h"

namespace semfield::testkit {

/// A plugin in float on a device, and its oracle.
template <class Float, class Double>
struct Twins {
  std::unique_ptr<Float> single;
  std::unique_ptr<Double> oracle;
};

/// For positions and for directions.
std::vector<EncoderBuild> encoder_builds(Device device);
/// In fp32 with all inputs and outputs, and with one left out at a time; the same in bf16 where the field has such
/// kernels for the device.
std::vector<FieldBuild> field_builds(const Registry& registry, const std::string& name, Device device);
SamplerBuild sampler_build(Device device);
/// Of one column and of many.
std::vector<HeadBuild> head_builds(Device device);

/// "directions", "bf16, no feature", "".
std::string text_of(const EncoderBuild& build);
std::string text_of(const FieldBuild& build);
std::string text_of(const SamplerBuild& build);
std::string text_of(const HeadBuild& build);

/// Throws what factories throw; a refusal is an Error.
Twins<Encoder<float>, Encoder<double>> make_twins(const Registry& registry, const std::string& name,
                                                  const Settings& settings, const EncoderBuild& build);
Twins<Field<float>, Field<double>> make_twins(const Registry& registry, const std::string& name,
                                              const Settings& settings, const FieldBuild& build);
Twins<Sampler<float>, Sampler<double>> make_twins(const Registry& registry, const std::string& name,
                                                  const Settings& settings, const SamplerBuild& build);
Twins<Head<float>, Head<double>> make_twins(const Registry& registry, const std::string& name, const Settings& settings,
                                            const HeadBuild& build);

}  // namespace semfield::testkit
