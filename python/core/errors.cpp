#include "python/core/errors.h"

#include <pthread.h>
#include <pybind11/stl.h>

#include <atomic>
#include <thread>

namespace semfield::python {

namespace {

const char* class_of(ErrorKind kind) {
  switch (kind) {
    case ErrorKind::usage:
      return "UsageError";
    case ErrorKind::data:
      return "DataError";
    case ErrorKind::no_input:
      return "InputError";
    case ErrorKind::unavailable:
      return "UnavailableError";
    case ErrorKind::cannot_create:
    case ErrorKind::io:
      return "WriteError";
    case ErrorKind::config:
      return "ConfigError";
    case ErrorKind::failure:
    case ErrorKind::internal:
      break;
  }
  return "Error";
}

void raise(const Error& error) {
  py::list findings;
  if (const auto* all = dynamic_cast<const FindingsError*>(&error)) {
    for (const Diagnostic& d : all->findings())
      findings.append(py::make_tuple(d.where, d.message, d.remedy, d.code.text()));
  } else {
    findings.append(py::make_tuple("", error.message(), error.remedy(), error.code().text()));
  }
  const py::object type = py::module_::import("semfield.errors").attr(class_of(error.kind()));
  const py::object made = type(error.what(), findings, error.remedy(), py::cast(error.context()),
                               static_cast<int>(error.kind()), error.code().text());
  PyErr_SetObject(type.ptr(), made.ptr());
}

// That of an exception of the package, which a plugin lets pass or raises with a code of its own.
Code code_of(const py::error_already_set& raised) {
  const py::object value = raised.value();
  if (py::isinstance(value, py::module_::import("semfield.errors").attr("Error"))) {
    if (const std::optional<Code> code = Code::parse(py::str(value.attr("code")).cast<std::string>())) return *code;
  }
  return "plugin.python.raised";
}

}  // namespace

void register_errors(py::module_&) {
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const Error& error) {
      raise(error);
    } catch (const py::cast_error& error) {  // a value beyond its type
      raise(Error(ErrorKind::usage, "python.value.type", error.what()));
    }
  });
}

Error error_of(py::error_already_set& raised, const std::string& doing) {
  std::string what = py::str(py::handle(raised.type()).attr("__name__")).cast<std::string>() + ": " +
                     py::str(raised.value()).cast<std::string>();
  py::object trace = raised.trace();
  while (trace && !trace.is_none() && !trace.attr("tb_next").is_none()) trace = trace.attr("tb_next");
  if (trace && !trace.is_none()) {
    const py::object code = trace.attr("tb_frame").attr("f_code");
    what += " (" + code.attr("co_filename").cast<std::string>() + ":" +
            py::str(trace.attr("tb_lineno")).cast<std::string>() + ")";
  }
  return Error(ErrorKind::failure, code_of(raised), doing + ": " + what);
}

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
