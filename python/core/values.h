// Values between Python and the framework: arrays, and scenes as dicts that the package's own classes make
// (semfield/scenes.py).
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <functional>
#include <memory>
#include <vector>

#include "config/config_words.h"
#include "config/settings/run_config.h"
#include "core/view.h"
#include "plugin/registry.h"
#include "scene/scene.h"

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

/// dict, list, tuple, str, bool, int, float, None and paths; NumPy's numbers too. `origin` stands for the file in
/// messages. Throws Error(usage) naming the key for any other type.
ConfigNode node_of(const py::handle& value, const std::string& origin);

/// The other way; numbers and truth values become Python's own.
py::object object_of(const ConfigNode& node);

/// {"train.rays": 2048} as overrides; messages say `set["train.rays"]`.
std::vector<ConfigOverride> overrides_of(const py::dict& set);

/// A path of a file, or a dict. Composed, with overrides.
/// `tree` with this scene in place of its own; what the tree says of labels and of loading stays.
ConfigNode with_scene(const ConfigNode& tree, const py::dict& scene);

ConfigNode composed(const py::object& config, const py::dict& set);

/// [4, 4] float64, world from camera.
py::array pose_array(const Pose& pose);
/// [4, 4] or [3, 4] numbers; a rotation that is none is an Error(data) naming `place`.
Pose pose_of(const py::object& value, const std::string& place);
/// width, height, fx, fy, cx, cy and distortion k1 k2 p1 p2 k3 k4 of a dict. Throws Error(data) for a picture above the
/// limits of inputs.
Camera camera_of(const py::dict& camera);
py::dict camera_dict(const Camera& camera);

/// An Error that `work` throws becomes a finding at `place`, which its message need not repeat.
void collect(Diagnostics& diagnostics, const std::string& place, const std::function<void()>& work);

/// Findings about names, poses and cameras go into `diagnostics`, each at its frame.
SceneInfo scene_info_of(const py::dict& scene, Diagnostics& diagnostics);

/// rgb [H, W, 3] uint8; depth_m [H, W] or None; labels [H, W] class ids or None. Shapes are those of the frame's
/// camera. Throws Error(data) naming the frame, and the pixel of a label that no class has.
void fill_frame(const py::dict& pixels, const SceneInfo& info, int frame, FrameBuffer& out);

/// Class ids [H, W] int32 of indices, row by row; -1 for void.
py::array ids_array(const std::vector<std::int16_t>& indices, const ClassTable& classes, std::int32_t height,
                    std::int32_t width);
/// The other way; -1 and ids of ignored classes are void. Throws as fill_frame.
std::vector<std::int16_t> indices_of(const py::object& ids, const ClassTable& classes, std::int32_t height,
                                     std::int32_t width, const std::string& place);

// What the parts of the extension define, and the plugins that runs of it start from.

/// What every session of this process starts from: linked plugins, and those that were loaded or defined since.
Registry& base_registry();

/// run_config_of, which lists only those loaded files of Python that it needs: a process tries many ideas, and a run
/// should open without the others.
RunConfig session_config_of(const ConfigNode& tree, Registry& registry);

void define_plugins(py::module_& module);
/// The class Run, and train_run.
void define_session(py::module_& module);

}  // namespace semfield::python
