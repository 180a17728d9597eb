// How far the opening of a scene is, for whoever shows it.
#pragma once

#include <cstddef>
#include <string_view>

#include "core/work_scope.h"

namespace semfield {

/// Tells WorkSettings::load_progress of this thread. From any thread; one call is passed on at a time.
void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total);

}  // namespace semfield
