// What the files of group D share.

#include <fmt/format.h>

#include <algorithm>
#include <cstring>
#include <utility>

#include "compute/math_functions.h"
#include "formats/image_io.h"
#include "formats/safetensors.h"
#include "model/losses/semantic_cross_entropy.h"
#include "named_case.h"
#include "plugin/head.h"
#include "rooms.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"
#include "tests/encoder_box.h"
#include "tests/model/adam_rows.h"
#include "tests/model/rays_of_slabs.h"

namespace semfield::numerics {

/// |got - want| / |want| beyond `quanta` of the smallest number of Real: what lies below the normal range has fewer
/// digits, or none.
template <class Real>
double error_above_quantum(long double got, long double want, double quanta = 0.51) {
  const auto quantum = long_double(std::numeric_limits<Real>::denorm_min());
  const long double off = std::abs(got - want) - quantum * long_double(quanta);
  if (std::isnan(off)) return std::numeric_limits<double>::infinity();
  return off <= 0 ? 0.0 : relative_error(off + std::abs(want), std::abs(want));
}

template <class Real>
View<const Real> row_of(const std::vector<Real>& values) {
  return {values.data(), 1, static_cast<std::int32_t>(values.size())};
}
template <class Real>
View<Real> row_of(std::vector<Real>& values) {
  return {values.data(), 1, static_cast<std::int32_t>(values.size())};
}

// Cases D01 to D04, D06, D10, D12 and D13: cross-entropy, softmax and entropy.

namespace {

/// Softmax of one row in long double, by differences to the largest logit.
struct Softmax {
  long double largest = 0, rest = 0;  ///< sum of the others' e^(s - largest)
  std::size_t argmax = 0;
  std::vector<long double> p;
  long double entropy = 0;

