// The laws of encoders.
#include <algorithm>
#include <cmath>
#include <numeric>

#include "compute/parallel.h"
#include "core/rng.h"
#include "testkit/compare.h"
#include "testkit/field_bench.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kRowCounts[] = {0, 1, 31, 33};
constexpr std::int64_t kFewRows = 33;

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

// One encoder with tensors, inputs of `rows` rows and guarded outputs.
template <class Real>
struct EncoderBench {
  EncoderBench(const Encoder<Real>& encoder_in, std::int64_t rows, std::int32_t padding, const LawOptions& options)
      : encoder(encoder_in),
        shape(encoder_in.traits()),
        workspace(scratch_of<Real>(options)),
        box(encoder_in, options.seed),
        x(rows, shape.in_dims, padding),
        dy(rows, shape.out_dims, padding),
        y(rows, shape.out_dims, padding),
        dx(rows, shape.in_dims, padding) {
    ctx.seed = options.seed;
    ctx.training = true;
    ctx.workspace = &workspace;
    fill_coordinates(x.view(), shape.domain, options.seed);
    fill_uniform(dy.view(), "testkit/output_weights", options.seed);
    encoder.derive(ctx, box.tensors());
  }
  void forward() { encoder.forward(ctx, box.tensors(), x.view(), y.view()); }
  void backward(bool with_dx = true) {
    encoder.backward(ctx, box.tensors(), x.view(), dy.view(), with_dx ? dx.view() : View<Real>());
    encoder.derive_backward(ctx, box.tensors());
  }
  // sum(dy * y) after derive and forward: the scalar whose gradients backward gives.
  double loss() {
    encoder.derive(ctx, box.tensors());
    forward();
    double sum = 0;
    for (std::int64_t r = 0; r < y.rows(); ++r) {
      for (std::int32_t c = 0; c < y.cols(); ++c) sum += static_cast<double>(dy(r, c)) * static_cast<double>(y(r, c));
    }
    return sum;
  }

  const Encoder<Real>& encoder;
  EncoderTraits shape;
  Workspace workspace;
  StepContext ctx;
  TensorBox<Real> box;
  Guarded<double> x;
  Guarded<Real> dy, y, dx;
};

template <class Real>
void check_rows(const Encoder<Real>& encoder, std::int64_t rows, std::int32_t padding, const LawOptions& options,
                Failures& failures) {
  const std::string law = std::to_string(rows) + " rows" + (padding > 0 ? ", stride above cols" : "");
  EncoderBench<Real> bench(encoder, rows, padding, options);
  bench.forward();
  note_failure(failures, law + ", every output written", bench.y.unwritten());
  note_failure(failures, law + ", outputs stay inside", bench.y.broken_guard());
  bench.backward();
  note_failure(failures, law + ", every dx written", bench.dx.unwritten());
  note_failure(failures, law + ", dx stays inside", bench.dx.broken_guard());
}

// Row r of a batch has the bits it has in a permuted batch and in a batch of its own half.
template <class Real>
void check_rows_independent(const Encoder<Real>& encoder, const LawOptions& options, Failures& failures) {
  EncoderBench<Real> whole(encoder, kFewRows, 0, options);
  whole.forward();
  whole.backward();
  EncoderBench<Real> permuted(encoder, kFewRows, 0, options);
  for (std::int64_t r = 0; r < kFewRows; ++r) {
    const std::int64_t from = (r * 7 + 5) % kFewRows;
    for (std::int32_t c = 0; c < permuted.x.cols(); ++c) permuted.x(r, c) = whole.x(from, c);
    for (std::int32_t c = 0; c < permuted.dy.cols(); ++c) permuted.dy(r, c) = whole.dy(from, c);
  }
  permuted.forward();
  permuted.backward();
  for (std::int64_t r = 0; r < kFewRows; ++r) {
    const std::int64_t from = (r * 7 + 5) % kFewRows;
    note_failure(failures, "permuted rows, y",
                 compare_bits<Real>(permuted.y.view().row_range(r, 1), whole.y.view().row_range(from, 1)));
    note_failure(failures, "permuted rows, dx",
                 compare_bits<Real>(permuted.dx.view().row_range(r, 1), whole.dx.view().row_range(from, 1)));
  }
  EncoderBench<Real> split(encoder, kFewRows, 0, options);
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 13}, {13, kFewRows - 13}}) {
    const auto part = [begin = begin, count = count](auto view) { return view.row_range(begin, count); };
    encoder.forward(split.ctx, split.box.tensors(), part(split.x.view()), part(split.y.view()));
    encoder.backward(split.ctx, split.box.tensors(), part(split.x.view()), part(split.dy.view()),
                     part(split.dx.view()));
  }
  note_failure(failures, "split batch, y", compare_bits<Real>(split.y.view(), whole.y.view()));
  note_failure(failures, "split batch, dx", compare_bits<Real>(split.dx.view(), whole.dx.view()));
}

