// Rays with samples, values and targets, and the gradients that a loss adds: for tests of losses.
#pragma once

#include <algorithm>
#include <array>
#include <string>
#include <vector>

#include "core/rng.h"
#include "plugin/loss.h"

namespace semfield::testkit {

/// Channels that a loss reads beside those of every run.
struct FurtherChannels {
  std::string target, head;  ///< of the dataset, and of a head; "": none

  FurtherChannels() = default;
  explicit FurtherChannels(const LossTraits& traits) {
    constexpr std::array known{channel::color, channel::label, channel::soft_label, channel::depth, channel::alpha};
    for (const std::string_view name : traits.targets)
      if (std::find(known.begin(), known.end(), name) == known.end()) target = name;
    for (const std::string_view name : traits.heads)
      if (name != channel::logits) head = name;
  }
};

/// Random rays of given sample counts. Every third ray has no known depth, every fifth no known alpha; labels are hard
/// or soft, one in four rays of the first half has none, and those of the second half have neither label nor logits. Of
/// a further target every fifth ray has none, a row of zeros.
template <class Real>
struct LossRays {
  explicit LossRays(const std::vector<int>& counts, std::uint64_t seed = 1, bool soft_labels = false,
                    const FurtherChannels& further_channels = {})
      : further(further_channels) {
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
      alpha_target.push_back(r % 5 == 3 ? -1.0F : static_cast<float>(r % 4) / 3);
      first.push_back(static_cast<std::int32_t>(t.size()));
    }
    semantic_rays = (static_cast<std::int64_t>(counts.size()) + 1) / 2;
    for (std::int64_t r = 0; r < rays(); ++r) {
      const bool labelled = r < semantic_rays && r % 4 != 1;
      label.push_back(labelled ? static_cast<std::int16_t>(r % kClasses) : std::int16_t{-1});
      for (std::int32_t c = 0; c < kClasses; ++c) {
        if (r < semantic_rays) logits.push_back(uniform(-3, 3));
        soft.push_back(labelled ? uniform(0, 1) : 0.0F);
      }
    }
    if (!soft_labels) soft.clear();
    for (std::int64_t r = 0; r < rays(); ++r) {
      for (std::int32_t c = 0; c < kColumns; ++c) {
        if (!further.target.empty()) further_target.push_back(r % 5 == 4 ? 0.0F : uniform(-1, 1));
        if (!further.head.empty()) made.push_back(uniform(-1, 1));
      }
    }
    d_made.assign(made.size(), Real(0));
    d_color.assign(color.size(), Real(0));
    d_depth.assign(depth.size(), Real(0));
    d_weight.assign(t.size(), Real(0));
    d_sigma.assign(t.size(), Real(0));
    d_logits.assign(logits.size(), Real(0));
  }
  static constexpr std::int32_t kClasses = 5, kColumns = 7;
  std::int64_t rays() const { return static_cast<std::int64_t>(first.size()) - 1; }
  template <class T>
  static View<T> mat(std::vector<T>& v, std::int32_t cols) {
    return View<T>(v.data(), static_cast<std::int64_t>(v.size()) / cols, cols);
  }
  RayTargets targets(std::int64_t begin = 0, std::int64_t count = -1) {
    const std::int64_t n = count < 0 ? rays() : count;
    RayTargets out;
    out.color = mat(color_target, 3).row_range(begin, n);
    out.label = mat(label, 1).row_range(begin, n);
    out.more.set(channel::depth, mat(depth_target, 1).row_range(begin, n));
    out.more.set(channel::alpha, mat(alpha_target, 1).row_range(begin, n));
    if (!soft.empty()) out.more.set(channel::soft_label, mat(soft, kClasses).row_range(begin, n));
    if (!further.target.empty()) out.more.set(further.target, mat(further_target, kColumns).row_range(begin, n));
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
    out.unit_m = unit_m;
    const auto [from, rows] = semantic_rows(begin, n);
    out.heads.set(channel::logits, mat(logits, kClasses).row_range(from, rows));
    if (!further.head.empty()) out.heads.set(further.head, mat(made, kColumns).row_range(begin, n));
    return out;
  }
  RayGradients<Real> gradients(std::int64_t begin = 0, std::int64_t count = -1) {
    const std::int64_t n = count < 0 ? rays() : count;
    const auto [from, rows] = semantic_rows(begin, n);
    RayGradients<Real> out{mat(d_color, 3).row_range(begin, n),
                           mat(d_depth, 1).row_range(begin, n),
                           mat(d_weight, 1),
                           mat(d_sigma, 1),
                           {}};
    out.heads.set(channel::logits, mat(d_logits, kClasses).row_range(from, rows));
    if (!further.head.empty()) out.heads.set(further.head, mat(d_made, kColumns).row_range(begin, n));
    return out;
  }
  /// Opacity has no gradient of its own: it follows the weights.
  void sum_opacity() {
    for (std::size_t r = 0; r + 1 < first.size(); ++r) {
      opacity[r] = 0;
      for (std::int32_t m = first[r]; m < first[r + 1]; ++m) opacity[r] += weight[static_cast<std::size_t>(m)];
    }
  }
  double add(const Loss& loss, double scale) { return loss.add(targets(), values(), scale, gradients()); }

  double unit_m = 1;
  std::int64_t semantic_rays = 0;  ///< the first rays, which have logits
  std::vector<std::int32_t> first;
  std::vector<std::int16_t> label;
  std::vector<double> near_far;
  FurtherChannels further;
  std::vector<float> color_target, depth_target, alpha_target, soft, further_target;
  std::vector<Real> t, delta, sigma, weight, color, depth, opacity, logits, made;
  std::vector<Real> d_color, d_depth, d_weight, d_sigma, d_logits, d_made;

 private:
  std::pair<std::int64_t, std::int64_t> semantic_rows(std::int64_t begin, std::int64_t count) const {
    const std::int64_t from = std::min(begin, semantic_rays);
    return {from, std::min(begin + count, semantic_rays) - from};
  }
};

/// Ray lengths that make warps and blocks end awkwardly.
inline std::vector<int> awkward_ray_lengths() { return {31, 0, 1, 32, 33, 2, 0, 64, 127, 128, 129, 5, 200, 0}; }

}  // namespace semfield::testkit
