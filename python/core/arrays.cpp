#include "python/core/arrays.h"

#include <pybind11/stl.h>

#include <algorithm>
#include <memory>
#include <vector>

#include "core/non_copyable.h"
#include "execution/device_library.h"

namespace semfield::python {

namespace {

// The tensor exchange that array libraries share (DLPack, version 0; its C structures are the interface).
struct DlDevice {
  std::int32_t type = 2;  // CUDA
  std::int32_t id = 0;
};
struct DlType {
  std::uint8_t code = 0, bits = 0;  // code: 0 integer, 1 unsigned, 2 float
  std::uint16_t lanes = 1;
};
struct DlTensor {
  void* data = nullptr;
  DlDevice device;
  std::int32_t dims = 0;
  DlType type;
  std::int64_t* shape = nullptr;
  std::int64_t* strides = nullptr;  // null: row by row
  std::uint64_t byte_offset = 0;
};
struct DlManaged {
  DlTensor tensor;
  void* owner = nullptr;
  void (*deleter)(DlManaged*) = nullptr;
};
constexpr const char* kFresh = "dltensor";  // a capsule of this name has not been taken up

struct Memory : NonCopyable {
  explicit Memory(const std::byte* from, std::size_t size, int ordinal_in) : bytes(size), ordinal(ordinal_in) {
    const DeviceCalls& calls = cuda_library().calls;
    (void)cuda_library().describe(ordinal);  // throws for a device that is not there
    calls.on(ordinal, [&] {
      data = calls.memory.allocate(std::max<std::size_t>(bytes, 1));
      if (bytes > 0) calls.to_device(from, data, bytes);
    });
  }
  ~Memory() {
    if (data != nullptr) cuda_library().calls.memory.release(data);
  }
  std::byte* data = nullptr;
  std::size_t bytes = 0;
  int ordinal = 0;
};

struct DeviceArray {
  std::shared_ptr<Memory> memory;
  std::vector<std::int64_t> shape;
  DlType type;
  py::dtype dtype;
};

struct Shared {
  std::shared_ptr<Memory> memory;
  std::vector<std::int64_t> shape;
};

py::capsule dlpack(const DeviceArray& array) {
  auto shared = std::make_unique<Shared>(Shared{array.memory, array.shape});
  auto managed = std::make_unique<DlManaged>();
  managed->tensor.data = array.memory->data;
  managed->tensor.device.id = array.memory->ordinal;
  managed->tensor.dims = static_cast<std::int32_t>(shared->shape.size());
  managed->tensor.type = array.type;
  managed->tensor.shape = shared->shape.data();
  managed->owner = shared.release();
  managed->deleter = [](DlManaged* self) {
    delete static_cast<Shared*>(self->owner);
    delete self;
  };
  return py::capsule(managed.release(), kFresh, [](PyObject* capsule) {
    if (PyCapsule_IsValid(capsule, kFresh) == 0) return;  // taken up: the taker deletes
    auto* const left = static_cast<DlManaged*>(PyCapsule_GetPointer(capsule, kFresh));
    left->deleter(left);
  });
}

py::array to_host(const DeviceArray& array) {
  py::array out(array.dtype, std::vector<py::ssize_t>(array.shape.begin(), array.shape.end()));
  const DeviceCalls& calls = cuda_library().calls;
  calls.on(array.memory->ordinal, [&] {
    if (array.memory->bytes > 0) calls.to_host(array.memory->data, out.mutable_data(), array.memory->bytes);
  });
  return out;
}

}  // namespace

py::object on_device(const py::array& given, int ordinal) {
  const py::array array = py::array::ensure(given, py::array::c_style);
  DeviceArray out;
  out.dtype = array.dtype();
  const char kind = out.dtype.kind();
  out.type.code = kind == 'f' ? 2 : kind == 'u' ? 1 : 0;
  out.type.bits = static_cast<std::uint8_t>(8 * array.itemsize());
  out.shape.assign(array.shape(), array.shape() + array.ndim());
  const auto* const from = static_cast<const std::byte*>(array.data());
  const auto bytes = static_cast<std::size_t>(array.nbytes());
  const py::gil_scoped_release free;
  out.memory = std::make_shared<Memory>(from, bytes, ordinal);
  const py::gil_scoped_acquire again;
  return py::cast(std::move(out));
}

void define_device_arrays(py::module_& module) {
  py::class_<DeviceArray>(module, "DeviceArray",
                          "An array in the memory of a CUDA device: torch.from_dlpack(array) takes it without a copy.")
      .def(
          "__dlpack__", [](const DeviceArray& a, const py::object&, const py::kwargs&) { return dlpack(a); },
          py::arg("stream") = py::none(), "The array is complete; no stream has to be waited for.")
      .def("__dlpack_device__", [](const DeviceArray& a) { return py::make_tuple(2, a.memory->ordinal); })
      .def_property_readonly(
          "shape", [](const DeviceArray& a) { return py::tuple(py::cast(a.shape)); }, "Sizes of its axes.")
      .def_property_readonly(
          "dtype", [](const DeviceArray& a) { return a.dtype; }, "NumPy's type of its numbers.")
      .def("numpy", to_host, "A copy in the memory of the CPU.")
      .def("__array__", [](const DeviceArray& a, const py::args&, const py::kwargs&) { return to_host(a); });
  module.def("to_device", on_device, py::arg("array"), py::arg("ordinal") = 0,
             "A copy of a NumPy array of any shape, as [N, 3], in the memory of CUDA device `ordinal`.");
}

}  // namespace semfield::python
