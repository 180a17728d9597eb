// Arrays between NumPy and the framework.
#pragma once

#include <pybind11/numpy.h>

#include <cstdint>
#include <memory>
#include <vector>

#include "core/view.h"

namespace semfield::python {

namespace py = pybind11;

/// An array that owns `values`, which are not copied.
template <class T>
py::array array_of(std::vector<T>&& values, std::vector<py::ssize_t> shape) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  T* const data = owned->data();
  const py::capsule owner(owned.release(), [](void* p) { delete static_cast<std::vector<T>*>(p); });
  return py::array_t<T>(std::move(shape), data, owner);
}

/// An array over borrowed memory, which must not be kept beyond the call that gets it.
template <class T>
py::array borrowed(View<T> view) {
  using Value = std::remove_const_t<T>;
  const py::capsule nobody(view.data == nullptr ? static_cast<const void*>("") : view.data, [](void*) {});
  py::array_t<Value> out({static_cast<py::ssize_t>(view.rows), static_cast<py::ssize_t>(view.cols)},
                         {static_cast<py::ssize_t>(view.row_stride * static_cast<std::int64_t>(sizeof(T))),
                          static_cast<py::ssize_t>(sizeof(T))},
                         view.data, nobody);
  if (std::is_const_v<T>) out.attr("setflags")(py::arg("write") = false);
  return out;
}

}  // namespace semfield::python
