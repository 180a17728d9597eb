// The laws of each plugin kind, as plain functions that return every way they were broken: call them from any test
// framework.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <tuple>
#include <type_traits>
#include <vector>

#include "core/workspace.h"
#include "plugin/field.h"
#include "plugin/registry.h"

namespace semfield::testkit {

using Failures = std::vector<std::string>;

/// Adds "<law>: <sentence>" unless the sentence is empty.
inline void note_failure(Failures& failures, const std::string& law, const std::string& sentence) {
  if (!sentence.empty()) failures.push_back(law + ": " + sentence);
}

inline void append(Failures& to, const Failures& from) { to.insert(to.end(), from.begin(), from.end()); }

/// One failure a line, for an assertion's message.
std::string to_text(const Failures& failures);

// Parameters of a registry entry from a small map of texts, without a config file.

/// Parameter name to value as text: "16", "0.5", "true", a choice's name, lists as "1,2,3".
using Settings = std::map<std::string, std::string>;

struct SettingsLine {
  int number = 0;     ///< in its file, from 1
  Settings settings;  ///< empty: the defaults
};
/// Lines "name=value name=value" or "defaults" of a file as conformance.txt; blank ones and those that begin with '#'
/// are passed over. Throws Error(config) with file and line for a word without '=', Error(no_input).
std::vector<SettingsLine> read_settings_lines(const std::string& path);

/// Reads `settings` into the parameters and returns every problem: unknown names, wrong types, values out of range.
Failures apply_settings(PluginParams& params, const Settings& settings);

/// The entry's defaults with `settings` applied and validated. Throws Error(config) listing every problem.
std::unique_ptr<PluginParams> make_params(const PluginEntry& entry, const Settings& settings = {});

struct LawOptions {
  std::uint64_t seed = 1;
  double gradient_tolerance = 1e-5;  ///< double against central differences, of the largest gradient in the tensor
  double float_tolerance = 1e-4;     ///< float against double, of the largest value in the matrix
  double bf16_tolerance = 0.02;      ///< outputs of bf16 products against double, of the largest value in the matrix
  /// Gradients of bf16 products against double, in norm: a unit whose input lies within rounding of zero takes the
  /// other branch of its ReLU. That happens to about one in 200 a layer, so some 30 samples through 8 layers differ by
  /// sqrt(8 / 200) = 0.2; sums over a batch by less. What a product may be off is bounded where products are tested.
  double bf16_gradient_tolerance = 0.25;
  std::int64_t many_rows = 4097;  ///< the largest batch
  int gradient_elements = 24;     ///< elements of each tensor that central differences check
  BlockSource scratch;            ///< of the float component's workspace: a device's, for a twin of host_twin.h
  /// Same bits for a batch that is cut, and for an output beside others that are not wanted. Not so where a library
  /// chooses the kernel of a product by its shape, and with it the order of its sums: then within float_tolerance, or
  /// the tolerances of bf16.
  bool same_bits_in_parts = true;
  /// Same bits of gradients that are sums over rows, in every run. Not so where rows are added as they come: then
  /// within float_tolerance.
  bool same_bits_of_sums = true;
  /// Called with the name of each law before it is asked; may be empty.
  std::function<void(const std::string& law)> on_law{};
  void begin(const std::string& law) const {
    if (on_law) on_law(law);
  }
};

/// Where a component of this precision has its scratch: the oracle in double always computes on the host.
template <class Real>
BlockSource scratch_of(const LawOptions& options) {
  return std::is_same_v<Real, float> ? options.scratch : BlockSource{};
}

/// Names, sentences, defaults in range and a lossless round trip of the parameters of one entry; a value outside its
/// range and an unknown name are refused, with the parameter named.
Failures declaration_laws(const PluginEntry& entry);

/// Every element written; guards and padding intact; 0, 1, 31, 33 and many rows; stride above cols; rows independent
/// under permutation and split (same bits); gradients against central differences; gradients accumulate; any thread
/// count gives the same bits; float agrees with double; a steady state allocates nothing.
Failures encoder_laws(const Encoder<float>& encoder32, const Encoder<double>& encoder64,
                      const LawOptions& options = {});

/// The encoder laws as they apply, and: sigma and feature have the same bits whatever the direction; an output that is
/// not wanted changes no other; an absent gradient counts as zero; colour lies in (0, 1); the same call again gives the
/// same bits. `build` gives the widths of the
/// inputs, and the precision of field32; field64 is the oracle of either.
Failures field_laws(const Field<float>& field32, const Field<double>& field64, const FieldBuild& build,
                    const LawOptions& options = {});

/// Sorted; inside [near, far]; delta > 0; counts add up; an empty ray has no samples; zero rays; independent of split
/// and order through first_ray; same (seed, step) same samples; without training no randomness; float agrees with
/// double.
Failures sampler_laws(const Sampler<float>& sampler32, const Sampler<double>& sampler64, const SamplerBuild& build,
                      const LawOptions& options = {});

/// The encoder laws as they apply, and: the output is linear in (activations, opacity), and without an opacity that
/// of 1.
Failures head_laws(const Head<float>& head32, const Head<double>& head64, const HeadBuild& build,
                   const LawOptions& options = {});

/// Of hard labels and, for a loss that reads labels, of soft ones: gradients against central differences of every value
/// that it sees; moves what its traits say and nothing else; float agrees with double; gradients accumulate and have
/// the scale, the loss has not; rays independent (same bits of gradients); no ray, no loss; without a target that it
/// names, and for rays without a label, exactly 0; extremes stay finite.
Failures loss_laws(const Loss& loss, const LawOptions& options = {});

/// Gradients against central differences; float agrees with double; gradients accumulate and have the scale, the loss
/// has not; numbers of segments mean nothing; no points, no loss; extremes stay finite; equal outputs have one place.
Failures grouping_laws(const Grouping& grouping, const LawOptions& options = {});

struct DatasetExpectation {
  int frames = -1;                ///< exact number of frames, -1 = at least one
  bool depth = false;             ///< at least one frame has depth
  bool labels = false;            ///< at least one frame has labels
  double depth_tolerance = 0.05;  ///< of the depth: neighbouring frames agree for most pixels that both see
};

/// open() without errors; unique names; rotations orthonormal and right-handed; intrinsics positive; pixels of the
/// stated size; depth finite and not negative; labels in [0, classes) or void; reprojected depth agrees between
/// neighbours; parallel read = serial read.
Failures dataset_laws(Dataset& dataset, const DatasetExpectation& expected = {});
Failures dataset_laws(const Registry& registry, const std::string& name, const Settings& settings,
                      const DatasetBuild& build, const DatasetExpectation& expected = {});

/// Every law of a plugin of the registry, its declaration's included, in each way in which it is built for the CPU:
/// what `semfield plugins check` asks. A dataset needs the settings that name its scene. Throws Error for a plugin that
/// is not there, settings that it has not, and a scene that it cannot open.
Failures plugin_laws(const Registry& registry, PluginKind kind, const std::string& name, const Settings& settings = {});

// The ways in which plugins are built for their laws, and their twins in double on the CPU.

/// A plugin in float on a device, and its oracle.
template <class Float, class Double>
struct Twins {
  std::unique_ptr<Float> single;
  std::unique_ptr<Double> oracle;
};
template <class Float, class Double>
Twins(std::unique_ptr<Float>, std::unique_ptr<Double>) -> Twins<Float, Double>;

/// For positions and for directions.
std::vector<EncoderBuild> encoder_builds(Device device);
/// In fp32 with all inputs and outputs, and with one left out at a time; the same in bf16 where the field has such
/// kernels for the device.
std::vector<FieldBuild> field_builds(const Registry& registry, const std::string& name, Device device);
SamplerBuild sampler_build(Device device);
/// Of one column and of many.
std::vector<HeadBuild> head_builds(Device device);

/// "directions", "bf16, no direction", "".
std::string text_of(const EncoderBuild& build);
std::string text_of(const FieldBuild& build);
std::string text_of(const SamplerBuild& build);
std::string text_of(const HeadBuild& build);

inline auto makers_for(const EncoderBuild&) {
  return std::tuple(PluginKind::encoder, &PluginEntry::encoder32, &PluginEntry::encoder64);
}
inline auto makers_for(const FieldBuild&) {
  return std::tuple(PluginKind::field, &PluginEntry::field32, &PluginEntry::field64);
}
inline auto makers_for(const SamplerBuild&) {
  return std::tuple(PluginKind::sampler, &PluginEntry::sampler32, &PluginEntry::sampler64);
}
inline auto makers_for(const HeadBuild&) {
  return std::tuple(PluginKind::head, &PluginEntry::head32, &PluginEntry::head64);
}

/// Throws what factories throw; a refusal is an Error.
template <class Build>
auto make_twins(const Registry& registry, const std::string& name, const Settings& settings, const Build& build) {
  const auto [kind, single, oracle] = makers_for(build);
  const PluginEntry& entry = registry.get(kind, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  Build on_cpu = build;
  on_cpu.device = Device::cpu;
  if constexpr (std::is_same_v<Build, FieldBuild>) on_cpu.precision = Precision::fp32;
  return Twins{(entry.*single)(*params, build, registry.kernels()),
               (entry.*oracle)(*params, on_cpu, registry.kernels())};
}

/// The laws of twins of whichever kind.
inline Failures laws_of(const Encoder<float>& single, const Encoder<double>& oracle, const EncoderBuild&,
                        const LawOptions& options) {
  return encoder_laws(single, oracle, options);
}
inline Failures laws_of(const Field<float>& single, const Field<double>& oracle, const FieldBuild& build,
                        const LawOptions& options) {
  return field_laws(single, oracle, build, options);
}
inline Failures laws_of(const Sampler<float>& single, const Sampler<double>& oracle, const SamplerBuild& build,
                        const LawOptions& options) {
  return sampler_laws(single, oracle, build, options);
}
inline Failures laws_of(const Head<float>& single, const Head<double>& oracle, const HeadBuild& build,
                        const LawOptions& options) {
  return head_laws(single, oracle, build, options);
}

/// body(builds), of a kind that is built for its laws: every way in which the plugin is. Does nothing for other kinds.
template <class Body>
void with_builds(const Registry& registry, PluginKind kind, const std::string& name, Device device, const Body& body) {
  if (kind == PluginKind::encoder) body(encoder_builds(device));
  if (kind == PluginKind::field) body(field_builds(registry, name, device));
  if (kind == PluginKind::sampler) body(std::vector{sampler_build(device)});
  if (kind == PluginKind::head) body(head_builds(device));
}

}  // namespace semfield::testkit
