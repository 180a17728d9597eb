// The line that shows how far the opening of a scene is.
#pragma once

#include "verbs.h"

namespace semfield::app {

/// From now on scenes that are opened show a ProgressLine. `context` outlives them.
void show_load_progress(const AppContext& context);

}  // namespace semfield::app
