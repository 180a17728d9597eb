// Configurations between Python's dicts and the framework's trees.
#pragma once

#include <pybind11/pybind11.h>

#include <vector>

#include "config/compose.h"

namespace semfield::python {

namespace py = pybind11;

/// dict, list, tuple, str, bool, int, float, None and paths; NumPy's numbers too. `origin` stands for the file in
/// messages. Throws Error(usage) naming the key for any other type.
ConfigNode node_of(const py::handle& value, const std::string& origin);

/// The other way; numbers and truth values become Python's own.
py::object object_of(const ConfigNode& node);

/// {"train.rays": 2048} as overrides; messages say `set["train.rays"]`.
std::vector<ConfigOverride> overrides_of(const py::dict& set);

/// A path of a file, or a dict. Composed, with overrides.
/// `tree` with this scene in place of its own; what the tree says of labels and of loading stays.
ConfigNode with_scene(const ConfigNode& tree, const py::dict& scene);

ConfigNode composed(const py::object& config, const py::dict& set);

}  // namespace semfield::python
