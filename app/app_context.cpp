#include "app/app_context.h"

#include "app/terminal.h"

namespace semfield::app {

void print_note(const AppContext& context, const std::string& text) {
  if (!context.quiet) say(text, context.terminal);
}

}  // namespace semfield::app
