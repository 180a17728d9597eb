// Arrays in the memory of a CUDA device, for whoever reads DLPack: PyTorch, CuPy, JAX.
#pragma once

#include <pybind11/numpy.h>

namespace semfield::python {

/// A copy of `array` on device `ordinal` of this machine, an object of class DeviceArray. Throws Error(unavailable)
/// without CUDA.
pybind11::object on_device(const pybind11::array& array, int ordinal);

void define_device_arrays(pybind11::module_& module);

}  // namespace semfield::python
