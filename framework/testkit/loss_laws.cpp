// The laws of groupings and losses.
#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "core/rng.h"
#include "testkit/compare.h"
#include "testkit/laws.h"
#include "testkit/loss_rays.h"

namespace semfield::testkit {

namespace {

constexpr double kScale = 0.37;
constexpr std::int32_t kSegments = 5;

// Rows, slow rows and segments of an image's points, the same in both precisions.
template <class Real>
struct Points {
  Points(std::int64_t count, std::int32_t width, std::uint64_t seed) : rows_count(count), cols(width) {
    const auto size = static_cast<std::size_t>(count * width);
    const RandomAddress address{seed, 0, stream_id("testkit/grouping")};
    for (std::size_t i = 0; i < size; ++i) {
      rows.push_back(static_cast<Real>(2 * uniform01(address, 2 * i) - 1));
      slow.push_back(static_cast<Real>(2 * uniform01(address, 2 * i + 1) - 1));
    }
    gradient.assign(size, Real(0));
    for (std::int64_t i = 0; i < count; ++i)
      segment.push_back(static_cast<std::int32_t>(
          uniform_below(address, static_cast<std::uint64_t>(i) + 1'000'000, static_cast<std::uint64_t>(kSegments))));
  }
  View<Real> view(std::vector<Real>& of) const { return {of.data(), rows_count, cols}; }
  double add(const Grouping& grouping, double scale) {
    return grouping.add({view(rows), view(slow), segment, kSegments}, scale, view(gradient));
  }
  std::int64_t rows_count;
  std::int32_t cols;
  std::vector<Real> rows, slow, gradient;
  std::vector<std::int32_t> segment;
};

// Numbers of rows, by their name in failures, and their gradient.
template <class Rows, class Real>
struct Gradient {
  std::string_view name;
  std::vector<Real> Rows::*value;
  std::vector<Real> Rows::*gradient;
};
std::string about(std::string_view name) { return "gradient of " + std::string(name); }

template <class Real>
View<const Real> column(const std::vector<Real>& v) {
  return {v.data(), std::ssize(v), 1};
}

class Notes {
 protected:
  explicit Notes(const LawOptions& options) : options_(options) {}
  template <class Laws>
  void ask(const char* law, void (Laws::*body)()) {
    options_.begin(law);
    (static_cast<Laws&>(*this).*body)();
  }
  void note(const std::string& law, const std::string& sentence) { note_failure(failures_, law, sentence); }
  void require(bool holds, const std::string& law, const std::string& sentence) {
    if (!holds) note(law, sentence);
  }
  // What a grouping or a loss adds to rows of either precision; a gradient has a name and is a member of the rows.
  template <class Narrow, class Wide, class Subject, class NarrowGradients, class WideGradients>
  void float_against_double(Narrow narrow, Wide wide, const Subject& subject, const NarrowGradients& narrow_gradients,
                            const WideGradients& wide_gradients) {
    const double got = narrow.add(subject, kScale), want = wide.add(subject, kScale);
    require(std::abs(got - want) <= options_.float_tolerance * std::abs(want), "float against double, loss",
            std::to_string(got) + ", not " + std::to_string(want));
    for (std::size_t i = 0; i < narrow_gradients.size(); ++i)
      note("float against double, " + about(narrow_gradients[i].name),
           compare(column(narrow.*narrow_gradients[i].gradient), column(wide.*wide_gradients[i].gradient),
                   options_.float_tolerance));
  }
  template <class Rows, class Subject, class Gradients>
  void accumulate(Rows once, const Subject& subject, const Gradients& gradients) {
    Rows thrice = once;
    const double sum = once.add(subject, 1);
    require(thrice.add(subject, 1) == sum && thrice.add(subject, 2) == sum, "the loss is before its scale",
            "it is another for another scale, or another time");
    for (const auto& one : gradients) {
      for (double& d : once.*one.gradient) d *= 3;
      note("gradients accumulate, " + std::string(one.name),
           compare(column(thrice.*one.gradient), column(once.*one.gradient), 1e-12));
    }
  }
  void require_finite(const std::vector<float>& values, const std::string& law, const std::string& sentence) {
    require(std::all_of(values.begin(), values.end(), [](float v) { return std::isfinite(v); }), law, sentence);
  }