  template <class Real>
  explicit Softmax(const std::vector<Real>& s) {
    argmax = static_cast<std::size_t>(std::max_element(s.begin(), s.end()) - s.begin());
    largest = long_double(s[argmax]);
    for (std::size_t c = 0; c < s.size(); ++c) {
      p.push_back(c == argmax ? 1.0L : std::exp(long_double(s[c]) - largest));
      rest += c == argmax ? 0.0L : p.back();
    }
    entropy = std::log1p(rest);
    for (std::size_t c = 0; c < s.size(); ++c) {
      p[c] /= 1 + rest;
      if (p[c] > 0) entropy += p[c] * (largest - long_double(s[c]));
    }
  }
  template <class Real>
  long double surprise(const std::vector<Real>& s, std::size_t label) const {
    return (largest - long_double(s[label])) + std::log1p(rest);
  }
  /// p - [label], without the cancellation of a row that is almost certain.
  long double slope(std::size_t c, std::size_t label) const {
    if (c != label) return p[c];
    return c == argmax ? -rest / (1 + rest) : p[c] - 1;
  }
};

template <class Real>
SemanticLoss loss_of(const std::vector<Real>& logits, std::int16_t label, std::vector<Real>* gradient,
                     View<const float> weights = {}) {
  SemanticTargets targets{.hard = {&label, 1, 1}};
  return semantic_cross_entropy<Real>(row_of(logits), targets, weights, 1.0, 1.0,
                                      gradient != nullptr ? row_of(*gradient) : View<Real>());
}

template <class Real>
std::vector<Real> softmax_of(const std::vector<Real>& logits) {
  std::vector<Real> p(logits.size());
  softmax<Real>(row_of(logits), row_of(p));
  return p;
}

template <class Real>
Real entropy_of(const std::vector<Real>& logits) {
  Real h = -1;
  softmax_entropy<Real>(row_of(logits), View<Real>(&h, 1, 1));
  return h;
}

/// Logits of size C: one class at v, one at -v, a ramp, alternating signs.
template <class Real>
std::vector<std::vector<Real>> patterns(std::size_t classes, double v) {
  std::vector<std::vector<Real>> rows(4, std::vector<Real>(classes, Real(0)));
  rows[0][classes / 2] = static_cast<Real>(v);
  rows[1][classes - 1] = static_cast<Real>(-v);
  for (std::size_t c = 0; c < classes; ++c) {
    rows[2][c] = static_cast<Real>(v * (2 * static_cast<double>(c) / static_cast<double>(classes - 1) - 1));
    rows[3][c] = static_cast<Real>(c % 2 == 0 ? v : -v);
  }
  return rows;
}

template <class Real>
void check_row(CaseRun& run, const std::vector<Real>& s) {
  const Softmax want(s);
  const auto quanta = static_cast<double>(s.size());
  // Terms are p (largest - s): below the normal range of double the quantum counts that many times, up to 745.
  const double entropy_quanta = std::is_same_v<Real, double> ? 745 * quanta : 1;
  run.measure(error_above_quantum<Real>(entropy_of(s), want.entropy, entropy_quanta), tolerance_of<Real>(1e-6),
              "entropy");
  const std::vector<Real> p = softmax_of(s);
  for (std::size_t c = 0; c < s.size(); ++c)
    run.measure(error_above_quantum<Real>(p[c], want.p[c], quanta), tolerance_of<Real>(1e-6), "probability");
  for (const std::size_t label : {std::size_t{0}, s.size() / 2, s.size() - 1}) {
    const auto y = static_cast<std::int16_t>(label);
    std::vector<Real> gradient(s.size());
    // The sum is double whatever Real is; with a gradient the exponentials are Real's.
    for (const double sum : {loss_of<Real>(s, y, nullptr).sum, loss_of<Real>(s, y, &gradient).sum})
      run.measure(error_above_quantum<double>(sum, want.surprise(s, label), quanta), tolerance_of<Real>(1e-6),
                  "cross-entropy");
    for (std::size_t c = 0; c < s.size(); ++c) {
      // The difference of two logits is rounded once, half an ulp of up to |s_c - largest|.
      const double rounded = std::min(200.0, std::abs(static_cast<double>(s[c]) - static_cast<double>(want.largest)));
      const double unit = static_cast<double>(std::numeric_limits<Real>::epsilon()) / 2;
      run.measure(error_above_quantum<Real>(gradient[c], want.slope(c, label), quanta),
                  tolerance_of<Real>(1e-6) + unit * rounded, "gradient");
    }
  }
}

}  // namespace

IN_BOTH_PRECISIONS(logit_sweep) {
  for (const std::size_t classes : {2u, 3u, 13u, 28u, 88u, 256u, 1024u}) {
    for (const double v : {0.0, 11.0, 88.0, 89.0, 1e4, 1e30}) {
      for (const std::vector<Real>& s : patterns<Real>(classes, v)) check_row(run, s);
    }
  }
}

IN_BOTH_PRECISIONS(infinite_logit) {
  const Real infinity = std::numeric_limits<Real>::infinity();
  for (const Real bad : {infinity, -infinity, std::numeric_limits<Real>::quiet_NaN()}) {
    for (const std::size_t place : {0u, 5u, 27u}) {
      for (const bool two : {false, true}) {
        std::vector<Real> s(28, Real(1)), out(28);
        s[place] = bad;
        if (two) s[27] = bad;
        const std::vector<std::string> words{"ray 0", fmt::format("class {} ", place), "finite"};
        run.expect_error(ErrorKind::failure, words, [&] { loss_of<Real>(s, 3, nullptr); });
        run.expect_error(ErrorKind::failure, words, [&] { loss_of<Real>(s, 3, &out); });
        run.expect_error(ErrorKind::failure, words, [&] { softmax_of(s); });
        run.expect_error(ErrorKind::failure, words, [&] { entropy_of(s); });
      }
    }
  }
}

IN_BOTH_PRECISIONS(one_hot_entropy) {
  for (const std::size_t classes : {2u, 28u, 1024u}) {
    for (const Real v : {Real(1e4), Real(1e30)}) {
      std::vector<Real> s(classes, Real(0)), gradient(classes, Real(-9));
      s[1] = v;
      run.measure(static_cast<double>(entropy_of(s)), 0, "entropy");
      const std::vector<Real> p = softmax_of(s);
      for (std::size_t c = 0; c < classes; ++c) run.near(p[c], c == 1 ? 1 : 0, 0, "probability");
      run.measure(loss_of<Real>(s, 1, &gradient).sum, 0, "loss");
      for (const Real g : gradient) run.measure(std::abs(g), 0, "gradient");
    }
  }
}

IN_BOTH_PRECISIONS(one_class) {
  for (const Real v : {Real(0), Real(-7), Real(89), Real(1e30)}) {
    const std::vector<Real> s{v};
    std::vector<Real> gradient{Real(-9)};
    run.measure(loss_of<Real>(s, 0, &gradient).sum, 0, "loss");
    run.measure(std::abs(gradient[0]), 0, "gradient");
    run.measure(static_cast<double>(entropy_of(s)), 0, "entropy");
    run.near(softmax_of(s)[0], 1, 0, "probability");
  }
}

IN_BOTH_PRECISIONS(one_labelled) {
  constexpr std::int64_t kRays = 1024;
  constexpr std::int32_t kClasses = 28;
  Numbers numbers(31);
  std::vector<Real> logits, one;
  for (std::int64_t i = 0; i < kRays * kClasses; ++i) logits.push_back(static_cast<Real>(numbers.in(-5, 5)));
  std::vector<std::int16_t> label(kRays, -1);
  label[700] = 9;
  one.assign(logits.begin() + 700 * kClasses, logits.begin() + 701 * kClasses);
  const Softmax want(one);
  SemanticTargets targets{.hard = {label.data(), kRays, 1}};
  const std::pair<SemanticNormalisation, long double> kinds[] = {{SemanticNormalisation::sum, 1},
                                                                 {SemanticNormalisation::mean_labelled, 1},
                                                                 {SemanticNormalisation::mean_rays, kRays}};
  double first = 0;
  for (const auto& [kind, divisor] : kinds) {
    const double normaliser = semantic_normaliser(kind, labelled_weight(targets, {}), kRays);
    run.relative(normaliser, divisor, 0, "normaliser");
    std::vector<Real> gradient(logits.size(), Real(-9));
    const SemanticLoss loss = semantic_cross_entropy<Real>({logits.data(), kRays, kClasses}, targets, {}, normaliser,
                                                           1.0, {gradient.data(), kRays, kClasses});
    const double value = loss.sum / normaliser;
    run.expect(loss.labelled == 1, "one ray is labelled");
    run.relative(value, want.surprise(one, 9) / divisor, tolerance_of<Real>(1e-6), "loss");
    if (first == 0) first = value;
    run.near(value * static_cast<double>(divisor), first, 0, "ratio 1 : 1 : 1/1,024");
    for (std::size_t i = 0; i < gradient.size(); ++i) {
      const std::size_t ray = i / kClasses;
      const long double slope = ray == 700 ? want.slope(i % kClasses, 9) / divisor : 0.0L;
      run.relative(gradient[i], slope, ray == 700 ? tolerance_of<Real>(1e-6) : 0.0, "gradient");
    }
  }
}

IN_BOTH_PRECISIONS(soft_labels) {
  Numbers numbers(32);
  for (const double total : {0.9, 1.0, 1.1, 1e-20, 1e20}) {
    std::vector<Real> s;
    std::vector<float> target;
    long double sum = 0;
    for (int c = 0; c < 28; ++c) {
      s.push_back(static_cast<Real>(numbers.in(-5, 5)));
      target.push_back(c % 3 == 0 ? 0.f : static_cast<float>(numbers.uniform() * total / 9));
      sum += long_double(target.back());
    }
    const Softmax row(s);
    long double want = 0;
    for (std::size_t c = 0; c < s.size(); ++c) want += long_double(target[c]) / sum * row.surprise(s, c);
    SemanticTargets targets{.soft = row_of(std::as_const(target))};
    std::vector<Real> gradient(s.size());
    const double loss =
        semantic_cross_entropy<Real>(row_of(std::as_const(s)), targets, {}, 1.0, 1.0, row_of(gradient)).sum;
    run.relative(loss, want, tolerance_of<Real>(1e-6), "loss");
    for (std::size_t c = 0; c < s.size(); ++c) {
      const long double slope = row.p[c] - long_double(target[c]) / sum;
      run.near(gradient[c], slope, tolerance_of<Real>(1e-7), "gradient");
    }
    run.near(labelled_weight(targets, {}), 1, 0, "a soft row counts once");
  }
  const std::vector<Real> s(4, Real(1));
  const std::vector<float> zeros(4, 0.f);
  SemanticTargets none{.soft = row_of(zeros)};
  std::vector<Real> gradient(4, Real(-9));
  const SemanticLoss unlabelled = semantic_cross_entropy<Real>(row_of(s), none, {}, 1.0, 1.0, row_of(gradient));
  run.measure(unlabelled.sum, 0, "a row of zeros is unlabelled");
  for (const Real g : gradient) run.measure(std::abs(g), 0, "its gradient");
  for (const float bad : {-0.1f, std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    std::vector<float> p(4, 0.25f);
    p[2] = bad;
    SemanticTargets refused{.soft = row_of(std::as_const(p))};
    run.expect_error(ErrorKind::data, {"ray 0", "class 2"},
                     [&] { semantic_cross_entropy<Real>(row_of(s), refused, {}, 1.0, 1.0, row_of(gradient)); });
    run.expect_error(ErrorKind::data, {"ray 0", "class 2"}, [&] { labelled_weight(refused, {}); });
  }
  run.note("rows are divided by their sum; negative and non-finite values are refused");
}

void class_weights(CaseRun& run) {
  run.row("fp32");
  const std::vector<std::vector<std::int64_t>> tables{
      {0, 0, 5, 1000000}, {0}, {0, 0}, {1, 1}, {0, std::int64_t{1} << 62}};
  for (const std::vector<std::int64_t>& pixels : tables) {
    long double total = 0;
    for (const std::int64_t n : pixels) total += long_double(n);
    const std::vector<float> weights = inverse_log_frequency_weights(pixels);
    for (std::size_t c = 0; c < pixels.size(); ++c) {
      const long double frequency = total > 0 ? long_double(pixels[c]) / total : 0.0L;
      run.relative(weights[c], 1 / std::log(1.02L + frequency), 1e-6, "weight");
      run.expect(weights[c] > 0 && weights[c] <= 50.5f, "at most 1 / ln 1.02");
    }
  }
  const std::vector<double> logits{0.3, -0.2};
  const std::vector<float> weights{0.5f, 2.f};
  for (const std::int16_t label : {0, 1}) {
    const double weight = static_cast<double>(weights[static_cast<std::size_t>(label)]);
    std::vector<double> plain(2), weighted(2);
    const double sum = loss_of<double>(logits, label, &plain).sum;
    run.near(loss_of<double>(logits, label, &weighted, row_of(weights)).sum, weight * sum, 1e-15, "loss");
    for (std::size_t c = 0; c < 2; ++c) run.near(weighted[c], weight * plain[c], 1e-15, "gradient");
    run.near(labelled_weight({.hard = {&label, 1, 1}}, row_of(weights)), weight, 0, "labelled weight");
  }
  run.note(fmt::format("an absent class weighs {:.4f}", inverse_log_frequency_weights({0, 1})[0]));
}

IN_BOTH_PRECISIONS(double_softmax) {
  // What reaches the loss are logits: a margin of 40 costs e^-40. Were they probabilities by the time (softmax of
  // softmax), no margin could bring 28 classes below ln(1 + 27 / e) = 2.39.
  std::vector<Real> s(28, Real(0)), gradient(28);
  s[4] = 40;
  const long double want = std::log1p(27 * std::exp(-40.0L));
  run.relative(loss_of<Real>(s, 4, &gradient).sum, want, tolerance_of<Real>(1e-6), "cross-entropy of a margin of 40");
  const std::vector<Real> twice = softmax_of(s);
  const double floor = std::log1p(27 * std::exp(-1.0));
  run.relative(loss_of<Real>(twice, 4, nullptr).sum, floor, tolerance_of<Real>(1e-6),
               "what a second softmax would give");
  run.expect(!std::is_invocable_v<decltype(&semantic_cross_entropy<Real>), View<Real>, View<const float>,
                                  View<const float>, double, double, View<Real>, std::int64_t>,
             "bare probabilities are no targets to the compiler");
  run.note(fmt::format(
      "2nd softmax would cost {:.3f}; logits and probabilities share a view type, so this is shown by value", floor));
}

// Cases D14 to D17: activations of colour and density, and colour targets out of range.

namespace {

constexpr DensityActivation kActivations[] = {DensityActivation::relu, DensityActivation::softplus,
                                              DensityActivation::trunc_exp};

std::string name_of(DensityActivation kind) {
  return std::string(ChoiceNames<DensityActivation>::names[static_cast<std::size_t>(kind)]);
}

template <class Real>
View<const Real> column(const std::vector<Real>& v) {
  return {v.data(), static_cast<std::int64_t>(v.size()), 1};
}
template <class Real>
View<Real> column(std::vector<Real>& v) {
  return {v.data(), static_cast<std::int64_t>(v.size()), 1};
}

template <class Real>
std::vector<Real> density_of(DensityActivation kind, std::vector<Real> raw) {
  std::vector<Real> sigma(raw.size(), Real(-9));
  density_forward<Real>({kind}, nullptr, column(raw), column(sigma));
  return sigma;
}
/// d_raw for d_sigma = 1.
template <class Real>
std::vector<Real> density_slope(DensityActivation kind, const std::vector<Real>& raw) {
  std::vector<Real> slope(raw.size(), Real(-9));
  const std::vector<Real> ones(raw.size(), Real(1));
  density_backward<Real>({kind}, column(raw), column(ones), column(slope));
  return slope;
}

long double sigmoid_of(long double x) {
  const long double e = std::exp(-std::abs(x));
  return (x < 0 ? e : 1.0L) / (1 + e);
}
long double density_reference(DensityActivation kind, long double x) {
  if (kind == DensityActivation::relu) return std::max(x, 0.0L);
  if (kind == DensityActivation::softplus) return std::max(x, 0.0L) + std::log1p(std::exp(-std::abs(x)));
  return std::exp(std::min(x, 15.0L));
}
long double slope_reference(DensityActivation kind, long double x) {
  if (kind == DensityActivation::relu) return x > 0 ? 1.0L : 0.0L;
  return kind == DensityActivation::softplus ? sigmoid_of(x) : std::exp(std::min(x, 15.0L));
}

template <class Real>
auto make_field(const Registry& registry, const std::string& name, const FieldBuild& build) {
  const testkit::Settings settings =
      name == "nerf_mlp" ? testkit::Settings{{"depth", "4"}, {"skip_at", "2"}, {"width", "16"}, {"view_width", "16"}}
                         : testkit::Settings{{"hidden_width", "16"}, {"color_width", "16"}};
  return testkit::make_part<Real>(registry, name, settings, build);
}

/// Colour and its bias gradient of a field whose colour layer has bias `raw` and no weights, for dL/drgb = 1.
template <class Real>
void check_saturated_field(CaseRun& run, const std::string& name, Precision precision, Real raw) {
  FieldBuild build{.position_dims = 6, .direction_dims = 4, .precision = precision};
  const auto field = make_field<Real>(run.registry(), name, build);
  testkit::TensorBox<Real> box(*field, 1);
  int bias = -1;
  for (std::size_t i = 0; i < box.count(); ++i) {
    const std::string& tensor = box.specs()[i].name;
    if (!(tensor.starts_with("rgb/") || tensor.starts_with("color/")) || !box.learned(i)) continue;
    const bool is_bias = tensor.ends_with("bias");
    if (is_bias) bias = static_cast<int>(i);
    for (std::int64_t e = 0; e < box.value(i).size(); ++e) box.value(i).data[e] = is_bias ? raw : Real(0);
  }
  run.expect(bias >= 0, name + " has a colour bias");
  if (bias < 0) return;
  constexpr int kSamples = 5;
  Workspace workspace;
  StepContext ctx{.workspace = &workspace};
  field->derive(ctx, box.tensors());
  std::vector<Real> position(6 * kSamples, Real(0.3)), direction(4, Real(0.5)), sigma(kSamples), rgb(3 * kSamples);
  std::vector<Real> feature(static_cast<std::size_t>(kSamples * field->traits().feature_dims));
  const std::vector<std::int32_t> ray(kSamples, 0);
  const FieldIn<Real> in{{position.data(), kSamples, 6}, {direction.data(), 1, 4}, {ray.data(), kSamples, 1}};
  const FieldOut<Real> out{
      column(sigma), {rgb.data(), kSamples, 3}, {feature.data(), kSamples, field->traits().feature_dims}};
  const View<std::byte> saved =
      workspace.take<std::byte>(1, static_cast<std::int32_t>(field->saved_bytes(kSamples, 1)));
  const Saved memory(saved.data, static_cast<std::size_t>(saved.cols));
  field->forward(ctx, box.tensors(), in, out, memory);
  const std::vector<Real> ones(3 * kSamples, Real(1));
  FieldGrad<Real> grad{.rgb = {ones.data(), kSamples, 3}};
  field->backward(ctx, box.tensors(), in, out, grad, memory, {});
  field->derive_backward(ctx, box.tensors());
  const long double y = sigmoid_of(long_double(raw));
  for (const Real c : rgb) {
    run.expect(c >= 0 && c <= 1, "a colour lies in 0..1");
    run.measure(error_above_quantum<Real>(c, y), tolerance_of<Real>(1e-6), "colour");
  }
  for (int c = 0; c < 3; ++c) {
    const Real g = box.grad(static_cast<std::size_t>(bias))(0, c);
    run.expect(std::isfinite(g) && g >= 0, "a saturated gradient is finite and not negative");
    // 1 - y is taken from the rounded y: absolute, not relative.
    run.near(g, kSamples * y * (1 - y), tolerance_of<Real>(1e-6), "colour gradient");
  }
}

}  // namespace

void saturated_sigmoid(CaseRun& run) {
  const auto sweep = [&]<class Real>(Real, Precision precision) {
    for (const char* name : {"tiny_mlp", "nerf_mlp"}) {
      for (const double raw : {0.0, 10.0, -10.0, 17.0, 89.0, -89.0, 100.0, -100.0, 1e4, -1e4})
        check_saturated_field<Real>(run, name, precision, static_cast<Real>(raw));
    }
  };
  in_both_precisions(run, [&]<class Real>(Real) {
    std::vector<Real> x, y;
    for (int i = -1200; i <= 1200; ++i) x.push_back(static_cast<Real>(i) / Real(8));
    y = x;
    sigmoid_inplace<Real>(y.data(), static_cast<std::int64_t>(y.size()));
    for (std::size_t i = 0; i < x.size(); ++i) {
      run.measure(error_above_quantum<Real>(y[i], sigmoid_of(long_double(x[i]))), tolerance_of<Real>(1e-6), "sigmoid");
      run.expect(y[i] >= 0 && y[i] <= 1, "a sigmoid lies in 0..1");
    }
    sweep(Real{}, Precision::fp32);
  });
  run.row("bf16");
  sweep(float{}, Precision::bf16);
}

void hdr_target(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const std::vector<Real> color{Real(0.25), Real(0.5), Real(1), Real(0), Real(0.125), Real(0.75)};
    std::vector<float> target{1e4f, -1.f, 0.5f, 65504.f, 1e-30f, 1.f};
    std::vector<Real> slope(6);
    const auto loss = [&] {
      return photometric_loss<Real>({color.data(), 2, 3}, {target.data(), 2, 3}, 6.0, 1.0, {slope.data(), 2, 3});
    };
    long double want = 0;
    for (std::size_t i = 0; i < 6; ++i) {
      const long double error = long_double(color[i]) - long_double(target[i]);
      want += error * error;
    }
    run.relative(loss(), want, tolerance_of<Real>(1e-6), "loss, not clamped");
    for (std::size_t i = 0; i < 6; ++i) {
      const long double error = long_double(color[i]) - long_double(target[i]);
      run.relative(slope[i], error / 3, tolerance_of<Real>(1e-6), "gradient");
    }
    target[4] = nan;
    run.expect(std::isnan(loss()), "a NaN target shows in the loss");
    for (std::size_t i = 0; i < 6; ++i) run.expect(std::isnan(slope[i]) == (i == 4), "and in its own gradient alone");
    target[4] = std::numeric_limits<float>::infinity();
    run.expect(!std::isfinite(loss()), "so does an infinite one");
    run.expect(std::is_same_v<decltype(StoredFrame::rgb)::value_type, std::uint8_t>,
               "frames in memory hold 8 bits per channel: training cannot meet such targets");
  });
  run.row("fp32");
  // Were one in a batch all the same, the ray is found and named, and no other.
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    TrainingBox box(run.registry(), small_config());
    box.gradients(0);
    const RayBatch batch = box.batch().view(box.pipeline().has_semantics());
    run.expect(!box.pipeline().lanes().find_fault(0, batch).has_value(), "a sound batch has no fault");
    box.batch().target[3 * 37 + 1] = bad;
    const std::optional<RayFault> fault = box.pipeline().lanes().find_fault(0, batch);
    run.expect(fault.has_value() && fault->ray() == 37, "the ray of a bad target is found");
  }
}

