// The laws of groupings.
#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "core/rng.h"
#include "testkit/compare.h"
#include "testkit/gradient_check.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

constexpr double kGroupingScale = 0.37;
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

template <class Real>
View<const Real> flat(const std::vector<Real>& v) {
  return {v.data(), std::ssize(v), 1};
}

class GroupingLaws {
 public:
  GroupingLaws(const Grouping& grouping, const LawOptions& options) : grouping_(grouping), options_(options) {}

  Failures run() {
    require(grouping_.width() > 0, "width", "no outputs");
    require(grouping_.slow_share() >= 0 && grouping_.slow_share() < 1, "slow share", "not in [0, 1)");
    Points<double> at = points<double>(24), moved = at;
    require(std::isfinite(moved.add(grouping_, kGroupingScale)), "loss", "not finite");
    const auto value = [&] {
      Points<double> copy = at;
      return kGroupingScale * copy.add(grouping_, 0);
    };
    note("gradients", check_gradient(value, at.view(at.rows), column_as(moved), {1e-6, 1e-6, 200, options_.seed}));
    float_against_double();
    accumulate();
    numbers_of_segments();
    nothing();
    extremes();
    placed();
    return failures_;
  }

 private:
  template <class Real>
  Points<Real> points(std::int64_t count) const {
    return Points<Real>(count, grouping_.width(), options_.seed);
  }
  static View<const double> column_as(Points<double>& of) { return of.view(of.gradient); }
  void note(const std::string& law, const std::string& sentence) { note_failure(failures_, law, sentence); }
  void require(bool holds, const std::string& law, const std::string& sentence) {
    if (!holds) note(law, sentence);
  }

  void float_against_double() {
    Points<float> narrow = points<float>(97);
    Points<double> wide = points<double>(97);
    const double got = narrow.add(grouping_, kGroupingScale), want = wide.add(grouping_, kGroupingScale);
    require(std::abs(got - want) <= options_.float_tolerance * std::abs(want), "float against double, loss",
            std::to_string(got) + ", not " + std::to_string(want));
    note("float against double, gradients",
         compare(flat(narrow.gradient), flat(wide.gradient), options_.float_tolerance));
  }

  void accumulate() {
    Points<double> once = points<double>(31), thrice = once;
    const double sum = once.add(grouping_, 1);
    require(thrice.add(grouping_, 1) == sum && thrice.add(grouping_, 2) == sum, "the loss is before its scale",
            "it is another for another scale, or another time");
    for (double& d : once.gradient) d *= 3;
    note("gradients accumulate", compare(flat(thrice.gradient), flat(once.gradient), 1e-12));
  }

  // What a segment is called means nothing.
  void numbers_of_segments() {
    Points<double> as_they_are = points<double>(40), renamed = as_they_are;
    for (std::int32_t& s : renamed.segment) s = (s + 2) % kSegments;
    const double a = as_they_are.add(grouping_, 1), b = renamed.add(grouping_, 1);
    require(std::abs(a - b) <= 1e-9 * std::abs(a), "numbers of segments", "the loss depends on them");
    note("numbers of segments", compare(flat(renamed.gradient), flat(as_they_are.gradient), 1e-9));
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
    require(std::all_of(far.gradient.begin(), far.gradient.end(), [](float v) { return std::isfinite(v); }), "extremes",
            "a gradient is not finite");
  }

  void placed() {
    Points<float> at = points<float>(9);
    std::copy_n(at.rows.begin(), grouping_.width(), at.rows.begin() + grouping_.width());
    grouping_.place(at.view(at.rows));
    require(std::all_of(at.rows.begin(), at.rows.end(), [](float v) { return std::isfinite(v); }), "place",
            "a number is not finite");
    require(std::equal(at.rows.begin(), at.rows.begin() + grouping_.width(), at.rows.begin() + grouping_.width()),
            "place", "equal outputs have different places");
  }

  const Grouping& grouping_;
  LawOptions options_;
  Failures failures_;
};

}  // namespace

Failures grouping_laws(const Grouping& grouping, const LawOptions& options) {
  return GroupingLaws(grouping, options).run();
}

Failures grouping_laws(const Registry& registry, const std::string& name, const Settings& settings,
                       const LawOptions& options) {
  const PluginEntry& entry = registry.get(PluginKind::grouping, name);
  return grouping_laws(*entry.grouping(*make_params(entry, settings)), options);
}

}  // namespace semfield::testkit
