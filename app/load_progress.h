// The line that shows how far the opening of a scene is.
#pragma once

#include "app/app_context.h"

namespace semfield::app {

/// Scenes that are opened under context.work show a ProgressLine. `context` outlives them.
void show_load_progress(AppContext& context);

}  // namespace semfield::app
