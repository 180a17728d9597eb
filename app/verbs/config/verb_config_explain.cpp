// config explain: the final tree, with where each value comes from.
#include <algorithm>
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"
#include "config/compose.h"
#include "config/explain.h"

namespace semfield::app {

namespace {

// What stands as `auto` is settled when a session opens; each such setting's sentence, as comments below the tree.
std::string open_choices(const ConfigNode& tree) {
  std::string out;
  const std::vector<ConfigSetting> settings = config_settings(tree);
  for (const SectionDoc& section : describe_sections()) {
    for (const ParamDoc& param : section.params) {
      const std::string key = section.path + "." + param.name;
      const bool open = std::any_of(settings.begin(), settings.end(),
                                    [&](const ConfigSetting& s) { return s.key == key && s.value == "auto"; });
      if (open) out += "# " + key + " is auto: " + param.help + "\n";
    }
  }
  return out;
}

int explain(const ConfigOptions& options, AppContext& context) {
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

void explain_words(VerbWords& verb, ConfigOptions& options) { verb.config(options); }

}  // namespace

Verb verb_config_explain() {
  return with_json(make_verb<ConfigOptions>(
      "config explain", 20, "print the final tree, with the origin of every value", explain_words, explain));
}

}  // namespace semfield::app
