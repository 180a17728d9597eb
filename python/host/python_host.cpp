// Python within the program: plugins that are files of Python. Loaded when the first such file is asked for.
#include <Python.h>
#include <dlfcn.h>

#include <filesystem>
#include <string>

#include "core/error.h"
#include "core/non_copyable.h"
#include "plugin/loader.h"
#include "system/files.h"

namespace {

using semfield::Error;
using semfield::ErrorKind;
using semfield::Registry;

constexpr const char* kRemedy = "install the package python3-semfield, or build with SEMFIELD_WITH_PYTHON=ON";

// Of semfield._core (python/core/plugins.cpp).
struct Host {
  void (*load)(Registry&, const std::string&);
  const char* (*framework)();
};

std::string raised_text() {
  PyObject *type = nullptr, *value = nullptr, *trace = nullptr;
  PyErr_Fetch(&type, &value, &trace);
  PyObject* const text = value != nullptr ? PyObject_Str(value) : nullptr;
  const char* const words = text != nullptr ? PyUnicode_AsUTF8(text) : nullptr;
  std::string out = words != nullptr ? words : "an error without words";
  Py_XDECREF(text);
  Py_XDECREF(type);
  Py_XDECREF(value);
  Py_XDECREF(trace);
  PyErr_Clear();
  return out;
}

// In a build folder the package lies beside the framework's; an installed one is where Python looks.
void add_build_folder() {
  Dl_info self{};
  ::dladdr(reinterpret_cast<const void*>(&add_build_folder), &self);
  std::error_code unknown;
  const std::filesystem::path folder = std::filesystem::weakly_canonical(
      std::filesystem::path(self.dli_fname).parent_path() / SEMFIELD_PYTHON_BUILD_DIR, unknown);
  if (!semfield::is_there(folder / "semfield" / "__init__.py")) return;
  PyObject* const path = PySys_GetObject("path");
  PyObject* const word = PyUnicode_FromString(folder.c_str());
  if (path != nullptr && word != nullptr) PyList_Insert(path, 0, word);
  Py_XDECREF(word);
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
  add_build_folder();
  PyEval_SaveThread();
}

struct Gil : semfield::NonCopyable {
  Gil() : state(PyGILState_Ensure()) {}
  ~Gil() { PyGILState_Release(state); }
  PyGILState_STATE state;
};

const Host& host() {
  static const Host& found = []() -> const Host& {
    PyObject* const core = PyImport_ImportModule("semfield._core");
    if (core == nullptr)
      throw Error(ErrorKind::unavailable, "python.module.missing", "Python's module semfield: " + raised_text(),
                  kRemedy);
    PyObject* const capsule = PyObject_GetAttrString(core, "_host");
    const auto* const own =
        capsule != nullptr ? static_cast<const Host*>(PyCapsule_GetPointer(capsule, "semfield.host")) : nullptr;
    if (own == nullptr)
      throw Error(ErrorKind::unavailable, "python.module.missing", "Python's module semfield: " + raised_text(),
                  kRemedy);
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
  const Gil gil;
  host().load(registry, path);
}
