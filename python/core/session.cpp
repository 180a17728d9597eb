// The class Run of semfield._core: a run that trains, or one that was trained. semfield/runs.py derives the users'
// class from it.
#include <pybind11/stl.h>
#include <sys/types.h>
#include <unistd.h>

#include <atomic>
#include <csignal>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>
#include <type_traits>

#include "core/error.h"
#include "core/non_copyable.h"
#include "core/workspace.h"
#include "eval/evaluator.h"
#include "eval/final_eval.h"
#include "eval/report/report.h"
#include "python/core/errors.h"
#include "python/core/values.h"
#include "scene/scene.h"
#include "train/run.h"
#include "train/run_scores.h"

namespace semfield::python {

namespace {

using namespace pybind11::literals;

constexpr std::size_t kPointsBetweenLooks = 65536;
constexpr const char* kSplits[] = {"train", "test", "unused"};

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

template <class T>
py::object or_none(const std::optional<T>& value) {
  return value ? py::cast(*value) : py::none();
}

py::dict values_dict(const std::vector<std::pair<std::string, std::optional<double>>>& values) {
  py::dict out;
  for (const auto& [name, value] : values) out[py::str(name)] = or_none(value);
  return out;
}

// What a run tells, kept for Python.
class Notes final : public RunListener {
 public:
  void note(const std::string& text) override { texts.push_back(text); }
  void row(const MetricsRow& made) override { rows.push_back(made); }
  int stop_signal() override { return interrupt != nullptr && interrupt->came() ? SIGINT : 0; }
  std::vector<std::string> texts;
  std::vector<MetricsRow> rows;    ///< training rows since the run was opened
  Interrupt* interrupt = nullptr;  ///< of the call under way
};

// It belongs to the process that opened it: a fork has its memory, but not its threads, and shares its files. There,
// calls that compute throw Error(usage), and the end of the object gives nothing back. Every call that computes gives
// the GIL back; calls from several threads wait for each other. Plugins written in Python take it in turn, so nobody
// may hold it while waiting here.
class PyRun : NonCopyable {
 public:
  // `how`: "open", of a configuration and a new folder or none, with `scene` in place of its section where it is a
  // dict; "resume", of a folder to go on with; "load", of a folder to look at.
  PyRun(const std::string& how, const py::object& config, const py::dict& set, const std::string& run_dir,
        const std::vector<std::string>& keep, const py::object& scene)
      : owner_(getpid()), registry_(base_registry()) {
    if (how == "load") {
      load(run_dir, set);
    } else {
      const bool resumes = how == "resume";
      ConfigNode tree;
      const std::vector<ConfigOverride> overrides = overrides_of(set);
      if (!resumes) tree = composed(config, set);
      if (!scene.is_none()) tree = with_scene(tree, scene.cast<py::dict>());
      run_ = opened([&] {
        if (resumes) tree = compose_config_with(RunFolder::read(run_dir).config_path(), overrides);
        return std::make_unique<Run>(session_config_of(tree, registry_), registry_,
                                     TrainRequest{run_dir, resumes, keep}, &notes_);
      });
    }
    name_ = session().config.name;
  }
  ~PyRun() { drop(); }

  // A call that computes in another thread ends first. One of this thread, out of which a signal's handler or a plugin
  // closes the run, keeps it until it returns.
  void close() {
    std::unique_lock<std::mutex> lock(mutex_, std::defer_lock);
    if (getpid() == owner_ && computing_.load() != std::this_thread::get_id()) {
      const Work working;
      lock.lock();
    }
    drop();
  }
  bool closed() const { return !run_ && !loaded_; }
  bool trains() const {
    (void)session();
    return run_ != nullptr;
  }
  std::int64_t step() const { return run_ ? run_->training().step() : loaded().step; }
  double train_s() const { return run_ ? run_->training().train_s() : loaded().train_s; }
  std::string run_dir() const { return run_ ? run_->run_dir() : loaded().run_dir; }
  py::object config() const { return object_of(resolved_config(session().config)); }

