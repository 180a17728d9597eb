// Losses that are written in Python.
#pragma once

#include <pybind11/pybind11.h>

#include <memory>
#include <string>

#include "plugin/loss.h"
#include "python/core/plugin_params.h"

namespace semfield::python {

/// An instance of the class `type`, a subclass of semfield.Loss.
std::unique_ptr<Loss> make_python_loss(const std::string& name, const py::object& type, const PythonParams& params);

}  // namespace semfield::python
