// Scenes as Python tells them: dicts that the package's own classes make (semfield/scenes.py).
#pragma once

#include <pybind11/numpy.h>

#include "scene/scene.h"

namespace semfield::python {

namespace py = pybind11;

/// [4, 4] float64, world from camera.
py::array pose_array(const Pose& pose);
/// [4, 4] or [3, 4] numbers; a rotation that is none is an Error(data) naming `place`.
Pose pose_of(const py::object& value, const std::string& place);
/// width, height, fx, fy, cx, cy and distortion k1 k2 p1 p2 k3 k4 of a dict.
Camera camera_of(const py::dict& camera);
py::dict camera_dict(const Camera& camera);

/// Files an error whose message begins with the place "frame 'a'" under that place, so that the same mistake in many
/// frames is one finding.
void report_of_frame(const std::string& frame, const Error& error, Diagnostics& diagnostics);

/// Findings about poses and cameras go into `diagnostics`.
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

}  // namespace semfield::python
