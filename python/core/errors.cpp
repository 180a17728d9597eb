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
    for (const Diagnostic& d : all->findings()) findings.append(py::make_tuple(d.where, d.message, d.remedy));
  } else {
    findings.append(py::make_tuple("", error.message(), error.remedy()));
  }
  const py::object type = py::module_::import("semfield.errors").attr(class_of(error.kind()));
  const py::object made =
      type(error.what(), findings, error.remedy(), py::cast(error.context()), static_cast<int>(error.kind()));
  PyErr_SetObject(type.ptr(), made.ptr());
}

}  // namespace

void register_errors(py::module_&) {
  py::register_exception_translator([](std::exception_ptr thrown) {
    try {
      if (thrown) std::rethrow_exception(thrown);
    } catch (const Error& error) {
      raise(error);
    } catch (const py::cast_error& error) {  // a value beyond its type
      raise(Error(ErrorKind::usage, error.what()));
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
  return Error(ErrorKind::failure, doing + ": " + what);
}

}  // namespace semfield::python
