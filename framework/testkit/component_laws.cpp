// The laws of encoders, fields and heads: those of every kind on a bench of the kind, and what each kind promises
// beside them.
#include <cmath>

#include "compute/gemm.h"
#include "compute/parallel.h"
#include "core/rng.h"
#include "testkit/benches.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kRowCounts[] = {0, 1, 31, 33};
constexpr std::int64_t kFew = 33, kCut = 15;  // between two rays of a field
constexpr std::int32_t kPadding = 5;
enum class Of : std::uint8_t { outputs, gradients };

/// Laws of every kind. Bench<Real>(component, build, rows, padding, options) has tensors in `box`, a `workspace`,
/// forward(), backward(), part(), which is both for some rows, and loss(), whose gradients backward gives; outputs(),
/// gradients() and inputs() name its matrices.
template <template <class> class Bench, template <class> class Kind, class Build>
class ComponentLaws {
 public:
  ComponentLaws(const Kind<float>& single, const Kind<double>& oracle, const Build& build, const LawOptions& options)
      : single_(single), oracle_(oracle), build_(build), options_(options) {}

  /// All of them; `steady_rows` is the batch whose third step may allocate nothing.
  void of_every_kind(std::int64_t steady_rows) {
    options_.begin("what is written");
    for (const std::int64_t rows : kRowCounts) {
      written<float>(rows, 0);
      written<float>(rows, kPadding);
      written<double>(rows, kPadding);
    }
    written<float>(options_.many_rows, 0);
    ask("split batch", &ComponentLaws::parts<float>);
    ask("split batch", &ComponentLaws::parts<double>);
    ask("gradients", &ComponentLaws::gradients);
    ask("gradients accumulate", &ComponentLaws::accumulation);
    ask("float against double", &ComponentLaws::precision);
    options_.begin("steady state");
    steady_state(steady_rows);
  }
  template <class Laws>
  void ask(const char* law, void (Laws::*body)()) {
    options_.begin(law);
    (static_cast<Laws&>(*this).*body)();
  }
  void note(const std::string& law, const std::string& sentence) { note_failure(failures, law, sentence); }

  template <class Real>
  Bench<Real> bench(std::int64_t rows, std::int32_t padding = 0) const {
    if constexpr (std::is_same_v<Real, float>) {
      return Bench<float>(single_, build_, rows, padding, options_);
    } else {
      return Bench<double>(oracle_, build_, rows, padding, options_);
    }
  }
  template <class Real>
  static void step(Bench<Real>& bench) {
    bench.forward();
    bench.backward();
  }
  /// Within what the precision of the build allows.
  template <class A, class B>
  std::string close(Of of, View<const A> got, View<const B> want) const {
    if constexpr (requires { build_.precision; }) {
      if (build_.precision == Precision::bf16)
        return of == Of::gradients ? compare_norms(got, want, options_.bf16_gradient_tolerance)
                                   : compare(got, want, options_.bf16_tolerance);
    }
    return compare(got, want, options_.float_tolerance);
  }
  /// The same numbers from a part of a call (LawOptions::same_bits_in_parts).
  template <class Real>
  std::string same(Of of, View<const Real> got, View<const Real> want) const {
    if constexpr (std::is_same_v<Real, float>) {
      if (!options_.same_bits_in_parts) return close(of, got, want);
    }
    return compare_bits(got, want);
  }
  /// match(of, got, want) of all that two benches wrote; a sentence is noted as "<law><name>: ...".
  template <class A, class B, class Match>
  void compare_written(const std::string& law, Bench<A>& got, Bench<B>& want, const Match& match) {
    const auto each = [&](Of of, const auto& a, const auto& b) {
      for (std::size_t i = 0; i < a.size(); ++i)
        note(law + a[i].name, match(of, View<const A>(a[i].rows->view()), View<const B>(b[i].rows->view())));
    };
    each(Of::outputs, got.outputs(), want.outputs());
    each(Of::gradients, got.gradients(), want.gradients());
  }
  /// match(got, want) of the gradients of every learned tensor.
  template <class A, class B, class Match>
  void compare_learned(const std::string& law, const Bench<A>& got, const Bench<B>& want, const Match& match) {
    for (std::size_t i = 0; i < want.box.count(); ++i) {
      if (want.box.learned(i))
        note(law + want.box.specs()[i].name, match(View<const A>(got.box.grad(i)), View<const B>(want.box.grad(i))));
    }
  }
  /// Comparison of gradients that are sums over rows (LawOptions::same_bits_of_sums).
  std::string same_sums(View<const float> got, View<const float> want) const {
    return options_.same_bits_of_sums ? compare_bits(got, want) : compare(got, want, options_.float_tolerance);
  }
  /// The same call in two benches gives the same bits, sums over rows included.
  void same_again(const std::string& law, Bench<float>& again, Bench<float>& once) {
    compare_written(law, again, once, [](Of, auto got, auto want) { return compare_bits(got, want); });
    compare_learned(law + "gradient of ", again, once, [&](auto got, auto want) { return same_sums(got, want); });
  }
  std::string count_text(std::int64_t rows) const { return std::to_string(rows) + " " + Bench<float>::kRows; }

