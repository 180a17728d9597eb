#include "app/app_context.h"

#include <fmt/format.h>

#include <utility>
#include <vector>

#include "app/terminal.h"
#include "compute/isa.h"
#include "plugin/module.h"
#include "run/run_folder.h"

namespace semfield::app {

void print_note(const AppContext& context, const std::string& text) {
  if (!context.quiet) say(text, context.terminal);
}

namespace {

std::vector<std::pair<std::string, std::string>> facts() {
  const Environment e = this_environment();
  return {{"semfield", fmt::format("{} ({})", e.version, e.source)},
          {"compiler", fmt::format("{}, {}", e.compiler, e.build_type)},
          {"plugin api", fmt::format("{}, abi {}", kPluginApi, e.abi)},
          {"cpu", fmt::format("{} ({} threads)", e.cpu, e.hardware_threads)},
          {"kernels", fmt::format("{} (this build has {})", isa_name(isa()), isas_of_build())}};
}

}  // namespace

std::string version_lines() {
  std::string text;
  for (const auto& [name, fact] : facts())
    text += text.empty() ? name + " " + fact + "\n" : fmt::format("{:<10} {}\n", name, fact);
  return text;
}

}  // namespace semfield::app
