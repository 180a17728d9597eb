#include "studies/quadrature_rays.h"

#include <algorithm>
#include <cmath>
#include <ctime>
#include <limits>

#include "core/error.h"
#include "model/compositor.h"
#include "plugin/quadrature.h"

namespace semfield {

namespace {

constexpr std::int64_t kTileRays = 16;
constexpr double kLeastTimed_s = 0.002;  // shorter measurements are repeated

const char* const kSamples = "samples";
const char* const kQuadrature = "quadrature";

// Finds, and sets when told to, the two parameters that all samplers with rules have.
class RuleParams final : public ParamVisitor {
 public:
  RuleParams() = default;
  RuleParams(std::int64_t samples, std::string choice) : samples_(samples), choice_(std::move(choice)) {}
  bool complete() const { return has_samples_ && !choices_.empty(); }
  const std::vector<std::string>& choices() const { return choices_; }

  void boolean(const ParamInfo&, bool&) override {}
  void integer(const ParamInfo& info, std::int64_t& value) override {
    if (info.name != kSamples) return;
    has_samples_ = true;
    if (samples_ > 0) value = samples_;
  }
  void real(const ParamInfo&, double&) override {}
  void text(const ParamInfo&, std::string&) override {}
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    if (info.name != kQuadrature) return;
    choices_.assign(names.begin(), names.end());
    for (std::size_t i = 0; i < names.size(); ++i) {
      if (names[i] == choice_) value = static_cast<int>(i);
    }
  }
  void integers(const ParamInfo&, std::vector<std::int64_t>&) override {}
  void reals(const ParamInfo&, std::vector<double>&) override {}
  void texts(const ParamInfo&, std::vector<std::string>&) override {}

 private:
  std::int64_t samples_ = 0;
  std::string choice_;
  std::vector<std::string> choices_;
  bool has_samples_ = false;
};

SamplerBuild build_of(const RayProblem& p) {
  SamplerBuild build;
  build.bounds = {{p.near_m, -1, -1}, {p.far_m, 1, 1}};
  build.near_m = p.near_m;
  build.far_m = p.far_m;
  return build;
}

template <class Real>
std::unique_ptr<Sampler<Real>> make_sampler(const PluginEntry& entry, std::int64_t samples, const std::string& choice,
                                            const RayProblem& p, const Registry& registry) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  RuleParams setter(samples, choice);
  params->describe(setter);
  if constexpr (sizeof(Real) == sizeof(float)) {
    return entry.sampler32(*params, build_of(p), registry.kernels());
  } else {
    return entry.sampler64(*params, build_of(p), registry.kernels());
  }
}

// The registered samplers with a rule; the first that needs no earlier pass proposes to the others.
std::vector<const PluginEntry*> samplers_with_rules(const Registry& registry) {
  std::vector<const PluginEntry*> out;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != PluginKind::sampler) continue;
    RuleParams finder;
    entry->new_params()->describe(finder);
    if (finder.complete()) out.push_back(entry);
  }
  return out;
}

bool needs_previous(const PluginEntry& entry, const Registry& registry) {
  return make_sampler<double>(entry, 1, "", constant_medium(1), registry)->traits().needs_previous;
}

const PluginEntry& first_pass_sampler(const Registry& registry) {
  for (const PluginEntry* entry : samplers_with_rules(registry)) {
    if (!needs_previous(*entry, registry)) return *entry;
  }
  throw Error(ErrorKind::config, "study.sampler.missing",
              "no registered sampler has the parameters 'samples' and 'quadrature'",
              "build with the stratified sampler");
}

double softmax_first(const double* logits) {
  double sum = 0;
  for (int j = 0; j < kBenchClasses; ++j) sum += std::exp(logits[j] - logits[0]);
  return 1 / sum;
}

// Buffers of one pass of a tile.
template <class Real>
struct PassBuffers {
  explicit PassBuffers(std::int64_t capacity)
      : t(size(capacity)),
        delta(size(capacity)),
        sigma(size(capacity)),
        rgb(size(capacity * 3)),
        hidden(size(capacity * kBenchClasses)),
        weight(size(capacity)),
        ray(size(capacity)),
        first(size(kTileRays + 1)) {
    samples = {View<Real>(t.data(), capacity, 1), View<Real>(delta.data(), capacity, 1),
               View<std::int32_t>(ray.data(), capacity, 1), View<std::int32_t>(first.data(), kTileRays + 1, 1), 0};
  }
  static std::size_t size(std::int64_t n) { return static_cast<std::size_t>(n); }
  std::vector<Real> t, delta, sigma, rgb, hidden, weight;
  std::vector<std::int32_t> ray, first;
  Samples<Real> samples;
};

