#include "tests/guards/poison.h"

#include <cstdio>
#include <cstring>

namespace semfield::testing_guards {

namespace {

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
  std::int64_t capacity(std::int64_t rays, std::int64_t previous) const noexcept override {
    return inner_->capacity(rays, previous);
  }
  void declare(ParamDeclarer& d) const override { inner_->declare(d); }
  void derive(const StepContext& ctx, const Tensors<float>& t) const override { inner_->derive(ctx, t); }
  void observe(const StepContext& ctx, const Tensors<float>& t, const DensityQuery<float>& query) const override {
    inner_->observe(ctx, t, query);
  }
  std::string status(const Tensors<float>& t) const override { return inner_->status(t); }

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

  std::size_t scratch_bytes(std::int64_t samples) const noexcept override { return inner_->scratch_bytes(samples); }

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
  std::size_t scratch_bytes(std::int64_t samples, std::int64_t rays) const noexcept override {
    return inner_->scratch_bytes(samples, rays);
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

}  // namespace

Poison& poison() {
  static Poison the_poison;
  return the_poison;
}

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

std::string poisoned(std::string yaml) {
  for (const char* slot : {"sampler", "position", "direction", "field"})
    replace_all(yaml, std::string(slot) + ": {type: ", std::string(slot) + ": {type: poisoned_");
  return yaml;
}

Subject::Subject(const std::string& yaml, Registry& registry, int steps)
    : session(testing_train::open_text(yaml, registry)) {
  poison() = {};
  rays = session.make_ray_source();
  trainer = std::make_unique<Trainer>(*session.pipeline, *rays, session.config.adam, session.config.schedule);
  for (int i = 0; i < steps; ++i) trainer->advance();
}

std::string Subject::aim(std::int64_t row) {
  BatchBuffers batch;
  rays->fill(trainer->step(), batch);
  const double* o = batch.origin.data() + 3 * row;
  const double* d = batch.direction.data() + 3 * row;
  Poison& p = poison();
  p.ray = row;
  p.origin = {o[0], o[1], o[2]};
  p.direction = {d[0], d[1], d[2]};
  for (const int f : session.scene.frames_of(Split::train)) {
    const FrameInfo& info = session.scene.info.frames[f];
    for (std::int32_t y = 0; y < info.camera.height_px; ++y) {
      for (std::int32_t x = 0; x < info.camera.width_px; ++x) {
        double origin[3], direction[3], limits[2];
        cast_ray({info.camera, info.world_from_camera, session.plan.undistortion}, session.limits, x, y, origin,
                 direction, limits);
        if (std::memcmp(origin, o, sizeof origin) != 0 || std::memcmp(direction, d, sizeof direction) != 0) continue;
        return "frame '" + info.name + "', pixel x " + std::to_string(x) + ", y " + std::to_string(y);
      }
    }
  }
  return "no pixel";
}

Snapshot::Snapshot(const Subject& subject) : step(subject.trainer->step()) {
  for (const Tensor<float>& t : subject.session.pipeline->store().all()) {
    bits[t.name] = bits_of(t.value);
    bits[t.name + " m"] = bits_of(t.moment1);
    bits[t.name + " v"] = bits_of(t.moment2);
  }
}

void Tally::add(const std::string& kind, bool caught) {
  ++sites[kind].first;
  sites[kind].second += caught ? 1 : 0;
}
int Tally::total() const {
  int sum = 0;
  for (const auto& [kind, counts] : sites) sum += counts.first;
  return sum;
}
void Tally::print() const {
  int caught = 0;
  for (const auto& [kind, counts] : sites) {
    std::printf("%4d of %4d caught: %s\n", counts.second, counts.first, kind.c_str());
    caught += counts.second;
  }
  std::printf("injection sites: %d, caught: %d\n", total(), caught);
}
Tally& tally() {
  static Tally the_tally;
  return the_tally;
}

std::string message_of_step(Trainer& trainer) {
  try {
    trainer.advance();
  } catch (const Error& error) {
    return error.what();
  }
  return {};
}

void expect_caught(Subject& subject, const std::string& kind, const std::string& site,
                   const std::vector<std::string>& words) {
  const Snapshot before(subject);
  const std::string message = message_of_step(*subject.trainer);
  bool caught = !message.empty();
  EXPECT_TRUE(caught) << site << " went through";
  for (const std::string& word : words) {
    if (message.find(word) != std::string::npos) continue;
    caught = false;
    ADD_FAILURE() << site << ": \"" << message << "\" does not say \"" << word << "\"";
  }
  if (!(Snapshot(subject) == before)) {
    caught = false;
    ADD_FAILURE() << site << " changed the state";
  }
  tally().add(kind, caught);
}

const std::vector<BadValue>& non_finite_values() {
  constexpr float kInf = std::numeric_limits<float>::infinity();
  static const std::vector<BadValue> values{
      {"nan", std::numeric_limits<float>::quiet_NaN()}, {"inf", kInf}, {"-inf", -kInf}};
  return values;
}

namespace {
class PrintTally final : public ::testing::Environment {
  void TearDown() override { tally().print(); }
};
const ::testing::Environment* const kPrint = ::testing::AddGlobalTestEnvironment(new PrintTally);
}  // namespace

}  // namespace semfield::testing_guards