  std::vector<std::string> notes() const {
    return computed([&] { return notes_.texts; });
  }
  py::list history() const {
    py::list out;
    for (const MetricsRow& row : computed([&] { return notes_.rows; })) {
      py::dict item = values_dict(row.values);
      item["step"] = row.step;
      item["train_s"] = row.train_s;
      out.append(item);
    }
    return out;
  }
  // To the end of the run's length; -1 while it is not settled.
  std::int64_t steps_left() const {
    const std::int64_t end = last_step(session().config);
    return end == 0 ? -1 : std::max<std::int64_t>(0, end - step());
  }
  void train_more(std::int64_t steps, double seconds) {
    computed([&] { training().train_more({steps, seconds}); });
  }

  // Means over the steps made, which are fewer than asked for after Ctrl-C; then the interrupt is raised, with the run
  // as after the last step. `to_end`: not beyond the end of the run's length.
  py::dict train(std::int64_t steps, bool to_end) {
    const Held held = hold();
    const Session& s = session();
    StepLosses sum;
    std::int64_t made = 0;
    std::vector<std::int64_t> active(s.config.losses.size(), 0);
    Interrupt interrupt;
    double seconds = 0;
    computed([&] {
      Run& run = training();
      const double before_s = run.training().train_s();
      notes_.interrupt = &interrupt;
      const std::shared_ptr<void> ended(nullptr, [&](void*) { notes_.interrupt = nullptr; });
      // Without run_ it was closed out of this call.
      while (made < steps && !interrupt.came() && run_ && !(to_end && run.training().at_its_end())) {
        for (const StepLosses& losses : run.advance(steps - made)) {
          ++made;
          sum.total += losses.total;
          sum.color += losses.color;
          sum.semantic += losses.semantic;
          sum.mse += losses.mse;
          for (std::size_t i = 0; i < active.size(); ++i) {
            if ((losses.active >> i & 1U) == 0) continue;
            ++active[i];
            sum.terms[i] += losses.terms[i];
          }
        }
      }
      seconds = run.training().train_s() - before_s;
    });
    interrupt.raise();
    py::dict terms;
    const double count = static_cast<double>(std::max<std::int64_t>(made, 1));
    for (std::size_t i = 0; i < active.size(); ++i)
      if (active[i] > 0) terms[py::str(s.config.losses[i].type)] = sum.terms[i] / static_cast<double>(active[i]);
    return py::dict("steps"_a = made, "loss"_a = sum.total / count, "color"_a = sum.color / count,
                    "semantic"_a = sum.semantic / count, "mse"_a = sum.mse / count, "terms"_a = terms,
                    "seconds"_a = seconds);
  }
  std::string save(const std::string& run_dir) {
    return computed([&] { return training().save(run_dir); });
  }
  py::dict parameters() {
    struct Copy {
      std::string name;
      std::vector<float> values;
      std::vector<py::ssize_t> shape;
    };
    std::vector<Copy> copies = computed([&] {  // while nobody trains
      std::vector<Copy> made;
      for (const TensorRef& tensor : training().training().state()) {
        if (tensor.type != TensorType::f32) continue;
        Copy& one = made.emplace_back(Copy{std::string(tensor.name), {}, {tensor.shape.begin(), tensor.shape.end()}});
        one.values.resize(tensor.bytes.size() / sizeof(float));
        std::copy_n(tensor.bytes.data(), tensor.bytes.size(), reinterpret_cast<std::byte*>(one.values.data()));
      }
      return made;
    });
    py::dict out;
    for (Copy& one : copies) out[py::str(one.name)] = array_of(std::move(one.values), std::move(one.shape));
    return out;
  }
  void set_labels(std::size_t frame, const py::object& ids) {
    const Held held = hold();  // NumPy's conversion lets other threads run
    const FrameInfo& info = session().scene.info.frames.at(frame);
    std::vector<std::int16_t> labels = indices_of(ids, session().scene.info.classes, info.camera.height_px,
                                                  info.camera.width_px, "labels of frame '" + info.name + "'");
    computed([&] { training().training().set_labels(static_cast<int>(frame), std::move(labels)); });
  }
  bool apply(const std::string& event) {
    return computed([&] { return training().apply(parse_label_event(event)); });
  }
  // Clicks in force, and the names of the classes that have one.
  py::tuple annotations() const {
    const Held held = hold();
    const Session& s = session();
    const std::optional<Annotations> all = computed([&]() -> std::optional<Annotations> {
      if (!run_ || run_->annotations() == nullptr) return std::nullopt;
      return *run_->annotations();
    });
    py::list named, marks;
    if (!all) return py::make_tuple(marks, named);
    for (int i = 0; i < all->named_classes(); ++i)
      if (all->is_named(i)) named.append(all->classes().valid(i).name);
    for (const Annotations::Mark& mark : all->marks()) {
      py::list points;
      for (const PixelPoint& p : mark.points) points.append(py::make_tuple(p.x, p.y));
      const bool erases = mark.class_index == kVoid;
      marks.append(py::dict(
          "id"_a = mark.id, "frame"_a = s.scene.info.frames[static_cast<std::size_t>(mark.frame)].name,
          "points"_a = points, "radius_px"_a = mark.radius_px,
          "class_"_a = erases ? py::object(py::none()) : py::str(all->classes().valid(mark.class_index).name)));
    }
    return py::make_tuple(marks, named);
  }

