// The laws of fields.
#include <cmath>
#include <type_traits>

#include "testkit/compare.h"
#include "testkit/field_bench.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kFieldSampleCounts[] = {0, 1, 31, 33};
constexpr std::int64_t kFew = 33;

struct Setup {
  const FieldBuild& build;
  const LawOptions& options;
};

enum class Of : std::uint8_t { outputs, gradients };

// Within what the precision of the build allows.
template <class A, class B>
std::string close(const Setup& setup, Of of, View<const A> got, View<const B> want) {
  if (setup.build.precision != Precision::bf16) return compare(got, want, setup.options.float_tolerance);
  return of == Of::gradients ? compare_norms(got, want, setup.options.bf16_gradient_tolerance)
                             : compare(got, want, setup.options.bf16_tolerance);
}

// The same numbers from a part of a call (LawOptions::same_bits_in_parts).
template <class Real>
std::string same(const Setup& setup, Of of, View<const Real> got, View<const Real> want) {
  if constexpr (std::is_same_v<Real, float>) {
    if (!setup.options.same_bits_in_parts) return close(setup, of, got, want);
  }
  return compare_bits(got, want);
}

// match(got, want) of the outputs that are wanted; a sentence is noted as "<before><output><after>: ...".
template <class A, class B, class Match>
void compare_outputs(Failures& failures, const std::string& before, const std::string& after, const FieldBench<A>& got,
                     const FieldBench<B>& want, const Match& match, Wanted wanted = {}) {
  if (wanted.sigma) note_failure(failures, before + "sigma" + after, match(got.sigma.view(), want.sigma.view()));
  if (wanted.rgb) note_failure(failures, before + "colour" + after, match(got.rgb.view(), want.rgb.view()));
  if (wanted.feature)
    note_failure(failures, before + "feature" + after, match(got.feature.view(), want.feature.view()));
}

template <class Real>
void check_sizes(const Field<Real>& field, const Setup& setup, std::int64_t samples, std::int32_t padding,
                 Failures& failures) {
  const std::string law = std::to_string(samples) + " samples" + (padding > 0 ? ", stride above cols" : "");
  FieldBench<Real> bench(field, setup.build, samples, padding, setup.options);
  bench.forward();
  note_failure(failures, law + ", every sigma written", bench.sigma.unwritten());
  note_failure(failures, law + ", every colour written", bench.rgb.unwritten());
  note_failure(failures, law + ", every feature written", bench.feature.unwritten());
  for (std::int64_t m = 0; m < samples; ++m) {
    for (std::int32_t c = 0; c < 3; ++c) {
      const Real value = bench.rgb(m, c);
      if (!(value >= 0 && value <= 1)) {
        note_failure(failures, law,
                     "colour " + std::to_string(value) + " of sample " + std::to_string(m) + " is outside [0, 1]");
      }
    }
  }
  bench.backward();
  note_failure(failures, law + ", every d_position written", bench.d_position.unwritten());
  for (const std::string& guard : {bench.sigma.broken_guard(), bench.rgb.broken_guard(), bench.feature.broken_guard(),
                                   bench.d_position.broken_guard()}) {
    note_failure(failures, law + ", outputs stay inside", guard);
  }
}

// sigma and feature have the same bits whatever the direction; a field that says it uses the direction lets it change
// colour.
template <class Real>
void check_direction(const Field<Real>& field, const Setup& setup, Failures& failures) {
  if (setup.build.direction_dims == 0) return;
  FieldBench<Real> plain(field, setup.build, kFew, 0, setup.options);
  plain.forward();
  FieldBench<Real> turned(field, setup.build, kFew, 0, setup.options);
  for (std::int64_t r = 0; r < turned.direction.rows(); ++r) {
    for (std::int32_t c = 0; c < turned.direction.cols(); ++c)
      turned.direction(r, c) = Real(0.5) - turned.direction(r, c);
  }
  turned.forward();
  note_failure(failures, "sigma does not see the direction",
               compare_bits<Real>(turned.sigma.view(), plain.sigma.view()));
  note_failure(failures, "feature does not see the direction",
               compare_bits<Real>(turned.feature.view(), plain.feature.view()));
  const bool changed = !compare_bits<Real>(turned.rgb.view(), plain.rgb.view()).empty();
  if (changed != plain.shape.uses_direction) {
    failures.push_back(std::string("traits: uses_direction is ") +
                       (changed ? "false but the colour changes" : "true but the colour does not change") +
                       " with the direction");
  }
}

