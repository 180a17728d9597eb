// config: the group of the verbs in this folder.
#include "app/verb.h"

namespace semfield::app {

Verb verb_config() { return make_group("config", 150, "check, explain and compare configurations"); }

}  // namespace semfield::app
