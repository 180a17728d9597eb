// The laws of declared parameters.
#include <cctype>
#include <cmath>
#include <set>

#include "config/config_tree.h"
#include "config/params_read.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

// Names, sentences and defaults of every parameter, and which of them have a closed range.
class Inspector final : public ParamVisitor {
 public:
  Failures failures;
  struct Bounded {
    std::string name;
    Range range;
    bool integer;
  };
  std::vector<Bounded> bounded;

  void boolean(const ParamInfo& info, bool&) override { declare(info); }
  void integer(const ParamInfo& info, std::int64_t& value) override {
    declare(info);
    in_range(info, static_cast<double>(value));
    bounded.push_back({std::string(info.name), info.range, true});
  }
  void real(const ParamInfo& info, double& value) override {
    declare(info);
    in_range(info, value);
    bounded.push_back({std::string(info.name), info.range, false});
  }
  void text(const ParamInfo& info, std::string&) override { declare(info); }
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    declare(info);
    if (value < 0 || value >= static_cast<int>(names.size()))
      note_failure(failures, std::string(info.name), "the default is none of the choices");
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>& value) override {
    declare(info);
    for (const std::int64_t element : value) in_range(info, static_cast<double>(element));
  }
  void reals(const ParamInfo& info, std::vector<double>& value) override {
    declare(info);
    for (const double element : value) in_range(info, element);
  }
  void texts(const ParamInfo& info, std::vector<std::string>&) override { declare(info); }

 private:
  void declare(const ParamInfo& info) {
    const std::string name(info.name);
    bool snake = !name.empty();
    for (const char c : name)
      snake &= (std::islower(static_cast<unsigned char>(c)) != 0) ||
               (std::isdigit(static_cast<unsigned char>(c)) != 0) || c == '_';
    if (!snake) failures.push_back("parameter '" + name + "': the name is not snake_case");
    if (!names_.insert(name).second) failures.push_back("parameter '" + name + "': declared twice");
    if (info.help.size() < 8) failures.push_back("parameter '" + name + "': no sentence says what it is");
    if (info.range.min > info.range.max) failures.push_back("parameter '" + name + "': its range is empty");
  }
  void in_range(const ParamInfo& info, double value) {
    if (!(value >= info.range.min && value <= info.range.max)) {
      failures.push_back("parameter '" + std::string(info.name) + "': the default is outside its range");
    }
  }
  std::set<std::string> names_;
};

bool names_parameter(const Failures& refusals, const std::string& name) {
  for (const std::string& refusal : refusals) {
    if (refusal.find(name) != std::string::npos) return true;
  }
  return false;
}

Describe describer(PluginParams& params) {
  return [&params](ParamVisitor& visit) { params.describe(visit); };
}

void check_refusal(const PluginEntry& entry, const std::string& name, const std::string& value, Failures& failures) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  if (!names_parameter(apply_settings(*params, {{name, value}}), name)) {
    failures.push_back("bad parameters: " + name + " = '" + value + "' is not refused by name");
  }
  const ConfigNode node = parse_config_text(name + ": " + value + "\n", "test.yaml");
  Diagnostics diagnostics;
  read_params(node, entry.name, describer(*params), diagnostics);
  Failures refusals;
  for (const Diagnostic& finding : diagnostics.all()) refusals.push_back(finding.text());
  if (!diagnostics.has_errors() || !names_parameter(refusals, name)) {
    failures.push_back("bad parameters: the config reader does not refuse " + name + ": " + value + " by name");
  }
}

// Defaults written as YAML, parsed and read into fresh parameters are the same YAML again.
void check_config_round_trip(const PluginEntry& entry, Failures& failures) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  const std::string written = write_config(params_to_config(describer(*params)));
  const std::unique_ptr<PluginParams> again = entry.new_params();
  Diagnostics diagnostics;
  read_params(parse_config_text(written, "test.yaml"), entry.name, describer(*again), diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) note_failure(failures, "config round trip", finding.text());
  if (write_config(params_to_config(describer(*again))) != written)
    failures.push_back("config round trip: parameters change");
}

}  // namespace

Failures declaration_laws(const PluginEntry& entry) {
  Failures failures;
  if (entry.summary.size() < 8) failures.push_back("entry: no sentence says what the plugin does");
  const std::unique_ptr<PluginParams> params = entry.new_params();
  Inspector inspector;
  params->describe(inspector);
  append(failures, inspector.failures);
  Diagnostics diagnostics;
  params->validate(diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) {
    // A dataset's path has no default that could be valid.
    if (finding.severity == Severity::error && entry.kind != PluginKind::dataset)
      failures.push_back("defaults: " + finding.text());
  }
  const Settings written = settings_of(*params);
  const std::unique_ptr<PluginParams> again = entry.new_params();
  append(failures, apply_settings(*again, written));
  if (settings_of(*again) != written) failures.push_back("round trip: parameters change when written and read");
  check_config_round_trip(entry, failures);
  check_refusal(entry, "no_such_parameter", "1", failures);
  for (const Inspector::Bounded& parameter : inspector.bounded) {
    check_refusal(entry, parameter.name, "not_a_number", failures);
    const bool reachable = std::isfinite(parameter.range.max) && std::abs(parameter.range.max) < 9e15;
    if (reachable)
      check_refusal(entry, parameter.name, std::to_string(static_cast<long long>(std::floor(parameter.range.max)) + 1),
                    failures);
  }
  return failures;
}

}  // namespace semfield::testkit
