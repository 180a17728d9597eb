// Calls of plugins that are written in Python: what holds their objects, and what becomes of what they raise.
#pragma once

#include <pybind11/pybind11.h>

#include <memory>
#include <string>

#include "core/error.h"
#include "python/core/errors.h"
#include "python/core/interrupt.h"

namespace semfield::python {

namespace py = pybind11;

// An object of Python that threads without the GIL may hold and drop.
using Held = std::shared_ptr<py::object>;

inline Held hold(py::object object) {
  return {new py::object(std::move(object)), [](py::object* p) {
            if (Py_IsInitialized() == 0) return;  // the process ends: nothing is given back any more
            const py::gil_scoped_acquire gil;
            delete p;
          }};
}

// Calls code of a plugin with the GIL; what it raises becomes an Error.
template <class Call>
auto called(const std::string& doing, const Call& call) {
  const py::gil_scoped_acquire gil;
  try {
    return call();
  } catch (py::error_already_set& raised) {
    if (raised.matches(PyExc_KeyboardInterrupt)) {
      note_interrupt();
      throw;
    }
    throw error_of(raised, doing);
  } catch (const py::cast_error& wrong) {
    throw Error(ErrorKind::failure, "plugin.python.value", doing + ": " + wrong.what());
  }
}

}  // namespace semfield::python
