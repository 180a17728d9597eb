// config diff: what differs between two configurations.
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "config/explain.h"

namespace semfield::app {

namespace {

struct DiffOptions {
  std::string a, b;
};

int run(const DiffOptions& options, AppContext& context) {
  const RunConfig first = load_run_config(options.a, {}, context.registry);
  const RunConfig second = load_run_config(options.b, {}, context.registry);
  if (context.json) {
    Json differences = Json::array();
    for (const ConfigDifference& d : config_differences(resolved_config(first), resolved_config(second)))
      differences.push_back({{"key", d.key}, {"a", d.left}, {"b", d.right}});
    print_json(context, {{"differences", differences}});
    return 0;
  }
  std::fputs(diff_config(resolved_config(first), resolved_config(second)).c_str(), stdout);
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
