// runs: the group of the verbs in this folder.
#include "app/verb.h"

namespace semfield::app {

Verb verb_runs() { return make_group("runs", 160, "compare finished runs"); }

}  // namespace semfield::app
