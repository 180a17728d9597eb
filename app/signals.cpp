#include "app/signals.h"

#include <fcntl.h>
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <new>
#include <string_view>

#include "app/terminal.h"
#include "core/error.h"
#include "core/files.h"
#include "core/process.h"

namespace semfield::app {

namespace {

volatile std::sig_atomic_t g_signal = 0;
volatile std::sig_atomic_t g_waits = 1;
volatile std::sig_atomic_t g_save = 0;
volatile std::sig_atomic_t g_asked = 0;  // how often a stop was asked for
volatile std::sig_atomic_t g_told = 1;   // whether the program says what it does about it
volatile std::sig_atomic_t g_heard = 0;  // the flag was raised for another process: the signal may still come
bool g_handled = false;                  // by on_stop
// Read by the handler; written only while g_waits is 1, when the handler does not look at it.
std::array<char, 8192> g_farewell{};
std::size_t g_farewell_size = 0;

// As a signal handler may.
void tell(std::string_view text) {
  if (g_told == 0) return;
  [[maybe_unused]] const ssize_t told = write(STDERR_FILENO, text.data(), text.size());
}

extern "C" void on_stop(int number) {
  if (g_heard != 0) {
    g_heard = 0;
    return;
  }
  g_asked = g_asked + 1;
  if (g_signal == 0) {
    g_signal = number;
    if (g_waits != 0) return;
    tell({g_farewell.data(), g_farewell_size});
    remove_own_temporaries();
    _exit(128 + number);
  }
  // Who presses Ctrl-C twice has mostly not seen an answer yet, and does not mean to lose what is being saved.
  constexpr int kAtOnce = 3;
  if (g_asked < kAtOnce) return tell("\nstill saving; press Ctrl-C again to end without saving\n");
  // What is on disk is whole at every moment, so the process may end here.
  tell("\nended without saving; everything saved before is intact\n");
  remove_own_temporaries();
  _exit(128 + number);
}

extern "C" void on_stop_of_follower(int number) { g_signal = number; }

extern "C" void on_hang_up(int) { g_save = 1; }

// Of verbs that do not wait for a signal: it ends the process as if nobody had caught it.
extern "C" void on_end(int number) {
  remove_own_temporaries();
  std::signal(number, SIG_DFL);
  std::raise(number);
}

void handle(int number, void (*handler)(int)) {
  struct sigaction action {};
  action.sa_handler = handler;
  sigemptyset(&action.sa_mask);
  action.sa_flags = SA_RESTART;
  sigaction(number, &action, nullptr);
}

}  // namespace

void prepare_process() {
  if (!claim_stack()) throw std::bad_alloc();
  std::signal(SIGPIPE, SIG_IGN);
  std::signal(SIGXFSZ, SIG_IGN);
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) {
    struct sigaction before {};
    if (sigaction(number, nullptr, &before) == 0 && before.sa_handler == SIG_DFL) handle(number, on_end);
  }
  for (const int stream : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) {
    // open() takes the lowest free number, which is this one.
    if (fcntl(stream, F_GETFD) < 0 && errno == EBADF) {
      [[maybe_unused]] const int opened = open("/dev/null", stream == STDIN_FILENO ? O_RDONLY : O_WRONLY);
    }
  }
}

void install_stop_signals(bool told) {
  g_told = told ? 1 : 0;
  handle(SIGINT, on_stop);
  handle(SIGTERM, on_stop);
  g_handled = true;
}

void leave_stop_to_rank_0() {
  handle(SIGINT, on_stop_of_follower);
  handle(SIGTERM, on_stop_of_follower);
  std::signal(SIGHUP, SIG_IGN);
}

void stop_with_the_others() {
  if (g_signal != 0) return;
  if (!g_handled) {
    std::raise(SIGTERM);  // this verb ends at once
    return;
  }
  on_stop(SIGTERM);
  g_heard = 1;
}

int stop_signal() { return g_signal; }

void stop_waits(bool waits, const std::string& farewell) {
  g_waits = 1;
  const std::string text = (isatty(STDERR_FILENO) != 0 ? "\r\033[K" : "") + farewell + "\n";
  g_farewell_size = farewell.empty() ? 0 : std::min(text.size(), g_farewell.size());
  std::copy_n(text.begin(), g_farewell_size, g_farewell.begin());
  std::atomic_signal_fence(std::memory_order_seq_cst);
  g_waits = waits ? 1 : 0;
}

void install_save_signal() { handle(SIGHUP, on_hang_up); }

bool take_save_request() {
  const bool asked = g_save != 0;
  if (asked) g_save = 0;
  return asked;
}

int finish_stdout(int code) {
  errno = 0;
  const bool failed = std::fflush(stdout) != 0 || std::ferror(stdout) != 0;
  if (!failed) return code;
  const int cause = errno;
  pollfd reader{STDOUT_FILENO, POLLOUT, 0};
  if (cause == EPIPE || (poll(&reader, 1, 0) == 1 && (reader.revents & POLLERR) != 0)) return code;
  const Error error(
      ErrorKind::io, "files.stdout.failed",
      std::string("cannot write the results to stdout") + (cause != 0 ? std::string(": ") + std::strerror(cause) : ""));
  say("semfield: " + shown(error), isatty(STDERR_FILENO) != 0);
  return code != 0 ? code : static_cast<int>(ErrorKind::io);
}

}  // namespace semfield::app
