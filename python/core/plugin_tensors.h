// Learned numbers of components that are written in Python, and arrays that they return.
#pragma once

#include <pybind11/numpy.h>

#include <algorithm>
#include <string>
#include <string_view>
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
  /// What call(gradients by name) returns. Throws Error(failure) where it put another array in the place of one: what
  /// is not added in place would be lost.
  template <class Call>
  py::object with_gradients(const std::string& doing, const Tensors<Real>& tensors, const Call& call) const {
    py::dict given;
    for (std::size_t i = 0; i < specs_.size() && i < tensors.grad.size(); ++i)
      given[py::str(specs_[i].name)] = borrowed(tensors.grad[i]);
    const py::dict before = given.attr("copy")();
    const py::object answer = call(given);
    for (const auto& [name, array] : before) {
      if (given.contains(name) && py::object(given[name]).is(array)) continue;
      throw Error(ErrorKind::failure, "plugin.python.gradient",
                  doing + ": the gradient of '" + py::str(name).cast<std::string>() + "' was replaced",
                  "add to it in place: grads[name] += ...");
    }
    if (given.size() != before.size())
      throw Error(ErrorKind::failure, "plugin.python.gradient", doing + ": grads got a name that no tensor has",
                  "declare the tensor in setup");
    return answer;
  }

 private:
  std::vector<TensorSpec> specs_;
};

using Shape = std::vector<py::ssize_t>;

inline std::string shape_text(const py::ssize_t* sizes, std::size_t count) {
  std::string out;
  for (std::size_t i = 0; i < count; ++i) out += (i == 0 ? "" : ", ") + std::to_string(sizes[i]);
  return "(" + out + (count == 1 ? ",)" : ")");
}

/// What `doing` ("head 'x'.output") returned, as an array of one of these shapes exactly: NumPy would stretch one row
/// to all of them. Throws Error(failure) for another shape or type.
inline py::array real_array(const std::string& doing, const py::handle& answer, const std::vector<Shape>& shapes) {
  const py::array given = py::array::ensure(answer);
  const auto has = [&](const Shape& shape) {
    return std::equal(shape.begin(), shape.end(), given.shape(), given.shape() + given.ndim());
  };
  if (!given || std::none_of(shapes.begin(), shapes.end(), has)) {
    PyErr_Clear();
    std::string wanted;
    for (const Shape& shape : shapes) wanted += (wanted.empty() ? "" : " or ") + shape_text(shape.data(), shape.size());
    const std::string got = given ? shape_text(given.shape(), static_cast<std::size_t>(given.ndim()))
                                  : py::repr(py::type::handle_of(answer)).cast<std::string>();
    throw Error(ErrorKind::failure, "plugin.python.shape",
                doing + ": expected an array of the shape " + wanted + ", got " + got);
  }
  if (std::string_view("fiub").find(given.dtype().kind()) == std::string_view::npos)
    throw Error(ErrorKind::failure, "plugin.python.value",
                doing + ": expected real numbers, got " + py::str(given.dtype()).cast<std::string>());
  return given;
}

/// Copies what `doing` returned.
template <class Real>
void take(const std::string& doing, const py::object& answer, View<Real> to) {
  const py::array given = real_array(doing, answer, {{to.rows, to.cols}});
  py::array target = borrowed(to);
  target[py::ellipsis()] = given;
}

}  // namespace semfield::python
