// The program's side of the studies in bench/.
#pragma once

#include "app/app_context.h"
#include "studies/study_tools.h"

namespace semfield::app {

/// `context` outlives them.
StudyTools study_tools(AppContext& context);

}  // namespace semfield::app
