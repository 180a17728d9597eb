// Learned numbers of components that are written in Python, and arrays that they return.
#pragma once

#include <pybind11/numpy.h>

#include <string>
#include <vector>

#include "core/error.h"
#include "plugin/parametric.h"
#include "python/core/arrays.h"

namespace semfield::python {

template <class Real>
class PythonTensors {
 public:
  PythonTensors() = default;
  /// Of `made`, an instance with a dict `tensors` of semfield.Tensor.
  explicit PythonTensors(const py::object& made) {
    for (const auto& [tensor, spec] : made.attr("tensors").template cast<py::dict>()) {
      TensorSpec declared;
      declared.name = py::str(tensor).template cast<std::string>();
      declared.rows = spec.attr("rows").template cast<std::int64_t>();
      declared.cols = spec.attr("cols").template cast<std::int32_t>();
      declared.init = {spec.attr("low").template cast<double>(), spec.attr("high").template cast<double>()};
      specs_.push_back(std::move(declared));
    }
  }

  void declare(ParamDeclarer& declarer) const {
    for (const TensorSpec& spec : specs_) declarer.tensor(spec);
  }
  py::dict values(const Tensors<Real>& tensors) const {
    py::dict out;
    for (std::size_t i = 0; i < specs_.size(); ++i)
      out[py::str(specs_[i].name)] = borrowed(View<const Real>(tensors.value[i]));
    return out;
  }
  py::dict gradients(const Tensors<Real>& tensors) const {
    py::dict out;
    for (std::size_t i = 0; i < specs_.size() && i < tensors.grad.size(); ++i)
      out[py::str(specs_[i].name)] = borrowed(tensors.grad[i]);
    return out;
  }

 private:
  std::vector<TensorSpec> specs_;
};

/// Copies what `doing` ("head 'x'.output") returned; throws Error(failure) for another shape or type.
template <class Real>
void take(const std::string& doing, const py::object& answer, View<Real> to) {
  const py::array given = py::array::ensure(answer);
  if (!given || given.ndim() != 2 || given.shape(0) != to.rows || given.shape(1) != to.cols) {
    PyErr_Clear();
    const std::string got =
        given ? py::str(given.attr("shape")).cast<std::string>() : py::repr(answer.get_type()).cast<std::string>();
    throw Error(ErrorKind::failure, "plugin.python.shape",
                doing + ": expected an array of the shape (" + std::to_string(to.rows) + ", " +
                    std::to_string(to.cols) + "), got " + got);
  }
  if (std::string_view("fiub").find(given.dtype().kind()) == std::string_view::npos)
    throw Error(ErrorKind::failure, "plugin.python.value",
                doing + ": expected real numbers, got " + py::str(given.dtype()).cast<std::string>());
  py::array target = borrowed(to);
  target[py::ellipsis()] = given;
}

}  // namespace semfield::python