IN_BOTH_PRECISIONS(density_activations) {
  std::vector<Real> raw;
  for (const double edge : {0.0, 15.0, 88.0, 89.0, 104.0, 710.0, 1e4, 1e-3, 1e-8, 1e-30}) {
    for (const double sign : {1.0, -1.0}) raw.push_back(static_cast<Real>(sign * edge));
  }
  for (int i = -4000; i <= 4000; ++i) {
    raw.push_back(static_cast<Real>(i) / Real(128));
    raw.push_back(static_cast<Real>(i) * Real(2.5));
  }
  // Below the normal range softplus rounds three times: exponential, quotient and sum, half a quantum each.
  constexpr double kQuanta = 1.51;
  for (const DensityActivation kind : kActivations) {
    const std::vector<Real> sigma = density_of(kind, raw), slope = density_slope(kind, raw);
    for (std::size_t i = 0; i < raw.size(); ++i) {
      const auto x = long_double(raw[i]);
      run.measure(error_above_quantum<Real>(sigma[i], density_reference(kind, x), kQuanta), tolerance_of<Real>(1e-6),
                  name_of(kind));
      run.measure(error_above_quantum<Real>(slope[i], slope_reference(kind, x), kQuanta), tolerance_of<Real>(1e-6),
                  name_of(kind) + " slope");
    }
  }
  run.expect(density_of<Real>(DensityActivation::trunc_exp, {Real(1e4)})[0] ==
                 density_of<Real>(DensityActivation::trunc_exp, {Real(15)})[0],
             "trunc_exp stays at e^15 above 15");
  for (const DensityActivation kind : kActivations)
    run.expect(std::isnan(density_of<Real>(kind, {std::numeric_limits<Real>::quiet_NaN()})[0]),
               name_of(kind) + " keeps NaN, so that it is found");
}

