// version: what this binary is.
#include <cstdio>

#include "app/verb.h"
#include "compute/isa.h"
#include "plugin/loader.h"
#include "run/run_folder.h"

namespace semfield::app {

namespace {

int run(AppContext& context) {
  const Environment e = this_environment();
  if (context.json) {
    std::fputs(environment_json(e).c_str(), stdout);
    return 0;
  }
  std::printf("semfield %s (%s)\ncompiler  %s, %s\nplugin api %d, abi %s\ncpu       %s (%d threads)\n",
              e.version.c_str(), e.source.c_str(), e.compiler.c_str(), e.build_type.c_str(), kPluginApi, e.abi.c_str(),
              e.cpu.c_str(), e.hardware_threads);
  std::printf("kernels   %s (this build has %s)\n", std::string(isa_name(isa())).c_str(), isas_of_build().c_str());
  return 0;
}

}  // namespace

Verb verb_version() {
  return make_verb("version", 200, "print version, compiler, plugin interface and instruction sets", run);
}

}  // namespace semfield::app
