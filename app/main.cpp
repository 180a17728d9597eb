// semfield: one binary, verbs. Only this folder prints and exits.
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <string>

#include "app/app_context.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/workspace.h"
#include "plugin/loader.h"

namespace {

constexpr unsigned kSecondsOfRank0 = 3;  // until another rank says what is wrong with its own words

// The one form in which errors are printed; the exit code with which the program ends.
int told(const semfield::Error& error) {
  semfield::app::say("semfield: " + semfield::shown(error), isatty(STDERR_FILENO) != 0);
  return static_cast<int>(error.kind());
}

semfield::Error internal(const std::string& cause) {
  return {semfield::ErrorKind::internal, "internal.exception", "internal error: " + cause};
}

// What nobody can catch: an exception out of a thread, or out of a static initialiser of a module. An orderly end, with
// a name, and no core.
[[noreturn]] void on_terminate() {
  std::string cause = "terminated";
  try {
    if (const std::exception_ptr thrown = std::current_exception()) std::rethrow_exception(thrown);
  } catch (const std::exception& error) {
    cause = error.what();
  } catch (...) {
    cause = "an unknown exception";
  }
  const std::string& module = semfield::module_being_loaded();
  if (module.empty()) std::_Exit(told(internal(cause)));
  std::_Exit(told({semfield::ErrorKind::unavailable, "plugin.module.throws",
                   "cannot load plugin '" + module + "': a static initialiser of it throws: " + cause,
                   "fix the module, or leave it out"}));
}

}  // namespace

int main(int argc, char** argv) {
  using namespace semfield;
  app::AppContext context;
  std::set_terminate(on_terminate);
  try {
    app::prepare_process();
    context.terminal = isatty(STDERR_FILENO) != 0;
    app::show_load_progress(context);
    const WorkScope scope(context.work);
    register_linked_plugins(context.registry);
    return app::finish_stdout(app::run_command_line(argc, argv, context));
  } catch (const RankLost& lost) {
    const bool leads = context.ranks->rank() == 0;
    if (leads) told(lost);
    std::fflush(nullptr);
    if (!leads) sleep(1);  // rank 0 shall see the one that is gone first, and not this one
    if (leads) context.ranks->abandon(static_cast<int>(lost.kind()));
    std::_Exit(static_cast<int>(lost.kind()));  // a device may wait for ever for one that is gone
  } catch (const Error& error) {
    const bool leads = context.ranks ? context.ranks->rank() == 0 : app::is_first_process();
    // What is wrong with the words of all, rank 0 says, and its launcher then ends the others.
    if (!leads && !context.ranks) sleep(kSecondsOfRank0);
    return leads || !context.ranks ? told(error) : static_cast<int>(error.kind());
  } catch (const std::bad_alloc&) {
    return told({ErrorKind::failure, "memory.host.full", "out of memory",
                 "lower train.rays or runtime.lanes, or raise scene.load.downscale"});
  } catch (const std::filesystem::filesystem_error& error) {  // a path of the user's that cannot even be looked at
    return told({ErrorKind::no_input, "files.path.unusable",
                 "'" + error.path1().string() + "': " + error.code().message(), "check the path and its permissions"});
  } catch (const std::exception& error) {
    return told(internal(error.what()));
  }
}