  Failures failures;

 protected:
  const Kind<float>& single_;
  const Kind<double>& oracle_;
  const Build& build_;
  const LawOptions& options_;

 private:
  template <class Real>
  void written(std::int64_t rows, std::int32_t padding) {
    const std::string law = count_text(rows) + (padding > 0 ? ", stride above cols" : "");
    Bench<Real> one = bench<Real>(rows, padding);
    one.forward();
    std::vector<Written<Real>> all = one.outputs();
    for (const Written<Real>& w : all) note(law + ", every " + w.name + " written", w.rows->unwritten());
    one.backward();
    for (const Written<Real>& w : one.gradients()) {
      note(law + ", every " + w.name + " written", w.rows->unwritten());
      all.push_back(w);
    }
    for (const Written<Real>& w : all) note(law + ", " + w.name + " stays inside", w.rows->broken_guard());
  }

  // A batch cut in two gives the numbers of the whole.
  template <class Real>
  void parts() {
    Bench<Real> whole = bench<Real>(kFew), split = bench<Real>(kFew);
    step(whole);
    split.part(0, kCut);
    split.part(kCut, kFew - kCut);
    compare_written("split batch, ", split, whole, [&](Of of, auto got, auto want) { return same(of, got, want); });
  }

  // Of inputs and of every learned tensor, against central differences.
  void gradients() {
    Bench<double> few = bench<double>(kFew);
    step(few);
    const GradientCheck check{options_.gradient_tolerance, 1e-6, options_.gradient_elements, options_.seed};
    const auto loss = [&few] {
      few.derive();
      few.forward();
      return few.loss();
    };
    for (const BenchInput& input : few.inputs())
      note(std::string("gradient of ") + input.name, check_gradient(loss, input.value, input.gradient, check));
    for (std::size_t i = 0; i < few.box.count(); ++i) {
      if (few.box.learned(i))
        note("gradient of " + few.box.specs()[i].name, check_gradient(loss, few.box.value(i), few.box.grad(i), check));
    }
  }

  // Gradients of tensors are added to, those of inputs are written.
  void accumulation() {
    Bench<double> clean = bench<double>(kFew), prefilled = bench<double>(kFew);
    step(clean);
    prefilled.box.add_to_grads(3);
    for (const Written<double>& w : prefilled.gradients()) w.rows->fill(7.0);
    step(prefilled);
    compare_written("overwritten, ", prefilled, clean, [](Of, auto got, auto want) { return compare_bits(got, want); });
    prefilled.box.add_to_grads(-3);
    compare_learned("gradients accumulate, ", prefilled, clean,
                    [](auto got, auto want) { return compare(got, want, 1e-12, 3.0); });
  }

  void precision() {
    Bench<float> single = bench<float>(kFew);
    Bench<double> twin = bench<double>(kFew);
    step(single);
    step(twin);
    compare_written("float against double, ", single, twin,
                    [&](Of of, auto got, auto want) { return close(of, got, want); });
    compare_learned("float against double, gradient of ", single, twin,
                    [&](auto got, auto want) { return close(Of::gradients, got, want); });
  }

