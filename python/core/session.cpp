#include "python/core/session.h"

#include <pybind11/stl.h>
#include <unistd.h>

#include <csignal>
#include <optional>

#include "core/error.h"
#include "core/non_copyable.h"
#include "core/workspace.h"
#include "eval/channel_query.h"
#include "eval/final_eval.h"
#include "python/core/arrays.h"
#include "python/core/errors.h"
#include "python/core/plugins.h"
#include "python/core/scene_values.h"
#include "report/report.h"
#include "run/run.h"
#include "scene/scene.h"

namespace semfield::python {

namespace {

constexpr std::size_t kPointsBetweenLooks = 65536;

template <class T>
void append(const std::vector<T>& part, std::vector<T>& whole) {
  whole.insert(whole.end(), part.begin(), part.end());
}

// Opening of a scene that Ctrl-C ends: images are read one by one, and between them somebody looks.
template <class Open>
auto opened(const Open& open) {
  const Work working;
  Interrupt interrupt;
  const LoadProgress look = [&](std::string_view, std::size_t, std::size_t total) {
    if (total > 0 && interrupt.came()) interrupt.raise();  // 0: told by a destructor
  };
  WorkSettings settings = work_settings();
  settings.load_progress = &look;
  const WorkScope scope(settings);
  return open();
}

// The interrupt that the listener looks at, for the time of one call.
class OneCall : NonCopyable {
 public:
  OneCall(Interrupt*& place, Interrupt* interrupt) : place_(place) { place_ = interrupt; }
  ~OneCall() { place_ = nullptr; }

