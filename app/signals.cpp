#include "signals.h"

#include <unistd.h>

#include <csignal>

namespace semfield::app {

namespace {
volatile std::sig_atomic_t g_signal = 0;

extern "C" void on_stop(int number) {
  // The checkpoint on disk is whole at every moment, so a second request may end the process here.
  if (g_signal != 0) _exit(128 + number);
  g_signal = number;
}
}  // namespace

void install_stop_signals() {
  struct sigaction action {};
  action.sa_handler = on_stop;
  sigemptyset(&action.sa_mask);
  action.sa_flags = SA_RESTART;
  sigaction(SIGINT, &action, nullptr);
  sigaction(SIGTERM, &action, nullptr);
}

int stop_signal() { return g_signal; }

}  // namespace semfield::app