// An output that is not wanted changes no other, nor does absent memory for backward.
template <class Real>
void check_wanted(const Field<Real>& field, const Setup& setup, Failures& failures) {
  FieldBench<Real> whole(field, setup.build, kFew, 0, setup.options);
  whole.forward();
  for (const Wanted wanted :
       {Wanted{true, false, false}, Wanted{false, true, false}, Wanted{true, false, true}, Wanted{true, true, false}}) {
    FieldBench<Real> part(field, setup.build, kFew, 0, setup.options);
    field.forward(part.ctx, part.box.values_only(), part.in(), part.out(wanted), {});
    compare_outputs(
        failures, "", " with others unwanted", part, whole,
        [&](auto got, auto want) { return same(setup, Of::outputs, got, want); }, wanted);
  }
}

// A batch cut in two between rays gives the numbers of the whole.
template <class Real>
void check_split(const Field<Real>& field, const Setup& setup, Failures& failures) {
  FieldBench<Real> whole(field, setup.build, kFew, 0, setup.options);
  whole.step();
  FieldBench<Real> split(field, setup.build, kFew, 0, setup.options);
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 15}, {15, kFew - 15}}) {
    const auto part = [begin = begin, count = count](auto view) {
      return view.empty() ? view : view.row_range(begin, count);
    };
    const FieldIn<Real> in = split.in();
    const FieldOut<Real> out = split.out();
    const FieldGrad<Real> weights = split.output_weights();
    const FieldIn<Real> part_in{part(in.position), in.direction, part(in.ray_of_sample)};
    const FieldOut<Real> part_out{part(out.sigma), part(out.rgb), part(out.feature)};
    const FieldGrad<Real> part_weights{part(weights.sigma), part(weights.rgb), part(weights.feature)};
    field.forward(split.ctx, split.box.tensors(), part_in, part_out, split.saved());
    field.backward(split.ctx, split.box.tensors(), part_in, part_out, part_weights, split.saved(),
                   part(split.d_position.view()));
  }
  compare_outputs(failures, "split batch, ", "", split, whole,
                  [&](auto got, auto want) { return same(setup, Of::outputs, got, want); });
  note_failure(failures, "split batch, d_position",
               same<Real>(setup, Of::gradients, split.d_position.view(), whole.d_position.view()));
}

void check_accumulation(const Field<double>& field, const Setup& setup, Failures& failures) {
  FieldBench<double> clean(field, setup.build, kFew, 0, setup.options);
  clean.step();
  FieldBench<double> prefilled(field, setup.build, kFew, 0, setup.options);
  prefilled.box.add_to_grads(3);
  prefilled.d_position.fill(7.0);
  prefilled.step();
  note_failure(failures, "d_position is overwritten",
               compare_bits<double>(prefilled.d_position.view(), clean.d_position.view()));
  prefilled.box.add_to_grads(-3);
  compare_learned(failures, "gradients accumulate, ", prefilled.box, clean.box,
                  [](auto got, auto want) { return compare(got, want, 1e-12, 3.0); });
}

