// bench: the group of the verbs in this folder.
#include "app/verb.h"

namespace semfield::app {

Verb verb_bench() { return make_group("bench", 180, "measure speed, integration error and left-out components"); }

}  // namespace semfield::app
