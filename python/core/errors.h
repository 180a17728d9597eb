// Errors as Python's exceptions.
#pragma once

#include <pybind11/pybind11.h>

#include "core/error.h"

namespace semfield::python {

/// Translates Error to semfield.Error and its kinds, which the package defines in errors.py.
void register_errors(pybind11::module_& module);

/// Of code of a plugin: "ValueError: no bands (idea.py:12)" while `doing`. To be called with the GIL.
Error error_of(pybind11::error_already_set& raised, const std::string& doing);

}  // namespace semfield::python
