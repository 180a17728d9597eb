// Plugins of the registry behind a wrapper that spoils one value of one ray: the seam that the library does not have.

#include <cstring>

#include "eval/final_eval.h"
#include "execution/lane_executor.h"
#include "model/optim/adam.h"
#include "model/stages.h"
#include "tests/session/train_testing.h"
#include "train/checkpoint.h"

namespace semfield {

using namespace testing_train;

/// What the wrappers spoil now. The address is a ray, so that it is the same in a tile, in a whole batch and alone.
struct Poison {
  std::string stage;  ///< "" = nothing: the wrappers pass everything through
  std::string pass;   ///< name of the pass, as its wrappers were given
  float value = 0;
  std::int64_t ray = 0;     ///< in the batch, or in the call that renders
  Vec3d origin, direction;  ///< of that ray
  bool in_training = true;  ///< forward calls of training, or those of rendering and queries
  DomainMap domain;         ///< of the pass
};

struct BadValue {
  const char* name;
  float value;
};
const BadValue kNonFinite[] = {{"nan", std::numeric_limits<float>::quiet_NaN()},
                               {"inf", std::numeric_limits<float>::infinity()},
                               {"-inf", -std::numeric_limits<float>::infinity()}};

/// The poison that every wrapper of this process reads; set between steps.
Poison& poison() {
  static Poison the_poison;
  return the_poison;
}

void arm(const std::string& stage, const std::string& pass, float value, bool in_training = true) {
  Poison& p = poison();
  p.stage = stage;
  p.pass = pass;
  p.value = value;
  p.in_training = in_training;
}
void aim_along(const double* o, const double* d) {
  poison().origin = {o[0], o[1], o[2]};
  poison().direction = {d[0], d[1], d[2]};
}

bool armed(const char* stage, const StepContext& ctx) {
  const Poison& p = poison();
  return p.stage == stage && ctx.training == p.in_training;
}

// The sampler, field and encoders of a pass differ by the pass's name: the wrappers of one pass are made one
// after the other, and a configuration's passes in order. Random numbers know passes by number.
bool of_pass(const StepContext& ctx) { return poison().pass.empty() || std::to_string(ctx.pass) == poison().pass; }

class PoisonedSampler final : public Sampler<float> {
 public:
  explicit PoisonedSampler(std::unique_ptr<Sampler<float>> inner) : inner_(std::move(inner)) {}
  SamplerTraits traits() const noexcept override { return inner_->traits(); }
  std::int64_t capacity(std::int64_t rays, std::int64_t previous, bool training) const noexcept override {
    return inner_->capacity(rays, previous, training);
  }
  void declare(ParamDeclarer& d) const override { inner_->declare(d); }
  void derive(const StepContext& ctx, const Tensors<float>& t) const override { inner_->derive(ctx, t); }
  void observe(const StepContext& ctx, const Tensors<float>& t, const DensityQuery<float>& query) const override {
    inner_->observe(ctx, t, query);
  }

 protected:
  void do_sample(const StepContext& ctx, const Tensors<float>& t, const Rays<float>& rays,
                 const Proposal<float>* previous, Samples<float>& out) const override {
    inner_->sample(ctx, t, rays, previous, out);
    const std::int64_t r = poison().ray - ctx.first_ray;
    if (r < 0 || r >= rays.origin.rows || !of_pass(ctx) || out.first(r, 0) == out.first(r + 1, 0)) return;
    if (armed("distance", ctx)) out.t(out.first(r, 0), 0) = poison().value;
    if (armed("interval", ctx)) out.delta(out.first(r, 0), 0) = poison().value;
  }

 private:
  std::unique_ptr<Sampler<float>> inner_;
};

class PoisonedEncoder final : public Encoder<float> {
 public:
  PoisonedEncoder(std::unique_ptr<Encoder<float>> inner, bool is_direction)
      : inner_(std::move(inner)), is_direction_(is_direction) {}
  EncoderTraits traits() const noexcept override { return inner_->traits(); }
  void declare(ParamDeclarer& d) const override { inner_->declare(d); }
  void derive(const StepContext& ctx, const Tensors<float>& t) const override { inner_->derive(ctx, t); }
  void derive_backward(const StepContext& ctx, const Tensors<float>& t) const override {
    inner_->derive_backward(ctx, t);
  }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<float>& t, View<const double> x, View<float> y) const override {
    inner_->forward(ctx, t, x, y);
    if (!armed(is_direction_ ? "encoded direction" : "encoded position", ctx) || !of_pass(ctx)) return;
    for (std::int64_t r = 0; r < x.rows; ++r) {
      if (is_direction_ ? same_direction(x.row(r)) : on_ray(x.row(r))) y(r, y.cols - 1) = poison().value;
    }
  }
  void do_backward(const StepContext& ctx, const Tensors<float>& t, View<const double> x, View<const float> dy,
                   View<float> dx) const override {
    inner_->backward(ctx, t, x, dy, dx);
  }

