// Python within the program: plugins that are files of Python. Loaded when the first such file is asked for.
#include <dlfcn.h>
#include <pybind11/pybind11.h>

#include <filesystem>
#include <string>

#include "core/error.h"
#include "core/files.h"
#include "plugin/loader.h"

namespace {

using semfield::Error;
using semfield::ErrorKind;
using semfield::Registry;

namespace py = pybind11;

constexpr const char* kRemedy = "install the package python3-semfield, or build with SEMFIELD_WITH_PYTHON=ON";

// Of semfield._core (python/core/plugins.cpp).
struct Host {
  void (*load)(Registry&, const std::string&);
  const char* (*framework)();
};

// The package of this library's build folder, or of its prefix where Python does not look there anyway.
void add_package_folder() {
  Dl_info self{};
  ::dladdr(reinterpret_cast<const void*>(&add_package_folder), &self);
  const py::list path = py::module_::import("sys").attr("path");
  std::error_code unknown;
  for (const char* const place : {SEMFIELD_PYTHON_BUILD_DIR, SEMFIELD_PYTHON_INSTALLED_DIR}) {
    const std::filesystem::path folder =
        std::filesystem::weakly_canonical(std::filesystem::path(self.dli_fname).parent_path() / place, unknown);
    if (semfield::is_there(folder / "semfield" / "__init__.py") && !path.contains(folder.string()))
      path.attr("insert")(0, folder.string());
  }
}

// Extension modules look for Python's functions among those that all libraries share, and this library was loaded for
// itself.
void share_python() {
  Dl_info python{};
  if (::dladdr(reinterpret_cast<const void*>(&Py_IsInitialized), &python) != 0 && python.dli_fname != nullptr)
    (void)::dlopen(python.dli_fname, RTLD_NOW | RTLD_GLOBAL | RTLD_NOLOAD);
}

// The interpreter lives until the process ends: plugins hold objects of it.
void start_python() {
  if (Py_IsInitialized() != 0) return;
  share_python();
  PyConfig config;
  PyConfig_InitPythonConfig(&config);
  config.install_signal_handlers = 0;  // the program has its own
  config.parse_argv = 0;
  const PyStatus status = Py_InitializeFromConfig(&config);
  PyConfig_Clear(&config);
  if (PyStatus_Exception(status) != 0)
    throw Error(ErrorKind::unavailable, "python.interpreter.failed",
                std::string("Python cannot be started: ") + status.err_msg, kRemedy);
  add_package_folder();
  PyEval_SaveThread();
}

const Host& host() {
  static const Host& found = []() -> const Host& {
    const Host* own = nullptr;
    try {
      const py::object capsule = py::module_::import("semfield._core").attr("_host");
      own = static_cast<const Host*>(PyCapsule_GetPointer(capsule.ptr(), "semfield.host"));
      if (own == nullptr) throw py::error_already_set();
    } catch (const py::error_already_set& raised) {
      throw Error(ErrorKind::unavailable, "python.module.missing",
                  "Python's module semfield: " + py::str(raised.value()).cast<std::string>(), kRemedy);
    }
    if (own->framework != semfield::abi_tag_of_framework)
      throw Error(ErrorKind::unavailable, "python.module.foreign",
                  "Python's module semfield belongs to another installation of Semfield",
                  "let PYTHONPATH name this one's, or run the other's program");
    return *own;
  }();
  return found;
}

}  // namespace

extern "C" __attribute__((visibility("default"))) void semfield_load_python(Registry& registry,
                                                                            const std::string& path) {
  start_python();
  const py::gil_scoped_acquire gil;
  host().load(registry, path);
}