  // [D, C] of a channel that is learned by its principal axes, else None.
  py::object channel_axes(const std::string& channel) const {
    const View<const float> axes = session().pipeline->passes().back().axes(channel);
    if (axes.empty()) return py::none();
    return array_of(std::vector<float>(axes.data, axes.data + axes.size()), {axes.rows, axes.cols});
  }
  // Maps of a camera, as semfield.View names them.
  py::dict render(const py::dict& camera, const py::object& pose, int stride, bool probability,
                  const std::vector<std::string>& channels) {
    const Held held = hold();
    const Session& s = session();
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
    options.classes = s.classes();
    options.channels = channels;
    Interrupt interrupt;
    options.progress = [&](double) {
      if (interrupt.came()) interrupt.raise();
    };
    RenderedFrame frame = computed([&] {
      return render_frame(*s.pipeline, {view.camera, view.world_from_camera, view.camera.has_distortion()}, s.limits,
                          s.plan.class_of_logit, {}, options);
    });
    const py::ssize_t height = frame.height_px, width = frame.width_px;
    const ClassTable& classes = s.scene.info.classes;
    const py::none none;
    py::dict out("rgb"_a = array_of(std::move(frame.rgb), {height, width, 3}),
                 "depth_m"_a = array_of(std::move(frame.depth_m), {height, width}),
                 "opacity"_a = array_of(std::move(frame.opacity), {height, width}), "label"_a = none,
                 "entropy"_a = none, "confidence"_a = none, "probability"_a = none, "channels"_a = py::dict());
    for (FrameChannel& one : frame.channels) {
      const py::ssize_t cols = one.cols;
      out["channels"][py::str(one.name)] = array_of(std::move(one.values), {height, width, cols});
    }
    if (!s.pipeline->has_semantics()) return out;
    out["label"] = ids_array(frame.label, classes, frame.height_px, frame.width_px);
    out["entropy"] = array_of(std::move(frame.entropy), {height, width});
    out["confidence"] = array_of(std::move(frame.confidence), {height, width});
    if (probability)
      out["probability"] = array_of(std::move(frame.probability), {height, width, classes.valid_count()});
    return out;
  }
  // A name and value each, and the JSON of final_eval.json.
  py::tuple evaluate(const std::string& split, const std::vector<int>& frames) {
    if (frames.empty())
      throw Error(ErrorKind::usage, "scene.split.empty", "the scene has no frames in split '" + split + "'",
                  "see run.frames");
    const Held held = hold();
    const Session& s = session();
    Interrupt interrupt;
    std::int64_t at_step = 0;
    double seconds = 0;
    const SplitScore score = computed([&] {
      EvalJob job = s.eval_job(frames);
      at_step = step();
      seconds = train_s();
      job.stop = [&] { return interrupt.came(); };
      return semfield::evaluate(*s.pipeline, job, s.limits, s.plan.class_of_logit);
    });
    interrupt.raise();
    return py::make_tuple(values_dict(score.values()),
                          final_eval_json(score, s.scene.info.classes, split, at_step, seconds));
  }
  // As semfield.Points names them.
  py::dict query(const py::object& positions, const py::object& directions) {
    const Held held = hold();
    const Session& s = session();
    const std::vector<Vec3d> places = vectors_of(positions, "positions");
    const std::vector<Vec3d> seen = directions.is_none() ? std::vector<Vec3d>() : vectors_of(directions, "directions");
    if (!directions.is_none() && seen.size() != places.size())
      throw Error(ErrorKind::usage, "python.array.shape",
                  "directions: expected one for each of " + std::to_string(places.size()) + " positions, got " +
                      std::to_string(seen.size()));
    const int classes = s.classes();
    FieldPoints found;
    Interrupt interrupt;
    computed([&] {
      s.pipeline->executor().download(step());
      for (std::size_t first = 0; first < places.size() && !interrupt.came(); first += kPointsBetweenLooks) {
        const std::size_t count = std::min(kPointsBetweenLooks, places.size() - first);
        const auto along = seen.empty() ? std::span<const Vec3d>() : std::span(seen).subspan(first, count);
        const FieldPoints part = field_at(*s.pipeline, std::span(places).subspan(first, count), along, s.limits,
                                          s.plan.class_of_logit, classes);
        append(part.sigma, found.sigma);
        append(part.rgb, found.rgb);
        append(part.label, found.label);
        append(part.probability, found.probability);
        append(part.entropy, found.entropy);
      }
    });
    interrupt.raise();
    const auto count = std::ssize(places);
    const py::none none;
    py::dict out("density"_a = array_of(std::move(found.sigma), {count}), "rgb"_a = none, "label"_a = none,
                 "probability"_a = none, "entropy"_a = none);
    if (!directions.is_none()) out["rgb"] = array_of(std::move(found.rgb), {count, 3});
    if (!s.pipeline->has_semantics()) return out;
    out["label"] =
        ids_array(found.label, s.scene.info.classes, 1, static_cast<std::int32_t>(count)).attr("reshape")(-1);
    out["probability"] = array_of(std::move(found.probability), {count, classes});
    out["entropy"] = array_of(std::move(found.entropy), {count});
    return out;
  }