/// Renders rays of a problem by a sampler, tile by tile.
template <class Real>
class SampledRays {
 public:
  SampledRays(const RayProblem& p, const QuadratureRule& rule, std::int64_t n, const Registry& registry)
      : p_(p), rule_(rule), coarse_(rule.guided ? std::max<std::int64_t>(1, n / 4) : 0) {
    const PluginEntry& entry = registry.get(PluginKind::sampler, rule.sampler);
    if (rule.guided) proposer_ = make_sampler<Real>(first_pass_sampler(registry), coarse_, rule.choice, p, registry);
    sampler_ = make_sampler<Real>(entry, n - coarse_, rule.choice, p, registry);
    if (proposer_) proposal_ = std::make_unique<PassBuffers<Real>>(proposer_->capacity(kTileRays, 0));
    pass_ = std::make_unique<PassBuffers<Real>>(sampler_->capacity(kTileRays, coarse_));
    for (std::int64_t r = 0; r < kTileRays; ++r) {
      direction_[static_cast<std::size_t>(3 * r)] = 1;
      near_far_[static_cast<std::size_t>(2 * r)] = p.near_m;
      near_far_[static_cast<std::size_t>(2 * r + 1)] = p.far_m;
    }
  }

  double evaluations() const { return evaluations_; }

  /// Rays begin .. begin + count - 1, count <= kTileRays.
  void render(std::int64_t begin, std::int64_t count, const double* shifts, std::array<double, kQuantities>* out) {
    Rays<Real> rays;
    rays.origin = View<const double>(origin_.data(), count, 3);
    rays.direction = View<const double>(direction_.data(), count, 3);
    rays.near_far = View<const double>(near_far_.data(), count, 2);
    StepContext ctx;
    ctx.training = rule_.training;
    ctx.first_ray = begin;
    ctx.workspace = &arena_;
    evaluations_ = 0;
    Proposal<Real> proposal;
    if (proposer_) {
      sample_and_evaluate(*proposer_, ctx, rays, nullptr, shifts, *proposal_);
      CompositeIn<Real> in = input(*proposal_);
      CompositeOut<Real> weights;
      weights.weight = View<Real>(proposal_->weight.data(), proposal_->samples.count, 1);
      composite_forward(in, weights);
      proposal = {&proposal_->samples, weights.weight};
      ctx.pass = 1;
    }
    sample_and_evaluate(*sampler_, ctx, rays, proposer_ ? &proposal : nullptr, shifts, *pass_);
    std::array<Real, 3 * kTileRays> color{}, hidden{};
    std::array<Real, kTileRays> depth{}, opacity{};
    CompositeOut<Real> composed;
    composed.color = View<Real>(color.data(), count, 3);
    composed.depth = View<Real>(depth.data(), count, 1);
    composed.opacity = View<Real>(opacity.data(), count, 1);
    composed.hidden = View<Real>(hidden.data(), count, kBenchClasses);
    composed.weight = View<Real>(pass_->weight.data(), pass_->samples.count, 1);
    composite_forward(input(*pass_), composed);
    for (std::int64_t r = 0; r < count; ++r) {
      const auto i = static_cast<std::size_t>(r);
      std::array<double, kBenchClasses> logits{};
      for (std::size_t j = 0; j < kBenchClasses; ++j) logits[j] = static_cast<double>(hidden[kBenchClasses * i + j]);
      out[r] = {static_cast<double>(color[3 * i]), static_cast<double>(opacity[i]), static_cast<double>(depth[i]),
                softmax_first(logits.data())};
    }
  }

 private:
  static CompositeIn<Real> input(const PassBuffers<Real>& b) {
    CompositeIn<Real> in;
    in.samples = &b.samples;
    in.sigma = View<const Real>(b.sigma.data(), b.samples.count, 1);
    in.rgb = View<const Real>(b.rgb.data(), b.samples.count, 3);
    in.hidden = View<const Real>(b.hidden.data(), b.samples.count, kBenchClasses);
    return in;
  }

  void sample_and_evaluate(const Sampler<Real>& sampler, const StepContext& ctx, const Rays<Real>& rays,
                           const Proposal<Real>* previous, const double* shifts, PassBuffers<Real>& b) {
    b.samples.first = View<std::int32_t>(b.first.data(), rays.origin.rows + 1, 1);
    sampler.sample(ctx, {}, rays, previous, b.samples);
    evaluations_ += static_cast<double>(b.samples.count) / static_cast<double>(rays.origin.rows);
    for (std::int64_t r = 0; r < rays.origin.rows; ++r) {
      const auto begin = static_cast<std::size_t>(b.first[static_cast<std::size_t>(r)]);
      const auto end = static_cast<std::size_t>(b.first[static_cast<std::size_t>(r + 1)]);
      const std::size_t n = end - begin;
      if (at_.size() < n) {
        at_.resize(n);
        sigma_.resize(n);
        color_.resize(n);
        logits_.resize(n * kBenchClasses);
      }
      for (std::size_t k = 0; k < n; ++k) at_[k] = static_cast<double>(b.t[begin + k]);
      p_.field->evaluate({at_.data(), n}, shifts[r], sigma_.data(), color_.data(), logits_.data());
      for (std::size_t k = 0; k < n; ++k) {
        b.sigma[begin + k] = static_cast<Real>(sigma_[k]);
        for (std::size_t c = 0; c < 3; ++c) b.rgb[3 * (begin + k) + c] = static_cast<Real>(color_[k]);
      }
      for (std::size_t j = 0; j < n * kBenchClasses; ++j)
        b.hidden[kBenchClasses * begin + j] = static_cast<Real>(logits_[j]);
    }
  }

