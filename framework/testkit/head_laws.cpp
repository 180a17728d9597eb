// The laws of heads.
#include <algorithm>
#include <cmath>

#include "testkit/compare.h"
#include "testkit/field_bench.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr std::int64_t kFewFeatures = 33;

// A head with tensors, inputs of `rows` rows and guarded outputs: per sample, then the output layer on the same rows as
// if each were a ray.
template <class Real>
struct HeadBench {
  HeadBench(const Head<Real>& head_in, const HeadBuild& build, std::int64_t rows, std::int32_t padding,
            const LawOptions& options)
      : head(head_in),
        workspace(scratch_of<Real>(options)),
        box(head_in, options.seed),
        feature(rows, build.feature_dims, padding),
        hidden(rows, head.hidden_width(), padding),
        out(rows, head.width(), padding),
        d_out(rows, head.width(), padding),
        d_hidden(rows, head.hidden_width(), padding),
        d_feature(rows, build.feature_dims, padding),
        opacity(rows, 1),
        d_opacity(rows, 1) {
    const std::uint64_t seed = options.seed;
    ctx.seed = seed;
    ctx.workspace = &workspace;
    fill_uniform(feature.view(), "testkit/head_feature", seed);
    fill_uniform(d_out.view(), "testkit/head_output_weights", seed);
    fill_uniform(opacity.view(), "testkit/head_opacity", seed);
    for (std::int64_t r = 0; r < rows; ++r) opacity(r, 0) = std::abs(opacity(r, 0));
    head.derive(ctx, box.tensors());
  }
  void forward() {
    head.hidden_forward(ctx, box.tensors(), feature.view(), hidden.view());
    head.output_forward(ctx, box.tensors(), hidden.view(), opacity.view(), out.view());
  }
  void backward() {
    head.output_backward(ctx, box.tensors(), hidden.view(), opacity.view(), d_out.view(), d_hidden.view(),
                         d_opacity.view());
    head.hidden_backward(ctx, box.tensors(), feature.view(), hidden.view(), d_hidden.view(), d_feature.view());
    head.derive_backward(ctx, box.tensors());
  }
  void step() { forward(), backward(); }
  double loss() {
    head.derive(ctx, box.tensors());
    forward();
    return weighted_sum(d_out, out);
  }

  const Head<Real>& head;
  Workspace workspace;
  StepContext ctx;
  TensorBox<Real> box;
  Guarded<Real> feature, hidden, out, d_out, d_hidden, d_feature, opacity, d_opacity;
};

template <class Real>
void check_written(const Head<Real>& head, const HeadBuild& build, const LawOptions& options, Failures& failures) {
  for (const std::int64_t rows : {std::int64_t{0}, std::int64_t{1}, std::int64_t{31}, kFewFeatures}) {
    HeadBench<Real> bench(head, build, rows, 3, options);
    bench.step();
    const std::string law = std::to_string(rows) + " rows, padded";
    for (const Guarded<Real>* each : {&bench.hidden, &bench.out, &bench.d_hidden, &bench.d_feature, &bench.d_opacity}) {
      note_failure(failures, law + ", every element written", each->unwritten());
      note_failure(failures, law + ", outputs stay inside", each->broken_guard());
    }
  }
}

// Compositing stands between the activations and the output layer, which must therefore be linear.
void check_linear(const Head<double>& head, const HeadBuild& build, const LawOptions& options, Failures& failures) {
  HeadBench<double> a(head, build, kFewFeatures, 0, options), b(head, build, kFewFeatures, 0, options),
      sum(head, build, kFewFeatures, 0, options);
  fill_uniform(a.hidden.view(), "testkit/head_h_1", options.seed);
  fill_uniform(b.hidden.view(), "testkit/head_h_2", options.seed);
  fill_uniform(b.opacity.view(), "testkit/head_opacity_2", options.seed);
  const auto output = [&](HeadBench<double>& of) {
    head.output_forward(of.ctx, of.box.tensors(), of.hidden.view(), of.opacity.view(), of.out.view());
  };
  for (std::int64_t r = 0; r < kFewFeatures; ++r) {
    sum.opacity(r, 0) = 2 * a.opacity(r, 0) - 3 * b.opacity(r, 0);
    for (std::int32_t c = 0; c < sum.hidden.cols(); ++c) sum.hidden(r, c) = 2 * a.hidden(r, c) - 3 * b.hidden(r, c);
  }
  output(a), output(b), output(sum);
  Guarded<double> wanted(kFewFeatures, head.width());
  for (std::int64_t r = 0; r < kFewFeatures; ++r)
    for (std::int32_t c = 0; c < head.width(); ++c) wanted(r, c) = 2 * a.out(r, c) - 3 * b.out(r, c);
  note_failure(failures, "the output is linear in activations and opacity",
               compare<double, double>(sum.out.view(), wanted.view(), 1e-10));
  // Without an opacity each row stands for a sample, whose opacity is 1.
  HeadBench<double> ones(head, build, kFewFeatures, 0, options), none(head, build, kFewFeatures, 0, options);
  ones.opacity.fill(1);
  ones.forward();
  none.forward();
  head.output_forward(none.ctx, none.box.tensors(), none.hidden.view(), {}, none.out.view());
  note_failure(failures, "no opacity is an opacity of 1",
               compare<double, double>(none.out.view(), ones.out.view(), 1e-12));
}

