// semfield._core: what the package in python/semfield is made of. Users see the package alone.
#include <pybind11/stl.h>

#include "labels/clicks/click_log.h"
#include "loading/packed_scene.h"
#include "python/core/arrays.h"
#include "python/core/errors.h"
#include "python/core/plugins.h"
#include "python/core/scene_values.h"
#include "run/run_folder.h"

namespace semfield::python {

namespace {

// Frames of the scene are asked for one by one: read(frame) gives the dict that fill_frame takes.
void write_pack(const std::string& path, const py::dict& scene, const py::function& read) {
  Diagnostics diagnostics;
  const SceneInfo info = scene_info_of(scene, diagnostics);
  // All that is wrong is told at once, and nothing is written then.
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    if (info.frames[i].camera.width_px < 1) continue;  // no size to hold them against
    collect(diagnostics, "frame '" + info.frames[i].name + "'", [&] {
      FrameBuffer frame;
      fill_frame(read(i), info, static_cast<int>(i), frame);
    });
  }
  diagnostics.throw_if_errors(ErrorKind::data, "");
  PackOptions options;
  options.depth_as_mm = false;
  write_packed_scene(
      path, info, [&](int frame, FrameBuffer& out) { fill_frame(read(frame), info, frame, out); }, options);
}

py::dict resolved(const py::object& config, const py::dict& set) {
  Registry registry = base_registry();
  return object_of(resolved_config(run_config_of(composed(config, set), registry)));
}

}  // namespace

}  // namespace semfield::python

PYBIND11_MODULE(_core, module) {
  using namespace semfield::python;
  register_errors(module);
  define_session(module);
  define_plugins(module);
  define_device_arrays(module);
  define_integral(module);
  module.def("write_pack", write_pack);
  module.def("is_pack", semfield::is_packed_scene);
  module.def("resolved", resolved);
  follow_forks();
  py::module_::import("atexit").attr("register")(py::cpp_function(end_work));
  module.def("environment", [] { return semfield::environment_json(semfield::this_environment()); });
  module.attr("__version__") = semfield::this_environment().version;
}