  void steady_state(std::int64_t rows) {
    Bench<float> steady = bench<float>(rows);
    for (int warm_up = 0; warm_up < 2; ++warm_up) step(steady);
    const std::int64_t growths = steady.workspace.growth_count();
    step(steady);
    if (steady.workspace.growth_count() != growths)
      note("steady state", "the workspace still grows in the third step; is a Workspace::Scope missing?");
  }
};

// Encoders.

// Coordinates as the encoder's domain says, kept off the faces of the unit cube where clamping has a kink.
void fill_coordinates(View<double> x, Domain domain, std::uint64_t seed) {
  const RandomAddress address{seed, 0, stream_id("testkit/coordinates")};
  for (std::int64_t r = 0; r < x.rows; ++r) {
    double norm = 0;
    for (std::int32_t c = 0; c < x.cols; ++c) {
      const auto index = static_cast<std::uint64_t>(r * x.cols + c);
      const double u = uniform01(address, index);
      x(r, c) = domain == Domain::unit_cube ? 0.01 + 0.98 * u : 2 * u - 1 + 1e-3;
      norm += x(r, c) * x(r, c);
    }
    if (domain != Domain::direction) continue;
    for (std::int32_t c = 0; c < x.cols; ++c) x(r, c) /= std::sqrt(norm);
  }
}

template <class Real>
struct EncoderBench : ComponentBench<Real, Encoder> {
  EncoderBench(const Encoder<Real>& encoder, const EncoderBuild&, std::int64_t rows, std::int32_t padding,
               const LawOptions& options)
      : ComponentBench<Real, Encoder>(encoder, options),
        x(rows, encoder.traits().in_dims, padding),
        dy(rows, encoder.traits().out_dims, padding),
        y(rows, encoder.traits().out_dims, padding),
        dx(rows, encoder.traits().in_dims, padding) {
    fill_coordinates(x.view(), encoder.traits().domain, options.seed);
    fill_uniform(dy.view(), "testkit/output_weights", options.seed);
    this->derive();
  }
  void forward() { this->component.forward(this->ctx, this->box.tensors(), x.view(), y.view()); }
  void backward(bool with_dx = true) {
    this->component.backward(this->ctx, this->box.tensors(), x.view(), dy.view(), with_dx ? dx.view() : View<Real>());
    this->component.derive_backward(this->ctx, this->box.tensors());
  }
  void part(std::int64_t begin, std::int64_t count) {
    const auto cut = [&](auto view) { return view.row_range(begin, count); };
    this->component.forward(this->ctx, this->box.tensors(), cut(x.view()), cut(y.view()));
    this->component.backward(this->ctx, this->box.tensors(), cut(x.view()), cut(dy.view()), cut(dx.view()));
  }
  double loss() const { return weighted_sum(dy, y); }
  std::vector<Written<Real>> outputs() { return {{"y", &y}}; }
  std::vector<Written<Real>> gradients() { return {{"dx", &dx}}; }
  std::vector<BenchInput> inputs() { return {{"x", x.view(), dx.view()}}; }
  static constexpr const char* kRows = "rows";

  Guarded<double> x;
  Guarded<Real> dy, y, dx;
};

class EncoderLaws : public ComponentLaws<EncoderBench, Encoder, EncoderBuild> {
 public:
  using ComponentLaws::ComponentLaws;

  Failures run() {
    of_every_kind(options_.many_rows);
    ask("permuted rows", &EncoderLaws::permuted<float>);
    ask("permuted rows", &EncoderLaws::permuted<double>);
    ask("gradients without dx", &EncoderLaws::without_others);
    ask("1 and 3 threads", &EncoderLaws::threads);
    return failures;
  }

