#include "app/launch.h"

#include <optional>

#include "app/signals.h"
#include "core/error.h"
#include "ranks/launcher.h"
#include "run/run_folder.h"
#include "session/ranks_session.h"

namespace semfield::app {

bool is_first_process() {
  try {
    const std::optional<Launched> by = launched();
    return !by || by->rank == 0;
  } catch (const Error&) {  // what is wrong with the environment every process says
    return true;
  }
}

int run_launched(const std::string& verb, Launch launch, const std::function<int(AppContext&)>& run,
                 AppContext& context) {
  const std::optional<Launched> by = launched();
  if (!by || launch == Launch::beside) return run(context);
  if (launch == Launch::alone) {
    throw Error(
        ErrorKind::usage,
        by->by + " started " + std::to_string(by->size) + " processes, but `semfield " + verb + "` works in one",
        "start it without " + by->by + "; train, eval, render and sweep work in several");
  }
  context.ranks = join_ranks(*by);
  Ranks& ranks = *context.ranks;
  const std::string made = prepare_ranks(ranks, this_environment().version);
  if (ranks.rank() != 0) {
    leave_stop_to_rank_0();
    follow(ranks, context.registry);
    return 0;
  }
  print_note(context, made);
  ranks.end_when([] { return stop_signal() != 0; });
  int code = 0;
  try {
    code = run(context);
  } catch (const RankLost&) {
    throw;
  } catch (...) {
    dismiss(ranks);
    throw;
  }
  dismiss(ranks);
  return code;
}

}  // namespace semfield::app