  const RayProblem& p_;
  const QuadratureRule& rule_;
  std::int64_t coarse_;
  std::unique_ptr<Sampler<Real>> proposer_, sampler_;
  std::unique_ptr<PassBuffers<Real>> proposal_, pass_;
  std::array<double, 3 * kTileRays> origin_{}, direction_{};
  std::array<double, 2 * kTileRays> near_far_{};
  std::vector<double> at_, sigma_, color_, logits_;
  Workspace arena_;
  double evaluations_ = 0;
};

/// Rules of the literature on N equal intervals; sums in double, values and exponentials in Real, as in the compositor.
template <class Real>
class LiteratureRays {
 public:
  LiteratureRays(const RayProblem& p, const QuadratureRule& rule, std::int64_t n) : p_(p), rule_(rule), n_(n) {
    const double h = (p.far_m - p.near_m) / static_cast<double>(n);
    const auto add = [&](double at) { at_.push_back(static_cast<double>(static_cast<Real>(at))); };
    const bool gauss = rule.shape == RuleShape::fourth;
    for (std::int64_t k = 0; k < n; ++k) {
      const double begin = p.near_m + h * static_cast<double>(k);
      add(begin + (gauss ? h * kGaussNode : 0));
      if (gauss) add(begin + h * (1 - kGaussNode));
    }
    if (rule.shape == RuleShape::second) add(p.far_m);
    h_ = static_cast<Real>(h);
    sigma_.resize(at_.size());
    values_.resize(at_.size());
    color_.resize(at_.size());
    logits_.resize(at_.size() * kBenchClasses);
  }

  double evaluations() const { return static_cast<double>(at_.size()); }

  void render(std::int64_t, std::int64_t count, const double* shifts, std::array<double, kQuantities>* out) {
    for (std::int64_t r = 0; r < count; ++r) {
      p_.field->evaluate(at_, shifts[r], sigma_.data(), color_.data(), logits_.data());
      for (std::size_t k = 0; k < at_.size(); ++k) {
        sigma_[k] = static_cast<double>(static_cast<Real>(sigma_[k]));
        values_[k] = {1, static_cast<Real>(color_[k]), static_cast<Real>(at_[k])};
        for (std::size_t j = 0; j < kBenchClasses; ++j)
          values_[k][3 + j] = static_cast<Real>(logits_[kBenchClasses * k + j]);
      }
      Sums sums{};
      double tau = 0;
      for (std::size_t k = 0; k < static_cast<std::size_t>(n_); ++k) interval(k, tau, sums);
      out[r] = {sums[1], sums[0], sums[2], softmax_first(sums.data() + 3)};
    }
  }

 private:
  static constexpr double kGaussNode = 0.21132486540518711775;  // (1 - 1/sqrt 3) / 2
  using Sums = std::array<double, 3 + kBenchClasses>;           // opacity, colour, depth, logits

  static void add(Sums& sums, Real weight, const std::array<Real, 3 + kBenchClasses>& value) {
    for (std::size_t c = 0; c < sums.size(); ++c) sums[c] += static_cast<double>(weight * value[c]);
  }

  void interval(std::size_t k, double& tau, Sums& sums) const {
    const Real before = std::exp(static_cast<Real>(-tau));
    if (rule_.shape == RuleShape::fourth) {
      // Two points of the integrand sigma T v itself, T by the line through both densities.
      const Real a = static_cast<Real>(sigma_[2 * k]), b = static_cast<Real>(sigma_[2 * k + 1]);
      const Real g = static_cast<Real>(kGaussNode);
      const Real slope = (b - a) / (1 - 2 * g);
      for (const bool second : {false, true}) {
        const Real x = second ? 1 - g : g;
        const Real inside = std::max(Real(0), h_ * (a * x + slope * (x * x / 2 - g * x)));  // the line may dip below 0
        const Real weight = h_ / 2 * (second ? b : a) * before * std::exp(-inside);
        add(sums, weight, values_[2 * k + (second ? 1 : 0)]);
      }
      tau += static_cast<double>(h_) * static_cast<double>(a + b) / 2;
      return;
    }
    const bool nodes = rule_.shape == RuleShape::second;  // else the left ends
    const Real sigma = nodes ? static_cast<Real>((sigma_[k] + sigma_[k + 1]) / 2) : static_cast<Real>(sigma_[k]);
    const Real x = sigma * h_;
    const Real weight = before * -std::expm1(-x);
    const Real share = nodes ? (rule_.choice == "linear" ? mean_place(x) : Real(0.5)) : Real(0);
    add(sums, weight * (1 - share), values_[k]);
    if (nodes) add(sums, weight * share, values_[k + 1]);
    tau += static_cast<double>(x);
  }

