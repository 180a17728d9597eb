// config check: a configuration read as a run would, every error reported.
#include <cstdio>

#include "app/json_output.h"
#include "app/verb.h"

namespace semfield::app {

namespace {

int check(const ConfigOptions& options, AppContext& context) {
  load_run_config(options.config, options.set, context.registry);
  if (context.json) {
    print_json(context, {{"config", options.config}, {"errors", 0}});
    return 0;
  }
  std::printf("%s: no errors\n", options.config.c_str());
  return 0;
}

void check_words(VerbWords& verb, ConfigOptions& options) { verb.config(options); }

}  // namespace

Verb verb_config_check() {
  return with_json(
      make_verb<ConfigOptions>("config check", 10, "read a configuration and report every error", check_words, check));
}

}  // namespace semfield::app
