// plugins show: the parameters of one plugin.
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"

namespace semfield::app {

namespace {

struct ShowOptions {
  std::string name;
};

int run(const ShowOptions& options, AppContext& context) {
  add_cuda_kernels(context);
  const std::string text =
      plugin_details_text(context.registry, options.name);  // refuses an unknown name in either form
  if (context.json) {
    print_plugins_json(context, options.name);
  } else {
    print_text(text);
  }
  return 0;
}

void words(VerbWords& verb, ShowOptions& options) { verb.operand("name", options.name, "name of the plugin"); }

}  // namespace

Verb verb_plugins_show() {
  return with_json(make_verb<ShowOptions>("plugins show", 20, "print the parameters of one plugin", words, run));
}

}  // namespace semfield::app