  // Where in an interval of optical depth x light comes from in the mean: 1/x - e^-x / (1 - e^-x).
  static Real mean_place(Real x) {
    if (x < Real(1e-2)) return Real(0.5) - x / 12 + x * x * x / 720;
    return 1 / x - 1 / std::expm1(x);
  }

  const RayProblem& p_;
  const QuadratureRule& rule_;
  std::int64_t n_;
  Real h_ = 0;
  std::vector<double> at_, sigma_, color_, logits_;
  std::vector<std::array<Real, 3 + kBenchClasses>> values_;
};

double processor_now_s() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

template <class Renderer>
Rendered render_all(Renderer&& renderer, const std::vector<double>& shifts, bool timed) {
  const auto rays = static_cast<std::int64_t>(shifts.size());
  Rendered out;
  out.rays.resize(shifts.size());
  out.seconds = std::numeric_limits<double>::infinity();
  double spent = 0;
  do {
    const double start = processor_now_s();
    for (std::int64_t begin = 0; begin < rays; begin += kTileRays)
      renderer.render(begin, std::min(kTileRays, rays - begin), shifts.data() + begin, out.rays.data() + begin);
    const double seconds = processor_now_s() - start;
    out.seconds = std::min(out.seconds, seconds / static_cast<double>(rays));
    spent += seconds;
  } while (timed && spent < kLeastTimed_s);
  out.evaluations = renderer.evaluations();
  return out;
}

}  // namespace

std::vector<QuadratureRule> quadrature_rules(const Registry& registry) {
  std::vector<QuadratureRule> out;
  for (const PluginEntry* entry : samplers_with_rules(registry)) {
    const bool guided = needs_previous(*entry, registry);
    RuleParams finder;
    entry->new_params()->describe(finder);
    const auto add = [&](const std::string& choice, const std::string& suffix, bool training, RuleShape shape) {
      out.push_back({(guided ? entry->name + " " : "") + choice + suffix, guided ? RuleShape::second : shape,
                     entry->name, choice, training, guided});
      if (guided && choice == ChoiceNames<Quadrature>::names[0]) out.back().shape = RuleShape::left;
    };
    for (const std::string& choice : finder.choices()) {
      const bool fixed = choice == ChoiceNames<Quadrature>::names[static_cast<std::size_t>(Quadrature::midpoint)];
      const bool paper = choice == ChoiceNames<Quadrature>::names[static_cast<std::size_t>(Quadrature::paper)];
      if (fixed) {
        add(choice, "", false, RuleShape::midpoint);
        continue;
      }
      add(choice, paper ? ", training" : "", true, paper ? RuleShape::paper_training : RuleShape::bin_training);
      if (paper) add(choice, ", rendering", false, RuleShape::paper_rendering);
    }
  }
  std::stable_sort(out.begin(), out.end(),
                   [](const QuadratureRule& a, const QuadratureRule& b) { return a.guided < b.guided; });
  out.push_back({"left grid", RuleShape::left, "", "left", false, false});
  out.push_back({"trapezoid", RuleShape::second, "", "trapezoid", false, false});
  out.push_back({"linear colour", RuleShape::second, "", "linear", false, false});
  out.push_back({"Gauss 2", RuleShape::fourth, "", "gauss", false, false});
  return out;
}

template <class Real>
Rendered render_rule(const RayProblem& p, const QuadratureRule& rule, std::int64_t samples,
                     const std::vector<double>& shifts, const Registry& registry, bool timed) {
  if (rule.sampler.empty()) return render_all(LiteratureRays<Real>(p, rule, samples), shifts, timed);
  return render_all(SampledRays<Real>(p, rule, samples, registry), shifts, timed);
}

template Rendered render_rule<float>(const RayProblem&, const QuadratureRule&, std::int64_t, const std::vector<double>&,
                                     const Registry&, bool);
template Rendered render_rule<double>(const RayProblem&, const QuadratureRule&, std::int64_t,
                                      const std::vector<double>&, const Registry&, bool);

}  // namespace semfield