  LawOptions options_;
  Failures failures_;
};

class GroupingLaws : public Notes {
 public:
  GroupingLaws(const Grouping& grouping, const LawOptions& options) : Notes(options), grouping_(grouping) {}

  Failures run() {
    options_.begin("gradients");
    require(grouping_.width() > 0, "width", "no outputs");
    require(grouping_.slow_share() >= 0 && grouping_.slow_share() < 1, "slow share", "not in [0, 1)");
    Points<double> at = points<double>(24), moved = at;
    require(std::isfinite(moved.add(grouping_, kScale)), "loss", "not finite");
    const auto value = [&] {
      Points<double> copy = at;
      return kScale * copy.add(grouping_, 0);
    };
    note("gradients",
         check_gradient(value, at.view(at.rows), moved.view(moved.gradient), {1e-6, 1e-6, 200, options_.seed}));
    options_.begin("float against double");
    float_against_double(points<float>(97), points<double>(97), grouping_, gradients<float>(), gradients<double>());
    accumulate(points<double>(31), grouping_, gradients<double>());
    ask("numbers of segments", &GroupingLaws::numbers_of_segments);
    ask("no points", &GroupingLaws::nothing);
    ask("extremes", &GroupingLaws::extremes);
    ask("place", &GroupingLaws::placed);
    return failures_;
  }

 private:
  template <class Real>
  Points<Real> points(std::int64_t count) const {
    return Points<Real>(count, grouping_.width(), options_.seed);
  }

  template <class Real>
  static std::vector<Gradient<Points<Real>, Real>> gradients() {
    return {{"rows", &Points<Real>::rows, &Points<Real>::gradient}};
  }

  // What a segment is called means nothing.
  void numbers_of_segments() {
    Points<double> as_they_are = points<double>(40), renamed = as_they_are;
    for (std::int32_t& s : renamed.segment) s = (s + 2) % kSegments;
    const double a = as_they_are.add(grouping_, 1), b = renamed.add(grouping_, 1);
    require(std::abs(a - b) <= 1e-9 * std::abs(a), "numbers of segments", "the loss depends on them");
    note("numbers of segments", compare(column(renamed.gradient), column(as_they_are.gradient), 1e-9));
  }

  void nothing() {
    Points<double> none = points<double>(0), one = points<double>(1);
    require(none.add(grouping_, 1) == 0, "no points", "their loss is not 0");
    require(std::isfinite(one.add(grouping_, 1)), "one point", "its loss is not finite");
  }

  void extremes() {
    Points<float> far = points<float>(16);
    for (float& v : far.rows) v *= 1e4F;
    require(std::isfinite(far.add(grouping_, 1)), "extremes", "the loss is not finite");
    require_finite(far.gradient, "extremes", "a gradient is not finite");
  }

  void placed() {
    Points<float> at = points<float>(9);
    std::copy_n(at.rows.begin(), grouping_.width(), at.rows.begin() + grouping_.width());
    grouping_.place(at.view(at.rows));
    require_finite(at.rows, "place", "a number is not finite");
    require(std::equal(at.rows.begin(), at.rows.begin() + grouping_.width(), at.rows.begin() + grouping_.width()),
            "place", "equal outputs have different places");
  }

