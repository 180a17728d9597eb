// config diff: what differs between two configurations.
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "session/settings/run_identity.h"

namespace semfield::app {

namespace {

struct DiffOptions {
  std::string a, b;
};

int run(const DiffOptions& options, AppContext& context) {
  const RunConfig first = load_run_config(options.a, {}, context.registry);
  const RunConfig second = load_run_config(options.b, {}, context.registry);
  const std::vector<ConfigDifference> found = changed_settings(resolved_config(first), resolved_config(second));
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

void words(VerbWords& verb, DiffOptions& options) {
  verb.operand("config_a", options.a, "configuration file (YAML), such as a run.yaml");
  verb.operand("config_b", options.b, "the other one");
}

}  // namespace

Verb verb_config_diff() {
  return with_json(
      make_verb<DiffOptions>("config diff", 30, "print what differs between two configurations", words, run));
}

}  // namespace semfield::app