 private:
  // A row has the bits that it has elsewhere in a batch.
  template <class Real>
  void permuted() {
    EncoderBench<Real> whole = bench<Real>(kFew), moved = bench<Real>(kFew);
    step(whole);
    const auto from = [](std::int64_t r) { return (r * 7 + 5) % kFew; };
    for (std::int64_t r = 0; r < kFew; ++r) {
      for (std::int32_t c = 0; c < moved.x.cols(); ++c) moved.x(r, c) = whole.x(from(r), c);
      for (std::int32_t c = 0; c < moved.dy.cols(); ++c) moved.dy(r, c) = whole.dy(from(r), c);
    }
    step(moved);
    for (std::int64_t r = 0; r < kFew; ++r) {
      note("permuted rows, y",
           compare_bits<Real>(moved.y.view().row_range(r, 1), whole.y.view().row_range(from(r), 1)));
      note("permuted rows, dx",
           compare_bits<Real>(moved.dx.view().row_range(r, 1), whole.dx.view().row_range(from(r), 1)));
    }
  }

  // dx is optional without changing the gradients of tensors, and the other way round.
  void without_others() {
    EncoderBench<double> clean = bench<double>(kFew), without_dx = bench<double>(kFew), alone = bench<double>(kFew);
    clean.backward();
    without_dx.backward(false);
    compare_learned("gradients without dx, ", without_dx, clean, compare_bits<double>);
    if (!oracle_.traits().gives_dx_alone) return;
    alone.dx.fill(7.0);
    oracle_.backward(alone.ctx, {alone.box.tensors().value, {}}, alone.x.view(), alone.dy.view(), alone.dx.view());
    note("dx alone", compare_bits<double>(alone.dx.view(), clean.dx.view()));
  }

  void threads() {
    const int kept = thread_count();
    set_thread_count(1);
    EncoderBench<float> serial = bench<float>(options_.many_rows);
    step(serial);
    set_thread_count(3);
    EncoderBench<float> threaded = bench<float>(options_.many_rows);
    step(threaded);
    set_thread_count(kept);
    same_again("1 and 3 threads, ", threaded, serial);
  }
};

// Fields.

class FieldLaws : public ComponentLaws<FieldBench, Field, FieldBuild> {
 public:
  using ComponentLaws::ComponentLaws;

  Failures run() {
    of_every_kind(257);
    ask("colour", &FieldLaws::colours<float>);
    ask("colour", &FieldLaws::colours<double>);
    ask("direction", &FieldLaws::direction<float>);
    ask("direction", &FieldLaws::direction<double>);
    ask("others unwanted", &FieldLaws::unwanted);
    ask("absent gradients", &FieldLaws::absent_gradients);
    FieldBench<float> once = bench<float>(options_.many_rows), again = bench<float>(options_.many_rows);
    step(once);
    step(again);
    same_again("again, ", again, once);
    return failures;
  }

 private:
  template <class Real>
  void colours() {
    FieldBench<Real> one = bench<Real>(options_.many_rows, kPadding);
    one.forward();
    for (std::int64_t m = 0; m < one.rgb.rows(); ++m) {
      for (std::int32_t c = 0; c < 3; ++c) {
        if (const Real value = one.rgb(m, c); !(value >= 0 && value <= 1))
          note("colour", std::to_string(value) + " of sample " + std::to_string(m) + " is outside [0, 1]");
      }
    }
  }

  // sigma and feature have the same bits whatever the direction; a field that says it uses the direction lets it change
  // colour.
  template <class Real>
  void direction() {
    if (build_.direction_dims == 0) return;
    FieldBench<Real> plain = bench<Real>(kFew), turned = bench<Real>(kFew);
    plain.forward();
    for (std::int64_t r = 0; r < turned.direction.rows(); ++r) {
      for (std::int32_t c = 0; c < turned.direction.cols(); ++c)
        turned.direction(r, c) = Real(0.5) - turned.direction(r, c);
    }
    turned.forward();
    note("sigma does not see the direction", compare_bits<Real>(turned.sigma.view(), plain.sigma.view()));
    note("feature does not see the direction", compare_bits<Real>(turned.feature.view(), plain.feature.view()));
    const bool changed = !compare_bits<Real>(turned.rgb.view(), plain.rgb.view()).empty();
    if (changed != plain.shape.uses_direction)
      note("traits", std::string("uses_direction is ") +
                         (changed ? "false but the colour changes" : "true but the colour does not change") +
                         " with the direction");
  }