 private:
  static bool same_direction(const double* d) {
    const Poison& p = poison();
    return d[0] == p.direction.x && d[1] == p.direction.y && d[2] == p.direction.z;
  }
  static bool on_ray(const double* x) {
    const Poison& p = poison();
    Vec3d out;
    for (int i = 0; i < 3; ++i) out[i] = (x[i] - p.domain.offset) / p.domain.scale + p.domain.center[i] - p.origin[i];
    return dot(out, p.direction) > 0 && length(cross(out, p.direction)) < 1e-9;
  }
  std::unique_ptr<Encoder<float>> inner_;
  bool is_direction_;
};

class PoisonedField final : public Field<float> {
 public:
  explicit PoisonedField(std::unique_ptr<Field<float>> inner) : inner_(std::move(inner)) {}
  FieldTraits traits() const noexcept override { return inner_->traits(); }
  std::size_t saved_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return inner_->saved_bytes(samples, rays);
  }
  void declare(ParamDeclarer& d) const override { inner_->declare(d); }
  void derive(const StepContext& ctx, const Tensors<float>& t) const override { inner_->derive(ctx, t); }
  void derive_backward(const StepContext& ctx, const Tensors<float>& t) const override {
    inner_->derive_backward(ctx, t);
  }

 protected:
  void do_forward(const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in, const FieldOut<float>& out,
                  Saved saved) const override {
    inner_->forward(ctx, t, in, out, saved);
    if (armed("queried density", ctx) && in.ray_of_sample.empty()) out.sigma(out.sigma.rows / 2, 0) = poison().value;
    const std::int64_t m = row_of_ray(ctx, in);
    if (m < 0) return;
    if (armed("raw density", ctx)) out.sigma(m, 0) = poison().value;
    if (armed("colour", ctx)) out.rgb(m, 1) = poison().value;
    if (armed("feature", ctx)) out.feature(m, 2) = poison().value;
  }
  void do_backward(const StepContext& ctx, const Tensors<float>& t, const FieldIn<float>& in,
                   const FieldOut<float>& out, const FieldGrad<float>& grad, Saved saved,
                   View<float> d_position) const override {
    inner_->backward(ctx, t, in, out, grad, saved, d_position);
    const std::int64_t m = row_of_ray(ctx, in);
    if (m < 0) return;
    if (armed("gradient of the field", ctx)) t.grad[0](0, 0) = poison().value;
    if (armed("gradient of the encoded position", ctx)) d_position(m, 0) = poison().value;
  }

 private:
  // The ray's first sample in the call, or -1.
  static std::int64_t row_of_ray(const StepContext& ctx, const FieldIn<float>& in) {
    if (poison().stage.empty() || !of_pass(ctx) || in.ray_of_sample.empty()) return -1;
    for (std::int64_t m = 0; m < in.ray_of_sample.rows; ++m) {
      if (ctx.first_ray + in.ray_of_sample(m, 0) == poison().ray) return m;
    }
    return -1;
  }
  std::unique_ptr<Field<float>> inner_;
};

std::vector<std::uint32_t> bits_of(const AlignedBuffer<float>& buffer) {
  std::vector<std::uint32_t> bits(buffer.size());
  if (!bits.empty()) std::memcpy(bits.data(), buffer.data(), 4 * bits.size());
  return bits;
}

void replace_all(std::string& text, const std::string& from, const std::string& to) {
  for (std::size_t at = 0; (at = text.find(from, at)) != std::string::npos; at += to.size())
    text.replace(at, from.size(), to);
}

/// Registry of tests/session whose encoders, fields and samplers are also there as "poisoned_NAME".
Registry make_poisoned_registry() {
  Registry registry = testing_train::make_registry();
  for (const PluginEntry* entry : registry.entries()) {
    PluginEntry e = *entry;
    e.name = "poisoned_" + e.name;
    if (e.kind == PluginKind::sampler) {
      e.sampler32 = [make = entry->sampler32](const auto& params, const auto& build, const auto& kernels) {
        return std::make_unique<PoisonedSampler>(make(params, build, kernels));
      };
    } else if (e.kind == PluginKind::encoder) {
      e.encoder32 = [make = entry->encoder32](const auto& params, const auto& build, const auto& kernels) {
        return std::make_unique<PoisonedEncoder>(make(params, build, kernels), build.is_direction);
      };
    } else if (e.kind == PluginKind::field) {
      e.field32 = [make = entry->field32](const auto& params, const auto& build, const auto& kernels) {
        return std::make_unique<PoisonedField>(make(params, build, kernels));
      };
    } else {
      continue;
    }
    registry.add(std::move(e));
  }
  return registry;
}

