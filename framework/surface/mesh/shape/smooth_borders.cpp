#include "surface/mesh/shape/smooth_borders.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "compute/parallel.h"
#include "scene/scene.h"

namespace semfield {

namespace {

constexpr int kRounds = 8;                 // of averaging: borders are smooth over some edges' lengths
constexpr float kLeastSure = 0.1F;         // what the least sure vertex counts
constexpr double kNearestToCorner = 0.02;  // of an edge: thinner triangles help nobody

// Shares of what a vertex may be, ascending by number; most have one.
struct Share {
  std::int32_t kind;
  float weight;
};
using Shares = std::vector<Share>;

float share_of(const Shares& shares, std::int32_t kind) {
  for (const Share& share : shares)
    if (share.kind == kind) return share.weight;
  return 0;
}

void add(Shares& to, const Shares& from, float weight) {
  for (const Share& share : from) {
    const auto at = std::find_if(to.begin(), to.end(), [&](const Share& s) { return s.kind >= share.kind; });
    if (at != to.end() && at->kind == share.kind) {
      at->weight += weight * share.weight;
    } else {
      to.insert(at, {share.kind, weight * share.weight});
    }
  }
}

class Cutter {
 public:
  Cutter(Surface& surface, const std::vector<Shares>& shares, const std::vector<std::int32_t>& kind)
      : surface_(surface), shares_(shares), kind_(kind) {}

  void cut() {
    const std::vector<Triangle> before = std::move(surface_.triangles);
    surface_.triangles.clear();
    for (const Triangle& t : before) {
      const std::array<bool, 3> same{is_one(t[0], t[1]), is_one(t[1], t[2]), is_one(t[2], t[0])};
      if (same[0] && same[1]) {
        surface_.triangles.push_back(t);
      } else if (same[0] || same[1] || same[2]) {
        const std::size_t alone = same[0] ? 2 : same[1] ? 0 : 1;
        cut_off(t[alone], t[(alone + 1) % 3], t[(alone + 2) % 3]);
      } else {
        cut_in_three(t);
      }
    }
  }

 private:
  bool is_one(std::uint32_t a, std::uint32_t b) const { return kind_[a] == kind_[b]; }

  void cut_off(std::uint32_t a, std::uint32_t b, std::uint32_t c) {
    surface_.triangles.push_back({a, on_edge(a, b), on_edge(a, c)});
    const std::uint32_t behind_b = on_edge(b, a), behind_c = on_edge(c, a);
    surface_.triangles.push_back({b, behind_c, behind_b});
    surface_.triangles.push_back({b, c, behind_c});
  }

  void cut_in_three(const Triangle& t) {
    const Triangle behind{on_edge(t[0], t[1]), on_edge(t[1], t[2]), on_edge(t[2], t[0])};
    for (std::size_t k = 0; k < 3; ++k) {
      const std::uint32_t a = t[k], b = t[(k + 1) % 3], c = t[(k + 2) % 3];
      const std::uint32_t middle = mean_of(a, behind, {1 / 3.0, 1 / 3.0, 1 / 3.0});
      surface_.triangles.push_back({a, on_edge(a, b), middle});
      surface_.triangles.push_back({a, middle, on_edge(a, c)});
    }
  }

  // Where what `a` is and what `b` is weigh the same: the vertex that is what `a` is.
  std::uint32_t on_edge(std::uint32_t a, std::uint32_t b) {
    const auto [found, fresh] = on_edge_.try_emplace({a, b}, 0);
    if (!fresh) return found->second;
    const auto lead = [&](std::uint32_t at, std::uint32_t other) {
      return std::max(0.0, static_cast<double>(share_of(shares_[at], kind_[at]) - share_of(shares_[at], kind_[other])));
    };
    // In one order, so that both sides have the very same place.
    const std::uint32_t first = std::min(a, b), second = std::max(a, b);
    const double lead_first = lead(first, second), lead_second = lead(second, first);
    const double share = lead_first + lead_second > 0 ? lead_first / (lead_first + lead_second) : 0.5;
    const double way = std::clamp(share, kNearestToCorner, 1 - kNearestToCorner);
    return found->second = mean_of(a, {first, second, second}, {1 - way, way, 0});
  }