 private:
  Interrupt*& place_;
};

std::vector<Vec3d> vectors_of(const py::object& value, const char* what) {
  const auto rows = py::array_t<double, py::array::c_style | py::array::forcecast>::ensure(value);
  if (!rows || rows.ndim() != 2 || rows.shape(1) != 3) {
    PyErr_Clear();
    throw Error(ErrorKind::usage, "python.array.shape", std::string(what) + ": expected numbers of the shape [N, 3]");
  }
  std::vector<Vec3d> out(static_cast<std::size_t>(rows.shape(0)));
  for (py::ssize_t i = 0; i < rows.shape(0); ++i)
    out[static_cast<std::size_t>(i)] = {rows.at(i, 0), rows.at(i, 1), rows.at(i, 2)};
  return out;
}

py::dict values_dict(const std::vector<std::pair<std::string, std::optional<double>>>& values) {
  py::dict out;
  for (const auto& [name, value] : values) out[py::str(name)] = value ? py::object(py::float_(*value)) : py::none();
  return out;
}

}  // namespace

PySession::PySession() : owner_(getpid()), registry_(base_registry()) {}

PySession::~PySession() {
  if (getpid() == owner_) return;
  (void)run_.release();  // its threads and files are those of the process that opened it
  (void)loaded_.release();
}

void PySession::refuse_fork() const {
  if (getpid() == owner_) return;
  throw Error(ErrorKind::usage, "python.session.fork",
              "this run was opened by process " + std::to_string(owner_) + ", and this is a fork of it, process " +
                  std::to_string(getpid()),
              "save the run before the fork and semfield.load its folder here, or open it here");
}

// Without the GIL, one caller at a time, under the settings of the session's work.
template <class Call>
auto PySession::computed(const Call& call) const {
  refuse_fork();
  const Work working;
  const std::lock_guard lock(mutex_);
  const WorkSettings settings = session().work();
  const WorkScope scope(settings);
  return call();
}

std::unique_ptr<PySession> PySession::open(const py::object& config, const py::dict& set, const std::string& run_dir,
                                           const std::vector<std::string>& keep, const py::object& scene) {
  std::unique_ptr<PySession> made(new PySession);
  ConfigNode tree = composed(config, set);
  if (!scene.is_none()) tree = with_scene(tree, scene.cast<py::dict>());
  made->run_ = opened([&] {
    return std::make_unique<Run>(session_config_of(tree, made->registry_), made->registry_,
                                 TrainRequest{run_dir, false, keep}, &made->notes_);
  });
  return made;
}

std::unique_ptr<PySession> PySession::resume(const std::string& run_dir, const py::dict& set,
                                             const std::vector<std::string>& keep) {
  std::unique_ptr<PySession> made(new PySession);
  const std::vector<ConfigOverride> overrides = overrides_of(set);
  made->run_ = opened([&] {
    const ConfigNode tree = compose_config_with(RunFolder::read(run_dir).config_path(), overrides);
    return std::make_unique<Run>(session_config_of(tree, made->registry_), made->registry_,
                                 TrainRequest{run_dir, true, keep}, &made->notes_);
  });
  return made;
}

std::unique_ptr<PySession> PySession::load(const std::string& run_dir, const py::dict& set) {
  std::unique_ptr<PySession> made(new PySession);
  std::vector<std::string> overrides;
  for (const ConfigOverride& o : overrides_of(set)) overrides.push_back(o.key + "=" + write_config_inline(o.value));
  Diagnostics found;
  made->loaded_ = opened([&] {
    return std::make_unique<OpenedRun>(
        open_run(run_dir, overrides, made->registry_, found, OpenFor::evaluation_of_training_frames));
  });
  for (const Diagnostic& finding : folded(found)) made->notes_.note(finding.shown());
  return made;
}

Run& PySession::training() {
  refuse_fork();
  if (run_) return *run_;
  throw Error(ErrorKind::usage, "python.session.read_only", "this run was opened to be looked at",
              "open it with semfield.resume to continue it");
}

std::vector<std::string> PySession::notes() const {
  return computed([&] { return notes_.texts; });
}

py::list PySession::rows() const {
  py::list out;
  if (!run_) return out;
  const std::vector<MetricsRow> rows = computed([&] { return notes_.rows; });
  for (const MetricsRow& row : rows) {
    py::dict item = values_dict(row.values);
    item["step"] = row.step;
    item["train_s"] = row.train_s;
    out.append(item);
  }
  return out;
}

std::int64_t PySession::steps_left() const {
  const std::int64_t end = last_step(session().config);
  return end == 0 ? -1 : std::max<std::int64_t>(0, end - step());
}

void PySession::train_more(std::int64_t steps, double seconds) {
  Run& run = training();
  computed([&] { run.train_more({steps, seconds}); });
}

py::dict PySession::train(std::int64_t steps, bool to_end) {
  Run& run = training();
  StepLosses sum;
  std::int64_t made = 0;
  std::vector<std::int64_t> active(session().config.losses.size(), 0);
  Interrupt interrupt;
  const double before_s = train_s();
  computed([&] {
    const OneCall asked(notes_.interrupt, &interrupt);
    while (made < steps && !interrupt.came() && !(to_end && run.training().at_its_end())) {
      for (const StepLosses& losses : run.advance(steps - made)) {
        ++made;
        sum.total += losses.total;
        sum.color += losses.color;
        sum.semantic += losses.semantic;
        sum.mse += losses.mse;
        sum.samples += losses.samples;
        sum.labelled += losses.labelled;
        sum.correct += losses.correct;
        for (std::size_t i = 0; i < active.size(); ++i) {
          if ((losses.active >> i & 1U) == 0) continue;
          ++active[i];
          sum.terms[i] += losses.terms[i];
        }
      }
    }
  });
  interrupt.raise();
  py::dict out, terms;
  const double count = static_cast<double>(std::max<std::int64_t>(made, 1));
  for (std::size_t i = 0; i < active.size(); ++i)
    if (active[i] > 0) terms[py::str(session().config.losses[i].type)] = sum.terms[i] / static_cast<double>(active[i]);
  out["steps"] = made;
  out["loss"] = sum.total / count;
  out["color"] = sum.color / count;
  out["semantic"] = sum.semantic / count;
  out["mse"] = sum.mse / count;
  out["samples"] = sum.samples;
  out["labelled"] = sum.labelled;
  out["correct"] = sum.correct;
  out["terms"] = terms;
  out["seconds"] = train_s() - before_s;
  return out;
}

std::string PySession::save(const std::string& run_dir) {
  Run& run = training();
  return computed([&] { return run.save(run_dir); });
}

py::dict PySession::parameters() {
  Run& run = training();
  const std::vector<TensorRef> tensors = computed([&] { return run.training().state(); });
  py::dict out;
  for (const TensorRef& tensor : tensors) {
    if (tensor.type != TensorType::f32) continue;
    std::vector<float> values(tensor.bytes.size() / sizeof(float));
    std::copy_n(tensor.bytes.data(), tensor.bytes.size(), reinterpret_cast<std::byte*>(values.data()));
    out[py::str(tensor.name)] = array_of(std::move(values), {tensor.shape.begin(), tensor.shape.end()});
  }
  return out;
}

void PySession::set_labels(int frame, const py::object& ids) {
  Run& run = training();
  const std::vector<FrameInfo>& frames = session().scene.info.frames;
  if (frame < 0 || frame >= std::ssize(frames))
    throw Error(ErrorKind::usage, "python.frame.range",
                "frame " + std::to_string(frame) + ": there are " + std::to_string(frames.size()));
  const FrameInfo& info = frames[static_cast<std::size_t>(frame)];
  std::vector<std::int16_t> labels = indices_of(ids, session().scene.info.classes, info.camera.height_px,
                                                info.camera.width_px, "labels of frame '" + info.name + "'");
  computed([&] { run.training().set_labels(frame, std::move(labels)); });
}

bool PySession::apply(const std::string& event) {
  Run& run = training();
  const LabelEvent parsed = parse_label_event(event);
  return computed([&] { return run.apply(parsed); });
}

py::dict PySession::annotations() const {
  py::dict out;
  py::list marks;
  const std::optional<Annotations> copy = computed([&]() -> std::optional<Annotations> {
    if (!run_ || run_->annotations() == nullptr) return std::nullopt;
    return *run_->annotations();
  });
  const Annotations* const all = copy ? &*copy : nullptr;
  out["room"] = all != nullptr ? all->classes().valid_count() : 0;
  py::list named;
  for (int i = 0; all != nullptr && i < all->named_classes(); ++i)
    if (all->is_named(i)) named.append(all->classes().valid(i).name);
  out["named"] = named;
  if (all != nullptr) {
    for (const Annotations::Mark& mark : all->marks()) {
      py::dict item;
      py::list points;
      for (const PixelPoint& p : mark.points) points.append(py::make_tuple(p.x, p.y));
      item["id"] = mark.id;
      item["frame"] = session().scene.info.frames[static_cast<std::size_t>(mark.frame)].name;
      item["points"] = points;
      item["radius_px"] = mark.radius_px;
      item["class_"] =
          mark.class_index == kVoid ? py::object(py::none()) : py::str(all->classes().valid(mark.class_index).name);
      marks.append(item);
    }
  }
  out["clicks"] = marks;
  return out;
}

py::object PySession::channel_axes(const std::string& channel) {
  const View<const float> axes = session().pipeline->passes().back().axes(channel);
  if (axes.empty()) return py::none();
  return array_of(std::vector<float>(axes.data, axes.data + axes.size()), {axes.rows, axes.cols});
}

py::dict PySession::render(const py::dict& camera, const py::object& pose, int stride, bool probability,
                           const std::vector<std::string>& channels, int ordinal) {
  const RayCamera view{camera_of(camera), pose_of(pose, "render"), true};
  Diagnostics found;
  check_camera(view.camera, "render", found);
  found.throw_if_errors(ErrorKind::usage, "");
  if (stride < 1 || stride > std::min(view.camera.width_px, view.camera.height_px))
    throw Error(ErrorKind::usage, "usage.value.stride",
                "stride " + std::to_string(stride) + ": expected 1 to the picture's shorter side");
  FrameOptions options;
  options.stride = stride;
  options.probability = probability;
  options.classes = session().classes();
  options.channels = channels;
  Interrupt interrupt;
  options.progress = [&](double) {
    if (interrupt.came()) interrupt.raise();
  };
  RenderedFrame frame = computed([&] {
    return render_frame(*session().pipeline, {view.camera, view.world_from_camera, view.camera.has_distortion()},
                        session().limits, session().plan.class_of_logit, {}, options);
  });
  const py::ssize_t height = frame.height_px, width = frame.width_px;
  const ClassTable& classes = session().scene.info.classes;
  py::dict out;
  out["rgb"] = array_of(std::move(frame.rgb), {height, width, 3});
  out["depth_m"] = array_of(std::move(frame.depth_m), {height, width});
  out["opacity"] = array_of(std::move(frame.opacity), {height, width});
  if (session().pipeline->has_semantics()) {
    out["label"] = ids_array(frame.label, classes, frame.height_px, frame.width_px);
    out["entropy"] = array_of(std::move(frame.entropy), {height, width});
    out["confidence"] = array_of(std::move(frame.confidence), {height, width});
    if (probability)
      out["probability"] = array_of(std::move(frame.probability), {height, width, classes.valid_count()});
  }
  for (FrameChannel& one : frame.channels) {
    const py::ssize_t cols = one.cols;
    out[py::str("channel " + one.name)] = array_of(std::move(one.values), {height, width, cols});
  }
  if (ordinal >= 0)
    for (const auto& item : py::dict(out)) out[item.first] = on_device(item.second.cast<py::array>(), ordinal);
  return out;
}

py::tuple PySession::evaluate(const std::string& split, const std::vector<int>& frames) {
  if (frames.empty())
    throw Error(ErrorKind::usage, "scene.split.empty", "the scene has no frames in split '" + split + "'",
                "see run.frames");
  Interrupt interrupt;
  const SplitScore score = computed([&] {
    EvalJob job = session().eval_job(frames);
    job.stop = [&] { return interrupt.came(); };
    return semfield::evaluate(*session().pipeline, job, session().limits, session().plan.class_of_logit);
  });
  interrupt.raise();
  FinalEval detail = final_eval(score, session().scene.info.classes, split);
  detail.step = step();
  detail.train_s = train_s();
  return py::make_tuple(values_dict(score.values()), final_eval_json(detail));
}

py::dict PySession::query(const py::object& positions, const py::object& directions) {
  const std::vector<Vec3d> places = vectors_of(positions, "positions");
  const std::vector<Vec3d> seen = directions.is_none() ? std::vector<Vec3d>() : vectors_of(directions, "directions");
  if (!directions.is_none() && seen.size() != places.size())
    throw Error(ErrorKind::usage, "python.array.shape",
                "directions: expected one for each of " + std::to_string(places.size()) + " positions, got " +
                    std::to_string(seen.size()));
  const int classes = session().classes();
  FieldPoints found;
  Interrupt interrupt;
  computed([&] {
    session().pipeline->executor().download(step());
    for (std::size_t first = 0; first < places.size() && !interrupt.came(); first += kPointsBetweenLooks) {
      const std::size_t count = std::min(kPointsBetweenLooks, places.size() - first);
      const auto along = seen.empty() ? std::span<const Vec3d>() : std::span(seen).subspan(first, count);
      const FieldPoints part = field_at(*session().pipeline, std::span(places).subspan(first, count), along,
                                        session().limits, session().plan.class_of_logit, classes);
      append(part.sigma, found.sigma);
      append(part.rgb, found.rgb);
      append(part.label, found.label);
      append(part.probability, found.probability);
      append(part.entropy, found.entropy);
    }
  });
  interrupt.raise();
  const auto count = std::ssize(places);
  py::dict out;
  out["sigma"] = array_of(std::move(found.sigma), {count});
  if (!directions.is_none()) out["rgb"] = array_of(std::move(found.rgb), {count, 3});
  if (session().pipeline->has_semantics()) {
    out["label"] =
        ids_array(found.label, session().scene.info.classes, 1, static_cast<std::int32_t>(count)).attr("reshape")(-1);
    out["probability"] = array_of(std::move(found.probability), {count, classes});
    out["entropy"] = array_of(std::move(found.entropy), {count});
  }
  return out;
}

// The class Session of semfield._core.

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
  module.def("open", &PySession::open);
  module.def("resume", &PySession::resume);
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

// `semfield train` as a call.

namespace {

// Tells a function of Python how the run goes, and asks it, and Ctrl-C, whether to stop.
class Told final : public RunListener {
 public:
  explicit Told(const py::object& progress) : progress_(progress) {}

