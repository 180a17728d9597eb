// Where library code sends its sentences; app/ decides how they look. Silent by default.
#pragma once

#include <functional>
#include <string>

#include "core/error.h"

namespace semfield {

using LogSink = std::function<void(Severity, const std::string&)>;

/// Installs the process-wide sink (nullptr: silence). Set once at start by the application or a test.
void set_log_sink(LogSink sink);
void log_note(const std::string& text);
void log_warning(const std::string& text);

}  // namespace semfield
