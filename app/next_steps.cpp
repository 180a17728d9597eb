#include "app/next_steps.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>

#include "app/terminal.h"

namespace semfield::app {

namespace {
constexpr const char* kLeftOut = "SEMFIELD_NEXT_LEFT_OUT";
}  // namespace

void print_next(const AppContext& context, const std::vector<NextStep>& steps) {
  if (context.quiet || context.json || steps.empty() || std::getenv(kLeftOut) != nullptr) return;
  std::size_t longest = 0;
  for (const NextStep& step : steps) longest = std::max(longest, step.words.size());
  std::string text;
  for (const NextStep& step : steps) {
    text += (text.empty() ? "next        semfield " : "\n            semfield ") + step.words;
    text += std::string(longest - step.words.size() + 3, ' ') + "# " + step.what;
  }
  std::fflush(stdout);  // results come first
  say(text, false);
}

void leave_next_out_of_children() { setenv(kLeftOut, "1", 1); }

}  // namespace semfield::app