void check_gradients(const Encoder<double>& encoder, const LawOptions& options, Failures& failures) {
  EncoderBench<double> bench(encoder, kFewRows, 0, options);
  bench.forward();
  bench.backward();
  const auto loss = [&bench] { return bench.loss(); };
  GradientCheck check;
  check.tolerance = options.gradient_tolerance;
  check.seed = options.seed;
  check.max_elements = options.gradient_elements;
  note_failure(failures, "gradient of x", check_gradient(loss, bench.x.view(), bench.dx.view(), check));
  for (std::size_t i = 0; i < bench.box.count(); ++i) {
    if (!bench.box.learned(i)) continue;
    note_failure(failures, "gradient of " + bench.box.specs()[i].name,
                 check_gradient(loss, bench.box.value(i), bench.box.grad(i), check));
  }
}

// Parameters accumulate, activations assign; and dx is optional without changing the rest.
void check_accumulation(const Encoder<double>& encoder, const LawOptions& options, Failures& failures) {
  EncoderBench<double> clean(encoder, kFewRows, 0, options);
  clean.backward();
  EncoderBench<double> prefilled(encoder, kFewRows, 0, options);
  for (std::size_t i = 0; i < prefilled.box.count(); ++i) {
    View<double> grad = prefilled.box.grad(i);
    if (!prefilled.box.learned(i)) continue;
    for (std::int64_t e = 0; e < grad.size(); ++e) grad.data[e] = 3.0;
  }
  prefilled.dx.fill(7.0);
  prefilled.backward();
  note_failure(failures, "dx is overwritten", compare_bits<double>(prefilled.dx.view(), clean.dx.view()));
  if (encoder.traits().gives_dx_alone) {
    EncoderBench<double> alone(encoder, kFewRows, 0, options);
    alone.dx.fill(7.0);
    encoder.backward(alone.ctx, {alone.box.tensors().value, {}}, alone.x.view(), alone.dy.view(), alone.dx.view());
    note_failure(failures, "dx alone", compare_bits<double>(alone.dx.view(), clean.dx.view()));
  }
  EncoderBench<double> without_dx(encoder, kFewRows, 0, options);
  without_dx.backward(false);
  for (std::size_t i = 0; i < clean.box.count(); ++i) {
    if (!clean.box.learned(i)) continue;
    const std::string& name = clean.box.specs()[i].name;
    View<double> grad = prefilled.box.grad(i);
    for (std::int64_t e = 0; e < grad.size(); ++e) grad.data[e] -= 3.0;
    note_failure(failures, "gradients accumulate, " + name,
                 compare<double, double>(grad, clean.box.grad(i), 1e-12, 3.0));
    note_failure(failures, "gradients without dx, " + name,
                 compare_bits<double>(without_dx.box.grad(i), clean.box.grad(i)));
  }
}

template <class Real>
void check_threads(const Encoder<Real>& encoder, const LawOptions& options, Failures& failures) {
  const int kept = thread_count();
  set_thread_count(1);
  EncoderBench<Real> serial(encoder, options.many_rows, 0, options);
  serial.backward();
  set_thread_count(3);
  EncoderBench<Real> threaded(encoder, options.many_rows, 0, options);
  threaded.backward();
  set_thread_count(kept);
  note_failure(failures, "1 and 3 threads, dx", compare_bits<Real>(threaded.dx.view(), serial.dx.view()));
  for (std::size_t i = 0; i < serial.box.count(); ++i) {
    if (!serial.box.learned(i)) continue;
    note_failure(failures, "1 and 3 threads, gradient of " + serial.box.specs()[i].name,
                 options.same_bits_of_sums
                     ? compare_bits<Real>(threaded.box.grad(i), serial.box.grad(i))
                     : compare<Real, Real>(threaded.box.grad(i), serial.box.grad(i), options.float_tolerance));
  }
}