  // As semfield.Frame has them, without pixels; the camera is a dict.
  py::list frames() const {
    py::list out;
    for (const FrameInfo& frame : session().scene.info.frames)
      out.append(py::dict("name"_a = frame.name, "split"_a = kSplits[static_cast<std::size_t>(frame.split)],
                          "camera"_a = camera_dict(frame.camera), "pose"_a = pose_array(frame.world_from_camera),
                          "has_depth"_a = frame.has_depth, "has_labels"_a = frame.has_labels,
                          "source"_a = frame.source));
    return out;
  }
  // As semfield.ClassEntry has them.
  py::list classes() const {
    const Session& s = session();
    const std::vector<std::int16_t> logits = s.logit_of_class();
    py::list out;
    for (int i = 0; i < s.classes(); ++i) {
      const ClassEntry& entry = s.scene.info.classes.valid(i);
      const bool learned = s.plan.semantics && logits[static_cast<std::size_t>(i)] != kVoid;
      out.append(py::dict("index"_a = i, "id"_a = entry.id, "name"_a = entry.name,
                          "color"_a = py::tuple(py::cast(entry.color)), "learned"_a = learned));
    }
    return out;
  }
  // What is known of a frame's pixels: rgb, depth_m, labels, and training_labels.
  py::dict pixels(std::size_t frame) const {
    const Session& s = session();
    const StoredFrame& stored = s.scene.frames.at(frame);
    const std::int32_t height = stored.height_px, width = stored.width_px;
    py::dict out;
    if (stored.rgb.empty()) return out;
    out["rgb"] = array_of(std::vector<std::uint8_t>(stored.rgb), {height, width, 3});
    if (!stored.depth_m.empty()) out["depth_m"] = array_of(stored.depth_m.expand(), {height, width});
    const ClassTable& classes = s.scene.info.classes;
    if (!stored.label.empty()) out["labels"] = ids_array(stored.label.expand(), classes, height, width);
    if (frame < s.labels.frames.size() && !s.labels.frames[frame].empty()) {
      const TrainingLabels::Frame& labels = s.labels.frames[frame];
      std::vector<std::int16_t> indices(labels.size());
      for (std::size_t i = 0; i < indices.size(); ++i) indices[i] = labels[i];
      out["training_labels"] = ids_array(indices, classes, height, width);
    }
    return out;
  }
  // Attributes of semfield.Run.
  py::dict facts() const {
    const Session& s = session();
    const auto& [lo, hi] = s.scene.bounds;
    std::vector<double> bounds{lo.x, lo.y, lo.z, hi.x, hi.y, hi.z};
    py::list left_out;
    for (const LeftOut& part : s.plan.left_out)
      left_out.append(py::make_tuple(part.component, part.rule, part.evidence, part.saving));
    return py::dict("name"_a = name_, "bounds"_a = array_of(std::move(bounds), {2, 3}), "near_m"_a = s.limits.near_m,
                    "far_m"_a = s.limits.far_m, "metric"_a = s.scene.info.metric,
                    "device"_a = s.pipeline->executor().description(), "has_semantics"_a = s.pipeline->has_semantics(),
                    "left_out"_a = left_out);
  }