  // An output that is not wanted changes no other, nor does absent memory for backward.
  void unwanted() {
    FieldBench<float> whole = bench<float>(kFew);
    whole.forward();
    for (int subset = 1; subset < 16; ++subset) {  // bits: the outputs, and whether the memory is there
      const Wanted wanted{(subset & 1) != 0, (subset & 2) != 0, (subset & 4) != 0};
      const bool keeps = (subset & 8) != 0;
      FieldBench<float> part = bench<float>(kFew);
      single_.forward(part.ctx, part.box.values_only(), part.in(), part.out(wanted), keeps ? part.saved() : Saved());
      const bool is_wanted[] = {wanted.sigma, wanted.rgb, wanted.feature};
      const auto got = part.outputs(), want = whole.outputs();
      for (std::size_t i = 0; i < got.size(); ++i) {
        if (is_wanted[i])
          note(std::string(got[i].name) + " with others unwanted",
               same<float>(Of::outputs, got[i].rows->view(), want[i].rows->view()));
      }
    }
  }

  // An absent output gradient counts as zero.
  void absent_gradients() {
    for (const Wanted wanted : {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{false, false, true}}) {
      FieldBench<double> absent = bench<double>(kFew), zeros = bench<double>(kFew);
      absent.forward();
      absent.backward(wanted);
      if (!wanted.sigma) zeros.w_sigma.fill(0);
      if (!wanted.rgb) zeros.w_rgb.fill(0);
      if (!wanted.feature) zeros.w_feature.fill(0);
      step(zeros);
      note("absent gradients, d_position",
           compare<double, double>(absent.d_position.view(), zeros.d_position.view(), 1e-12));
      compare_learned("absent gradients, ", absent, zeros,
                      [](auto got, auto want) { return compare(got, want, 1e-12, 1e-3); });
    }
  }
};

// Heads.

// Per sample, then the output layer on the same rows as if each were a ray.
template <class Real>
struct HeadBench : ComponentBench<Real, Head> {
  HeadBench(const Head<Real>& head, const HeadBuild& build, std::int64_t rows, std::int32_t padding,
            const LawOptions& options)
      : ComponentBench<Real, Head>(head, options),
        feature(rows, build.feature_dims, padding),
        hidden(rows, head.hidden_width(), padding),
        out(rows, head.width(), padding),
        d_out(rows, head.width(), padding),
        d_hidden(rows, head.hidden_width(), padding),
        d_feature(rows, build.feature_dims, padding),
        opacity(rows, 1),
        d_opacity(rows, 1) {
    fill_uniform(feature.view(), "testkit/head_feature", options.seed);
    fill_uniform(d_out.view(), "testkit/head_output_weights", options.seed);
    fill_uniform(opacity.view(), "testkit/head_opacity", options.seed);
    for (std::int64_t r = 0; r < rows; ++r) opacity(r, 0) = std::abs(opacity(r, 0));
    this->derive();
  }
  void forward() { forward_of(0, feature.rows()); }
  void backward() {
    backward_of(0, feature.rows());
    this->component.derive_backward(this->ctx, this->box.tensors());
  }
  void part(std::int64_t begin, std::int64_t count) {
    forward_of(begin, count);
    backward_of(begin, count);
  }
  double loss() const { return weighted_sum(d_out, out); }
  std::vector<Written<Real>> outputs() { return {{"hidden", &hidden}, {"channel", &out}}; }
  std::vector<Written<Real>> gradients() {
    return {{"d_hidden", &d_hidden}, {"d_feature", &d_feature}, {"d_opacity", &d_opacity}};
  }
  std::vector<BenchInput> inputs() {
    return {{"the feature", feature.view(), d_feature.view()}, {"the opacity", opacity.view(), d_opacity.view()}};
  }
  static constexpr const char* kRows = "rows";

  Guarded<Real> feature, hidden, out, d_out, d_hidden, d_feature, opacity, d_opacity;

