// What a labelling session writes for the report of its run.
#pragma once

#include "labels/clicks/annotations.h"
#include "run/run_folder.h"
#include "serve/label_loop.h"
#include "serve/label_state.h"
#include "session/session.h"

namespace semfield {

/// labelling.json and the pictures of the frames with the most clicks: photograph with clicks, labels, entropy. `state`
/// has classes, marks and the step. Throws write_error.
void write_session_record(const RunFolder& folder, const Session& session, LabelLoop& loop, const LabelState& state);

}  // namespace semfield
