// plugins list: every plugin with one sentence.
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"

namespace semfield::app {

namespace {

int print_list(AppContext& context) {
  if (context.json) {
    print_plugins_json(context);
  } else {
    print_text(plugins_list_text(context.registry));
  }
  return 0;
}

}  // namespace

Verb verb_plugins_list() {
  return with_json(make_verb("plugins list", 10, "list every plugin with one sentence", print_list));
}

}  // namespace semfield::app
