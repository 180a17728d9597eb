// The class Session of semfield._core.
#include <pybind11/stl.h>

#include "python/core/arrays.h"
#include "python/core/config_nodes.h"
#include "python/core/plugins.h"
#include "python/core/scene_values.h"
#include "python/core/session.h"

namespace semfield::python {

namespace {

constexpr const char* kSplits[] = {"train", "test", "unused"};

py::list frames_of(const PySession& self) {
  py::list out;
  for (const FrameInfo& frame : self.session().scene.info.frames) {
    py::dict item;
    item["name"] = frame.name;
    item["split"] = kSplits[static_cast<std::size_t>(frame.split)];
    item["camera"] = camera_dict(frame.camera);
    item["pose"] = pose_array(frame.world_from_camera);
    item["has_depth"] = frame.has_depth;
    item["has_labels"] = frame.has_labels;
    item["source"] = frame.source;
    out.append(item);
  }
  return out;
}

py::list session_classes(const PySession& self) {
  const Session& s = self.session();
  const std::vector<std::int16_t> logits = s.logit_of_class();
  py::list out;
  for (int i = 0; i < s.classes(); ++i) {
    const ClassEntry& entry = s.scene.info.classes.valid(i);
    const bool learned = s.plan.semantics && logits[static_cast<std::size_t>(i)] != kVoid;
    out.append(py::make_tuple(i, entry.id, entry.name, py::cast(entry.color), learned));
  }
  return out;
}

py::dict pixels_of(const PySession& self, int frame) {
  const Session& s = self.session();
  const auto f = static_cast<std::size_t>(frame);
  if (frame < 0 || f >= s.scene.frames.size())
    throw Error(ErrorKind::usage, "python.frame.range",
                "frame " + std::to_string(frame) + ": there are " + std::to_string(s.scene.frames.size()));
  const StoredFrame& stored = s.scene.frames[f];
  const std::int32_t height = stored.height_px, width = stored.width_px;
  py::dict out;
  if (stored.rgb.empty()) return out;
  out["rgb"] = array_of(std::vector<std::uint8_t>(stored.rgb), {height, width, 3});
  if (!stored.depth_m.empty()) out["depth_m"] = array_of(stored.depth_m.expand(), {height, width});
  const ClassTable& classes = s.scene.info.classes;
  if (!stored.label.empty()) out["labels"] = ids_array(stored.label.expand(), classes, height, width);
  if (f < s.labels.frames.size() && !s.labels.frames[f].empty()) {
    const TrainingLabels::Frame& labels = s.labels.frames[f];
    std::vector<std::int16_t> indices(labels.size());
    for (std::size_t i = 0; i < indices.size(); ++i) indices[i] = labels[i];
    out["training_labels"] = ids_array(indices, classes, height, width);
  }
  return out;
}

py::dict facts_of(const PySession& self) {
  const Session& s = self.session();
  py::dict out;
  std::vector<double> bounds{s.scene.bounds.lo.x, s.scene.bounds.lo.y, s.scene.bounds.lo.z,
                             s.scene.bounds.hi.x, s.scene.bounds.hi.y, s.scene.bounds.hi.z};
  out["name"] = s.config.name;
  out["bounds"] = array_of(std::move(bounds), {2, 3});
  out["near_m"] = s.limits.near_m;
  out["far_m"] = s.limits.far_m;
  out["metric"] = s.scene.info.metric;
  out["device"] = s.pipeline->executor().description();
  const DeviceId device = s.pipeline->executor().device();
  out["cuda"] = device.kind == Device::cuda ? device.ordinal : -1;
  out["has_semantics"] = s.pipeline->has_semantics();
  py::list left_out;
  for (const LeftOut& part : s.plan.left_out)
    left_out.append(py::make_tuple(part.component, part.rule, part.evidence, part.saving));
  out["left_out"] = left_out;
  return out;
}

}  // namespace

void define_session(py::module_& module) {
  using Opening = PySession::Opening;
  const auto open = [](const py::object& config, const py::dict& set, const std::string& out,
                       const std::vector<std::string>& keep, const py::object& scene) {
    return PySession::open(config, set, Opening{out, keep, scene});
  };
  const auto resume = [](const std::string& run_dir, const py::dict& set, const std::vector<std::string>& keep) {
    return PySession::resume(run_dir, set, Opening{run_dir, keep, py::none()});
  };
  module.def("open", open);
  module.def("resume", resume);
  module.def("load", &PySession::load);
  module.def("train_run", train_run);
  py::class_<PySession>(module, "Session")
      .def_property_readonly("trains", &PySession::trains)
      .def_property_readonly("step", &PySession::step)
      .def_property_readonly("train_s", &PySession::train_s)
      .def_property_readonly("run_dir", &PySession::run_dir)
      .def("notes", &PySession::notes)
      .def("rows", &PySession::rows)
      .def("train", &PySession::train)
      .def("train_more", &PySession::train_more)
      .def_property_readonly("steps_left", &PySession::steps_left)
      .def("save", &PySession::save)
      .def("parameters", &PySession::parameters)
      .def("set_labels", &PySession::set_labels)
      .def("apply", &PySession::apply)
      .def("annotations", &PySession::annotations)
      .def("render", &PySession::render)
      .def("channel_axes", &PySession::channel_axes)
      .def("evaluate", &PySession::evaluate)
      .def("query", &PySession::query)
      .def("frames", frames_of)
      .def("classes", session_classes)
      .def("pixels", pixels_of)
      .def("facts", facts_of)
      .def("config", [](const PySession& self) { return object_of(resolved_config(self.session().config)); });
}

}  // namespace semfield::python
