// Errors as Python's exceptions.
#pragma once

#include <pybind11/pybind11.h>

#include <chrono>
#include <optional>

#include "core/error.h"
#include "core/non_copyable.h"

namespace semfield::python {

/// Translates Error to semfield.Error and its kinds, which the package defines in errors.py.
void register_errors(pybind11::module_& module);

/// Of code of a plugin: "ValueError: no bands (idea.py:12)" while `doing`. To be called with the GIL.
Error error_of(pybind11::error_already_set& raised, const std::string& doing);

// Ctrl-C and the end of Python, as seen by work that goes on without the GIL.

namespace py = pybind11;

/// Ctrl-C met the code of a plugin: whoever works for that plugin stops too. With or without the GIL.
void note_interrupt();

/// A forked process has none of the threads that worked, and waits for none of them.
void follow_forks();

/// Lets nobody in any more, and waits for those who are in Work (a few seconds at most). At the end of the process: a
/// thread that asks for the GIL of a Python that is gone would be ended in the middle of C++.
void end_work();

/// Work of a session without the GIL, while it lives. Once Python ends it throws: SystemExit, which ends a thread in
/// silence, and Error(usage) on the thread that ends Python.
class Work : NonCopyable {
 public:
  Work();
  ~Work();

 private:
  struct Entry {
    Entry();
    ~Entry();
  } entry_;  // left with the GIL held
  py::gil_scoped_release free_;
};

/// Asks now and then, from a thread without the GIL, whether the work is to end.
class Interrupt {
 public:
  Interrupt();
  bool came();
  /// Throws what came: KeyboardInterrupt, what a handler of the signal raised, or as Work once Python ends.
  void raise() const;

 private:
  std::chrono::steady_clock::time_point last_;
  std::int64_t noted_before_;
  bool ends_ = false;
  std::optional<py::error_already_set> raised_;
};

}  // namespace semfield::python
