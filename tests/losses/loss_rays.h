// Rays with samples, values and targets for tests of loss terms, and every setting that a term's choices have.
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "core/rng.h"
#include "losses/loss_term.h"

namespace semfield::testing {

/// Random rays of given sample counts. Every third ray has no known depth.
template <class Real>
struct LossRays {
  explicit LossRays(const std::vector<int>& counts, std::uint64_t seed = 1) {
    auto uniform = [&, next = std::uint64_t{0}](double low, double high) mutable {
      // As float: the same numbers in every precision.
      return static_cast<float>(low + (high - low) * static_cast<double>(uniform01({seed, 0, 0x10557}, next++)));
    };
    first.push_back(0);
    for (std::size_t r = 0; r < counts.size(); ++r) {
      const auto near_m = static_cast<double>(uniform(0.05, 0.5)), far_m = static_cast<double>(uniform(3, 6));
      near_far.insert(near_far.end(), {counts[r] == 0 ? 0 : near_m, counts[r] == 0 ? 0 : far_m});
      double sum = 0, place = 0;
      const auto each = static_cast<float>((far_m - near_m) / std::max(counts[r], 1));
      for (int k = 0; k < counts[r]; ++k) {
        t.push_back(static_cast<float>(near_m) + (static_cast<float>(k) + uniform(0, 1)) * each);
        delta.push_back(each);
        sigma.push_back(uniform(0, 3));
        const float w = uniform(0, 1) / static_cast<float>(counts[r]);
        weight.push_back(w);
        sum += static_cast<double>(w);
        place += static_cast<double>(w) * static_cast<double>(t.back());
      }
      for (int c = 0; c < 3; ++c) {
        color.push_back(uniform(0, 1));
        color_target.push_back(uniform(0, 1));
      }
      depth.push_back(static_cast<float>(place));
      opacity.push_back(static_cast<float>(sum));
      const float truth = uniform(0.5, 4);
      depth_target.push_back(r % 3 == 2 || counts[r] == 0 ? 0.0F : truth);
      first.push_back(static_cast<std::int32_t>(t.size()));
    }
    for (auto* v : {&d_color}) v->assign(color.size(), Real(0));
    for (auto* v : {&d_depth}) v->assign(depth.size(), Real(0));
    for (auto* v : {&d_weight, &d_sigma}) v->assign(t.size(), Real(0));
  }
  std::int64_t rays() const { return static_cast<std::int64_t>(first.size()) - 1; }
  template <class T>
  static View<T> mat(std::vector<T>& v, std::int32_t cols) {
    return View<T>(v.data(), static_cast<std::int64_t>(v.size()) / cols, cols);
  }
  RayTargets targets(std::int64_t begin = 0, std::int64_t count = -1) {
    RayTargets out;
    out.color = mat(color_target, 3).row_range(begin, count < 0 ? rays() : count);
    out.depth = mat(depth_target, 1).row_range(begin, count < 0 ? rays() : count);
    return out;
  }
  /// Rays [begin, begin + count); sample arrays stay whole.
  RayValues<Real> values(std::int64_t begin = 0, std::int64_t count = -1) {
    const std::int64_t n = count < 0 ? rays() : count;
    RayValues<Real> out;
    out.near_far = mat(near_far, 2).row_range(begin, n);
    out.first = mat(first, 1).row_range(begin, n + 1);
    out.t = mat(t, 1);
    out.delta = mat(delta, 1);
    out.sigma = mat(sigma, 1);
    out.weight = mat(weight, 1);
    out.color = mat(color, 3).row_range(begin, n);
    out.depth = mat(depth, 1).row_range(begin, n);
    out.opacity = mat(opacity, 1).row_range(begin, n);
    return out;
  }
  RayGradients<Real> gradients(std::int64_t begin = 0, std::int64_t count = -1) {
    const std::int64_t n = count < 0 ? rays() : count;
    return {mat(d_color, 3).row_range(begin, n), mat(d_depth, 1).row_range(begin, n), mat(d_weight, 1),
            mat(d_sigma, 1)};
  }
  double add(const LossTerm& term, double scale) { return term.add(targets(), values(), scale, gradients()); }

  std::vector<std::int32_t> first;
  std::vector<double> near_far;
  std::vector<float> color_target, depth_target;
  std::vector<Real> t, delta, sigma, weight, color, depth, opacity;
  std::vector<Real> d_color, d_depth, d_weight, d_sigma;
};

/// A kind with one of its choices set, or as it is.
struct LossSetting {
  std::string name;
  std::shared_ptr<LossTerm> term;
};

/// Sets choice `wanted` of the parameters to its value `value`; counts choices and their values.
class ChoiceSetter final : public ParamVisitor {
 public:
  ChoiceSetter(int wanted, int value) : wanted_(wanted), value_(value) {}
  void boolean(const ParamInfo&, bool&) override {}
  void integer(const ParamInfo&, std::int64_t&) override {}
  void real(const ParamInfo&, double&) override {}
  void text(const ParamInfo&, std::string&) override {}
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    if (choices_++ != wanted_ || value_ >= static_cast<int>(names.size())) return;
    value = value_;
    set = std::string(info.name) + "_" + std::string(names[static_cast<std::size_t>(value_)]);
  }
  void integers(const ParamInfo&, std::vector<std::int64_t>&) override {}
  void reals(const ParamInfo&, std::vector<double>&) override {}
  void texts(const ParamInfo&, std::vector<std::string>&) override {}
  std::string set;

 private:
  int wanted_, value_, choices_ = 0;
};

/// Every kind as it is, and with each value of each of its choices.
inline std::vector<LossSetting> loss_settings() {
  std::vector<LossSetting> out;
  for (const LossKind& kind : loss_kinds()) {
    out.push_back({std::string(kind.type), kind.make()});
    for (int choice = 0, found = 1; found > 0; ++choice) {
      found = 0;
      for (int value = 0; value < 16; ++value) {
        std::shared_ptr<LossTerm> term = kind.make();
        ChoiceSetter setter(choice, value);
        term->describe(setter);
        if (setter.set.empty()) break;
        ++found;
        out.push_back({std::string(kind.type) + "_" + setter.set, std::move(term)});
      }
    }
  }
  return out;
}

/// Ray lengths that make warps and blocks end awkwardly.
inline std::vector<int> awkward_ray_lengths() { return {31, 0, 1, 32, 33, 2, 0, 64, 127, 128, 129, 5, 200, 0}; }

}  // namespace semfield::testing
