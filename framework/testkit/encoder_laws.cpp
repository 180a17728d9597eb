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
  void step() { forward(), backward(); }
  // sum(dy * y) after derive and forward.
  double loss() {
    encoder.derive(ctx, box.tensors());
    forward();
    return weighted_sum(dy, y);
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
  whole.step();
  EncoderBench<Real> permuted(encoder, kFewRows, 0, options);
  for (std::int64_t r = 0; r < kFewRows; ++r) {
    const std::int64_t from = (r * 7 + 5) % kFewRows;
    for (std::int32_t c = 0; c < permuted.x.cols(); ++c) permuted.x(r, c) = whole.x(from, c);
    for (std::int32_t c = 0; c < permuted.dy.cols(); ++c) permuted.dy(r, c) = whole.dy(from, c);
  }
  permuted.step();
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

// Parameters accumulate, activations assign; and dx is optional without changing the rest.
void check_accumulation(const Encoder<double>& encoder, const LawOptions& options, Failures& failures) {
  EncoderBench<double> clean(encoder, kFewRows, 0, options);
  clean.backward();
  EncoderBench<double> prefilled(encoder, kFewRows, 0, options);
  prefilled.box.add_to_grads(3);
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
  prefilled.box.add_to_grads(-3);
  compare_learned(failures, "gradients accumulate, ", prefilled.box, clean.box,
                  [](auto got, auto want) { return compare(got, want, 1e-12, 3.0); });
  compare_learned(failures, "gradients without dx, ", without_dx.box, clean.box, compare_bits<double>);
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
  compare_learned(failures, "1 and 3 threads, gradient of ", threaded.box, serial.box, same_sums<Real>(options));
}

void check_precision(const Encoder<float>& encoder32, const Encoder<double>& encoder64, const LawOptions& options,
                     Failures& failures) {
  EncoderBench<float> single(encoder32, kFewRows, 0, options);
  EncoderBench<double> twin(encoder64, kFewRows, 0, options);
  single.step();
  twin.step();
  const auto close = [&](View<const float> got, View<const double> want) {
    return compare(got, want, options.float_tolerance);
  };
  note_failure(failures, "float against double, y", close(single.y.view(), twin.y.view()));
  note_failure(failures, "float against double, dx", close(single.dx.view(), twin.dx.view()));
  compare_learned(failures, "float against double, gradient of ", single.box, twin.box, close);
}

void check_scratch(const Encoder<float>& encoder, const LawOptions& options, Failures& failures) {
  if (options.scratch.allocate != nullptr) return;  // a device's memory is not planned ahead
  for (const std::int64_t rows : {std::int64_t{1}, kFewRows, options.many_rows}) {
    EncoderBench<float> bench(encoder, rows, 0, options);
    bench.step();
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
  EncoderBench<double> few(encoder64, kFewRows, 0, options);
  check_gradients(few, options, {{"x", few.x.view(), few.dx.view()}}, failures);
  check_accumulation(encoder64, options, failures);
  check_threads(encoder32, options, failures);
  check_precision(encoder32, encoder64, options, failures);
  EncoderBench<float> many(encoder32, options.many_rows, 0, options);
  check_steady_state(many, failures);
  check_scratch(encoder32, options, failures);
  return failures;
}

}  // namespace semfield::testkit