  const Grouping& grouping_;
};

}  // namespace

Failures grouping_laws(const Grouping& grouping, const LawOptions& options) {
  return GroupingLaws(grouping, options).run();
}

// The laws of losses.

namespace {

template <class Real>
std::vector<Gradient<LossRays<Real>, Real>> every_gradient(const std::string& head) {
  using Rays = LossRays<Real>;
  std::vector<Gradient<Rays, Real>> all{{channel::color, &Rays::color, &Rays::d_color},
                                        {channel::depth, &Rays::depth, &Rays::d_depth},
                                        {channel::weight, &Rays::weight, &Rays::d_weight},
                                        {channel::sigma, &Rays::sigma, &Rays::d_sigma},
                                        {channel::logits, &Rays::logits, &Rays::d_logits}};
  if (!head.empty()) all.push_back({head, &Rays::made, &Rays::d_made});
  return all;
}

class LossLaws : public Notes {
 public:
  LossLaws(const Loss& loss, const LawOptions& options, bool soft_labels)
      : Notes(options), loss_(loss), traits_(loss.traits()), further_(traits_), soft_(soft_labels) {
    lengths_ = awkward_ray_lengths();
    if (options.many_rows < 4097)
      for (int& length : lengths_) length = std::min(length, 9);  // one that is slow
  }

  Failures run() {
    ask("counted rays", &LossLaws::declared);
    ask("gradients", &LossLaws::central_differences);
    ask("traits", &LossLaws::moves);
    options_.begin("float against double");
    float_against_double(rays<float>(lengths_), rays<double>(lengths_), loss_, gradients<float>(), gradients<double>());
    accumulate(rays<double>(lengths_), loss_, gradients<double>());
    ask("rays are independent", &LossLaws::rays_alone);
    ask("no ray", &LossLaws::nothing);
    without_targets();
    ask("rays without a label", &LossLaws::unlabelled);
    ask("extremes", &LossLaws::extremes);
    return failures_;
  }

 private:
  template <class Real>
  LossRays<Real> rays(const std::vector<int>& counts) const {
    return LossRays<Real>(counts, options_.seed, soft_, further_);
  }
  template <class Real>
  std::vector<Gradient<LossRays<Real>, Real>> gradients() const {
    return every_gradient<Real>(further_.head);
  }

  void declared() {
    require(loss_.rule().weight > 0, "traits", "the default weight is 0: a loss that is named works");
    require(!traits_.moves.empty(), "traits", "it moves nothing");
    LossRays<double> all = rays<double>(lengths_);
    const std::int64_t counted = loss_.counted_rays(all.targets(), all.rays());
    require(counted > 0 && counted <= all.rays(), "counted rays",
            std::to_string(counted) + " of " + std::to_string(all.rays()));
  }

  // Of every value that a loss sees, moved by its traits or not: a slope that it does not give must be none.
  void central_differences() {
    LossRays<double> at = rays<double>({7, 0, 1, 12, 3, 5});
    at.sum_opacity();
    LossRays<double> moved = at;
    moved.add(loss_, kScale);
    const auto value = [&] {
      LossRays<double> copy = at;
      copy.sum_opacity();
      return kScale * copy.add(loss_, 0);
    };
    const GradientCheck check{1e-6, 1e-6, 16 * options_.gradient_elements, options_.seed};
    for (const auto& one : gradients<double>())
      note(about(one.name),
           check_gradient(value, LossRays<double>::mat(at.*one.value, 1), column(moved.*one.gradient), check));
  }

  void moves() {
    LossRays<double> all = rays<double>(lengths_);
    require(all.add(loss_, kScale) > 0, "traits", "random rays cost nothing");
    for (const auto& one : gradients<double>()) {
      const std::vector<double>& gradient = all.*one.gradient;
      const bool any = std::any_of(gradient.begin(), gradient.end(), [](double d) { return d != 0; });
      require(any == traits_.does_move(one.name), "traits",
              std::string(any ? "moves " : "does not move ") + std::string(one.name) + ", and says otherwise");
    }
  }

  void rays_alone() {
    LossRays<float> whole = rays<float>(lengths_), parts = whole;
    const double sum = whole.add(loss_, kScale);
    double of_parts = 0;
    for (std::int64_t r = 0; r < parts.rays(); r += 5) {
      const std::int64_t count = std::min<std::int64_t>(5, parts.rays() - r);
      of_parts += loss_.add(parts.targets(r, count), parts.values(r, count), kScale, parts.gradients(r, count));
    }
    require(std::abs(of_parts - sum) <= 1e-6 * std::abs(sum), "rays are independent, loss",
            std::to_string(of_parts) + ", not " + std::to_string(sum));
    for (const auto& one : gradients<float>())
      note("rays are independent, " + about(one.name),
           compare_bits(column(parts.*one.gradient), column(whole.*one.gradient)));
  }

