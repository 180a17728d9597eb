// version: what this binary is.
#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/verb.h"
#include "app/version_text.h"
#include "run/run_folder.h"

namespace semfield::app {

namespace {

int print_version(AppContext& context) {
  if (context.json) {
    print_json(context, Json::parse(environment_json(this_environment())));
  } else {
    std::fputs(version_lines().c_str(), stdout);
  }
  return 0;
}

}  // namespace

Verb verb_version() {
  return with_json(
      make_verb("version", 200, "print version, compiler, plugin interface and instruction sets", print_version));
}

}  // namespace semfield::app
