// semfield._core: what the package in python/semfield is made of. Users see the package alone.
#include <pybind11/stl.h>

#include "config/settings/run_config.h"
#include "core/check.h"
#include "model/compositor.h"
#include "python/core/errors.h"
#include "python/core/values.h"
#include "scene/loading/packed_scene.h"
#include "train/run_folder.h"

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
  write_packed_scene(
      path, info, [&](int frame, FrameBuffer& out) { fill_frame(read(frame), info, frame, out); }, false);
}

// The program's own steps of the rendering integral, for studies: samples along rays, and what is composited from them.

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
template <class T>
View<T> view_of(const Array<T>& array, py::ssize_t columns = 1) {
  return {const_cast<T*>(array.data()), array.size() / columns, static_cast<std::int32_t>(columns)};
}

template <class Real>
py::tuple sample(const Sampler<Real>& sampler, const Array<double>& rays, bool training, const py::object& previous) {
  const View<const double> all = view_of(rays, 8);  // origin, direction, near and far
  Workspace arena;
  StepContext ctx;
  ctx.training = training;
  ctx.workspace = &arena;
  ctx.pass = previous.is_none() ? 0 : 1;
  Samples<Real> before, out;
  Proposal<Real> proposal{&before, {}};
  if (!previous.is_none()) {
    const auto [t, delta, first, weight] =
        previous.cast<std::tuple<Array<Real>, Array<Real>, Array<std::int32_t>, Array<Real>>>();
    before = {view_of(t), view_of(delta), {}, view_of(first), t.size()};
    proposal.weight = view_of(weight);
  }
  const std::int64_t room = sampler.capacity(all.rows, before.count / all.rows, training);
  Array<Real> t(room), delta(room);
  Array<std::int32_t> ray(room), first(all.rows + 1);
  out = {view_of(t), view_of(delta), view_of(ray), view_of(first), 0};
  sampler.sample(ctx, {}, {all.col_range(0, 3), all.col_range(3, 3), all.col_range(6, 2)},
                 previous.is_none() ? nullptr : &proposal, out);
  const py::slice made(0, out.count, 1);
  return py::make_tuple(t[made], delta[made], first);
}

template <class Real>
py::tuple composite(const Array<Real>& t, const Array<Real>& delta, const Array<std::int32_t>& first,
                    const Array<Real>& sigma, const Array<Real>& values) {
  SEMFIELD_CHECK(delta.size() == t.size() && sigma.size() == t.size() && values.ndim() == 2 &&
                     values.shape(0) == t.size() && values.shape(1) >= 3,
                 "delta, sigma and values have a row for each of t");
  const Samples<Real> samples{view_of(t), view_of(delta), {}, view_of(first), t.size()};
  const py::ssize_t rays = first.size() - 1, width = values.shape(1);  // of colour and hidden channels
  Array<Real> depth(rays), opacity(rays), sums({rays, width}), weight(t.size());
  const View<Real> in = view_of(values, width), out = view_of(sums, width);
  const std::int32_t hidden = in.cols - 3;
  composite_forward<Real>(
      {&samples, view_of(sigma), in.col_range(0, 3), in.col_range(3, hidden)},
      {out.col_range(0, 3), view_of(depth), view_of(opacity), out.col_range(3, hidden), view_of(weight)});
  return py::make_tuple(opacity, depth, sums, weight);
}

py::tuple sample_of(const py::dict& sampler, const Array<double>& rays, bool training, bool doubles,
                    const py::object& previous) {
  Diagnostics diagnostics;
  Registry& registry = base_registry();
  const PluginSlot slot =
      read_slot(PluginKind::sampler, node_of(sampler, "sampler"), "sampler", registry, diagnostics, {});
  diagnostics.throw_if_errors(ErrorKind::config, "");
  const SamplerBuild build{{}, {}, rays.at(0, 6), rays.at(0, 7)};
  const PluginEntry& entry = *slot.entry;
  return doubles ? sample(*entry.sampler64(*slot.params, build, registry.kernels()), rays, training, previous)
                 : sample(*entry.sampler32(*slot.params, build, registry.kernels()), rays, training, previous);
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
  module.def("write_pack", write_pack);
  module.def("is_pack", semfield::is_packed_scene);
  module.def("resolved", resolved);
  module.def("sample", sample_of);
  module.def("composite", composite<double>);
  module.def("composite_float32", composite<float>);
  follow_forks();
  py::module_::import("atexit").attr("register")(py::cpp_function(end_work));
  module.def("environment", [] { return semfield::environment_json(semfield::this_environment()); });
  module.attr("__version__") = semfield::this_environment().version;
}
