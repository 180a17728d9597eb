// Parameters of a plugin that is written in Python.
#pragma once

#include <pybind11/pybind11.h>

#include <string>
#include <variant>
#include <vector>

#include "plugin/registry.h"

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

}  // namespace semfield::python
