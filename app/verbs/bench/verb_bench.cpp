// bench: the group of the verbs in this folder.
#include "app/verb.h"

namespace semfield::app {

Verb verb_bench() { return make_group("bench", 180, "measure the speed of training steps"); }

}  // namespace semfield::app
