#include "app/launch.h"

#include <optional>

#include "app/signals.h"
#include "core/error.h"
#include "execution/ranks/ranks.h"
#include "run/run_folder.h"
#include "session/session.h"

namespace semfield::app {

bool is_first_process() {
  try {
    const std::optional<Launched> by = launched();
    return !by || by->rank == 0;
  } catch (const Error&) {  // what is wrong with the environment every process says
    return true;
  }
}

namespace {

void refuse_other_words(Ranks& ranks, const std::string& words) {
  const std::vector<std::string> all = texts_of(ranks, words);
  for (int r = 1; r < ranks.size(); ++r) {
    const std::string& theirs = all[static_cast<std::size_t>(r)];
    if (theirs == all.front()) continue;
    throw Error(
        ErrorKind::usage, "ranks.command.differs",
        ranks.name_of(r) + " was started as `semfield " + theirs + "`, and rank 0 as `semfield " + all.front() + "`",
        "start all processes of a run with the same words");
  }
}

}  // namespace

int run_launched(const LaunchedVerb& verb, AppContext& context) {
  const std::optional<Launched> by = launched();
  if (!by || verb.launch == Launch::beside) return verb.run(context);
  if (verb.launch == Launch::alone) {
    throw Error(
        ErrorKind::usage, "ranks.verb.single",
        by->by + " started " + std::to_string(by->size) + " processes, but `semfield " + verb.name + "` works in one",
        "start it without " + by->by + "; train, eval, render and sweep work in several");
  }
  context.ranks = join_ranks(*by);
  Ranks& ranks = *context.ranks;
  const std::string made = prepare_ranks(ranks, this_environment().version);
  refuse_other_words(ranks, verb.words);
  if (ranks.rank() != 0) {
    leave_stop_to_rank_0();
    ranks.end_when([] { return stop_signal() != 0; }, {});
    follow(ranks, context.registry);
    return 0;
  }
  print_note(context, made);
  ranks.end_when([] { return stop_signal() != 0; }, stop_with_the_others);
  int code = 0;
  try {
    code = verb.run(context);
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