 private:
  void load(const std::string& run_dir, const py::dict& set) {
    std::vector<std::string> overrides;
    for (const ConfigOverride& o : overrides_of(set)) overrides.push_back(o.key + "=" + write_config_inline(o.value));
    Diagnostics found;
    loaded_ = opened([&] {
      return std::make_unique<OpenedRun>(
          open_run(run_dir, overrides, registry_, found, OpenFor::evaluation_of_training_frames));
    });
    for (const Diagnostic& finding : folded(found)) notes_.note(finding.shown());
  }
  // What a call needs stays until it returns, whoever closes the run.
  struct Held {
    std::shared_ptr<Run> run;
    std::shared_ptr<OpenedRun> loaded;
  };
  Held hold() const { return {run_, loaded_}; }
  // In a fork its threads and files are those of the process that opened it.
  void drop() {
    if (getpid() != owner_) (void)new Held(hold());
    run_.reset();
    loaded_.reset();
  }
  const OpenedRun& loaded() const {
    if (loaded_) return *loaded_;
    throw Error(ErrorKind::usage, "python.run.closed",
                "the run '" + name_ + "' is closed; open it again with open, resume or load");
  }
  const Session& session() const { return run_ ? run_->session() : loaded().session; }
  Run& training() {
    if (run_) return *run_;
    (void)loaded();
    throw Error(ErrorKind::usage, "python.session.read_only", "this run was opened to be looked at",
                "open it with semfield.resume to continue it");
  }
  // Without the GIL, one caller at a time, under the settings of the session's work.
  template <class Call>
  std::invoke_result_t<Call> computed(const Call& call) const {
    if (getpid() != owner_)
      throw Error(ErrorKind::usage, "python.session.fork",
                  "this run was opened by process " + std::to_string(owner_) + ", and this is a fork of it, process " +
                      std::to_string(getpid()),
                  "save the run before the fork and semfield.load its folder here, or open it here");
    const Held held = hold();
    const Work working;
    const std::lock_guard lock(mutex_);
    computing_ = std::this_thread::get_id();
    const std::shared_ptr<void> ended(nullptr, [&](void*) { computing_ = std::thread::id(); });
    const WorkSettings settings = session().work();
    const WorkScope scope(settings);
    return call();
  }

