// The shipped table of leave-out pairs (docs/reference/leave_out.json), as far as a run's own list needs it.
#pragma once

#include <string>

namespace semfield {

/// What leaving `component` out saved where it was measured, with the source; empty where no pair measured it.
std::string shipped_saving(const std::string& component);

}  // namespace semfield
