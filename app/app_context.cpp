#include "app/app_context.h"

#include <cstdio>

namespace semfield::app {

void print_note(const AppContext& context, const std::string& text) {
  if (!context.quiet) std::fprintf(stderr, "%s\n", text.c_str());
}

}  // namespace semfield::app