// An absent output gradient counts as zero.
void check_absent_gradients(const Field<double>& field, const Setup& setup, Failures& failures) {
  const Wanted kinds[] = {{true, false, false}, {false, true, false}, {false, false, true}};
  for (const Wanted wanted : kinds) {
    FieldBench<double> absent(field, setup.build, kFew, 0, setup.options);
    absent.forward();
    absent.backward(wanted);
    FieldBench<double> zeros(field, setup.build, kFew, 0, setup.options);
    if (!wanted.sigma) zeros.w_sigma.fill(0);
    if (!wanted.rgb) zeros.w_rgb.fill(0);
    if (!wanted.feature) zeros.w_feature.fill(0);
    zeros.forward();
    zeros.backward();
    note_failure(failures, "absent gradients, d_position",
                 compare<double, double>(absent.d_position.view(), zeros.d_position.view(), 1e-12));
    compare_learned(failures, "absent gradients, ", absent.box, zeros.box,
                    [](auto got, auto want) { return compare(got, want, 1e-12, 1e-3); });
  }
}

void check_precision(const Field<float>& field32, const Field<double>& field64, const Setup& setup,
                     Failures& failures) {
  FieldBench<float> single(field32, setup.build, kFew, 0, setup.options);
  FieldBench<double> twin(field64, setup.build, kFew, 0, setup.options);
  single.step();
  twin.step();
  const auto close_gradients = [&](View<const float> got, View<const double> want) {
    return close(setup, Of::gradients, got, want);
  };
  compare_outputs(failures, "float against double, ", "", single, twin,
                  [&](auto got, auto want) { return close(setup, Of::outputs, got, want); });
  note_failure(failures, "float against double, d_position",
               close_gradients(single.d_position.view(), twin.d_position.view()));
  compare_learned(failures, "float against double, gradient of ", single.box, twin.box, close_gradients);
}

// The same call again gives the same bits, sums over rows included.
void check_repeat(const Field<float>& field, const Setup& setup, Failures& failures) {
  FieldBench<float> once(field, setup.build, setup.options.many_rows, 0, setup.options);
  FieldBench<float> again(field, setup.build, setup.options.many_rows, 0, setup.options);
  once.step();
  again.step();
  compare_outputs(failures, "again, ", "", again, once, compare_bits<float>);
  note_failure(failures, "again, d_position", compare_bits<float>(again.d_position.view(), once.d_position.view()));
  compare_learned(failures, "again, gradient of ", again.box, once.box, same_sums<float>(setup.options));
}

}  // namespace

Failures field_laws(const Field<float>& field32, const Field<double>& field64, const FieldBuild& build,
                    const LawOptions& options) {
  Failures failures;
  const FieldTraits shape = field32.traits();
  const FieldTraits twin = field64.traits();
  if (shape.feature_dims != twin.feature_dims || shape.uses_direction != twin.uses_direction) {
    return {"traits: the float and the double field differ"};
  }
  if (shape.uses_direction && build.direction_dims == 0)
    return {"traits: uses a direction that the build does not give"};
  const Setup setup{build, options};
  for (const std::int64_t samples : kFieldSampleCounts) check_sizes(field32, setup, samples, 0, failures);
  check_sizes(field32, setup, options.many_rows, 0, failures);
  check_sizes(field32, setup, kFew, 5, failures);
  check_sizes(field64, setup, kFew, 5, failures);
  check_direction(field32, setup, failures);
  check_direction(field64, setup, failures);
  check_wanted(field32, setup, failures);
  check_split(field32, setup, failures);
  check_split(field64, setup, failures);
  FieldBench<double> few(field64, build, kFew, 0, options);
  check_gradients(few, options, {{"position", few.position.view(), few.d_position.view()}}, failures);
  check_accumulation(field64, setup, failures);
  check_absent_gradients(field64, setup, failures);
  check_precision(field32, field64, setup, failures);
  check_repeat(field32, setup, failures);
  FieldBench<float> steady(field32, build, 257, 0, options);
  check_steady_state(steady, failures);
  check_costs(field32, build, options, failures);
  return failures;
}

}  // namespace semfield::testkit