/// A configuration of tests/session with every plugin in its poisoned form.
std::string poisoned(std::string yaml) {
  for (const char* slot : {"sampler", "position", "direction", "field"})
    replace_all(yaml, std::string(slot) + ": {type: ", std::string(slot) + ": {type: poisoned_");
  return yaml;
}

/// A run that stands after `steps` clean steps.
struct Subject {
  Subject(const std::string& yaml, Registry& registry, int steps)
      : session(testing_train::open_text(yaml, registry)), trainer(std::make_unique<Trainer>(session)) {
    poison() = {};
    for (int i = 0; i < steps; ++i) trainer->advance();
  }
  ParamStore<float>& store() { return session.pipeline->store(); }
  /// Puts the address of row `row` of the coming step's batch into poison() and returns what a message must say of it,
  /// found without the ray source: the pixel whose ray has the same bits.
  std::string aim(std::int64_t row) {
    BatchBuffers batch;
    trainer->rays().fill(trainer->step(), batch);
    const double* o = batch.origin.data() + 3 * row;
    const double* d = batch.direction.data() + 3 * row;
    poison().ray = row;
    aim_along(o, d);
    for (const int f : session.scene.frames_of(Split::train)) {
      const FrameInfo& info = session.scene.info.frames[f];
      for (std::int32_t i = 0; i < info.camera.width_px * info.camera.height_px; ++i) {
        const std::int32_t x = i % info.camera.width_px, y = i / info.camera.width_px;
        double origin[3], direction[3], limits[2];
        cast_ray({info.camera, info.world_from_camera, session.plan.undistortion}, session.limits, x, y, origin,
                 direction, limits);
        if (std::memcmp(origin, o, sizeof origin) != 0 || std::memcmp(direction, d, sizeof direction) != 0) continue;
        return "frame '" + info.name + "', pixel x " + std::to_string(x) + ", y " + std::to_string(y);
      }
    }
    return "no pixel";
  }

  Session session;
  std::unique_ptr<Trainer> trainer;
};

/// Values, moments and states, and the number of steps: all that a failed step may not change.
struct Snapshot {
  explicit Snapshot(const Subject& subject) : step(subject.trainer->step()) {
    for (const Tensor<float>& t : subject.session.pipeline->store().all()) {
      bits[t.name] = bits_of(t.value);
      bits[t.name + " m"] = bits_of(t.moment1);
      bits[t.name + " v"] = bits_of(t.moment2);
    }
  }
  bool operator==(const Snapshot& other) const = default;
  std::map<std::string, std::vector<std::uint32_t>> bits;
  std::int64_t step = 0;
};

/// One site of a training step: the step must fail, say every one of `words`, and change nothing.
void expect_caught(Subject& subject, const std::string& site, const std::vector<std::string>& words) {
  const Snapshot before(subject);
  const std::string message = error_of([&] { subject.trainer->advance(); });
  EXPECT_NE(message, "") << site << " went through";
  for (const std::string& word : words) EXPECT_HAS(message, word) << site;
  EXPECT_TRUE(Snapshot(subject) == before) << site << " changed the state";
}

// A bad number in every tensor of a run and in every stage of a pass: each is named.

std::string small(const std::string& yaml) { return with_rays(yaml, 16); }

std::string element_words(const Tensor<float>& t, std::int64_t element) {
  return "row " + std::to_string(element / t.spec.cols) + ", column " + std::to_string(element % t.spec.cols);
}

bool in_window(const Tensor<float>& t, std::int64_t element, std::int64_t step) {
  const std::int64_t rows = (t.spec.rows + kTableWindows - 1) / kTableWindows;
  return element / t.spec.cols / rows == step % kTableWindows;
}

// An element of a sparse tensor that the coming step touches, in the window that it looks at or out of it; the middle
// of any other.
std::int64_t element_of(Subject& subject, const Tensor<float>& t, bool windowed = true) {
  if (t.spec.role != TensorRole::sparse) return t.size() / 2;
  BatchBuffers batch;
  subject.trainer->rays().fill(subject.trainer->step(), batch);
  subject.session.pipeline->lanes().gradients(subject.trainer->step(), batch.view(true));
  std::int64_t element = -1;
  for (std::int64_t i = 0; i < t.size() && element < 0; ++i) {
    const bool touched = t.grad.data()[i] != 0;
    element = touched && in_window(t, i, subject.trainer->step()) == windowed ? i : -1;
  }
  subject.store().clear_gradients();
  return element;
}

