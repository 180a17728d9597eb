#include "python/core/interrupt.h"

#include <pthread.h>

#include <atomic>
#include <thread>

#include "core/error.h"

namespace semfield::python {

namespace {

constexpr auto kLookForSignals = std::chrono::milliseconds(50);
constexpr auto kWaitAtTheEnd = std::chrono::seconds(5);

std::atomic<std::int64_t> g_noted{0};
std::atomic<int> g_working{0};
std::atomic<bool> g_ending{false};
std::thread::id g_last;  // the thread that ends Python; written before g_ending

// Other threads end in silence: one that prints its exception while Python ends may hold a lock of stderr that Python
// then needs, and the process is aborted.
[[noreturn]] void refuse() {
  if (std::this_thread::get_id() != g_last) {
    const py::gil_scoped_acquire gil;
    PyErr_SetNone(PyExc_SystemExit);
    throw py::error_already_set();
  }
  throw Error(ErrorKind::usage, "python.session.ending", "Python is ending, and so is the work of this run");
}

}  // namespace

void note_interrupt() { ++g_noted; }

void follow_forks() {
  pthread_atfork(nullptr, nullptr, [] { g_working = 0; });
}

void end_work() {
  g_last = std::this_thread::get_id();
  g_ending = true;
  const py::gil_scoped_release free;
  const auto until = std::chrono::steady_clock::now() + kWaitAtTheEnd;
  while (g_working > 0 && std::chrono::steady_clock::now() < until)
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
}

Work::Entry::Entry() {
  ++g_working;
  if (!g_ending) return;
  --g_working;
  refuse();
}

Work::Entry::~Entry() { --g_working; }

Work::Work() = default;
Work::~Work() = default;

Interrupt::Interrupt() : last_(std::chrono::steady_clock::now()), noted_before_(g_noted) {}

bool Interrupt::came() {
  if (raised_ || ends_) return true;
  if (g_ending) return ends_ = true;
  const auto now = std::chrono::steady_clock::now();
  const bool noted = g_noted != noted_before_;
  if (!noted && now - last_ < kLookForSignals) return false;
  last_ = now;
  const py::gil_scoped_acquire gil;
  if (noted) PyErr_SetNone(PyExc_KeyboardInterrupt);
  if (noted || PyErr_CheckSignals() != 0) raised_.emplace();
  return raised_.has_value();
}

void Interrupt::raise() const {
  if (ends_) refuse();
  if (raised_) throw py::error_already_set(*raised_);
}

}  // namespace semfield::python
