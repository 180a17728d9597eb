#include "python/core/plugin_params.h"

#include <pybind11/stl.h>

#include <algorithm>

#include "config/params_read.h"

namespace semfield::python {

namespace {

// Whole numbers or not, by what the list holds.
template <class T>
bool all_are(const py::list& list, const T& is) {
  return std::all_of(list.begin(), list.end(), [&](const py::handle item) { return is(item); });
}

bool is_whole(const py::handle& value) { return py::isinstance<py::int_>(value) && !py::isinstance<py::bool_>(value); }

bool is_number(const py::handle& value) { return is_whole(value) || py::isinstance<py::float_>(value); }

// A default that its own range refuses would be refused where nobody gave it.
void require_in_range(const PythonParam& param, const std::string& owner) {
  std::vector<double> numbers;
  if (const auto* whole = std::get_if<std::int64_t>(&param.value)) numbers = {static_cast<double>(*whole)};
  if (const auto* real = std::get_if<double>(&param.value)) numbers = {*real};
  if (const auto* wholes = std::get_if<std::vector<std::int64_t>>(&param.value))
    numbers.assign(wholes->begin(), wholes->end());
  if (const auto* reals = std::get_if<std::vector<double>>(&param.value)) numbers = *reals;
  for (const double number : numbers) {
    if (number >= param.range.min && number <= param.range.max) continue;
    throw Error(
        ErrorKind::usage, "plugin.python.default",
        owner + ": the default of '" + param.name + "' is " + shortest_number(number) + ", outside its own range");
  }
}

}  // namespace

void PythonParams::describe(ParamVisitor& visit) {
  for (PythonParam& p : params_) {
    const ParamInfo info{p.name, p.help, p.range};
    struct Visit {
      ParamVisitor& visit;
      const ParamInfo& info;
      void operator()(bool& value) const { visit.boolean(info, value); }
      void operator()(std::int64_t& value) const { visit.integer(info, value); }
      void operator()(double& value) const { visit.real(info, value); }
      void operator()(std::string& value) const { visit.text(info, value); }
      void operator()(ChoiceValue& value) const {
        const std::vector<std::string_view> names(value.names.begin(), value.names.end());
        visit.choice(info, value.index, names);
      }
      void operator()(std::vector<std::int64_t>& value) const { visit.integers(info, value); }
      void operator()(std::vector<double>& value) const { visit.reals(info, value); }
      void operator()(std::vector<std::string>& value) const { visit.texts(info, value); }
    };
    std::visit(Visit{visit, info}, p.value);
  }
}

py::dict PythonParams::values() const {
  py::dict out;
  for (const PythonParam& p : params_) {
    out[py::str(p.name)] = std::visit(
        [](const auto& value) -> py::object {
          if constexpr (std::is_same_v<std::decay_t<decltype(value)>, ChoiceValue>) {
            return py::str(value.names[static_cast<std::size_t>(value.index)]);
          } else {
            return py::cast(value);
          }
        },
        p.value);
  }
  return out;
}

std::vector<PythonParam> params_of(const py::list& declared, const std::string& owner) {
  std::vector<PythonParam> out;
  for (const py::handle row : declared) {
    const auto item = py::reinterpret_borrow<py::dict>(row);
    PythonParam p;
    p.name = item["name"].cast<std::string>();
    p.help = item["help"].cast<std::string>();
    if (!item["low"].is_none()) p.range.min = item["low"].cast<double>();
    if (!item["high"].is_none()) p.range.max = item["high"].cast<double>();
    const py::object value = item["default"];
    if (!item["choices"].is_none()) {
      ChoiceValue choice{0, item["choices"].cast<std::vector<std::string>>()};
      const auto at = std::find(choice.names.begin(), choice.names.end(), py::str(value).cast<std::string>());
      if (at == choice.names.end())
        throw Error(ErrorKind::usage, "plugin.python.default",
                    owner + ": the default of '" + p.name + "' is none of its choices");
      choice.index = static_cast<int>(at - choice.names.begin());
      p.value = std::move(choice);
    } else if (py::isinstance<py::bool_>(value)) {
      p.value = value.cast<bool>();
    } else if (is_whole(value)) {
      p.value = value.cast<std::int64_t>();
    } else if (py::isinstance<py::float_>(value)) {
      p.value = value.cast<double>();
    } else if (py::isinstance<py::str>(value)) {
      p.value = value.cast<std::string>();
    } else if (py::isinstance<py::list>(value) || py::isinstance<py::tuple>(value)) {
      const py::list list(value);
      if (!list.empty() && all_are(list, is_whole)) {
        p.value = list.cast<std::vector<std::int64_t>>();
      } else if (!list.empty() && all_are(list, [](const py::handle& v) { return py::isinstance<py::str>(v); })) {
        p.value = list.cast<std::vector<std::string>>();
      } else if (all_are(list, is_number)) {
        p.value = list.cast<std::vector<double>>();
      } else {
        throw Error(ErrorKind::usage, "plugin.python.default",
                    owner + ": the default of '" + p.name + "' is " + py::repr(value).cast<std::string>(),
                    "a list has numbers alone, or texts alone");
      }
    } else {
      throw Error(ErrorKind::usage, "plugin.python.default",
                  owner + ": the default of '" + p.name + "' is " + py::repr(value).cast<std::string>(),
                  "a parameter is a truth value, a number, a text, or a list of numbers or texts");
    }
    require_in_range(p, owner);
    out.push_back(std::move(p));
  }
  return out;
}

}  // namespace semfield::python