class TensorInjection : public ::testing::TestWithParam<const char*> {
 protected:
  std::string yaml() const {
    return small(std::string(GetParam()) == "hash" ? testing_train::hash_config() : testing_train::two_pass_config());
  }
};

// Puts `value` at `place`, tries a step, takes it away again.
void spoil(Subject& subject, const std::string& kind, const Tensor<float>& t, float* place, const BadValue& bad,
           std::vector<std::string> words) {
  const float good = *place;
  *place = bad.value;
  words.insert(words.end(), {"'" + t.name + "'", "nothing was changed"});
  expect_caught(subject, t.name + " " + kind + " " + bad.name, words);
  *place = good;
}

TEST_P(TensorInjection, EveryTensorIsNamed) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  std::vector<BadValue> with_huge(std::begin(kNonFinite), std::end(kNonFinite)), second = with_huge;
  with_huge.push_back({"huge", -1e30F});
  second.push_back({"negative", -1});
  for (Tensor<float>& t : subject.store().all()) {
    if (t.spec.role == TensorRole::rearranged) continue;  // made anew from a learned one before each step
    const std::int64_t at = element_of(subject, t);
    ASSERT_GE(at, 0) << t.name << " is touched by no ray";
    const std::string element = element_words(t, at);
    if (!t.learned()) {
      const char* kind = t.spec.role == TensorRole::state ? "value of a state tensor" : "value of a derived tensor";
      for (const BadValue& bad : kNonFinite) spoil(subject, kind, t, t.value.data() + at, bad, {element});
      continue;
    }
    for (const BadValue& bad : with_huge) {
      spoil(subject, "value", t, t.value.data() + at, bad, {element});
      // A gradient of lane 0 for what lanes sum, else the one that the encoder adds to.
      float* const gradient = t.lanes.size() > 0 ? t.lanes.data() + at : t.grad.data() + at;
      spoil(subject, "gradient", t, gradient, bad, {"the gradient of", element});
      subject.store().clear_gradients();
      spoil(subject, "first moment", t, t.moment1.data() + at, bad, {"the first moment of", element});
    }
    for (const BadValue& bad : second)
      spoil(subject, "second moment", t, t.moment2.data() + at, bad, {"the second moment of", element});
  }
  Subject clean(yaml(), registry, 3);
  subject.trainer->advance();
  EXPECT_TRUE(Snapshot(subject) == Snapshot(clean)) << "a failed step left something behind";
}

// Moments of a table's rows that are not in the step's window: found when their turn comes or when the value that they
// spoil is read, whatever comes first; nothing like it is ever saved.
TEST(TensorInjectionOfTables, MomentsOutOfTheWindowAreFoundInTheirTurn) {
  Registry registry = testing_train::make_registry();
  std::vector<std::string> names;
  Subject any(small(testing_train::hash_config()), registry, 0);
  for (const Tensor<float>& t : any.store().all()) {
    if (t.spec.role == TensorRole::sparse) names.push_back(t.name);
  }
  ASSERT_EQ(names.size(), 6u);
  for (const std::string& name : names) {
    for (const bool second : {false, true}) {
      Subject subject(small(testing_train::hash_config()), registry, 2);
      const Tensor<float>& t = *subject.store().find(name);
      const std::int64_t at = element_of(subject, t, false);
      ASSERT_GE(at, 0);
      (second ? t.moment2 : t.moment1).data()[at] = kNonFinite[0].value;
      EXPECT_THROW(check_storable(subject.store(), subject.trainer->step()), Error);
      std::string message;
      for (int i = 0; i < kTableWindows && message.empty(); ++i)
        message = error_of([&] { subject.trainer->advance(); });
      EXPECT_HAS(message, "'" + name + "'");
    }
  }
}