IN_BOTH_PRECISIONS(large_exponents) {
  for (const DensityActivation kind : kActivations) {
    for (const double value : {88.0, 89.0, 710.0, 1e4, 1e30}) {
      const auto raw = static_cast<Real>(value);
      // Forward and backward through activation and compositing: a thin sample, the opaque one, one behind it.
      testing::RayBuffers<Real> rays({3}, 1);
      rays.space_evenly(3);
      const std::vector<Real> raws{Real(-1), raw, Real(2)};
      rays.sigma = density_of(kind, raws);
      for (std::size_t i = 0; i < 9; ++i) rays.rgb[i] = static_cast<Real>(i) / Real(8);
      rays.hidden = {Real(1), Real(-2), Real(3)};
      rays.g_color = {Real(1), Real(-1), Real(0.5)};
      rays.g_hidden = {Real(1)};
      rays.g_depth = {Real(1)};
      rays.g_opacity = {Real(-1)};
      rays.forward();
      rays.backward();
      std::vector<Real> d_raw(3);
      density_backward<Real>({kind}, column(std::as_const(raws)), column(std::as_const(rays.d_sigma)), column(d_raw));
      for (std::size_t i = 0; i < 3; ++i) {
        run.expect(std::isfinite(rays.sigma[i]) && std::isfinite(rays.weight[i]), "forward is finite");
        run.expect(std::isfinite(rays.d_sigma[i]) && std::isfinite(d_raw[i]), "backward is finite");
      }
      run.near(rays.opacity[0], 1, tolerance_of<Real>(1.2e-7), "opacity");
      // What is seen behind: the exponent's rounding, u tau, is the weight's relative error.
      const auto before = long_double(rays.sigma[0]) * long_double(rays.delta[0]) +
                          long_double(rays.sigma[1]) * long_double(rays.delta[1]);
      const long double behind =
          std::exp(-before) * -std::expm1(-long_double(rays.sigma[2]) * long_double(rays.delta[2]));
      run.measure(error_above_quantum<Real>(rays.weight[2], behind), tolerance_of<Real>(2e-5), "weight behind");
      const long double want = density_reference(kind, long_double(raw));
      run.relative(rays.sigma[1], want, tolerance_of<Real>(1e-6), "density");
    }
  }
}

// Cases D05 and D07: batches without a label, and labels outside the class table.

