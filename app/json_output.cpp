#include "app/json_output.h"

#include <cstdio>

#include "run/run_folder.h"

namespace semfield::app {

std::string json_object(const AppContext& context, const Json& results) {
  Json out{{"semfield", this_environment().version}, {"verb", context.verb}};
  out.update(results);
  return out.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

void print_json(const AppContext& context, const Json& results) {
  const std::string text = json_object(context, results);
  std::fwrite(text.data(), 1, text.size(), stdout);
  std::fflush(stdout);
}

}  // namespace semfield::app