TEST_P(TensorInjection, NoCheckpointHoldsABadNumber) {
  Registry registry = testing_train::make_registry();
  Subject subject(yaml(), registry, 2);
  EXPECT_NO_THROW(check_storable(subject.store(), subject.trainer->step()));
  for (Tensor<float>& t : subject.store().all()) {
    if (!is_stored(t.spec.role)) continue;
    for (const AlignedBuffer<float>* buffer : {&t.value, &t.moment1, &t.moment2}) {
      if (buffer->size() == 0) continue;
      float& place = buffer->data()[buffer->size() - 1];  // of a table: a row that perhaps no ray ever touched
      const float good = place;
      place = kNonFinite[0].value;
      const std::string message = error_of([&] { check_storable(subject.store(), subject.trainer->step()); });
      place = good;
      EXPECT_HAS(message, "'" + t.name + "'", element_words(t, t.size() - 1));
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Runs, TensorInjection, ::testing::Values("hash", "two_pass"),
                         [](const auto& test) { return std::string(test.param); });

// A bad value of one ray at every stage of a step and of rendering: named with frame and pixel, nothing changed.

std::string hash_yaml() { return with_rays(poisoned(testing_train::hash_config()), 48); }
std::string two_pass_yaml() { return with_rays(poisoned(testing_train::two_pass_config()), 24); }

struct Place {
  std::string pass, number;
};

void spoil_stages_of_training(const std::string& yaml, const Place& place, bool learned_encoder) {
  Registry registry = make_poisoned_registry();
  Subject subject(yaml, registry, 3);
  std::vector<std::string> stages{"distance",    "interval", "encoded position", "encoded direction",
                                  "raw density", "colour",   "feature",          "gradient of the field"};
  if (learned_encoder) stages.push_back("gradient of the encoded position");
  std::int64_t row = 5;
  for (const std::string& stage : stages) {
    std::vector<BadValue> values(std::begin(kNonFinite), std::end(kNonFinite));
    if (stage == "interval") values.push_back({"negative", -0.25F});
    if (stage.rfind("gradient", 0) == 0) values.push_back({"huge", 1e30F});
    for (const BadValue& bad : values) {
      row = (row + 7) % subject.session.config.train.rays;
      const std::string pixel = subject.aim(row);
      arm(stage, place.number, bad.value);
      for (const Pass<float>& pass : subject.session.pipeline->passes()) {
        if (pass.parts().name == place.pass) poison().domain = pass.parts().domain;
      }
      std::vector<std::string> words{"step 3", "nothing was changed"};
      const bool sums = bad.name == std::string("huge");  // one ray's part is a number: the sum's square is not
      if (!sums) words.push_back(pixel);
      if (stage.rfind("gradient", 0) != 0) words.push_back(stage);
      if (stage == "gradient of the field") words.push_back("'" + place.pass + "/field/");
      if (!sums && stage == "gradient of the encoded position") words.push_back(stage);
      expect_caught(subject, place.pass + ": " + stage + " " + bad.name, words);
    }
  }
  // What is left behind by all the failures: nothing. The next step has the bits of a run that never failed.
  poison() = {};
  Subject clean(yaml, registry, 4);
  subject.trainer->advance();
  EXPECT_TRUE(Snapshot(subject) == Snapshot(clean)) << "a failed step left something behind";
}

TEST(StageInjection, LearnedEncoder) { spoil_stages_of_training(hash_yaml(), {"main", "0"}, true); }
TEST(StageInjection, CoarsePass) { spoil_stages_of_training(two_pass_yaml(), {"coarse", "0"}, false); }
TEST(StageInjection, FinePass) { spoil_stages_of_training(two_pass_yaml(), {"fine", "1"}, false); }

std::string message_of_evaluation(Subject& subject, const std::vector<int>& frames) {
  return error_of([&] {
    evaluate(*subject.session.pipeline, subject.session.eval_job(frames), subject.session.limits,
             subject.session.plan.class_of_logit);
  });
}

void spoil_rendering(const std::string& yaml, const Place& place) {
  Registry registry = make_poisoned_registry();
  Subject subject(yaml, registry, 3);
  const std::vector<int> test = subject.session.scene.frames_of(Split::test);
  ASSERT_FALSE(test.empty());
  const FrameInfo& info = subject.session.scene.info.frames[test[0]];
  const Snapshot before(subject);
  std::int64_t pixel = 611;
  for (const char* stage :
       {"distance", "interval", "encoded position", "encoded direction", "raw density", "colour", "feature"}) {
    for (const BadValue& bad : kNonFinite) {
      pixel = (pixel + 131) % (std::int64_t{info.camera.width_px} * info.camera.height_px);
      poison() = {.ray = pixel, .domain = subject.session.pipeline->passes().back().parts().domain};
      arm(stage, place.number, bad.value, false);
      const std::int64_t x = pixel % info.camera.width_px, y = pixel / info.camera.width_px;
      double origin[3], direction[3], limits[2];
      cast_ray({info.camera, info.world_from_camera, false}, subject.session.limits, static_cast<std::int32_t>(x),
               static_cast<std::int32_t>(y), origin, direction, limits);
      aim_along(origin, direction);
      const std::string message = message_of_evaluation(subject, {test[0]});
      EXPECT_HAS(message, "pixel x " + std::to_string(x) + ", y " + std::to_string(y), stage,
                 "frame '" + info.name + "'")
          << bad.name;
    }
  }
  poison() = {};
  EXPECT_EQ(message_of_evaluation(subject, {test[0]}), "");
  EXPECT_TRUE(Snapshot(subject) == before);
}

TEST(StageInjection, RenderingWithAnOccupancyGrid) { spoil_rendering(hash_yaml(), {"main", "0"}); }
TEST(StageInjection, RenderingWithTwoPasses) { spoil_rendering(two_pass_yaml(), {"fine", "1"}); }

TEST(StageInjection, DensityAskedForByPosition) {
  Registry registry = make_poisoned_registry();
  Subject subject(hash_yaml(), registry, 3);
  for (const BadValue& bad : kNonFinite) {
    arm("queried density", "", bad.value, false);
    std::vector<double> positions{0.1, 0.2, 0.3, -0.4, 0.5, 0.6, 0.7, 0.2, 0.1};
    std::vector<float> sigma(3);
    const std::string message = error_of([&] {
      subject.session.pipeline->executor().density({positions.data(), 3, 3}, {sigma.data(), 3, 1});
    });
    EXPECT_HAS(message, "density at (") << bad.name;
  }
}

// The grid reads densities after the update: the step counts, the grid keeps its bits.
TEST(StageInjection, DensityThatTheOccupancyGridAsksFor) {
  Registry registry = make_poisoned_registry();
  for (const BadValue& bad : kNonFinite) {
    Subject subject(hash_yaml(), registry, 15), clean(hash_yaml(), registry, 16);
    const Snapshot before(subject);
    arm("queried density", "", bad.value);
    EXPECT_HAS(error_of([&] { subject.trainer->advance(); }), "density at (") << bad.name;
    poison() = {};
    const Snapshot after(subject), wanted(clean);
    EXPECT_EQ(after.step, 16);
    for (const auto& [name, bits] : after.bits)
      EXPECT_EQ(bits, (name.starts_with("main/sampler") ? before : wanted).bits.at(name)) << name;
  }
}

// Bad rays, colours and labels that reach a batch all the same: named with frame and pixel.

const double kBad[] = {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(),
                       -std::numeric_limits<double>::infinity()};

// Rays: cameras that became bad behind the reader's back.
struct BadRays {
  FrameBuffer buffer;
  StoredFrame stored;
  TrainingLabels::Frame labels;
  RayLimits limits;

  BadRays() {
    buffer.width_px = 8;
    buffer.height_px = 4;
    buffer.rgb.assign(96, 128);
  }
  std::unique_ptr<RaySource> make(const RayCamera& camera, const Subject& subject) {
    RaySourceOptions options{.train = {.rays = 12}, .tile_rays = subject.session.pipeline->tile_rays()};
    stored = StoredFrame(buffer);
    std::vector<TrainFrame> frames{{camera, &stored, labels.empty() ? nullptr : &labels, "bad_one"}};
    return std::make_unique<RaySource>(std::move(frames), std::vector<std::int16_t>{0, 1, 2, 3, 4},
                                       subject.session.limits, options);
  }
  static RayCamera camera() {
    return RayCamera{.camera = {.width_px = 8, .height_px = 4, .fx = 4, .fy = 4, .cx = 4, .cy = 2}};
  }
};

TEST(ReadingInjection, RaysOfABadCamera) {
  Registry registry = testing_train::make_registry();
  Subject subject(testing_train::two_pass_config(), registry, 1);
  const auto expect_named = [&](const std::string& site, const RayCamera& camera) {
    BadRays bad;
    subject.trainer = std::make_unique<Trainer>(subject.session, nullptr, bad.make(camera, subject));
    expect_caught(subject, site, {"frame 'bad_one', pixel x ", " of ray ", "nothing was changed"});
  };
  for (const double bad : kBad) {
    for (std::size_t i = 0; i < 12; ++i) {
      RayCamera c = BadRays::camera();
      (i < 9 ? c.world_from_camera.r[i / 3][i % 3] : c.world_from_camera.t[static_cast<int>(i - 9)]) = bad;
      expect_named("pose entry " + std::to_string(i), c);
    }
    for (double Camera::*const member : {&Camera::cx, &Camera::cy}) {
      RayCamera c = BadRays::camera();
      c.camera.*member = bad;
      expect_named("principal point", c);
    }
  }
}

// What only a caller of the pipeline can do: colours and soft labels of a batch. The ray is named.
TEST(ReadingInjection, ColoursAndSoftLabelsOfABatch) {
  Registry registry = testing_train::make_registry();
  Subject subject(testing_train::two_pass_config(), registry, 1);
  const auto classes = static_cast<std::int32_t>(subject.session.plan.class_of_logit.size());
  for (const bool soft : {false, true}) {
    for (const double bad : {kBad[0], kBad[1], kBad[2], -0.5}) {
      if (!soft && bad == -0.5) continue;  // a colour may be any number
      BatchBuffers batch;
      subject.trainer->rays().fill(1, batch);
      const std::int64_t rays = std::ssize(batch.label);
      std::vector<float> rows(static_cast<std::size_t>(rays * classes), 1.0F / static_cast<float>(classes));
      RayBatch view = batch.view(true);
      if (soft) {
        rows[7 * classes + 1] = static_cast<float>(bad);
        view.targets.more.set(channel::soft_label, {rows.data(), rays, classes});
      } else {
        batch.target[3 * 7 + 1] = static_cast<float>(bad);
      }
      const std::string message = error_of([&] { subject.session.pipeline->lanes().gradients(1, view); });
      const std::optional<RayFault> fault = subject.session.pipeline->lanes().find_fault(1, view);
      EXPECT_HAS(message, "ray 7") << soft << ' ' << bad;
      EXPECT_TRUE(!soft || (fault && fault->ray() == 7));
    }
  }
}

// Nothing to see and nothing seen: a black scene in front of a black background needs no density.
TEST(DeadDensity, AnEmptySceneIsNoFault) {
  Registry registry = make_registry();
  Subject subject(
      "scene: {type: analytic_room, frames: 4, width_px: 16, height_px: 12, with_labels: false}\n"
      "rendering: {density_activation: relu, density_bias: -2}\npasses:\n  - sampler: {type: stratified, samples: 6}\n"
      "    position: {type: frequency, frequencies: 2}\n    direction: {type: frequency, frequencies: 1}\n"
      "    field: {type: nerf_mlp, depth: 2, width: 8, skip_at: 0, view_width: 8}\ntrain: {steps: 200, rays: 16}\n",
      registry, 0);
  FrameBuffer black{.width_px = 16, .height_px = 12};
  black.rgb.assign(576, 0);
  const StoredFrame stored(black);
  const FrameInfo& info = subject.session.scene.info.frames[0];
  RaySourceOptions options{.train = {.rays = 16}, .tile_rays = subject.session.pipeline->tile_rays()};
  std::vector<TrainFrame> frames{{{info.camera, info.world_from_camera, false}, &stored, nullptr, ""}};
  Trainer trainer(
      subject.session, nullptr,
      std::make_unique<RaySource>(std::move(frames), std::vector<std::int16_t>{}, subject.session.limits, options));
  for (int i = 0; i < 220; ++i) ASSERT_EQ(trainer.advance().back().dense_passes, 0U);
}

// A10: opacity that came in one or two long steps is reported, with a remedy; short steps are not blamed.

struct SlabParams {
  double at_m = 1.2;
  double width_m = 0.02;
};
void describe(ParamVisitor& visit, SlabParams& p) {
  SEMFIELD_PARAM(visit, p, at_m, "x of the middle plane, metres", {-10, 10});
  SEMFIELD_PARAM(visit, p, width_m, "width, metres", {1e-6, 10});
}
void validate(const SlabParams&, Diagnostics&) {}

// Grey matter of optical depth 10 between two planes, nothing else.
template <class Real>
class Slab final : public Field<Real> {
 public:
  Slab(const SlabParams& p, const FieldBuild&, const KernelTables&) : p_(p) {}
  FieldTraits traits() const noexcept override { return {}; }
  std::size_t saved_bytes(std::int64_t, std::int64_t) const noexcept override { return 64; }

 protected:
  void do_forward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>& in, const FieldOut<Real>& out,
                  Saved) const override {
    for (std::int64_t m = 0; m < in.position.rows; ++m) {
      const bool inside = std::abs(static_cast<double>(in.position(m, 0)) - p_.at_m) < 0.5 * p_.width_m;
      if (!out.sigma.empty()) out.sigma(m, 0) = static_cast<Real>(inside ? 10 / p_.width_m : -1);
      for (int c = 0; c < 3 && !out.rgb.empty(); ++c) out.rgb(m, c) = Real(0.5);
    }
  }
  void do_backward(const StepContext&, const Tensors<Real>&, const FieldIn<Real>&, const FieldOut<Real>&,
                   const FieldGrad<Real>&, Saved, View<Real>) const override {}

 private:
  SlabParams p_;
};

SplitScore score_of(int samples, double width_m) {
  Registry registry = make_registry();
  registry.add_field<Slab, SlabParams>("slab", "matter between two planes");
  const std::string yaml =
      "scene: {type: analytic_room, with_labels: false}\nrendering: {density_activation: relu, scene_scale: 1}\n"
      "passes:\n  - name: main\n    sampler: {type: stratified, samples: " +
      std::to_string(samples) + "}\n    position: {type: identity}\n    direction: {type: spherical_harmonics, " +
      "degree: 1}\n    field: {type: slab, width_m: " + std::to_string(width_m) + "}\n";
  const Session s = open_text(yaml, registry);
  return evaluate(*s.pipeline, s.eval_job(s.scene.frames_of(Split::test)), s.limits, s.plan.class_of_logit);
}

TEST(Resolution, AThinSlabBetweenLongStepsIsTold) {
  const SplitScore score = score_of(24, 0.02);
  ASSERT_GT(score.resolution.opaque_px, 0) << "some rays meet the slab by chance";
  EXPECT_GT(*score.resolution.share(), 0.95) << "all but rays that graze the slab";
  const std::string warning = score.resolution.warning();
  EXPECT_HAS(warning, " % of the pixels that meet something", "raise the sampler's samples");
  EXPECT_HAS(final_eval_json(score, {}, "test", 1, 1),
             "\"opaque_pixels\":" + std::to_string(score.resolution.opaque_px),
             "\"under_resolved_pixels\":" + std::to_string(score.resolution.under_resolved_px));
}

TEST(Resolution, ShortStepsAndThickMatterAreNot) {
  EXPECT_EQ(score_of(1024, 0.02).resolution.under_resolved_px, 0);
  // Matter that fades in over many long steps is resolved as well as it is sharp.
  const SplitScore thick = score_of(48, 3);
  ASSERT_GT(thick.resolution.opaque_px, 100);
  EXPECT_EQ(thick.resolution.under_resolved_px, 0);
  EXPECT_EQ(thick.resolution.warning(), "");
}

struct OneRay {
  std::vector<float> t, delta, weight;
  std::vector<std::int32_t> ray, first;
  Samples<float> samples;
  OneRay(std::vector<float> weights, float step) : weight(std::move(weights)) {
    const auto n = static_cast<std::int32_t>(weight.size());
    for (std::int32_t k = 0; k < n; ++k) t.push_back(2.0F + step * static_cast<float>(k));
    delta.assign(weight.size(), step);
    ray.assign(weight.size(), 0);
    first = {0, n};
    samples.t = {t.data(), n, 1};
    samples.delta = {delta.data(), n, 1};
    samples.ray_of_sample = {ray.data(), n, 1};
    samples.first = {first.data(), 2, 1};
    samples.count = n;
  }
  OpacityResolution look(FarMode far = FarMode::open, double footprint_per_m = 0.01) const {
    return opacity_resolution<float>(samples, View<const float>(weight.data(), samples.count, 1), far, 0,
                                     footprint_per_m);
  }
};

TEST(Resolution, TheRule) {
  using R = OpacityResolution;
  EXPECT_EQ(OneRay({0.2F, 0.2F}, 0.1F).look(), R::clear);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0, 0.5F, 0.45F}, 0.1F).look(), R::under_resolved);
  EXPECT_EQ(OneRay({0.2F, 0.3F, 0.3F, 0.2F}, 0.1F).look(), R::resolved);
  EXPECT_EQ(OneRay({0, 0.9F, 0}, 0.01F).look(), R::resolved) << "a step below the pixel's 0.02 m";
  EXPECT_EQ(OneRay({0, 0.1F, 0.9F}, 0.1F).look(FarMode::background), R::clear) << "the rest is no density";
  EXPECT_EQ(OneRay({}, 0.1F).look(), R::clear);
}

TEST(Resolution, BandsBeyondTheCoordinatesAreSaid) {
  std::string yaml = two_pass_config();
  yaml.replace(yaml.find("frequencies: 3"), 14, "frequencies: 30, arithmetic: float32");
  const Session s = open_text(yaml);
  ASSERT_EQ(s.chosen.size(), 1u);
  EXPECT_EQ(s.chosen[0].rfind("passes.coarse.position: warning: effective_bands is ", 0), 0u) << s.chosen[0];
}

}  // namespace semfield