  // A new vertex that is what `same` is.
  std::uint32_t mean_of(std::uint32_t same, const Triangle& of, const std::array<double, 3>& weight) {
    const auto mean = [&](const auto& value) {
      return value(of[0]) * weight[0] + value(of[1]) * weight[1] + value(of[2]) * weight[2];
    };
    PointAttributes& known = surface_.attributes;
    surface_.positions.push_back(mean([&](std::uint32_t v) { return surface_.positions[v]; }));
    const Vec3d normal = mean([&](std::uint32_t v) { return surface_.normals[v]; });
    const double size = length(normal);
    surface_.normals.push_back(size > 0 ? normal * (1 / size) : surface_.normals[same]);
    std::array<std::uint8_t, 3> color{};
    for (std::size_t c = 0; c < 3; ++c)
      color[c] = static_cast<std::uint8_t>(
          std::lround(mean([&](std::uint32_t v) { return static_cast<double>(known.color[v][c]); })));
    known.color.push_back(color);
    if (known.has_labels()) {
      known.label.push_back(known.label[same]);
      known.entropy.push_back(
          static_cast<float>(mean([&](std::uint32_t v) { return static_cast<double>(known.entropy[v]); })));
    }
    if (known.has_instances()) known.instance.push_back(known.instance[same]);
    return static_cast<std::uint32_t>(surface_.positions.size() - 1);
  }

  Surface& surface_;
  const std::vector<Shares>& shares_;
  const std::vector<std::int32_t>& kind_;
  std::map<std::pair<std::uint32_t, std::uint32_t>, std::uint32_t> on_edge_;
};

}  // namespace

void smooth_borders(Surface& surface) {
  PointAttributes& known = surface.attributes;
  if (!known.has_labels() && !known.has_instances()) return;
  const std::size_t count = surface.positions.size();
  using Kind = std::pair<std::int16_t, std::int32_t>;  // class, object
  std::map<Kind, std::int32_t> number;
  std::vector<Kind> kinds;
  std::vector<Shares> shares(count);
  for (std::size_t v = 0; v < count; ++v) {
    const Kind kind{known.has_labels() ? known.label[v] : kVoid, known.has_instances() ? known.instance[v] : 0};
    const auto [found, fresh] = number.try_emplace(kind, static_cast<std::int32_t>(kinds.size()));
    if (fresh) kinds.push_back(kind);
    const float sure = known.has_labels() ? std::exp(-known.entropy[v]) : 1;
    shares[v] = {{found->second, std::max(kLeastSure, sure)}};
  }
  const Edges edges = edges_of(surface);
  for (int round = 0; round < kRounds; ++round) {
    std::vector<Shares> next(count);
    parallel_for((std::ssize(next) + 4095) / 4096, [&](std::int64_t block) {
      const auto begin = static_cast<std::size_t>(block * 4096);
      for (std::size_t v = begin; v < std::min(count, begin + 4096); ++v) {
        add(next[v], shares[v], 0.5F);
        const std::uint32_t first = edges.first[v], last = edges.first[v + 1];
        for (std::uint32_t e = first; e < last; ++e)
          add(next[v], shares[edges.to[e]], 0.5F / static_cast<float>(last - first));
      }
    });
    shares = std::move(next);
  }
  std::vector<std::int32_t> kind_of(count);
  for (std::size_t v = 0; v < count; ++v) {
    kind_of[v] = std::max_element(shares[v].begin(), shares[v].end(), [](const Share& a, const Share& b) {
                   return a.weight < b.weight;
                 })->kind;
    const Kind& kind = kinds[static_cast<std::size_t>(kind_of[v])];
    if (known.has_labels()) known.label[v] = kind.first;
    if (known.has_instances()) known.instance[v] = kind.second;
  }
  Cutter(surface, shares, kind_of).cut();
}

}  // namespace semfield
