#include "serve/proposals.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "compute/parallel.h"
#include "core/rng.h"

namespace semfield {

namespace {

constexpr const char* kRandom = "proposals/candidates";
constexpr std::int64_t kCandidates = 512;
// Two points of the surface count as alike by the square of their distance, in cells of the pool, and of their colours.
constexpr double kReachCells = 8;
constexpr double kColorReach = 0.12;
constexpr double kEntropyShare = 0.7;  // the rest is novelty alone
constexpr double kAreaPower = 0.5;     // a region counts by this power of its area: small things have classes too

class Alike {
 public:
  explicit Alike(const SurfacePool& pool)
      : by_place_(0.5 / (kReachCells * kReachCells * pool.cell_m * pool.cell_m)),
        by_color_(0.5 / (kColorReach * kColorReach)) {}
  double operator()(Vec3d a, const float* color_a, Vec3d b, const float* color_b) const {
    const Vec3d d = a - b;
    double square = dot(d, d) * by_place_;
    for (int c = 0; c < 3; ++c) {
      const double step = static_cast<double>(color_a[c]) - static_cast<double>(color_b[c]);
      square += step * step * by_color_;
    }
    return square > 12 ? 0 : std::exp(-square);
  }

 private:
  double by_place_, by_color_;
};

// [N] entropy as a share of the largest there can be; all 1 while nothing is learned.
std::vector<double> entropies(const ProposalInput& in) {
  const std::size_t count = in.pool->points.size();
  std::vector<double> out(count, 1.0);
  if (in.probability.empty()) return out;
  const auto width = static_cast<std::size_t>(in.classes);
  std::size_t live = 0;
  for (std::size_t c = 0; c < width; ++c) live += in.probability[c] > 0 ? 1 : 0;
  const double most = std::log(static_cast<double>(std::max<std::size_t>(live, 2)));
  for (std::size_t i = 0; i < count; ++i) {
    double sum = 0;
    for (const float p : in.probability.subspan(i * width, width))
      if (p > 0) sum -= static_cast<double>(p) * std::log(static_cast<double>(p));
    out[i] = std::min(1.0, sum / most);
  }
  return out;
}

double margin(std::span<const float> probability) {
  float first = 0, second = 0;
  for (const float p : probability) {
    if (p > first) {
      second = first;
      first = p;
    } else {
      second = std::max(second, p);
    }
  }
  return static_cast<double>(first - second);
}

template <class Score>
Asked best_of(std::size_t count, const Score& score) {
  Asked best{0, -INFINITY, "uncertain"};
  for (std::size_t i = 0; i < count; ++i) {
    const double found = score(i);
    if (found > best.gain) best = {static_cast<std::int32_t>(i), found, "uncertain"};
  }
  return best;
}

Asked by_surface(const ProposalInput& in) {
  const std::vector<PoolPoint>& points = in.pool->points;
  const Alike alike(*in.pool);
  const std::vector<double> entropy = entropies(in);
  std::vector<double> open(points.size()), novelty(points.size(), 1.0);
  parallel_for(std::ssize(points), [&](std::int64_t n) {
    const auto i = static_cast<std::size_t>(n);
    for (std::size_t a = 0; a < in.answered.size(); ++a) {
      novelty[i] = std::min(novelty[i],
                            1 - alike(points[i].position, points[i].color, in.answered[a], &in.answered_color[3 * a]));
    }
    open[i] = novelty[i] * (1 - kEntropyShare + kEntropyShare * entropy[i]);
  });
  // Candidates: points that are open, drawn in proportion to it, and not beside a border.
  std::vector<double> up_to;
  std::vector<std::int32_t> may;
  double sum = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (!points[i].interior) continue;
    may.push_back(static_cast<std::int32_t>(i));
    up_to.push_back(sum += open[i] + 1e-9);
  }
  if (may.empty()) return {0, 0, "unseen"};
  const RandomAddress address{in.seed, in.round, stream_id(kRandom)};
  std::vector<std::int32_t> candidates;
  for (std::int64_t k = 0; k < kCandidates; ++k) {
    const double at =
        (static_cast<double>(k) + static_cast<double>(uniform01(address, static_cast<std::uint64_t>(k)))) /
        static_cast<double>(kCandidates) * sum;
    const auto found = std::upper_bound(up_to.begin(), up_to.end(), at) - up_to.begin();
    candidates.push_back(may[static_cast<std::size_t>(std::min(found, std::ssize(may) - 1))]);
  }
  std::vector<double> gain(candidates.size());
  parallel_for(std::ssize(candidates), [&](std::int64_t k) {
    const PoolPoint& c = points[static_cast<std::size_t>(candidates[static_cast<std::size_t>(k)])];
    double settled = 0, area = 0;
    for (std::size_t j = 0; j < points.size(); ++j) {
      const double share = alike(c.position, c.color, points[j].position, points[j].color);
      settled += share * open[j];
      area += share;
    }
    const auto own = static_cast<std::size_t>(candidates[static_cast<std::size_t>(k)]);
    gain[static_cast<std::size_t>(k)] = open[own] * settled / std::pow(area, 1 - kAreaPower);
  });
  const auto best = static_cast<std::size_t>(std::max_element(gain.begin(), gain.end()) - gain.begin());
  const std::int32_t point = candidates[best];
  return {point, gain[best], novelty[static_cast<std::size_t>(point)] > 0.9 ? "unseen" : "uncertain"};
}

}  // namespace

std::optional<Asked> choose_click(Acquisition how, const ProposalInput& in) {
  const std::vector<PoolPoint>& points = in.pool->points;
  if (points.empty()) return std::nullopt;
  const RandomAddress address{in.seed, in.round, stream_id(kRandom)};
  const auto any = static_cast<std::int32_t>(uniform_below(address, 1u << 30, points.size()));
  const auto width = static_cast<std::size_t>(in.classes);
  switch (how) {
    case Acquisition::random:
      break;
    case Acquisition::farthest:
      if (in.answered.empty()) break;
      return best_of(points.size(), [&](std::size_t i) {
        double nearest = INFINITY;
        for (const Vec3d& place : in.answered) nearest = std::min(nearest, length(points[i].position - place));
        return nearest;
      });
    case Acquisition::entropy: {
      if (in.probability.empty()) break;
      const std::vector<double> entropy = entropies(in);
      return best_of(points.size(), [&](std::size_t i) { return entropy[i]; });
    }
    case Acquisition::margin:
      if (in.probability.empty()) break;
      return best_of(points.size(), [&](std::size_t i) { return -margin(in.probability.subspan(i * width, width)); });
    case Acquisition::surface:
      return by_surface(in);
  }
  return Asked{any, 0, "unseen"};
}

}  // namespace semfield
