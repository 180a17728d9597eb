// `semfield train` as a call.
#include "run/train_run.h"

#include <pybind11/stl.h>

#include <csignal>
#include <optional>

#include "python/core/config_nodes.h"
#include "python/core/interrupt.h"
#include "python/core/plugins.h"
#include "python/core/session.h"
#include "report/run_report.h"

namespace semfield::python {

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
  py::dict scores;
  for (const auto& [name, value] : outcome.values)
    scores[py::str(name)] = value ? py::object(py::float_(*value)) : py::none();
  py::dict result;
  result["run_dir"] = outcome.run_dir;
  result["report"] = outcome.report_path;
  result["step"] = outcome.step;
  result["train_s"] = outcome.train_s;
  result["scores"] = scores;
  result["scored"] = outcome.scored.frames == 0 ? std::string() : outcome.scored.text();
  result["notes"] = told.notes;
  return result;
}

}  // namespace semfield::python
