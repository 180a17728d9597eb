// Training steps of a session, one after the other, and everything of them that a checkpoint must hold.
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "config/settings/choices.h"
#include "core/non_copyable.h"
#include "formats/safetensors.h"
#include "train/changed_labels.h"
#include "train/checkpoint.h"
#include "train/ray_source.h"
#include "train/session.h"

namespace semfield {

/// What a training reports while it runs; every call comes from the thread that asked for the work.
class TrainingListener : NonCopyable {
 public:
  virtual ~TrainingListener() = default;
  /// A finding or a choice, as a sentence.
  virtual void note(const std::string&) {}
  /// A finding that something may be wrong.
  virtual void warning(const std::string& text) { note(text); }
  /// What opening a session found, and what it chose: each by itself, unless somebody says it shorter.
  virtual void opened(const Diagnostics& diagnostics, const Session& session);
  /// A clock for what steps take; it never runs back.
  virtual double step_clock_s();
  /// `step` steps are made; these are the losses of the last of them.
  virtual void stepped(std::int64_t /*step*/, const StepLosses&) {}
};

/// Steps in a row without any density after which a pass counts as dead.
inline constexpr std::int64_t kDeadSteps = 100;

/// Trainers share nothing: several of them train in threads of their own, and each gets the bits that it would get
/// alone. One trainer is used by one thread at a time; cancel() alone may come from any.
class Trainer : NonCopyable {
 public:
  /// Opens the scene and builds the network (open_session). `registry` and `listener`, which may be null, must outlive
  /// the object. Throws Error as open_session does.
  Trainer(RunConfig config, Registry& registry, const SessionOptions& options = {},
          TrainingListener* listener = nullptr);
  /// Trains a session that was opened as trainable, which it borrows. `rays`: where batches come from; null: the
  /// session's own. `inputs`: scene_inputs of its scene, where they are known.
  explicit Trainer(Session& session, TrainingListener* listener = nullptr, std::unique_ptr<RaySource> rays = {},
                   std::optional<SceneInputs> inputs = {});

  const Session& session() const { return session_; }
  const SceneInputs& inputs();
  RaySource& rays() { return *rays_; }

  /// Steps made so far, and the seconds that they took; loading takes up both.
  std::int64_t step() const { return step_; }
  double train_s() const { return train_s_; }
  /// Seconds of work between steps that is training too.
  void add_train_s(double seconds) { train_s_ += seconds; }
  /// Steps of the run at its end; 0 while they are not settled. A configuration that asks for seconds settles them,
  /// with the schedule, by the rate of its own steps: session().config then has them.
  std::int64_t last_step() const { return semfield::last_step(session_.config); }
  bool at_its_end() const { return last_step() > 0 && step_ >= last_step(); }
  /// ask_more of this training: what it trains from its present step on.
  void train_more(const AskedLength& asked);
  /// Whether the length was settled since the last call: run.yaml has to say so before another step is made.
  bool take_settled() { return std::exchange(settled_, false); }

  /// At least one step and at most `most`: as many as run without waiting in between. A step is: batch, losses,
  /// gradients, checks, Adam, derived tensors, samplers' observe. Returns their losses, in order, valid until the next
  /// call. A value of a ray, a gradient, a parameter, a moment or a state that is not finite (or too large for an
  /// update) throws Error: it names the value, frame and pixel of the ray it belongs to, and the tensor and element
  /// that it comes from. Values, moments, samplers and the step count are then untouched. A density that is not finite
  /// where a sampler asks for it in `observe` is found after the update: the step then counts as made and the sampler's
  /// state stays as it was. After kDeadSteps steps in which the density of a pass was 0 at every sample, while colours
  /// are not explained, the next one is an Error too: nothing of it can learn.
  std::span<const StepLosses> advance(std::int64_t most = 1);
  /// `steps` more steps, or fewer after a cancel; returns how many.
  std::int64_t train(std::int64_t steps);
  /// The train() under way, or the next one, ends after the step that it is in.
  void cancel() { cancelled_ = true; }
  /// Of the last step made; zeros before the first.
  const StepLosses& losses() const { return losses_; }

