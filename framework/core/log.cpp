#include "core/log.h"

#include <mutex>
#include <utility>

namespace semfield {

namespace {
std::mutex g_mutex;
LogSink g_sink;

void emit(Severity severity, const std::string& text) {
  const std::lock_guard<std::mutex> lock(g_mutex);
  if (g_sink) g_sink(severity, text);
}
}  // namespace

void set_log_sink(LogSink sink) {
  const std::lock_guard<std::mutex> lock(g_mutex);
  g_sink = std::move(sink);
}
void log_note(const std::string& text) { emit(Severity::note, text); }
void log_warning(const std::string& text) { emit(Severity::warning, text); }

}  // namespace semfield
