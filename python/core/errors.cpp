#include "python/core/errors.h"

#include <pybind11/stl.h>

#include "core/findings.h"

namespace semfield::python {

namespace py = pybind11;

namespace {

const char* class_of(ErrorKind kind) {
  switch (kind) {
    case ErrorKind::usage:
      return "UsageError";
    case ErrorKind::data:
      return "DataError";
    case ErrorKind::no_input:
      return "InputError";
    case ErrorKind::unavailable:
      return "UnavailableError";
    case ErrorKind::cannot_create:
    case ErrorKind::io:
      return "WriteError";
    case ErrorKind::config:
      return "ConfigError";
    case ErrorKind::failure:
    case ErrorKind::internal:
      break;
  }
  return "Error";
}

void raise(const Error& error) {
  py::list findings;
  if (const auto* all = dynamic_cast<const FindingsError*>(&error)) {
    for (const Diagnostic& d : all->findings())
      findings.append(py::make_tuple(d.where, d.message, d.remedy, d.code.text()));
  } else {
    findings.append(py::make_tuple("", error.message(), error.remedy(), error.code().text()));
  }
  const py::object type = py::module_::import("semfield.errors").attr(class_of(error.kind()));
  const py::object made = type(error.what(), findings, error.remedy(), py::cast(error.context()),
                               static_cast<int>(error.kind()), error.code().text());
  PyErr_SetObject(type.ptr(), made.ptr());
}

// That of an exception of the package, which a plugin lets pass or raises with a code of its own.
Code code_of(const py::error_already_set& raised) {
  const py::object value = raised.value();
  if (py::isinstance(value, py::module_::import("semfield.errors").attr("Error"))) {
    if (const std::optional<Code> code = Code::parse(py::str(value.attr("code")).cast<std::string>())) return *code;
  }
  return "plugin.python.raised";
}

}  // namespace

void register_errors(py::module_&) {
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const Error& error) {
      raise(error);
    } catch (const py::cast_error& error) {  // a value beyond its type
      raise(Error(ErrorKind::usage, "python.value.type", error.what()));
    }
  });
}

Error error_of(py::error_already_set& raised, const std::string& doing) {
  std::string what = py::str(py::handle(raised.type()).attr("__name__")).cast<std::string>() + ": " +
                     py::str(raised.value()).cast<std::string>();
  py::object trace = raised.trace();
  while (trace && !trace.is_none() && !trace.attr("tb_next").is_none()) trace = trace.attr("tb_next");
  if (trace && !trace.is_none()) {
    const py::object code = trace.attr("tb_frame").attr("f_code");
    what += " (" + code.attr("co_filename").cast<std::string>() + ":" +
            py::str(trace.attr("tb_lineno")).cast<std::string>() + ")";
  }
  return Error(ErrorKind::failure, code_of(raised), doing + ": " + what);
}

}  // namespace semfield::python
