// Encoders, datasets and losses that are written in Python: one batch per call, under the GIL.
#pragma once

#include <pybind11/pybind11.h>

#include <string>
#include <variant>
#include <vector>

#include "plugin/registry.h"
#include "session/settings/run_config.h"

namespace semfield::python {

namespace py = pybind11;

/// One of a list of names.
struct ChoiceValue {
  int index = 0;
  std::vector<std::string> names;
};

struct PythonParam {
  std::string name, help;
  Range range;
  std::variant<bool, std::int64_t, double, std::string, ChoiceValue, std::vector<std::int64_t>, std::vector<double>,
               std::vector<std::string>>
      value;
};

class PythonParams final : public PluginParams {
 public:
  explicit PythonParams(std::vector<PythonParam> params) : params_(std::move(params)) {}
  void describe(ParamVisitor& visit) override;
  void validate(Diagnostics&) const override {}
  /// Name to value; with the GIL.
  py::dict values() const;

 private:
  std::vector<PythonParam> params_;
};

/// From dicts {name, help, default, low, high, choices}. Throws Error(usage) for a default of no known kind.
std::vector<PythonParam> params_of(const py::list& declared, const std::string& owner);

/// What every session of this process starts from: linked plugins, and those that were loaded or defined since.
Registry& base_registry();

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