void all_void(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr std::int64_t kRays = 1024;
    constexpr std::int32_t kClasses = 28;
    Numbers numbers(51);
    std::vector<Real> logits;
    for (std::int64_t i = 0; i < kRays * kClasses; ++i) logits.push_back(static_cast<Real>(numbers.in(-5, 5)));
    const std::vector<std::int16_t> label(kRays, -1);
    const std::vector<float> soft(kRays * kClasses, 0.f), weights(kClasses, 2.f);
    for (const bool is_soft : {false, true}) {
      SemanticTargets targets;
      if (is_soft) {
        targets.soft = {soft.data(), kRays, kClasses};
      } else {
        targets.hard = {label.data(), kRays, 1};
      }
      for (const bool weighted : {false, true}) {
        const View<const float> class_weight = weighted ? row_of(weights) : View<const float>();
        for (const SemanticNormalisation kind :
             {SemanticNormalisation::mean_labelled, SemanticNormalisation::sum, SemanticNormalisation::mean_rays}) {
          const double normaliser = semantic_normaliser(kind, labelled_weight(targets, class_weight), kRays);
          std::vector<Real> gradient(logits.size(), Real(-9));
          const SemanticLoss loss =
              semantic_cross_entropy<Real>({logits.data(), kRays, kClasses}, targets, class_weight, normaliser, 1.0,
                                           {gradient.data(), kRays, kClasses});
          run.measure(std::abs(loss.sum), 0, "loss");
          run.expect(loss.labelled == 0, "no ray counts");
          const std::vector<Real> zeros(gradient.size(), Real(0));
          run.expect(std::memcmp(gradient.data(), zeros.data(), sizeof(Real) * zeros.size()) == 0,
                     "every gradient is +0, bit by bit");
        }
      }
    }
  });
  run.row("fp32");
  // Training on few labels: 4 rays per step and one labelled frame, so about half of the batches hold no label. In such
  // a step the head is not touched: neither its values nor its moments, which an update with gradient 0 would move and
  // decay.
  TrainingBox box(run.registry(), small_config("scene: {type: box_room, labels: {frames: 1}}\n"
                                               "semantics: {hidden_width: 16, weight: 0.3}\n"
                                               "train: {steps: 50, rays: 4}\n"));
  int with = 0, without = 0;
  for (int step = 0; step < 40; ++step) {
    const std::vector<TrainingBox::Kept> before = box.state();
    const StepLosses losses = box.trainer().advance().back();
    const std::vector<TrainingBox::Kept> after = box.state();
    ++(losses.labelled == 0 ? without : with);
    if (losses.labelled == 0) run.measure(std::abs(losses.semantic), 0, "semantic loss of a step without labels");
    bool others_moved = false, head_moved = false;
    for (std::size_t i = 0; i < before.size(); ++i) {
      const bool moved = !(before[i] == after[i]);
      const bool head =
          before[i].name.find("/head/") != std::string::npos || before[i].name.find("semantic") != std::string::npos;
      (head ? head_moved : others_moved) |= moved;
    }
    run.expect(others_moved, "the colour network learns from every step");
    run.expect(head_moved == (losses.labelled > 0), "the head moves in steps with labels alone");
  }
  run.expect(with >= 5 && without >= 5, "both kinds of step occurred");
  run.note(fmt::format("{} of 40 steps without a label", without));
}

void label_range(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const std::vector<Real> logits(28 * 3, Real(1));
    std::vector<Real> gradient(28 * 3);
    const std::vector<float> weights(28, 1.f);
    for (const int bad : {28, -2, 255, 32767, -32768}) {
      const std::vector<std::int16_t> label{27, static_cast<std::int16_t>(bad), -1};
      SemanticTargets targets{.hard = {label.data(), 3, 1}};
      run.expect_error(ErrorKind::data, {"ray 1001 ", fmt::format("is {};", bad), "0 to 27"}, [&] {
        semantic_cross_entropy<Real>({logits.data(), 3, 28}, targets, {}, 1.0, 1.0, {gradient.data(), 3, 28}, 1000);
      });
      if (bad > 0)
        run.expect_error(ErrorKind::data, {"ray 1 ", fmt::format("is {};", bad)},
                         [&] { labelled_weight(targets, row_of(weights)); });
    }
  });
  // Where labels enter: an image whose pixel (3, 2) holds an id that no class has. 65535 must not become void, -1.
  run.row("-");
  std::vector<ClassEntry> entries;
  for (int c = 0; c < 28; ++c) entries.push_back({c + 1, "class " + std::to_string(c), {}, false});
  const ClassTable classes(entries);
  FrameInfo frame{.name = "view_7", .camera = {.width_px = 6, .height_px = 4}};
  FrameFiles files{run.folder() + "/color.png", "", run.folder() + "/label.png", ""};
  write_png_rgb(files.color, 6, 4, std::vector<std::uint8_t>(72, 100));
  for (const int bad : {0, 29, 255, 65534, 65535}) {
    std::vector<std::uint16_t> ids(24, 5);
    ids[2 * 6 + 3] = static_cast<std::uint16_t>(bad);
    write_png_gray16(files.label, 6, 4, ids);
    FrameBuffer buffer;
    run.expect_error(ErrorKind::data, {"frame 'view_7'", "label.png", fmt::format("id {} ", bad), "x 3", "y 2"},
                     [&] { read_frame_files(frame, files, {}, classes, buffer); });
    FrameReadRules lenient{.unknown_labels = UnknownLabels::as_void};
    read_frame_files(frame, files, lenient, classes, buffer);
    run.expect(buffer.label[15] == kVoid && buffer.label[14] == 4, "unknown_labels: void makes it void, and it alone");
  }
  // Where a batch is made: a label that got into memory by another way.
  for (const int bad : {28, -2, 255, 32767}) {
    StoredFrame pixels;
    pixels.width_px = 6;
    pixels.height_px = 4;
    pixels.rgb.assign(72, 100);
    std::vector<std::int16_t> label(24, 5);
    label[15] = static_cast<std::int16_t>(bad);
    TrainingLabels::Frame labels;
    labels.hard = LabelMap(label);
    TrainFrame train{{frame.camera, Pose{}, false}, &pixels, &labels, frame.name};
    train.camera.camera.fx = train.camera.camera.fy = 5;
    std::vector<std::int16_t> logit_of_class;
    for (std::int16_t c = 0; c < 28; ++c) logit_of_class.push_back(c);
    RaySourceOptions options;
    options.train.rays = 256;  // of 24 pixels: the bad one is among them
    const RaySource source({train}, logit_of_class, {}, options);
    BatchBuffers batch;
    run.expect_error(ErrorKind::data, {"frame 'view_7'", "x 3, y 2", fmt::format("label {} ", bad)},
                     [&] { source.fill(0, batch); });
  }
}

// Cases D08, D09 and D11: class logits of rays that are empty, half opaque, or may not move the density.

namespace {

constexpr std::int32_t kClasses = 28, kHidden = 8;
constexpr std::int16_t kLabel = 5;

/// One ray with a semantic head behind it: hidden activations to a loss, and back to the densities.
template <class Real>
struct SemanticRay {
  explicit SemanticRay(int samples)
      : head(HeadShape{4, kHidden, kClasses}),
        box(head, 3, 0.0),
        rays({samples}, kHidden),
        logits(kClasses),
        slope(kClasses) {
    rays.space_evenly(samples * 0.75);
    Numbers numbers(41);
    for (Real& h : rays.hidden) h = static_cast<Real>(numbers.in(0, 2));
    ctx.workspace = &workspace;
    head.derive(ctx, box.tensors());
  }
  View<Real> weight() { return box.value(2); }
  View<Real> bias() { return box.value(3); }

  double loss() {
    rays.forward();
    head.output_forward(ctx, box.tensors(), {rays.out_hidden.data(), 1, kHidden}, {rays.opacity.data(), 1, 1},
                        row_of(logits));
    SemanticTargets targets{.hard = {&kLabel, 1, 1}};
    return semantic_cross_entropy<Real>(row_of(std::as_const(logits)), targets, {}, 1.0, 1.0, row_of(slope)).sum;
  }
  void backward() {
    std::fill(rays.g_color.begin(), rays.g_color.end(), Real(0));
    head.output_backward(ctx, box.tensors(), {rays.out_hidden.data(), 1, kHidden}, {rays.opacity.data(), 1, 1},
                         row_of(std::as_const(slope)), {rays.g_hidden.data(), 1, kHidden},
                         {rays.g_opacity.data(), 1, 1});
    rays.backward();
  }

  OneLayerHead<Real> head;
  testkit::TensorBox<Real> box;
  testing::RayBuffers<Real> rays;
  std::vector<Real> logits, slope;
  Workspace workspace;
  StepContext ctx;
};

}  // namespace

