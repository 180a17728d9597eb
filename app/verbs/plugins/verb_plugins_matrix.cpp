// plugins matrix: which plugin runs on which device.
#include "app/verb.h"
#include "app/verbs/plugins/plugin_output.h"
#include "plugin/reference.h"

namespace semfield::app {

namespace {

int run(AppContext& context) {
  add_cuda_kernels(context);
  print_text(support_matrix_text(context.registry));
  return 0;
}

}  // namespace

Verb verb_plugins_matrix() { return make_verb("plugins matrix", 40, "print which plugin runs on which device", run); }

}  // namespace semfield::app
