// Parameters from texts, ways of building, costs, and the laws of declared parameters.
#include "testkit/laws.h"

#include <algorithm>
#include <cctype>
#include <cmath>
#include <set>

#include "config/config_tree.h"
#include "config/params.h"
#include "core/files.h"
#include "core/text.h"
#include "plugin/kernels.h"

namespace semfield::testkit {

namespace {

// A value as it would stand in a configuration.
ConfigNode node_of(const std::string& value, bool is_list) {
  const auto scalar = [](std::string_view text) { return ConfigNode::make_scalar(std::string(text), false, {}); };
  if (!is_list) return scalar(value);
  return ConfigNode::list_of(value.empty() ? std::vector<std::string_view>() : parts_of(value, ','), scalar);
}

}  // namespace

std::vector<SettingsLine> read_settings_lines(const std::string& path) {
  std::vector<SettingsLine> lines;
  const std::string text = read_text_file(path);
  std::string_view rest = text, line;
  for (int number = 1; next_line(rest, line); ++number) {
    const std::vector<std::string_view> words = words_of(line);
    if (words.empty() || words[0].starts_with('#')) continue;
    SettingsLine read{number, {}};
    for (const std::string_view word : words) {
      if (words.size() == 1 && word == "defaults") break;
      const std::size_t equals = word.find('=');
      if (equals == std::string_view::npos || equals == 0)
        throw Error(ErrorKind::config, "plugin.laws.settings",
                    path + ":" + std::to_string(number) + ": '" + std::string(word) + "' sets nothing",
                    "write name=value name=value, or the one word defaults");
      read.settings[std::string(word.substr(0, equals))] = word.substr(equals + 1);
    }
    lines.push_back(std::move(read));
  }
  return lines;
}

Failures apply_settings(PluginParams& params, const Settings& settings) {
  const Describe describe = described(params);
  std::vector<ConfigNode::Entry> entries;
  for (const auto& [name, value] : settings) {
    bool is_list = false;
    for (const ParamDoc& doc : describe_params(describe)) is_list |= doc.name == name && doc.type.starts_with("list");
    entries.emplace_back(name, node_of(value, is_list));
  }
  Diagnostics diagnostics;
  read_params(ConfigNode::make_map(std::move(entries), {}), {}, describe, diagnostics);
  Failures failures;
  for (const Diagnostic& finding : diagnostics.all()) failures.push_back(finding.text());
  return failures;
}

std::unique_ptr<PluginParams> make_params(const PluginEntry& entry, const Settings& settings) {
  std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics diagnostics;
  for (const std::string& failure : apply_settings(*params, settings))
    diagnostics.error("plugin.laws.settings", entry.name, failure, {});
  params->validate(diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, {});
  return params;
}

// Ways of building.

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
  FieldBuild no_savings = all;
  no_savings.savings = {false, false};
  std::vector<FieldBuild> builds{all, no_direction, no_savings};
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
  const ExactSavings& savings = build.savings;
  if (!savings.fold_feature_layer && !savings.direction_once_per_ray) text += ", no savings";
  return text;
}

std::string text_of(const SamplerBuild&) { return {}; }

std::string text_of(const HeadBuild& build) { return build.width == 1 ? "one column" : "several columns"; }

// The laws of declared parameters.

namespace {

struct Bounded {
  std::string name;
  Range range;
};

// Names, sentences and defaults of every parameter; those that are one number.
std::vector<Bounded> inspect(PluginParams& params, Failures& failures) {
  std::vector<Bounded> numbers;
  std::set<std::string> names;
  each_param(described(params), [&]<class T>(const ParamInfo& info, const T& value) {
    const std::string name(info.name), parameter = "parameter '" + name + "': ";
    const bool snake = !name.empty() && std::all_of(name.begin(), name.end(), [](unsigned char c) {
      return std::islower(c) != 0 || std::isdigit(c) != 0 || c == '_';
    });
    if (!snake) failures.push_back(parameter + "the name is not snake_case");
    if (!names.insert(name).second) failures.push_back(parameter + "declared twice");
    if (info.help.size() < 8) failures.push_back(parameter + "no sentence says what it is");
    if (info.range.min > info.range.max) failures.push_back(parameter + "its range is empty");
    const auto in_range = [&](double number) {
      if (!(number >= info.range.min && number <= info.range.max))
        failures.push_back(parameter + "the default is outside its range");
    };
    if constexpr (std::is_same_v<T, std::int64_t> || std::is_same_v<T, double>) {
      in_range(static_cast<double>(value));
      numbers.push_back({name, info.range});
    } else if constexpr (std::is_same_v<T, std::vector<std::int64_t>> || std::is_same_v<T, std::vector<double>>) {
      for (const auto element : value) in_range(static_cast<double>(element));
    } else if constexpr (std::is_same_v<T, ChosenName>) {
      if (value.index < 0 || value.index >= std::ssize(value.names))
        note_failure(failures, name, "the default is none of the choices");
    }
  });
  return numbers;
}

void check_refusal(const PluginEntry& entry, const std::string& name, const std::string& value, Failures& failures) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const ConfigNode node = parse_config_text(name + ": " + value + "\n", "test.yaml");
  Diagnostics diagnostics;
  read_params(node, entry.name, described(*params), diagnostics);
  const bool by_name = std::any_of(diagnostics.all().begin(), diagnostics.all().end(), [&](const Diagnostic& finding) {
    return finding.text().find(name) != std::string::npos;
  });
  if (!diagnostics.has_errors() || !by_name)
    failures.push_back("bad parameters: the config reader does not refuse " + name + ": " + value + " by name");
}

// Defaults written as YAML, parsed and read into fresh parameters are the same YAML again.
void check_config_round_trip(const PluginEntry& entry, Failures& failures) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const std::string written = write_config(params_to_config(described(*params)));
  const std::unique_ptr<PluginParams> again = entry.new_params();
  Diagnostics diagnostics;
  read_params(parse_config_text(written, "test.yaml"), entry.name, described(*again), diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) note_failure(failures, "config round trip", finding.text());
  if (write_config(params_to_config(described(*again))) != written)
    failures.push_back("config round trip: parameters change");
}

}  // namespace

Failures declaration_laws(const PluginEntry& entry) {
  Failures failures;
  if (entry.summary.size() < 8) failures.push_back("entry: no sentence says what the plugin does");
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const std::vector<Bounded> numbers = inspect(*params, failures);
  Diagnostics diagnostics;
  params->validate(diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) {
    // A dataset's path has no default that could be valid.
    if (finding.severity == Severity::error && entry.kind != PluginKind::dataset)
      failures.push_back("defaults: " + finding.text());
  }
  check_config_round_trip(entry, failures);
  check_refusal(entry, "no_such_parameter", "1", failures);
  for (const Bounded& parameter : numbers) {
    check_refusal(entry, parameter.name, "not_a_number", failures);
    const bool reachable = std::isfinite(parameter.range.max) && std::abs(parameter.range.max) < 9e15;
    if (reachable)
      check_refusal(entry, parameter.name, std::to_string(static_cast<long long>(std::floor(parameter.range.max)) + 1),
                    failures);
  }
  return failures;
}

}  // namespace semfield::testkit
