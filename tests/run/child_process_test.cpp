// A child that gets a signal while it starts.
#include "app/child_process.h"

#include <gtest/gtest.h>
#include <signal.h>

#include "app/signals.h"

namespace semfield::app {
namespace {

TEST(ChildProcess, ASignalThatComesBeforeItsProgramEndsIt) {
  install_stop_signals(false);  // the child begins with these handlers, which would only take a note of it
  for (int start = 0; start < 20; ++start) {
    OwnedChild child(SIGKILL);
    child.pid = start_child({"/bin/sleep", "5"}, ChildStreams{-1, STDERR_FILENO, STDERR_FILENO});
    ASSERT_EQ(kill(child.pid, SIGTERM), 0);
    ASSERT_EQ(child.wait(), 128 + SIGTERM) << "start " << start;
  }
}

}  // namespace
}  // namespace semfield::app
