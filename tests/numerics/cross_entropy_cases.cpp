// Cases D01 to D04, D06, D10, D12 and D13: cross-entropy, softmax and entropy.
#include <fmt/format.h>

#include <algorithm>

#include "encoder_box.h"
#include "loss_cases.h"
#include "losses/semantic_cross_entropy.h"

namespace semfield::numerics {

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
    largest = static_cast<long double>(s[argmax]);
    for (std::size_t c = 0; c < s.size(); ++c) {
      p.push_back(c == argmax ? 1.0L : std::exp(static_cast<long double>(s[c]) - largest));
      rest += c == argmax ? 0.0L : p.back();
    }
    entropy = std::log1p(rest);
    for (std::size_t c = 0; c < s.size(); ++c) {
      p[c] /= 1 + rest;
      if (p[c] > 0) entropy += p[c] * (largest - static_cast<long double>(s[c]));
    }
  }
  template <class Real>
  long double surprise(const std::vector<Real>& s, std::size_t label) const {
    return (largest - static_cast<long double>(s[label])) + std::log1p(rest);
  }
  /// p - [label], without the cancellation of a row that is almost certain.
  long double slope(std::size_t c, std::size_t label) const {
    if (c != label) return p[c];
    return c == argmax ? -rest / (1 + rest) : p[c] - 1;
  }
};

template <class Real>
SemanticLoss loss_of(const std::vector<Real>& logits, std::int16_t label, std::vector<Real>* gradient,
                     double normaliser = 1) {
  SemanticTargets targets{.hard = {&label, 1, 1}};
  return semantic_cross_entropy<Real>(row_of(logits), targets, {}, normaliser, 1.0,
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

void logit_sweep(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::size_t classes : {2u, 3u, 13u, 28u, 88u, 256u, 1024u}) {
      for (const double v : {0.0, 11.0, 88.0, 89.0, 1e4, 1e30}) {
        for (const std::vector<Real>& s : patterns<Real>(classes, v)) check_row(run, s);
      }
    }
  });
}

void infinite_logit(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
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
  });
}

void one_hot_entropy(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const std::size_t classes : {2u, 28u, 1024u}) {
      for (const Real v : {Real(1e4), Real(1e30)}) {
        std::vector<Real> s(classes, Real(0)), gradient(classes, Real(-9));
        s[1] = v;
        run.measure(static_cast<double>(entropy_of(s)), 0, "entropy");
        const std::vector<Real> p = softmax_of(s);
        for (std::size_t c = 0; c < classes; ++c)
          run.measure(std::abs(static_cast<double>(p[c]) - (c == 1 ? 1 : 0)), 0, "probability");
        run.measure(loss_of<Real>(s, 1, &gradient).sum, 0, "loss");
        for (const Real g : gradient) run.measure(std::abs(g), 0, "gradient");
      }
    }
  });
}

void one_class(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    for (const Real v : {Real(0), Real(-7), Real(89), Real(1e30)}) {
      const std::vector<Real> s{v};
      std::vector<Real> gradient{Real(-9)};
      run.measure(loss_of<Real>(s, 0, &gradient).sum, 0, "loss");
      run.measure(std::abs(gradient[0]), 0, "gradient");
      run.measure(static_cast<double>(entropy_of(s)), 0, "entropy");
      run.measure(std::abs(static_cast<double>(softmax_of(s)[0]) - 1), 0, "probability");
      run.expect(loss_of<Real>(s, 0, nullptr).correct == 1, "the only class is right");
    }
  });
}

void one_labelled(CaseRun& run) {
  constexpr std::int64_t kRays = 1024;
  constexpr std::int32_t kClasses = 28;
  in_both_precisions(run, [&]<class Real>(Real) {
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
      run.measure(relative_error(normaliser, divisor), 0, "normaliser");
      std::vector<Real> gradient(logits.size(), Real(-9));
      const SemanticLoss loss = semantic_cross_entropy<Real>({logits.data(), kRays, kClasses}, targets, {}, normaliser,
                                                             1.0, {gradient.data(), kRays, kClasses});
      const double value = loss.sum / normaliser;
      run.expect(loss.labelled == 1, "one ray is labelled");
      run.measure(relative_error(value, want.surprise(one, 9) / divisor), tolerance_of<Real>(1e-6), "loss");
      if (first == 0) first = value;
      run.measure(std::abs(value * static_cast<double>(divisor) - first), 0, "ratio 1 : 1 : 1/1,024");
      for (std::size_t i = 0; i < gradient.size(); ++i) {
        const std::size_t ray = i / kClasses;
        const long double slope = ray == 700 ? want.slope(i % kClasses, 9) / divisor : 0.0L;
        run.measure(relative_error(gradient[i], slope), ray == 700 ? tolerance_of<Real>(1e-6) : 0.0, "gradient");
      }
    }
  });
}

