// Heads that are written in Python.
#pragma once

#include <pybind11/pybind11.h>

#include <memory>
#include <string>

#include "plugin/head/head.h"
#include "python/core/plugin_params.h"

namespace semfield::python {

/// An instance of the class `type`, a subclass of semfield.Head.
template <class Real>
std::unique_ptr<Head<Real>> make_python_head(const std::string& name, const py::object& type,
                                             const PythonParams& params, const HeadBuild& build);

}  // namespace semfield::python