  void nothing() {
    LossRays<float> none = rays<float>({});
    require(none.add(loss_, kScale) == 0, "no ray", "has a loss");
    if (!traits_.does_move(channel::weight) && !traits_.does_move(channel::sigma)) return;
    LossRays<float> empty = rays<float>({0, 0});
    require(empty.add(loss_, kScale) == 0, "rays without a sample", "have a loss");
  }

  // Each target that it cannot do without, taken away.
  void without_targets() {
    for (const std::string_view name : traits_.targets) {
      LossRays<float> all = rays<float>(lengths_);
      RayTargets targets;
      const RayTargets given = all.targets();
      if (name != channel::color) targets.color = given.color;
      if (name != channel::label) targets.label = given.label;
      for (const auto& one : given.more)
        if (one.name != name && name != channel::label) targets.more.set(one.name, one.view);
      const std::string law = "without " + std::string(name);
      options_.begin(law);
      require(loss_.counted_rays(targets, all.rays()) == 0, law, "rays are counted");
      require(loss_.add(targets, all.values(), kScale, all.gradients()) == 0, law, "there is a loss");
    }
  }

  void unlabelled() {
    if (!traits_.reads_target(channel::label)) return;
    LossRays<double> all = rays<double>(lengths_), other = all;
    for (std::int64_t r = 0; r < all.semantic_rays; ++r) {
      if (all.label[static_cast<std::size_t>(r)] >= 0) continue;
      for (std::int32_t c = 0; c < all.kClasses; ++c) other.logits[static_cast<std::size_t>(r * all.kClasses + c)] += 1;
    }
    require(all.add(loss_, kScale) == other.add(loss_, kScale), "rays without a label", "have a loss");
    for (std::int64_t r = 0; r < all.semantic_rays; ++r) {
      if (all.label[static_cast<std::size_t>(r)] >= 0) continue;
      for (std::int32_t c = 0; c < all.kClasses; ++c) {
        if (all.d_logits[static_cast<std::size_t>(r * all.kClasses + c)] == 0) continue;
        return note("rays without a label", "have a gradient of logits");
      }
    }
  }

  // An interval without an end, a near of 0, weights of 0 and logits far apart give finite numbers.
  void extremes() {
    LossRays<float> three = rays<float>({4, 3, 2});
    for (std::size_t r = 0; r < 3; ++r) three.near_far[2 * r] = 0;
    three.t = {0, 1, 1, 2, 0, 0, 0, 1e-30F, 3};
    three.delta[3] = three.delta[8] = INFINITY;
    three.weight = {0, 1, 0, 0, 0, 0, 0, 0.5F, 0.5F};
    for (std::size_t i = 0; i < three.logits.size(); ++i) three.logits[i] = i % 2 == 0 ? 1e4F : -1e4F;
    for (std::size_t i = 0; i < three.made.size(); ++i) three.made[i] = i < three.made.size() / 2 ? 0 : 1e18F;
    require(std::isfinite(three.add(loss_, kScale)), "extremes", "the loss is not finite");
    for (const auto& one : gradients<float>())
      require_finite(three.*one.gradient, "extremes", about(one.name) + " is not finite");
  }

  const Loss& loss_;
  LossTraits traits_;
  FurtherChannels further_;
  bool soft_;
  std::vector<int> lengths_;
};

}  // namespace

Failures loss_laws(const Loss& loss, const LawOptions& options) {
  Failures failures = LossLaws(loss, options, false).run();
  if (!loss.traits().reads_target(channel::label)) return failures;
  for (const std::string& failure : LossLaws(loss, options, true).run()) failures.push_back("soft labels: " + failure);
  return failures;
}

}  // namespace semfield::testkit
