// config: a configuration read as a run would, explained, compared, and the schema of all.
#include <algorithm>
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "config/compose.h"
#include "config/explain.h"
#include "config/schema.h"
#include "report/sweep.h"
#include "session/settings/run_config.h"
#include "session/settings/choices.h"

namespace semfield::app {

namespace {

// config check: every error reported.

struct ConfigWords : Options {
  using Options::Options;
  const std::string& config = operand("config", "configuration file (YAML)");
  const std::vector<std::string>& set = settings();
};

int check(const ConfigWords& options, AppContext& context) {
  load_run_config(options.config, options.set, context.registry);
  print_results(context, {{"config", options.config}, {"errors", 0}}, options.config + ": no errors");
  return 0;
}

// config diff: what differs between two configurations.

struct DiffOptions : Options {
  using Options::Options;
  const std::string& a = operand("config_a", "configuration file (YAML), such as a run.yaml");
  const std::string& b = operand("config_b", "the other one");
};

int run(const DiffOptions& options, AppContext& context) {
  const RunConfig first = load_run_config(options.a, {}, context.registry);
  const RunConfig second = load_run_config(options.b, {}, context.registry);
  const std::vector<ConfigDifference> found = config_differences(resolved_config(first), resolved_config(second));
  if (context.json) {
    Json differences = Json::array();
    for (const ConfigDifference& d : found)
      differences.push_back(
          {{"key", d.key}, {"a", d.left}, {"b", d.right}, {"other_training", is_part_of_identity(d.key)}});
    print_json(context, {{"differences", differences}});
    return 0;
  }
  for (const ConfigDifference& d : found)
    std::printf("%s%s\n", d.text().c_str(), is_part_of_identity(d.key) ? "" : "   # the same training");
  return 0;
}

// config explain: the final tree, with where each value comes from.

// What stands as `auto` is settled when a session opens; each such setting's sentence, as comments below the tree.
std::string open_choices(const ConfigNode& tree) {
  std::string out;
  const std::vector<ConfigSetting> settings = config_settings(tree);
  for (const SchemaSection& section : describe_sections()) {
    for (const ParamDoc& param : section.params) {
      const std::string key = section.path + "." + param.name;
      const bool open = std::any_of(settings.begin(), settings.end(),
                                    [&](const ConfigSetting& s) { return s.key == key && s.value == "auto"; });
      if (open) out += "# " + key + " is auto: " + param.help + "\n";
    }
  }
  return out;
}

int explain(const ConfigWords& options, AppContext& context) {
  const ConfigNode written = compose_config(options.config, options.set);
  const RunConfig config = load_run_config(options.config, options.set, context.registry);
  const ConfigNode tree = with_origins(resolved_config(config), written);
  if (context.json) {
    Json settings = Json::array();
    for (const ConfigSetting& setting : config_settings(tree))
      settings.push_back({{"key", setting.key}, {"value", setting.value}, {"from", setting.from}});
    print_json(context, {{"settings", settings}});
    return 0;
  }
  std::fputs((explain_config(tree) + open_choices(tree)).c_str(), stdout);
  return 0;
}

// config schema: the JSON schema of configurations, or of sweep files.

struct SchemaOptions : Options {
  using Options::Options;
  const bool& of_sweeps = flag("--sweep", "print the schema of sweep files instead");
};

int run(const SchemaOptions& options, AppContext& context) {
  if (options.of_sweeps) {
    std::fputs(sweep_schema().c_str(), stdout);
    return 0;
  }
  std::fputs(json_schema_of("Semfield configuration", describe_sections(&context.registry)).c_str(), stdout);
  return 0;
}

}  // namespace

Verb verb_config() { return make_group("config", 150, "check, explain and compare configurations"); }

Verb verb_config_check() {
  return make_verb<ConfigWords>("config check", 10, "read a configuration and report every error", check);
}

Verb verb_config_diff() {
  return make_verb<DiffOptions>("config diff", 30, "print what differs between two configurations", run);
}

Verb verb_config_explain() {
  return make_verb<ConfigWords>("config explain", 20, "print the final tree, with the origin of every value", explain);
}

Verb verb_config_schema() {
  return without_json(make_verb<SchemaOptions>("config schema", 40,
                                               "print a JSON schema of configurations (and --plugin modules)", run));
}

}  // namespace semfield::app
