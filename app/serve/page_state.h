// The state of a labelling session as its page gets it.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "app/json_output.h"
#include "app/serve/page_exports.h"
#include "labels/serve/label_session.h"

namespace semfield::app {

/// `known`: the session's revision that the client has seen, 0 for none: marks that are no newer are null.
/// `first`: PageOptions::first_revision; `now`: what the client gives back as `after`.
Json state_json(const LabelState& s, const LabelSource& source, const std::vector<ExportState>& exports,
                const std::string& run_id, std::uint64_t known, std::uint64_t first, std::uint64_t now);

}  // namespace semfield::app
