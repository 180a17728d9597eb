// semfield: one binary, verbs. Only this folder prints and exits.
#include <unistd.h>

#include <cstdio>
#include <exception>
#include <filesystem>

#include "command_line.h"
#include "core/error.h"
#include "core/log.h"
#include "load_progress.h"
#include "plugin/linked_plugins.h"
#include "signals.h"
#include "verbs.h"

int main(int argc, char** argv) {
  using namespace semfield;
  app::AppContext context;
  app::prepare_process();
  context.terminal = isatty(STDERR_FILENO) != 0;
  app::show_load_progress(context);
  set_log_sink([&](Severity severity, const std::string& text) {
    if (context.quiet && severity == Severity::note) return;
    std::fprintf(stderr, "%s%s\n", severity == Severity::warning ? "warning: " : "", text.c_str());
  });
  try {
    register_linked_plugins(context.registry);
    return app::finish_stdout(app::run_command_line(argc, argv, context));
  } catch (const Error& error) {
    std::fprintf(stderr, "semfield: %s\n", error.what());
    return static_cast<int>(error.kind());
  } catch (const std::bad_alloc&) {
    std::fprintf(
        stderr,
        "semfield: out of memory; lower train.rays or scene.load.downscale, or see `semfield train --dry-run`\n");
    return static_cast<int>(ErrorKind::failure);
  } catch (const std::filesystem::filesystem_error& error) {  // a path of the user's that cannot even be looked at
    std::fprintf(stderr, "semfield: '%s': %s; check the path and its permissions\n", error.path1().c_str(),
                 error.code().message().c_str());
    return static_cast<int>(ErrorKind::no_input);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "semfield: internal error: %s\n", error.what());
    return static_cast<int>(ErrorKind::internal);
  }
}