void check_accumulates(const Head<double>& head, const HeadBuild& build, const LawOptions& options,
                       Failures& failures) {
  HeadBench<double> once(head, build, kFewFeatures, 0, options), twice(head, build, kFewFeatures, 0, options);
  once.step();
  twice.step();
  twice.step();
  for (std::size_t i = 0; i < once.box.count(); ++i) {
    const View<double> grad = once.box.grad(i);
    for (std::int64_t e = 0; e < grad.size(); ++e) grad.data[e] *= 2;
  }
  compare_learned(failures, "gradients accumulate, ", twice.box, once.box,
                  [](auto got, auto want) { return compare(got, want, 1e-9); });
}

// Each row of a batch has the bits that it has alone.
void check_split(const Head<float>& head, const HeadBuild& build, const LawOptions& options, Failures& failures) {
  HeadBench<float> whole(head, build, kFewFeatures, 0, options), part(head, build, kFewFeatures, 0, options);
  whole.forward();
  for (const auto& [begin, count] : {std::pair<std::int64_t, std::int64_t>{0, 5}, {5, kFewFeatures - 5}}) {
    head.hidden_forward(part.ctx, part.box.tensors(), part.feature.view().row_range(begin, count),
                        part.hidden.view().row_range(begin, count));
    head.output_forward(part.ctx, part.box.tensors(), part.hidden.view().row_range(begin, count),
                        part.opacity.view().row_range(begin, count), part.out.view().row_range(begin, count));
  }
  note_failure(failures, "rows are independent",
               options.same_bits_in_parts
                   ? compare_bits<float>(part.out.view(), whole.out.view())
                   : compare<float, float>(part.out.view(), whole.out.view(), options.float_tolerance));
}

void check_precision(const Head<float>& single, const Head<double>& oracle, const HeadBuild& build,
                     const LawOptions& options, Failures& failures) {
  HeadBench<float> narrow(single, build, kFewFeatures, 0, options);
  HeadBench<double> wide(oracle, build, kFewFeatures, 0, options);
  narrow.step();
  wide.step();
  const auto close = [&](View<const float> got, View<const double> want) {
    return compare(got, want, options.float_tolerance);
  };
  note_failure(failures, "float against double, channel", close(narrow.out.view(), wide.out.view()));
  note_failure(failures, "float against double, gradient of the feature",
               close(narrow.d_feature.view(), wide.d_feature.view()));
  compare_learned(failures, "float against double, gradient of ", narrow.box, wide.box, close);
}

}  // namespace

Failures head_laws(const Head<float>& single, const Head<double>& oracle, const HeadBuild& build,
                   const LawOptions& options) {
  Failures failures;
  if (single.width() != build.width || oracle.width() != build.width)
    note_failure(failures, "width", std::to_string(single.width()) + " columns, not " + std::to_string(build.width));
  check_written(single, build, options, failures);
  check_written(oracle, build, options, failures);
  check_linear(oracle, build, options, failures);
  HeadBench<double> bench(oracle, build, kFewFeatures, 0, options);
  check_gradients(bench, options,
                  {{"the feature", bench.feature.view(), bench.d_feature.view()},
                   {"the opacity", bench.opacity.view(), bench.d_opacity.view()}},
                  failures);
  check_accumulates(oracle, build, options, failures);
  check_split(single, build, options, failures);
  check_precision(single, oracle, build, options, failures);
  return failures;
}

}  // namespace semfield::testkit