void soft_labels(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    Numbers numbers(32);
    for (const double total : {0.9, 1.0, 1.1, 1e-20, 1e20}) {
      std::vector<Real> s;
      std::vector<float> target;
      long double sum = 0;
      for (int c = 0; c < 28; ++c) {
        s.push_back(static_cast<Real>(numbers.in(-5, 5)));
        target.push_back(c % 3 == 0 ? 0.f : static_cast<float>(numbers.uniform() * total / 9));
        sum += static_cast<long double>(target.back());
      }
      const Softmax row(s);
      long double want = 0;
      for (std::size_t c = 0; c < s.size(); ++c) want += static_cast<long double>(target[c]) / sum * row.surprise(s, c);
      SemanticTargets targets{.soft = row_of(std::as_const(target))};
      std::vector<Real> gradient(s.size());
      const double loss =
          semantic_cross_entropy<Real>(row_of(std::as_const(s)), targets, {}, 1.0, 1.0, row_of(gradient)).sum;
      run.measure(relative_error(loss, want), tolerance_of<Real>(1e-6), "loss");
      for (std::size_t c = 0; c < s.size(); ++c) {
        const long double slope = row.p[c] - static_cast<long double>(target[c]) / sum;
        run.measure(static_cast<double>(std::abs(static_cast<long double>(gradient[c]) - slope)),
                    tolerance_of<Real>(1e-7), "gradient");
      }
      run.measure(std::abs(labelled_weight(targets, {}) - 1), 0, "a soft row counts once");
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
  });
}

void class_weights(CaseRun& run) {
  run.row("fp32");
  const std::vector<std::vector<std::int64_t>> tables{
      {0, 0, 5, 1000000}, {0}, {0, 0}, {1, 1}, {0, std::int64_t{1} << 62}};
  for (const std::vector<std::int64_t>& pixels : tables) {
    long double total = 0;
    for (const std::int64_t n : pixels) total += static_cast<long double>(n);
    const std::vector<float> weights = inverse_log_frequency_weights(pixels);
    for (std::size_t c = 0; c < pixels.size(); ++c) {
      const long double frequency = total > 0 ? static_cast<long double>(pixels[c]) / total : 0.0L;
      run.measure(relative_error(weights[c], 1 / std::log(1.02L + frequency)), 1e-6, "weight");
      run.expect(weights[c] > 0 && weights[c] <= 50.5f, "at most 1 / ln 1.02");
    }
  }
  run.note(fmt::format("an absent class weighs {:.4f}", inverse_log_frequency_weights({0, 1})[0]));
}

void double_softmax(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    // What reaches the loss are logits: a margin of 40 costs e^-40. Were they probabilities by the time (softmax of
    // softmax), no margin could bring 28 classes below ln(1 + 27 / e) = 2.39.
    std::vector<Real> s(28, Real(0)), gradient(28);
    s[4] = 40;
    const long double want = std::log1p(27 * std::exp(-40.0L));
    run.measure(relative_error(loss_of<Real>(s, 4, &gradient).sum, want), tolerance_of<Real>(1e-6),
                "cross-entropy of a margin of 40");
    const std::vector<Real> twice = softmax_of(s);
    const double floor = std::log1p(27 * std::exp(-1.0));
    run.measure(relative_error(loss_of<Real>(twice, 4, nullptr).sum, floor), tolerance_of<Real>(1e-6),
                "what a second softmax would give");
    run.expect(!std::is_invocable_v<decltype(&semantic_cross_entropy<Real>), View<Real>, View<const float>,
                                    View<const float>, double, double, View<Real>, std::int64_t>,
               "bare probabilities are no targets to the compiler");
    run.note(fmt::format(
        "2nd softmax would cost {:.3f}; logits and probabilities share a view type, so this is shown by value", floor));
  });
}

}  // namespace semfield::numerics
