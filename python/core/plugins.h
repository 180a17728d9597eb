// Encoders, datasets and losses that are written in Python: one batch per call, under the GIL.
#pragma once

#include <pybind11/pybind11.h>

#include <string>

#include "plugin/registry.h"
#include "session/settings/run_config.h"

namespace semfield::python {

namespace py = pybind11;

/// What every session of this process starts from: linked plugins, and those that were loaded or defined since.
Registry& base_registry();

/// Where the decorators of semfield/plugins.py add their plugins now.
void add_encoder(const py::dict& declared);
void add_dataset(const py::dict& declared);
void add_loss(const py::dict& declared);

/// Runs a file of Python, whose plugins go into `registry`. Throws Error(unavailable) for a file that raises, or that
/// defines no plugin. To be called with the GIL.
void load_python_file(Registry& registry, const std::string& path);

/// run_config_of, which lists only those loaded files of Python that it needs: a process tries many ideas, and a run
/// should open without the others.
RunConfig session_config_of(const ConfigNode& tree, Registry& registry);

void define_plugins(py::module_& module);
/// The samplers and the compositor by themselves, for studies.
void define_integral(py::module_& module);

}  // namespace semfield::python
