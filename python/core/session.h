// What Python holds of a run: one that trains, or one that was trained.
#pragma once

#include <pybind11/pybind11.h>
#include <sys/types.h>

#include <csignal>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "core/non_copyable.h"
#include "python/core/errors.h"
#include "run/run.h"
#include "run/run_scores.h"

namespace semfield::python {

namespace py = pybind11;

/// What a run tells, kept for Python.
class Notes final : public RunListener {
 public:
  void note(const std::string& text) override { texts.push_back(text); }
  void row(const MetricsRow& made) override { rows.push_back(made); }
  int stop_signal() override { return interrupt != nullptr && interrupt->came() ? SIGINT : 0; }
  std::vector<std::string> texts;
  std::vector<MetricsRow> rows;    ///< training rows since the run was opened
  Interrupt* interrupt = nullptr;  ///< of the call under way
};

/// It belongs to the process that opened it: a fork has its memory, but not its threads, and shares its files. There,
/// calls that compute throw Error(usage), and the end of the object gives nothing back. Every call that computes gives
/// the GIL back; calls from several threads wait for each other. Plugins written in Python take it in turn, so nobody
/// may hold it while waiting here.
class PySession : NonCopyable {
 public:
  ~PySession();
  /// A configuration that trains. `scene`: in place of its section, a dict or None.
  static std::unique_ptr<PySession> open(const py::object& config, const py::dict& set, const std::string& run_dir,
                                         const std::vector<std::string>& keep, const py::object& scene);
  /// A run's folder, to go on with.
  static std::unique_ptr<PySession> resume(const std::string& run_dir, const py::dict& set,
                                           const std::vector<std::string>& keep);
  /// A run's folder, to look at.
  static std::unique_ptr<PySession> load(const std::string& run_dir, const py::dict& set);

  const Session& session() const { return run_ ? run_->session() : loaded_->session; }
  std::vector<std::string> notes() const;
  bool trains() const { return run_ != nullptr; }
  std::int64_t step() const { return run_ ? run_->training().step() : loaded_->step; }
  double train_s() const { return run_ ? run_->training().train_s() : loaded_->train_s; }
  std::string run_dir() const { return run_ ? run_->run_dir() : loaded_->run_dir; }
  py::list rows() const;

  /// {steps, loss, color, semantic, mse, samples, labelled, correct, terms, seconds}: means over the steps made, which
  /// are fewer than asked for after Ctrl-C; then the interrupt is raised, with the session as after the last step.
  /// `to_end`: not beyond the end of the run's length.
  py::dict train(std::int64_t steps, bool to_end);
  /// Steps to the end of the run's length; -1 while it is not settled.
  std::int64_t steps_left() const;
  void train_more(std::int64_t steps, double seconds);
  std::string save(const std::string& run_dir);
  py::dict parameters();
  void set_labels(int frame, const py::object& ids);
  bool apply(const std::string& event);
  py::dict annotations() const;

  /// Maps of a camera, NumPy arrays; with `ordinal` >= 0 DLPack of that CUDA device.
  py::dict render(const py::dict& camera, const py::object& pose, int stride, bool probability,
                  const std::vector<std::string>& channels, int ordinal);
  /// [D, C] of a channel that is learned by its principal axes, else None.
  py::object channel_axes(const std::string& channel);
  /// A name and value each, and the JSON of final_eval.json.
  py::tuple evaluate(const std::string& split, const std::vector<int>& frames);
  py::dict query(const py::object& positions, const py::object& directions);

 private:
  PySession();
  Run& training();
  void refuse_fork() const;
  template <class Call>
  auto computed(const Call& call) const;

  const pid_t owner_;
  Registry registry_;  // of its own: plugins that are loaded later leave it alone
  Notes notes_;
  mutable std::mutex mutex_;
  std::unique_ptr<Run> run_;
  std::unique_ptr<OpenedRun> loaded_;
};

/// `semfield train` as a call: {run_dir, report, step, train_s, scores, stopped}. `progress` is called with a dict, or
/// None. Ctrl-C ends the run with its checkpoint, and is raised then.
py::dict train_run(const py::object& config, const py::dict& set, const std::string& out, bool resume,
                   const py::object& progress);

void define_session(py::module_& module);

}  // namespace semfield::python
