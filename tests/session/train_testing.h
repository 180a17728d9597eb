// Shared by the tests of training: the linked plugins plus the analytic room as a dataset, and small configurations.
#pragma once

#include "plugin/registry.h"
#include "tests/says.h"
#include "tests/temp_dir.h"
#include "train/run.h"
#include "train/session.h"
#include "train/trainer.h"

namespace semfield::testing_train {

/// Linked plugins and the dataset 'analytic_room'.
Registry make_registry();
/// One of make_registry() for all tests that add nothing to it.
Registry& all_plugins();
/// The same, and the loss `albedo` against a channel that the dataset offers with `with_albedo: true`.
Registry make_channel_registry();
/// One of those for all tests that add nothing to it.
Registry& channel_plugins();

/// Hash grid behind an occupancy grid on the analytic room; `more` is YAML appended at the top level.
std::string hash_config(const std::string& more = "");
/// Two passes of the paper's shape (frequency, nerf_mlp, importance), narrow.
std::string two_pass_config(const std::string& more = "");

/// Reads and opens; fails the test through exceptions.
Session open_text(const std::string& yaml, Registry& registry, const std::vector<std::string>& keep = {},
                  Ranks* ranks = nullptr);
/// The same with all_plugins().
Session open_text(const std::string& yaml, const std::vector<std::string>& keep = {});
Session open_text(const std::string& yaml, Registry& registry, const SessionOptions& options, Diagnostics& diagnostics);
/// A frame of the session's scene as rendering makes it.
RenderedFrame render_frame_of(const Session& session, int frame, const FrameOptions& options = {});
/// A session and its trainer.
struct TestRun {
  TestRun(const std::string& yaml, Registry& registry, const std::vector<std::string>& keep = {})
      : session(open_text(yaml, registry, keep)) {}
  explicit TestRun(const std::string& yaml) : session(open_text(yaml)) {}
  /// Trains up to that step, several steps at a time where the device takes them; the losses of the last one.
  StepLosses to(std::int64_t step);
  ParamStore<float>& store() const { return session.pipeline->store(); }
  /// fingerprint() of what was trained.
  std::uint32_t bits() const;

  Session session;
  Trainer trainer{session};
};

/// What the session's list says of the component that it leaves out; throws where it is not left out.
const LeftOut& left_out_row(const Session& session, const std::string& component);

/// `yaml` with `to` in the place of its first `from`, which must be there.
std::string replaced(std::string yaml, std::string_view from, const std::string& to);

/// `yaml` with another number of rays a step.
std::string with_rays(std::string yaml, int rays);

/// `yaml`, whose scene is {type: analytic_room}, with another.
std::string with_scene(std::string yaml, const std::string& scene);

/// A small hash grid behind a stratified sampler, whose one pass ends in `pass_end` ("" or lines of YAML of the pass).
/// `scene` is the body of the section, `train` that of its own.
std::string stratified_config(const std::string& scene, const std::string& pass_end, const std::string& train,
                              const std::string& more = "");

/// CRC-32C over every tensor's values and moments, by name.
std::uint32_t fingerprint(const ParamStore<float>& store);
/// The same after so many steps on so many threads.
std::uint32_t train_fingerprint(const std::string& yaml, int threads, std::int64_t steps);

/// A listener whose calls are functions; those that are null are the listener's own.
class HookListener final : public RunListener {
 public:
  std::function<void(const TrainProgress&)> on_progress;
  std::function<void(std::int64_t)> on_step;
  std::function<void(const ScoreProgress&)> on_scoring;
  std::function<void(const std::string&)> on_note;
  std::function<int()> on_stop_signal;
  std::function<bool()> on_save_request;
  std::function<double()> on_now_s;
  std::function<double()> on_step_clock_s;
  bool reports = false;  ///< write_run_report
  std::string notes;     ///< a line each, where on_note is null

  void progress(const TrainProgress& p) override;
  void stepped(std::int64_t step, const StepLosses&) override {
    if (on_step) on_step(step);
  }
  void scoring(const ScoreProgress& p) override;
  void note(const std::string& text) override;
  int stop_signal() override;
  bool save_request() override;
  double now_s() override;
  double step_clock_s() override;
  std::string write_report(const RunFolder& folder, const Session& session, const ReportFrames& frames) override;
};

/// `semfield train`, from opening to report.
inline TrainOutcome run_training(RunConfig config, Registry& registry, TrainRequest request,
                                 RunListener* listener = nullptr) {
  request.driver = Driver::command;
  return Run(std::move(config), registry, request, listener).finish();
}

/// Packs the analytic room into `dir` and writes config.yaml, which trains on it with `hash_config` and saves so often.
/// Returns its path.
std::string write_packed_config(const TempDir& dir, int steps, double checkpoint_every_s);

/// CRC-32C over names and values of the newest checkpoint of a run; fails the test when that is not of
/// `expected_step`, or when any newer one is damaged.
std::uint32_t checkpoint_fingerprint(const std::string& run_dir, std::int64_t expected_step);

}  // namespace semfield::testing_train