  /// Any camera at any pose, with the options of render_frame; FrameOptions::classes is the session's.
  RenderedFrame render(const Camera& camera, const Pose& world_from_camera, const FrameOptions& options = {}) const;
  /// Scores of frames of the scene, by their numbers.
  SplitScore evaluate(std::vector<int> frames) const;

  /// From the next step on `frame`, a training frame, has these hard labels: class indices [height * width], kVoid for
  /// none. Every class must have a logit: classes that the labels had when the session opened have one, and all of the
  /// class table with runtime.keep: [semantics, absent_classes]. Class weights stay those of the start. A checkpoint
  /// names the labels that were set, and load() asks for them. Throws Error(data); nothing has changed then.
  void set_labels(int frame, std::vector<std::int16_t> labels);
  /// From the next step on these training frames have the labels that the session opened with, without its clicks, and
  /// `clicks` painted over them; classes have the names that clicks give them. `clicks` grew from
  /// config.labels.clicks, by events that are in the file scene.labels.clicks: a checkpoint does not name these labels,
  /// for that file reports them. Throws Error(data) as set_labels; nothing has changed then.
  void set_clicks(const Annotations& clicks, std::span<const int> frames);

  /// Brings values, moments and states into the network's store; before any of them is read, stored or checked.
  void collect() { executor().download(step_); }
  /// stored_tensors of the network.
  std::vector<TensorRef> tensors() const { return stored_tensors(pipeline().store()); }
  /// The same, collected and checked: what is not finite is no checkpoint.
  std::vector<TensorRef> state();
  /// What a checkpoint says of now, but for self-training.
  CheckpointFacts facts();
  /// A checkpoint, written atomically and read back before it takes its name.
  void save(const std::string& path);
  /// Continues from a checkpoint of the same network: the next steps give the bits of the training that was never
  /// stopped. Throws Error(data) for another network, other classes or other labels set; nothing has changed then.
  void load(const std::string& path);
  /// Its tensors alone, as load_tensors.
  void load(const TensorFile& file, std::int64_t step);

 private:
  Trainer(std::unique_ptr<Session> session, TrainingListener* listener);
  Pipeline<float>& pipeline() const { return *session_.pipeline; }
  Executor<float>& executor() const { return pipeline().executor(); }
  double clock_s() const;
  void start_pace();
  void settle_length();

  void hold_pixels();
  void fill(std::int64_t step);
  RayBatch batch() const { return batch_.view(pipeline().has_semantics()); }
  AdamStep update_of(std::int64_t step) const;
  std::uint32_t terms_of(std::int64_t step) const;
  void note_density(const StepLosses& losses);
  void check_alive() const;
  [[noreturn]] void fail(const Error& error);
  [[noreturn]] void explain_failed_step();

  std::unique_ptr<Session> own_;  // null: borrowed
  Session& session_;
  WorkSettings work_;
  TrainingListener* listener_;
  std::unique_ptr<RaySource> rays_;
  ChangedLabels labels_;
  std::int64_t step_ = 0;
  double train_s_ = 0;
  StepLosses losses_;
  BatchBuffers batch_;
  std::uint64_t held_ = 0;       // version of *rays_ that the executor has looked at
  std::int64_t filled_ = -1;     // the step that batch_ is of
  bool drawn_ = false;           // by the executor
  std::int64_t dead_steps_ = 0;  // in a row
  std::size_t dead_pass_ = 0;
  std::optional<Pace> pace_;
  bool settled_ = false;
  std::atomic<bool> cancelled_{false};
  std::map<std::string, std::string> modules_;
  std::optional<SceneInputs> inputs_;
};

/// Tensors of a pipeline alone, for rendering (load_tensors without moments).
void load_pipeline(Pipeline<float>& pipeline, const TensorFile& file);

}  // namespace semfield