IN_BOTH_PRECISIONS(empty_ray) {
  SemanticRay<Real> ray(6);  // density 0
  const double loss = ray.loss();
  for (const Real s : ray.logits) run.measure(std::abs(s), 0, "logit");
  std::vector<Real> p(kClasses);
  softmax<Real>(row_of(std::as_const(ray.logits)), row_of(p));
  for (const Real one : p) run.near(one, Real(1) / Real(kClasses), 0, "probability 1/C");
  run.relative(loss, std::log(long_double(kClasses)), 4e-16, "loss ln C");
  // At density 0 only the sample's own weight moves: dL/dsigma_k = delta_k (h_k W + b) . (1/C - [label]).
  ray.backward();
  SemanticRay<double> oracle(6);
  for (std::size_t k = 0; k < 6; ++k) {
    long double want = 0;
    for (std::int32_t c = 0; c < kClasses; ++c) {
      auto s = long_double(ray.bias()(0, c));
      for (std::int32_t h = 0; h < kHidden; ++h)
        s += long_double(ray.rays.hidden[k * kHidden + static_cast<std::size_t>(h)]) * long_double(ray.weight()(h, c));
      want += s * (1.0L / kClasses - (c == kLabel ? 1 : 0));
    }
    want *= long_double(ray.rays.delta[k]);
    run.relative(ray.rays.d_sigma[k], want, tolerance_of<Real>(1e-5), "density gradient");
    // The same by differences of the whole way, one-sided and extrapolated twice: densities are not negative.
    double at[4];
    for (int i = 0; i < 4; ++i) {
      oracle.rays.sigma[k] = i == 0 ? 0.0 : 1e-3 * static_cast<double>(1 << (i - 1));
      at[i] = oracle.loss();
    }
    oracle.rays.sigma[k] = 0;
    const double d1 = (at[1] - at[0]) / 1e-3, d2 = (at[2] - at[0]) / 2e-3, d4 = (at[3] - at[0]) / 4e-3;
    const double e1 = 2 * d1 - d2, e2 = 2 * d2 - d4;
    run.near((4 * e1 - e2) / 3, ray.rays.d_sigma[k], 2e-6, "by differences");
  }
}

IN_BOTH_PRECISIONS(half_opacity) {
  const long double want = std::exp(5.0L) / (std::exp(5.0L) + 27);
  for (const bool by_bias : {false, true}) {
    for (const int samples : {1, 7}) {
      SemanticRay<Real> ray(samples);
      for (auto* values : {&ray.rays.hidden}) std::fill(values->begin(), values->end(), Real(0));
      for (std::int64_t i = 0; i < ray.weight().size(); ++i) ray.weight().data[i] = 0;
      for (std::int64_t i = 0; i < ray.bias().size(); ++i) ray.bias().data[i] = 0;
      for (std::size_t k = 0; k < static_cast<std::size_t>(samples); ++k) {
        ray.rays.hidden[k * kHidden] = Real(1);
        ray.rays.sigma[k] = static_cast<Real>(std::log(2.0L) / (samples * 0.75L));  // opacity 1/2 in all
      }
      (by_bias ? ray.bias() : ray.weight())(0, kLabel) = Real(10);
      const double loss = ray.loss();
      run.near(ray.rays.opacity[0], 0.5, tolerance_of<Real>(2e-7), "opacity");
      run.near(std::exp(-loss), want, tolerance_of<Real>(1e-6),
               by_bias ? "probability, by the bias" : "probability, by the weights");
      run.expect(std::abs(std::exp(-loss) - 0.84608) < 1e-5, "0.8461");
    }
  }
  run.note(fmt::format("p = {:.6f}: a margin of 10 counts 5 at half opacity", static_cast<double>(want)));
}

void detached(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    testing::RayBuffers<Real> rays({40, 1, 7}, 5);
    rays.space_evenly(4);
    Numbers numbers(42);
    for (Real& v : rays.sigma) v = static_cast<Real>(numbers.in(0, 3));
    for (Real& v : rays.hidden) v = static_cast<Real>(numbers.in(-1, 1));
    for (Real& v : rays.g_hidden) v = static_cast<Real>(numbers.in(-1, 1));
    rays.forward();
    std::fill(rays.d_sigma.begin(), rays.d_sigma.end(), Real(-9));
    CompositeGrad<Real> grad = rays.grad();
    grad.hidden_moves_density = false;
    composite_backward(rays.in(), rays.out(), grad, rays.col(rays.d_sigma), rays.mat(rays.d_rgb, 3),
                       rays.mat(rays.d_hidden, 5));
    for (const Real g : rays.d_sigma) run.measure(std::abs(g), 0, "dL/dsigma when detached");
    for (std::size_t i = 0; i < rays.d_hidden.size(); ++i) {
      const std::size_t sample = i / 5, ray = static_cast<std::size_t>(rays.ray[sample]);
      const long double want = long_double(rays.weight[sample]) * long_double(rays.g_hidden[5 * ray + i % 5]);
      run.relative(rays.d_hidden[i], want, tolerance_of<Real>(1e-6), "dL/dh");
    }
    rays.backward();
    run.expect(std::any_of(rays.d_sigma.begin(), rays.d_sigma.end(), [](Real g) { return g != Real(0); }),
               "without the flag semantics do move the density");
  });
  run.row("fp32");
  // The whole pipeline: the density layer's gradient of a step, with and without weight on the semantic loss.
  const auto density_gradient = [&](const char* weight, const char* stop) {
    TrainingBox box(run.registry(), small_config(fmt::format("semantics: {{hidden_width: 16, weight: {}, "
                                                             "stop_gradient_to_density: {}}}\n",
                                                             weight, stop)));
    const StepLosses losses = box.gradients(0);
    run.expect(losses.labelled > 0, "the batch has labels");
    std::vector<float> out;
    for (const Tensor<float>& t : box.pipeline().store().all()) {
      if (t.name.find("/density/") == std::string::npos || !t.learned()) continue;
      out.insert(out.end(), t.grad.data(), t.grad.data() + t.grad.size());
    }
    return out;
  };
  const std::vector<float> without = density_gradient("0", "true"), with = density_gradient("0.7", "true");
  run.expect(!without.empty() && without.size() == with.size(), "the field has a density layer");
  run.measure(std::memcmp(without.data(), with.data(), sizeof(float) * without.size()) == 0 ? 0 : 1, 0, "same bits");
  run.expect(with != density_gradient("0.7", "false"), "without the flag they differ");
}

// Case D18: runs that begin with no density at any sample.

namespace {

enum class End { learns, stopped, unnoticed };

/// ReLU density with `bias`, 200 steps at most. `last` is the step at which it ended.
End outcome(CaseRun& run, int seed, const char* bias, std::int64_t& last) {
  TrainingBox box(run.registry(),
                  fmt::format("scene: {{type: box_room, load: {{downscale: 4}}}}\n"
                              "rendering: {{density_activation: relu, density_bias: {}}}\n"
                              "passes:\n"
                              "  - sampler: {{type: stratified, samples: 8}}\n"
                              "    position: {{type: frequency, frequencies: 2}}\n"
                              "    field: {{type: tiny_mlp, hidden_width: 16, color_width: 16, color_layers: 1}}\n"
                              "train: {{steps: 200, rays: 16}}\n"
                              "runtime: {{seed: {}}}\n",
                              bias, seed));
  bool dense = false;
  try {
    for (last = 0; last < 200; ++last) dense = box.trainer().advance().back().dense_passes != 0;
  } catch (const Error& error) {
    const std::string text = error.what();
    run.expect(error.kind() == ErrorKind::failure && text.find("no density") != std::string::npos &&
                   text.find("pass 'main'") != std::string::npos && text.find("density_bias") != std::string::npos,
               "the message names pass, cause and remedy");
    return End::stopped;
  }
  return dense ? End::learns : End::unnoticed;
}

}  // namespace

