// What a labelling session leaves in its run's folder for the report.
#pragma once

#include "labels/serve/label_loop.h"
#include "labels/serve/label_state.h"
#include "train/run_folder.h"
#include "train/session.h"

namespace semfield {

/// labelling.json and the pictures of the frames with the most clicks: photograph with clicks, labels, entropy. Throws
/// write_error.
void write_labelling_record(const RunFolder& folder, const Session& session, LabelLoop& loop, const LabelState& state);

}  // namespace semfield
