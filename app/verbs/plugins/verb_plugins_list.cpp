// plugins list: every plugin with one sentence, or with the devices that it runs on.
#include "app/json_output.h"
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"

namespace semfield::app {

namespace {

struct ListOptions {
  bool devices = false;
};

void print_devices(AppContext& context) {
  add_cuda_kernels(context);
  if (!context.json) {
    print_text(support_matrix_text(context.registry));
    return;
  }
  Json plugins = Json::array();
  for (const PluginEntry* entry : context.registry.entries())
    plugins.push_back({{"kind", kind_name(entry->kind)},
                       {"name", entry->name},
                       {"devices", devices_text(context.registry, *entry)},
                       {"module", entry->module}});
  print_json(context, {{"plugins", plugins}});
}

int run(const ListOptions& options, AppContext& context) {
  if (options.devices) {
    print_devices(context);
  } else if (context.json) {
    print_plugins_json(context);
  } else {
    print_text(plugins_list_text(context.registry));
  }
  return 0;
}

void words(VerbWords& verb, ListOptions& options) {
  verb.flag("--devices", options.devices, "print which plugin runs on which device");
}

}  // namespace

Verb verb_plugins_list() {
  return with_json(make_verb<ListOptions>("plugins list", 10, "list every plugin with one sentence", words, run));
}

}  // namespace semfield::app
