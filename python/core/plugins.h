// What the parts of the extension define, and the plugins that runs of it start from.
#pragma once

#include <pybind11/pybind11.h>

#include <string>

#include "config/settings/run_config.h"
#include "plugin/registry.h"

namespace semfield::python {

namespace py = pybind11;

/// What every session of this process starts from: linked plugins, and those that were loaded or defined since.
Registry& base_registry();

/// run_config_of, which lists only those loaded files of Python that it needs: a process tries many ideas, and a run
/// should open without the others.
RunConfig session_config_of(const ConfigNode& tree, Registry& registry);

void define_plugins(py::module_& module);
/// The class Run, and train_run.
void define_session(py::module_& module);

}  // namespace semfield::python