  void note(const std::string& text) override { notes.push_back(text); }
  void progress(const TrainProgress& p) override {
    const py::gil_scoped_acquire gil;
    if (progress_.is_none() || raised) return;
    py::dict now;
    now["step"] = p.step;
    now["steps"] = p.steps;
    now["loss"] = p.loss;
    now["psnr"] = p.psnr;
    now["miou_present"] = p.miou_present ? py::object(py::float_(*p.miou_present)) : py::none();
    now["rays_per_s"] = p.rays_per_s;
    now["train_s"] = p.train_s;
    now["remaining_s"] = p.remaining_s;
    try {
      progress_(now);
    } catch (py::error_already_set& error) {
      raised.emplace(error);
    }
  }
  int stop_signal() override { return raised || interrupt_.came() ? SIGINT : 0; }
  void raise() const {
    if (raised) throw py::error_already_set(*raised);
    interrupt_.raise();
  }
  std::string write_report(const RunFolder& folder, const Session& session, const ReportFrames& frames) override {
    return write_run_report(folder, session, frames);
  }

  std::optional<py::error_already_set> raised;
  std::vector<std::string> notes;

 private:
  const py::object& progress_;
  Interrupt interrupt_;
};

}  // namespace

py::dict train_run(const py::object& config, const py::dict& set, const std::string& out, bool resume,
                   const py::object& progress) {
  Registry registry = base_registry();
  const ConfigNode tree =
      resume ? compose_config_with(RunFolder::read(out).config_path(), overrides_of(set)) : composed(config, set);
  Told told(progress);
  TrainOutcome outcome;
  {
    const Work working;
    outcome = run_training(session_config_of(tree, registry), registry, {out, resume, {}}, &told);
  }
  told.raise();
  py::dict result;
  result["run_dir"] = outcome.run_dir;
  result["report"] = outcome.report_path;
  result["step"] = outcome.step;
  result["train_s"] = outcome.train_s;
  result["scores"] = values_dict(outcome.values);
  result["scored"] = outcome.scored.frames == 0 ? std::string() : outcome.scored.text();
  result["notes"] = told.notes;
  return result;
}

}  // namespace semfield::python
