#include "run/train_run.h"

#include <fmt/format.h>

#include <cmath>
#include <limits>

#include "core/text.h"
#include "run/run_loop.h"
#include "system/memory_limit.h"

namespace semfield {

namespace {

constexpr std::int64_t kAllSteps = std::numeric_limits<std::int64_t>::max();

// As long again as it trained.
std::string train_on_words(const std::string& run_dir, double train_s) {
  return fmt::format("semfield train --resume {} --time {:.0f}s", shell_word(run_dir), std::ceil(train_s));
}

// What a run that goes on begins with.
void tell_resumed(RunListener& listener, const RunLoop& loop, const ResumePoint& point) {
  for (const ConfigDifference& change : point.changed)
    listener.note(fmt::format("from step {} on: {}", point.step(), change.text()));
  if (!point.facts) return listener.note("no checkpoint yet: starting from step 0");
  const Training& training = loop.training();
  listener.note(fmt::format("resuming at step {} ({:.1f} s of training) from {}", training.step(), training.train_s(),
                            point.path));
  // Its last evaluation may have been cut off, and settings of the page may be others now.
  if (training.at_its_end())
    listener.note(
        fmt::format("the run has come to its end, {} steps: it is scored again, not trained; to train on: `{}`",
                    training.step(), train_on_words(loop.run_dir(), training.train_s())));
}

TrainOutcome train_to_the_end(RunLoop& loop, RunListener& listener) {
  const Training& training = loop.training();
  const double start_s = training.train_s();
  listener.stop_waits(true);
  while (!training.at_its_end() && !loop.advance(kAllSteps).empty() && listener.stop_signal() == 0) {
  }
  if (!loop.saved() || training.step() == 0) loop.save();
  listener.stop_waits(false);
  TrainOutcome outcome;
  outcome.signal = listener.stop_signal();
  if (outcome.signal == 0) {
    outcome.values = loop.scores().score_end(loop.moment());
    outcome.scored = loop.scores().last_part();
  }
  outcome.step = training.step();
  outcome.train_s = training.train_s();
  outcome.trained_s = training.train_s() - start_s;
  outcome.run_dir = loop.run_dir();
  outcome.peak_bytes = peak_resident_bytes();
  if (outcome.signal == 0)
    outcome.report_path = listener.write_report(*loop.folder(), loop.session(), loop.scores().report_frames());
  return outcome;
}

// A write that fails ends the run; the message then states what is left of it.
void add_what_is_left(Error& error, const RunLoop& loop) {
  const bool lost = dynamic_cast<const RankLost*>(&error) != nullptr;
  const bool writing = error.kind() == ErrorKind::io || error.kind() == ErrorKind::cannot_create;
  if (!lost && !(writing && error.message().starts_with("cannot "))) return;
  const std::string kept = lost || error.context().empty() ? loop.kept_text() + "; " : "";  // a save has said it
  error.while_doing(fmt::format("training ended at step {} ({}resume with `semfield train --resume {}`{})",
                                loop.training().step(), kept, shell_word(loop.run_dir()),
                                lost ? ", with any number of processes" : ""));
}

}  // namespace

TrainOutcome run_training(RunConfig config, Registry& registry, const TrainRequest& request, RunListener* told) {
  RunListener nobody;
  RunListener& listener = told != nullptr ? *told : nobody;
  OpenedForTraining opened = open_for_training(std::move(config), registry, request, listener);
  if (opened.ended) {
    listener.note(fmt::format("the run has come to its end, {} steps, and nothing of it was changed; to train on: `{}`",
                              opened.ended->step, train_on_words(opened.ended->run_dir, opened.ended->train_s)));
    return *opened.ended;
  }
  const ResumePoint point = opened.point;
  RunLoopOptions options;
  options.scores = options.saves = true;
  RunLoop loop(std::move(opened), registry, &listener, options);
  if (request.resume) tell_resumed(listener, loop, point);
  const WorkSettings work = loop.session().work();
  const WorkScope scope(work);
  try {
    return train_to_the_end(loop, listener);
  } catch (Error& error) {
    add_what_is_left(error, loop);
    throw;
  }
}

}  // namespace semfield
