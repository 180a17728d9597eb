// plugins matrix: which plugin runs on which device.
#include "app/json_output.h"
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"

namespace semfield::app {

namespace {

int print_matrix(AppContext& context) {
  add_cuda_kernels(context);
  if (context.json) {
    Json plugins = Json::array();
    for (const PluginEntry* entry : context.registry.entries())
      plugins.push_back({{"kind", kind_name(entry->kind)},
                         {"name", entry->name},
                         {"devices", devices_text(context.registry, *entry)},
                         {"module", entry->module}});
    print_json(context, {{"plugins", plugins}});
    return 0;
  }
  print_text(support_matrix_text(context.registry));
  return 0;
}

}  // namespace

Verb verb_plugins_matrix() {
  return with_json(make_verb("plugins matrix", 40, "print which plugin runs on which device", print_matrix));
}

}  // namespace semfield::app
