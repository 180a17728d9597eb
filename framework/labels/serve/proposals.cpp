#include "labels/serve/proposals.h"

#include <array>
#include <cmath>

#include "compute/parallel.h"
#include "core/rng.h"
#include "eval/metrics.h"

namespace semfield {

namespace {

constexpr const char* kRandom = "proposals/candidates";
constexpr std::size_t kMostKnown = 512;  // places that a point's look is compared with

// Classes that have a probability anywhere.
std::ptrdiff_t named_classes(const ProposalInput& in) {
  std::vector<bool> named(static_cast<std::size_t>(in.classes), false);
  for (std::size_t i = 0; i < in.probability.size(); ++i)
    if (in.probability[i] > 0) named[i % named.size()] = true;
  return std::count(named.begin(), named.end(), true);
}

// [N] entropy as a fraction of the largest there can be; all 1 while nothing is learned.
std::vector<double> entropies(const ProposalInput& in) {
  const std::size_t count = in.pool->points.size();
  std::vector<double> out(count, 1.0);
  if (in.probability.empty()) return out;
  const auto width = static_cast<std::size_t>(in.classes);
  const auto live = named_classes(in);
  if (live < 2) return out;  // a single class is sure of everything
  const double most = std::log(static_cast<double>(live));
  for (std::size_t i = 0; i < count; ++i) {
    out[i] = std::min(1.0, entropy_nats(in.probability.subspan(i * width, width)) / most);
  }
  return out;
}

bool is_barred(const ProposalInput& in, std::size_t point) {
  return in.barred != nullptr && !in.barred->empty() && (*in.barred)[point];
}

// Colour and normal of a point, in units of what makes a difference.
using Look = std::array<float, 6>;

Look look_of(const PoolPoint& point, const ProposalRules& rules) {
  const auto [r, g, b] = std::array{point.color.x, point.color.y, point.color.z};
  const double light = rules.lightness_sigma, chroma = rules.chroma_sigma, normal = rules.normal_sigma;
  Look look{};
  const double parts[6] = {(r + g + b) / 3 / light, (r - g) / chroma,        (b - (r + g) / 2) / chroma,
                           point.normal.x / normal, point.normal.y / normal, point.normal.z / normal};
  std::copy(std::begin(parts), std::end(parts), look.begin());
  return look;
}

// Of each point, what its doubt counts: less where it looks like a clicked place, while there are few clicks. The first
// questions would all be about walls else, whose pieces are large.
std::vector<float> novelties(const ProposalInput& in) {
  const std::vector<PoolPoint>& points = in.pool->points;
  const double early = std::exp(-static_cast<double>(in.clicks) / in.rules.first_clicks);
  std::vector<float> novelty(points.size(), 1);
  if (early < 0.05) return novelty;
  std::vector<Look> known;
  for (std::size_t i = 0; i < points.size(); ++i)
    if (in.graph->settled()[i].cost[0] == 0) known.push_back(look_of(points[i], in.rules));
  for (const std::int32_t point : in.passed)
    known.push_back(look_of(points[static_cast<std::size_t>(point)], in.rules));
  const std::size_t every = 1 + known.size() / kMostKnown;  // given labels may be many
  constexpr std::int64_t kBlock = 256;
  parallel_for((std::ssize(points) + kBlock - 1) / kBlock, [&](std::int64_t block) {
    for (std::int64_t i = block * kBlock; i < std::min(std::ssize(points), (block + 1) * kBlock); ++i) {
      const Look own = look_of(points[static_cast<std::size_t>(i)], in.rules);
      float least = INFINITY;
      for (std::size_t k = 0; k < known.size(); k += every) {
        float square = 0;
        for (std::size_t c = 0; c < own.size(); ++c) square += (own[c] - known[k][c]) * (own[c] - known[k][c]);
        least = std::min(least, square);
      }
      const double unlike = 1 - std::exp(-static_cast<double>(least) / 2);
      novelty[static_cast<std::size_t>(i)] = static_cast<float>(1 - early * (1 - in.rules.alike) * (1 - unlike));
    }
  });
  return novelty;
}

// How little is known of each point, 0 to 1: far from every click by way of the surface, or doubted by the network.
std::vector<float> doubts(const ProposalInput& in) {
  const std::vector<double> entropy = entropies(in);
  const std::vector<float> novelty = novelties(in);
  std::vector<float> doubt(entropy.size());
  for (std::size_t i = 0; i < doubt.size(); ++i) {
    const float way = std::min(1.0F, in.graph->settled()[i].cost[0] / in.rules.unseen);
    if (is_barred(in, i)) continue;
    doubt[i] = static_cast<float>((1 - in.rules.entropy_share) * static_cast<double>(way) +
                                  in.rules.entropy_share * static_cast<double>(way) * entropy[i]) *
               novelty[i];
  }
  std::vector<SurfaceGraph::Near> near;
  SurfaceGraph::Scratch scratch;
  for (const std::int32_t point : in.passed) {
    in.graph->around(point, in.rules.reach, in.rules.most, scratch, near);
    for (const SurfaceGraph::Near& n : near) doubt[static_cast<std::size_t>(n.point)] = 0;
  }
  return doubt;
}

// Points drawn in proportion to their doubt, and not beside a border.
std::vector<std::int32_t> candidates_of(const ProposalInput& in, std::span<const float> doubt) {
  std::vector<double> up_to;
  std::vector<std::int32_t> may;
  double sum = 0;
  for (std::size_t i = 0; i < doubt.size(); ++i) {
    if (!in.pool->points[i].interior || is_barred(in, i)) continue;
    may.push_back(static_cast<std::int32_t>(i));
    up_to.push_back(sum += static_cast<double>(doubt[i]) + 1e-9);
  }
  std::vector<std::int32_t> out;
  if (may.empty()) return out;
  const RandomAddress address{in.seed, in.round, stream_id(kRandom)};
  for (std::int64_t k = 0; k < in.rules.candidates; ++k) {
    const double at =
        (static_cast<double>(k) + static_cast<double>(uniform01(address, static_cast<std::uint64_t>(k)))) /
        static_cast<double>(in.rules.candidates) * sum;
    out.push_back(may[place_in(up_to, at)]);
  }
  return out;
}

}  // namespace

std::optional<Asked> choose_click(const ProposalInput& in) {
  if (in.pool->points.empty()) return std::nullopt;
  const std::vector<float> doubt = doubts(in);
  const std::vector<std::int32_t> candidates = candidates_of(in, doubt);
  if (candidates.empty()) return Asked{0, 0, "unseen"};
  std::vector<double> gain(candidates.size());
  constexpr std::int64_t kBlock = 16;
  parallel_for((std::ssize(candidates) + kBlock - 1) / kBlock, [&](std::int64_t block) {
    SurfaceGraph::Scratch scratch;
    std::vector<SurfaceGraph::Near> near;
    for (std::int64_t k = block * kBlock; k < std::min(std::ssize(candidates), (block + 1) * kBlock); ++k) {
      in.graph->around(candidates[static_cast<std::size_t>(k)], in.rules.reach, in.rules.most, scratch, near);
      double settled = 0, area = 0;
      for (const SurfaceGraph::Near& n : near) {
        const double share = 1 - static_cast<double>(n.cost / in.rules.reach);
        settled += share * static_cast<double>(doubt[static_cast<std::size_t>(n.point)]);
        area += share;
      }
      gain[static_cast<std::size_t>(k)] = settled / std::pow(area, 1 - in.rules.area_power);
    }
  });
  const auto best = static_cast<std::size_t>(std::max_element(gain.begin(), gain.end()) - gain.begin());
  const std::int32_t point = candidates[best];
  const float way = in.graph->settled()[static_cast<std::size_t>(point)].cost[0];
  return Asked{point, gain[best], way >= in.rules.unseen ? "unseen" : "uncertain"};
}

}  // namespace semfield