void check_precision(const Encoder<float>& encoder32, const Encoder<double>& encoder64, const LawOptions& options,
                     Failures& failures) {
  EncoderBench<float> single(encoder32, kFewRows, 0, options);
  EncoderBench<double> twin(encoder64, kFewRows, 0, options);
  single.forward();
  twin.forward();
  single.backward();
  twin.backward();
  const double tolerance = options.float_tolerance;
  note_failure(failures, "float against double, y", compare<float, double>(single.y.view(), twin.y.view(), tolerance));
  note_failure(failures, "float against double, dx",
               compare<float, double>(single.dx.view(), twin.dx.view(), tolerance));
  for (std::size_t i = 0; i < twin.box.count(); ++i) {
    if (!twin.box.learned(i)) continue;
    note_failure(failures, "float against double, gradient of " + twin.box.specs()[i].name,
                 compare<float, double>(single.box.grad(i), twin.box.grad(i), tolerance));
  }
}

void check_steady_state(const Encoder<float>& encoder, const LawOptions& options, Failures& failures) {
  EncoderBench<float> bench(encoder, options.many_rows, 0, options);
  for (int warm_up = 0; warm_up < 2; ++warm_up) {
    bench.forward();
    bench.backward();
  }
  const std::int64_t growths = bench.workspace.growth_count();
  bench.forward();
  bench.backward();
  if (bench.workspace.growth_count() != growths) {
    failures.push_back("steady state: the workspace still grows in the third step; is a Workspace::Scope missing?");
  }
}

void check_scratch(const Encoder<float>& encoder, const LawOptions& options, Failures& failures) {
  if (options.scratch.allocate != nullptr) return;  // a device's memory is not planned ahead
  for (const std::int64_t rows : {std::int64_t{1}, kFewRows, options.many_rows}) {
    EncoderBench<float> bench(encoder, rows, 0, options);
    bench.forward();
    bench.backward();
    note_failure(
        failures, "scratch_bytes, " + std::to_string(rows) + " rows",
        scratch_failure(encoder.scratch_bytes(rows), bench.workspace.high_water_bytes(), rows == options.many_rows));
  }
}

}  // namespace

Failures encoder_laws(const Encoder<float>& encoder32, const Encoder<double>& encoder64, const LawOptions& options) {
  Failures failures;
  const EncoderTraits shape = encoder32.traits();
  const EncoderTraits twin = encoder64.traits();
  if (shape.in_dims != twin.in_dims || shape.out_dims != twin.out_dims || shape.domain != twin.domain) {
    return {"traits: the float and the double encoder differ"};
  }
  if (shape.in_dims <= 0 || shape.out_dims <= 0) return {"traits: in_dims and out_dims must be positive"};
  for (const std::int64_t rows : kRowCounts) check_rows(encoder32, rows, 0, options, failures);
  check_rows(encoder32, options.many_rows, 0, options, failures);
  check_rows(encoder32, kFewRows, 5, options, failures);
  check_rows(encoder64, kFewRows, 5, options, failures);
  check_rows_independent(encoder32, options, failures);
  check_rows_independent(encoder64, options, failures);
  check_gradients(encoder64, options, failures);
  check_accumulation(encoder64, options, failures);
  check_threads(encoder32, options, failures);
  check_precision(encoder32, encoder64, options, failures);
  check_steady_state(encoder32, options, failures);
  check_scratch(encoder32, options, failures);
  return failures;
}

Failures encoder_laws(const Registry& registry, const std::string& name, const Settings& settings,
                      const EncoderBuild& build, const LawOptions& options) {
  const PluginEntry& entry = registry.get(PluginKind::encoder, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  const auto encoder32 = entry.encoder32(*params, build, registry.kernels());
  const auto encoder64 = entry.encoder64(*params, build, registry.kernels());
  return encoder_laws(*encoder32, *encoder64, options);
}

}  // namespace semfield::testkit