void dead_start(CaseRun& run) {
  run.row("fp32");
  // With -0.3 about half of the runs begin dead; the others show that a run that learns is left alone.
  for (const auto& [bias, seeds] : {std::pair{"-0.3", 100}, std::pair{"0", 20}, std::pair{"-3", 20}}) {
    int counts[3] = {};
    std::int64_t latest = 0;
    for (int seed = 0; seed < seeds; ++seed) {
      std::int64_t last = 0;
      const End end = outcome(run, seed, bias, last);
      ++counts[static_cast<int>(end)];
      if (end == End::stopped) latest = std::max(latest, last);
    }
    run.measure(counts[2], 0, "runs dead and unnoticed");
    run.expect(latest <= 200, "within 200 steps");
    run.note(fmt::format("bias {}: {} learn, {} stopped by step {}", bias, counts[0], counts[1], latest));
  }
}

// Cases E01 to E04 and E07: Adam and the learning-rate schedule against long double.

namespace {

/// Bias corrections of one step.
struct Corrections {
  Corrections(const AdamParams& p, std::int64_t step)
      : mean(1 - std::pow(long_double(p.beta1), long_double(step) + 1)),
        square(1 - std::pow(long_double(p.beta2), long_double(step) + 1)) {}
  long double mean, square;
};

/// [Kingma15 Alg. 1] of one parameter in long double; `path` is the way it went.
struct Reference {
  long double x = 0, m = 0, v = 0, path = 0;
  void update(const AdamParams& p, long double g, const Corrections& correction) {
    const auto b1 = long_double(p.beta1), b2 = long_double(p.beta2);
    m = b1 * m + (1 - b1) * g;
    v = b2 * v + (1 - b2) * g * g;
    const long double step = long_double(p.learning_rate) * m / correction.mean /
                             (std::sqrt(v / correction.square) + long_double(p.epsilon));
    x -= step;
    path += std::abs(step);
  }
};

template <class Real>
void check(CaseRun& run, const testing::AdamRows<Real>& got, std::size_t i, const Reference& want, double tolerance,
           const std::string& what) {
  run.measure(static_cast<double>(std::abs(long_double(got.value[i]) - want.x) / want.path), tolerance, what);
}

}  // namespace

IN_BOTH_PRECISIONS(adam_sizes) {
  const AdamParams params;
  constexpr int kSizes = 39;  // 1e-20 .. 1e18: from 1e19 on a step is refused (E08)
  for (const bool sparse : {false, true}) {
    testing::AdamRows<Real> state(kSizes);
    std::vector<Reference> want(kSizes);
    Numbers numbers(61);
    for (std::int64_t step = 0; step < 1000; ++step) {
      const Corrections correction(params, step);
      for (std::size_t i = 0; i < kSizes; ++i) {
        const double size = std::pow(10.0, static_cast<int>(i) - 20) * numbers.in(-0.5, 1.5);
        state.grad[i] = static_cast<Real>(size);
        want[i].update(params, long_double(state.grad[i]), correction);
      }
      const AdamStep rule = adam_step(params, params.learning_rate, step);
      sparse ? static_cast<void>(state.touched(rule)) : state.dense(rule);
    }
    for (std::size_t i = 0; i < kSizes; ++i) {
      const std::string at = fmt::format("gradients near 1e{}", static_cast<int>(i) - 20);
      check(run, state, i, want[i], tolerance_of<Real>(1e-5), at);
      run.relative(state.m[i], want[i].m, tolerance_of<Real>(1e-5), at);
      // Squares of gradients below 1e-15 leave the normal range of fp32; the root of them stands beside epsilon. In
      // fp32 beta2 = 0.999 is off by 1.3e-8, so 1,000 steps leave v off by up to 1.3e-5, and its root by half of it.
      if (std::is_same_v<Real, double> || want[i].v > 1e-33L)
        run.relative(state.v[i], want[i].v, tolerance_of<Real>(2e-5), at);
    }
  }
}

IN_BOTH_PRECISIONS(adam_sparse) {
  const AdamParams params;
  for (const std::int32_t cols : {1, 2, 8, 3}) {  // widths with kernels of their own, and one without
    constexpr std::size_t kRows = 10;
    const auto width = static_cast<std::size_t>(cols);
    testing::AdamRows<Real> lazy(kRows, cols), dense(kRows, cols);
    std::vector<Reference> want_lazy(lazy.value.size()), want_dense(lazy.value.size());
    Numbers numbers(62);
    for (std::int64_t step = 0; step < 6000; ++step) {
      const Corrections correction(params, step);
      const std::size_t hit = static_cast<std::size_t>(step % 1000);  // row r at r, 1000 + r, ...
      std::fill(dense.grad.begin(), dense.grad.end(), Real(0));
      if (hit < kRows) {
        for (std::size_t c = 0; c < width; ++c) {
          const auto g = static_cast<Real>(numbers.in(0.5, 1.5));
          lazy.grad[hit * width + c] = dense.grad[hit * width + c] = g;
        }
      }
      for (std::size_t i = 0; i < want_dense.size(); ++i) {
        const auto g = long_double(dense.grad[i]);
        if (g != 0) want_lazy[i].update(params, g, correction);
        if (step < 2500) want_dense[i].update(params, g, correction);
      }
      const AdamStep rule = adam_step(params, params.learning_rate, step);
      run.expect(lazy.touched(rule) == (hit < kRows ? 1 : 0), "rows touched");
      if (step < 2500) dense.dense(rule);
    }
    for (std::size_t i = 0; i < lazy.value.size(); ++i) {
      check(run, lazy, i, want_lazy[i], tolerance_of<Real>(1e-5), "lazy rule");
      check(run, dense, i, want_dense[i], tolerance_of<Real>(1e-5), "dense rule");
      run.expect(lazy.grad[i] == Real(0), "a touched row's gradient is cleared");
    }
    run.expect(std::abs(want_lazy[0].x - want_dense[0].x) > 1e-4L, "the two rules are told apart");
  }
  run.note("lazy: moments of an untouched row stay, bias correction counts all steps");
}

IN_BOTH_PRECISIONS(adam_epsilon) {
  std::string first_zero = "none";
  for (const double epsilon : {1e-15, 1e-8}) {
    AdamParams params{.epsilon = epsilon};
    constexpr int kSizes = 14;
    testing::AdamRows<Real> state(kSizes);
    std::vector<Reference> want(kSizes);
    for (std::int64_t step = 0; step < 300; ++step) {
      const Corrections correction(params, step);
      for (std::size_t i = 0; i < kSizes; ++i) {
        state.grad[i] = static_cast<Real>(std::pow(10.0, -9 - static_cast<int>(i)));
        want[i].update(params, long_double(state.grad[i]), correction);
      }
      state.dense(adam_step(params, params.learning_rate, step));
    }
    for (std::size_t i = 0; i < kSizes; ++i) {
      check(run, state, i, want[i], tolerance_of<Real>(1e-5), fmt::format("gradient 1e-{}", 9 + i));
      if (state.v[i] == Real(0) && first_zero == "none") first_zero = fmt::format("1e-{}", 9 + i);
    }
  }
  run.expect((first_zero == "none") == std::is_same_v<Real, double>, "squares underflow in fp32 alone");
  run.note("v is 0 from gradient " + first_zero + " on: epsilon alone then scales the step");
}

