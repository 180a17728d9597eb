// plugins: the group of the verbs in this folder.
#include "app/verb.h"

namespace semfield::app {

Verb verb_plugins() { return make_group("plugins", 170, "list plugins and their parameters, and check them"); }

}  // namespace semfield::app