  const pid_t owner_;
  Registry registry_;  // of its own: plugins that are loaded later leave it alone
  std::string name_;
  Notes notes_;
  mutable std::mutex mutex_;
  mutable std::atomic<std::thread::id> computing_{};  // of the call that has the mutex
  std::shared_ptr<Run> run_;
  std::shared_ptr<OpenedRun> loaded_;
};

// `semfield train` as a call.

// Tells a function of Python how the run goes, and asks it, and Ctrl-C, whether to stop.
class Told final : public RunListener {
 public:
  explicit Told(const py::object& progress) : progress_(progress) {}

  void note(const std::string& text) override { notes.push_back(text); }
  void progress(const TrainProgress& p) override {
    const py::gil_scoped_acquire gil;
    if (progress_.is_none() || raised) return;
    const py::dict now("step"_a = p.step, "steps"_a = p.steps, "loss"_a = p.loss, "psnr"_a = p.psnr,
                       "miou_present"_a = or_none(p.miou_present), "rays_per_s"_a = p.rays_per_s,
                       "train_s"_a = p.train_s, "remaining_s"_a = p.remaining_s);
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

// As semfield.Outcome has it. Ctrl-C ends the run with its checkpoint, and is raised then.
py::dict train_run(const py::object& config, const py::dict& set, const std::string& out, bool resume,
                   const py::object& progress) {
  Registry registry = base_registry();
  const ConfigNode tree =
      resume ? compose_config_with(RunFolder::read(out).config_path(), overrides_of(set)) : composed(config, set);
  Told told(progress);
  TrainOutcome outcome;
  {
    const Work working;
    const TrainRequest request{.out_dir = out, .resume = resume, .driver = Driver::command};
    outcome = Run(session_config_of(tree, registry), registry, request, &told).finish();
  }
  told.raise();
  return py::dict("run_dir"_a = outcome.run_dir, "report"_a = outcome.report_path, "step"_a = outcome.step,
                  "train_s"_a = outcome.train_s, "scores"_a = values_dict(outcome.values),
                  "scored"_a = outcome.scored.frames == 0 ? std::string() : outcome.scored.text(),
                  "notes"_a = told.notes);
}

}  // namespace

void define_session(py::module_& module) {
  module.def("train_run", train_run);
  py::class_<PyRun>(module, "Run")
      .def(py::init<const std::string&, const py::object&, const py::dict&, const std::string&,
                    const std::vector<std::string>&, const py::object&>())
      .def_property_readonly("step", &PyRun::step, "Steps made so far.")
      .def_property_readonly("train_s", &PyRun::train_s, "Seconds of training; rendering and scoring do not count.")
      .def_property_readonly("run_dir", &PyRun::run_dir,
                             "The run's folder, or the one it was saved in last; \"\" for neither.")
      .def_property_readonly("notes", &PyRun::notes,
                             "Messages of opening and training: findings, and what was chosen from the scene.")
      .def_property_readonly("history", &PyRun::history,
                             "Rows of training as metrics.jsonl has them, those of this object's steps.")
      .def_property_readonly("config", &PyRun::config, "The resolved configuration: every parameter.")
      .def("parameters", &PyRun::parameters,
           "Every tensor of a checkpoint by name, float32 copies: values, moments and states.")
      .def("_close", &PyRun::close)
      .def_property_readonly("_closed", &PyRun::closed)
      .def_property_readonly("_trains", &PyRun::trains)
      .def_property_readonly("_steps_left", &PyRun::steps_left)
      .def("_train", &PyRun::train)
      .def("_train_more", &PyRun::train_more)
      .def("_save", &PyRun::save)
      .def("_set_labels", &PyRun::set_labels)
      .def("_apply", &PyRun::apply)
      .def("_annotations", &PyRun::annotations)
      .def("_render", &PyRun::render)
      .def("_channel_axes", &PyRun::channel_axes)
      .def("_evaluate", &PyRun::evaluate)
      .def("_query", &PyRun::query)
      .def("_frame_rows", &PyRun::frames)
      .def("_class_rows", &PyRun::classes)
      .def("_pixels", &PyRun::pixels)
      .def("_facts", &PyRun::facts);
}

}  // namespace semfield::python