IN_BOTH_PRECISIONS(adam_zero) {
  const std::vector<Real> starts{Real(0),
                                 Real(-0.0),
                                 Real(1),
                                 Real(-1e-30),
                                 std::numeric_limits<Real>::denorm_min(),
                                 std::numeric_limits<Real>::max(),
                                 Real(1) / Real(3),
                                 Real(-7e8)};
  for (const std::int32_t cols : {1, 2, 4, 8}) {
    testing::AdamRows<Real> dense(8 / cols, cols), sparse(8 / cols, cols);
    dense.value = sparse.value = starts;
    for (std::size_t i = 0; i < 8; ++i) sparse.m[i] = sparse.v[i] = Real(0.25);  // rows hit before, not now
    std::int64_t touched = 0;
    for (std::int64_t step = 0; step < 1000; ++step) {
      const AdamStep rule = adam_step({}, 5e-4, step);
      dense.dense(rule);
      touched += sparse.touched(rule);
    }
    const std::size_t bytes = 8 * sizeof(Real);
    run.expect(std::memcmp(dense.value.data(), starts.data(), bytes) == 0, "dense: the same bits");
    run.expect(std::memcmp(sparse.value.data(), starts.data(), bytes) == 0, "sparse: the same bits");
    run.expect(touched == 0, "no row was touched");
    for (std::size_t i = 0; i < 8; ++i) {
      run.measure(static_cast<double>(std::abs(dense.m[i]) + std::abs(dense.v[i])), 0, "moments stay 0");
      run.expect(sparse.m[i] == Real(0.25) && sparse.v[i] == Real(0.25), "moments of untouched rows stay");
    }
  }
  run.note("no weight decay");
}

void counters(CaseRun& run) {
  run.row("float64");
  const std::int64_t steps[] = {
      0, 1, 9, 999, 100000, (std::int64_t{1} << 31) - 1, std::int64_t{1} << 31, std::int64_t{1} << 53};
  for (const auto& [beta1, beta2] : {std::pair{0.9, 0.999}, std::pair{0.0, 0.99999999}, std::pair{0.999999, 0.9}}) {
    AdamParams params{.beta1 = beta1, .beta2 = beta2};
    for (const std::int64_t step : steps) {
      const AdamStep rule = adam_step(params, 5e-4, step);
      const long double t = long_double(step) + 1;
      const auto power = [&](double beta) { return beta == 0 ? 0.0L : std::exp(t * std::log(long_double(beta))); };
      const auto correction = [&](double beta) {
        return beta == 0 ? 1.0L : -std::expm1(t * std::log(long_double(beta)));
      };
      run.relative(rule.step_size, 5e-4 / correction(beta1), 1e-12, "step size");
      run.relative(rule.root_scale, 1 / std::sqrt(correction(beta2)), 1e-12, "root scale");
      run.expect(power(beta1) < 1 && std::isfinite(rule.step_size) && std::isfinite(rule.root_scale), "finite");
    }
  }
  const long double pi = 3.14159265358979323846264338327950288L;
  for (const std::int64_t end : {std::int64_t{1}, std::int64_t{250000}, std::int64_t{1} << 31}) {
    for (const std::int64_t warmup : {std::int64_t{0}, std::int64_t{100}}) {
      for (const std::int64_t step : {std::int64_t{0}, std::int64_t{1}, warmup - 1, warmup, end - 1, end, end + 1,
                                      2 * end, std::int64_t{1} << 33}) {
        if (step < 0) continue;
        const long double progress = long_double(step) / long_double(end);
        const long double rise = step < warmup ? long_double(step + 1) / long_double(warmup) : 1.0L;
        ScheduleParams schedule{.decay_steps = end, .warmup_steps = warmup};
        const auto check_factor = [&](ScheduleKind kind, long double want, const char* what) {
          schedule.kind = kind;
          run.measure(std::max(0.0, static_cast<double>(std::abs(long_double(schedule_factor(schedule, step)) - want)) -
                                        5e-324) /
                          std::max(1e-300, static_cast<double>(want)),
                      1e-12, what);
        };
        check_factor(ScheduleKind::constant, rise, "constant");
        check_factor(ScheduleKind::exponential, rise * std::pow(long_double(schedule.factor), std::min(progress, 1.0L)),
                     "exponential, held at the end");
        const auto floor = long_double(schedule.factor);
        check_factor(ScheduleKind::cosine,
                     rise * (floor + (1 - floor) * (1 + std::cos(pi * std::min(progress, 1.0L))) / 2), "cosine");
      }
    }
  }
  run.row("fp32");
  // One step of a parameter that has seen 2^31: the corrections are 1, so the plain moments count.
  testing::AdamRows<float> state(1);
  state.grad[0] = 0.5f;
  state.m[0] = 0.25f;
  state.v[0] = 0.0625f;
  state.dense(adam_step({}, 5e-4, std::int64_t{1} << 31));
  const long double m = 0.9L * 0.25L + 0.1L * 0.5L, v = 0.999L * 0.0625L + 0.001L * 0.25L;
  run.relative(state.value[0], -5e-4L * m / (std::sqrt(v) + 1e-8L), 1e-6, "step after 2^31 steps");
}

// Cases E05, E06 and E08: what a training step does with gradients that are no numbers, huge, or zero.

namespace {

/// Puts `value` where the step's gradient of the tensor is summed up: into a lane, or into a sparse tensor's gradient.
float& gradient_slot(Tensor<float>& tensor, std::size_t element) {
  return tensor.lanes.size() > 0 ? tensor.lanes.data()[element] : tensor.grad.data()[element];
}

/// A step with `value` in one gradient of each learned tensor in turn: it throws, names the tensor, changes nothing.
void refused_everywhere(CaseRun& run, const std::string& yaml, float value) {
  TrainingBox box(run.registry(), yaml);
  for (int i = 0; i < 3; ++i) box.trainer().advance();
  int tensors = 0;
  for (Tensor<float>& tensor : box.pipeline().store().all()) {
    if (!tensor.learned()) continue;
    const std::vector<TrainingBox::Kept> before = box.state();
    const std::int64_t step = box.trainer().step();
    const auto element = static_cast<std::size_t>(tensor.size() / 2);
    const std::vector<float> kept(tensor.grad.data(), tensor.grad.data() + tensor.grad.size());
    gradient_slot(tensor, element) = value;
    const std::int64_t at = static_cast<std::int64_t>(element);
    run.expect_error(ErrorKind::failure,
                     {fmt::format("step {}", step), "'" + tensor.name + "'",
                      fmt::format("row {}, column {}", at / tensor.spec.cols, at % tensor.spec.cols)},
                     [&] { box.trainer().advance(); });
    run.expect(box.state() == before, "values and moments keep their bits (" + tensor.name + ")");
    run.expect(box.trainer().step() == step, "the step was not counted");
    // Leave the store as it was: sparse gradients are cleared by the optimiser alone.
    for (Tensor<float>& other : box.pipeline().store().all()) {
      if (other.spec.role == TensorRole::sparse) std::fill_n(other.grad.data(), other.grad.size(), 0.f);
    }
    ++tensors;
  }
  box.trainer().advance();
  run.expect(box.trainer().step() == 4, "a clean step goes on");
  run.note(fmt::format("{} tensors", tensors));
}

}  // namespace

void bad_gradient(CaseRun& run) {
  run.row("fp32");
  const float infinity = std::numeric_limits<float>::infinity();
  for (const float bad : {std::nanf(""), infinity, -infinity}) {
    refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\n"), bad);
    refused_everywhere(run, grid_config(), bad);
  }
  run.row("bf16");
  refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\nruntime: {precision: bf16}\n"),
                     std::nanf(""));
}

void loss_scale(CaseRun& run) {
  run.row("fp16");
  run.absent("no fp16 training, so no loss scale; bf16 products keep fp32's range");
}

void extreme_norms(CaseRun& run) {
  run.row("fp32");
  // Finite gradients whose square is not: Adam's second moment would become infinite and stay so, the parameter would
  // never move again, and a checkpoint of it could not be read back.
  refused_everywhere(run, small_config("semantics: {hidden_width: 16, weight: 0.3}\n"), 3e30f);
  run.row("-");
  run.absent("gradients are not clipped by norm; zero gradients are E04, infinite ones E05");
}

}  // namespace semfield::numerics