 private:
  void forward_of(std::int64_t begin, std::int64_t count) {
    const auto cut = [&](auto& rows) { return rows.view().row_range(begin, count); };
    this->component.hidden_forward(this->ctx, this->box.tensors(), cut(feature), cut(hidden));
    this->component.output_forward(this->ctx, this->box.tensors(), cut(hidden), cut(opacity), cut(out));
  }
  void backward_of(std::int64_t begin, std::int64_t count) {
    const auto cut = [&](auto& rows) { return rows.view().row_range(begin, count); };
    this->component.output_backward(this->ctx, this->box.tensors(), cut(hidden), cut(opacity), cut(d_out),
                                    cut(d_hidden), cut(d_opacity));
    this->component.hidden_backward(this->ctx, this->box.tensors(), cut(feature), cut(hidden), cut(d_hidden),
                                    cut(d_feature));
  }
};

class HeadLaws : public ComponentLaws<HeadBench, Head, HeadBuild> {
 public:
  using ComponentLaws::ComponentLaws;

  Failures run() {
    for (const std::int32_t width : {single_.width(), oracle_.width()}) {
      if (width != build_.width) note("width", std::to_string(width) + " columns, not " + std::to_string(build_.width));
    }
    of_every_kind(257);
    ask("the output is linear", &HeadLaws::linear);
    return failures;
  }

 private:
  // Compositing stands between the activations and the output layer, which must therefore be linear.
  void linear() {
    HeadBench<double> a = bench<double>(kFew), b = bench<double>(kFew), sum = bench<double>(kFew);
    fill_uniform(a.hidden.view(), "testkit/head_h_1", options_.seed);
    fill_uniform(b.hidden.view(), "testkit/head_h_2", options_.seed);
    fill_uniform(b.opacity.view(), "testkit/head_opacity_2", options_.seed);
    const auto output = [&](HeadBench<double>& of, View<const double> opacity) {
      oracle_.output_forward(of.ctx, of.box.tensors(), of.hidden.view(), opacity, of.out.view());
    };
    const auto combined = [](Guarded<double>& to, const Guarded<double>& x, const Guarded<double>& y) {
      for (std::int64_t r = 0; r < to.rows(); ++r)
        for (std::int32_t c = 0; c < to.cols(); ++c) to(r, c) = 2 * x(r, c) - 3 * y(r, c);
    };
    combined(sum.opacity, a.opacity, b.opacity);
    combined(sum.hidden, a.hidden, b.hidden);
    for (HeadBench<double>* one : {&a, &b, &sum}) output(*one, one->opacity.view());
    Guarded<double> wanted(kFew, oracle_.width());
    combined(wanted, a.out, b.out);
    note("the output is linear in activations and opacity",
         compare<double, double>(sum.out.view(), wanted.view(), 1e-10));
    // Without an opacity each row stands for a sample, whose opacity is 1.
    HeadBench<double> ones = bench<double>(kFew), none = bench<double>(kFew);
    ones.opacity.fill(1);
    ones.forward();
    none.forward();
    output(none, {});
    note("no opacity is an opacity of 1", compare<double, double>(none.out.view(), ones.out.view(), 1e-12));
  }
};

}  // namespace

Failures encoder_laws(const Encoder<float>& encoder32, const Encoder<double>& encoder64, const LawOptions& options) {
  const EncoderTraits shape = encoder32.traits(), twin = encoder64.traits();
  if (shape.in_dims != twin.in_dims || shape.out_dims != twin.out_dims || shape.domain != twin.domain)
    return {"traits: the float and the double encoder differ"};
  if (shape.in_dims <= 0 || shape.out_dims <= 0) return {"traits: in_dims and out_dims must be positive"};
  return EncoderLaws(encoder32, encoder64, EncoderBuild{}, options).run();
}

Failures field_laws(const Field<float>& field32, const Field<double>& field64, const FieldBuild& build,
                    const LawOptions& options) {
  const FieldTraits shape = field32.traits(), twin = field64.traits();
  if (shape.feature_dims != twin.feature_dims || shape.uses_direction != twin.uses_direction)
    return {"traits: the float and the double field differ"};
  if (shape.uses_direction && build.direction_dims == 0)
    return {"traits: uses a direction that the build does not give"};
  return FieldLaws(field32, field64, build, options).run();
}

Failures head_laws(const Head<float>& single, const Head<double>& oracle, const HeadBuild& build,
                   const LawOptions& options) {
  return HeadLaws(single, oracle, build, options).run();
}

}  // namespace semfield::testkit
