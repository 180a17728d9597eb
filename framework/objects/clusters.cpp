#include "objects/clusters.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <numeric>

#include "compute/parallel.h"

namespace semfield {

namespace {

// Numbers that are joined into one, the least of them.
class Joined {
 public:
  explicit Joined(std::size_t count) : up_(count) { std::iota(up_.begin(), up_.end(), 0); }
  std::int32_t of(std::int32_t i) {
    while (up_[static_cast<std::size_t>(i)] != i) {
      std::int32_t& up = up_[static_cast<std::size_t>(i)];
      i = up = up_[static_cast<std::size_t>(up)];
    }
    return i;
  }
  void join(std::int32_t a, std::int32_t b) {
    a = of(a);
    b = of(b);
    up_[static_cast<std::size_t>(std::max(a, b))] = std::min(a, b);
  }

 private:
  std::vector<std::int32_t> up_;
};

// What views say of two groups.
struct Evidence {
  double weight = 0, same = 0, views = 0;
  double share() const { return weight > 0 ? same / weight : 0; }
};

class Clustering {
 public:
  Clustering(const SurfacePool& pool, const PlacedPoints& points, std::span<const SegmentSights> sights,
             const ClusterRules& rules)
      : points_(points),
        sights_(sights),
        rules_(rules),
        near_(pool.cells.neighbours()),
        group_(pool.points.size(), -1) {}

  std::vector<std::int32_t> run() {
    grow();
    take_in(1);
    join_by_views();
    drop_small();
    take_in(INFINITY);
    number();
    return std::move(group_);
  }

 private:
  bool is_stuff(std::int32_t i) const { return !points_.stuff.empty() && points_.stuff[static_cast<std::size_t>(i)]; }
  static float squared(const float* a, const float* b, std::int32_t width) {
    float sum = 0;
    for (std::int32_t d = 0; d < width; ++d) sum += (a[d] - b[d]) * (a[d] - b[d]);
    return sum;
  }

  // Mean places of the segments of all views: a segment's middle lies where its object does, also where its border is
  // blurred. Segments of stuff have none.
  void take_means() {
    const std::int32_t width = points_.place.cols;
    for (const SegmentSights& view : sights_) {
      first_segment_.push_back(static_cast<std::int32_t>(segment_size_.size()));
      for (std::int32_t s = 0; s < view.segments(); ++s) {
        std::vector<double> sum(static_cast<std::size_t>(width), 0);
        double count = 0, all = 0;
        for (std::int32_t i = view.first[static_cast<std::size_t>(s)]; i < view.first[static_cast<std::size_t>(s) + 1];
             ++i) {
          const std::int32_t point = view.point[static_cast<std::size_t>(i)];
          ++all;
          if (is_stuff(point)) continue;
          ++count;
          for (std::int32_t d = 0; d < width; ++d)
            sum[static_cast<std::size_t>(d)] += static_cast<double>(points_.place(point, d));
        }
        segment_size_.push_back(2 * count > all ? count : 0);
        for (const double value : sum) segment_mean_.push_back(static_cast<float>(value / std::max(count, 1.0)));
      }
    }
    first_segment_.push_back(static_cast<std::int32_t>(segment_size_.size()));
  }

  // Clusters of the segments of all views [Ester96].
  std::vector<std::int32_t> cluster_segments() const {
    const auto count = std::ssize(segment_size_);
    const std::int32_t width = points_.place.cols;
    const auto reach = static_cast<float>(rules_.reach * rules_.reach);
    std::vector<std::vector<std::int32_t>> near(static_cast<std::size_t>(count));
    parallel_for(count, [&](std::int64_t i) {
      if (!(segment_size_[static_cast<std::size_t>(i)] > 0)) return;
      for (std::int64_t j = 0; j < count; ++j)
        if (j != i && segment_size_[static_cast<std::size_t>(j)] > 0 &&
            squared(&segment_mean_[static_cast<std::size_t>(i * width)],
                    &segment_mean_[static_cast<std::size_t>(j * width)], width) < reach)
          near[static_cast<std::size_t>(i)].push_back(static_cast<std::int32_t>(j));
    });
    const auto inside = [&](std::int64_t i) {
      return std::ssize(near[static_cast<std::size_t>(i)]) >= rules_.neighbours;
    };
    Joined joined(static_cast<std::size_t>(count));
    std::vector<std::int32_t> cluster(static_cast<std::size_t>(count), -1);
    for (std::int64_t i = 0; i < count; ++i)
      for (const std::int32_t j : near[static_cast<std::size_t>(i)])
        if (j > i && inside(i) && inside(j)) joined.join(static_cast<std::int32_t>(i), j);
    for (std::int64_t i = 0; i < count; ++i)
      if (inside(i)) cluster[static_cast<std::size_t>(i)] = joined.of(static_cast<std::int32_t>(i));
    return cluster;
  }

  // Of each point the cluster that most of its segments are of, the first of equals; -1: none, or the point is stuff.
  std::vector<std::int32_t> votes_of(const std::vector<std::int32_t>& cluster) const {
    std::vector<std::int32_t> first(group_.size() + 1, 0);
    const auto for_votes = [&](const auto& body) {
      for (std::size_t v = 0; v < sights_.size(); ++v)
        for (std::size_t i = 0; i < sights_[v].point.size(); ++i)
          if (const auto c = cluster[static_cast<std::size_t>(first_segment_[v] + sights_[v].segment[i])]; c >= 0)
            body(static_cast<std::size_t>(sights_[v].point[i]), c);
    };
    for_votes([&](std::size_t point, std::int32_t) { ++first[point + 1]; });
    std::partial_sum(first.begin(), first.end(), first.begin());
    std::vector<std::int32_t> vote(static_cast<std::size_t>(first.back())), next(first.begin(), first.end() - 1);
    for_votes([&](std::size_t point, std::int32_t c) { vote[static_cast<std::size_t>(next[point]++)] = c; });
    std::vector<std::int32_t> of_point(group_.size(), -1);
    parallel_for((std::ssize(of_point) + kBlock - 1) / kBlock, [&](std::int64_t block) {
      for (std::int64_t i = block * kBlock; i < std::min(std::ssize(of_point), (block + 1) * kBlock); ++i) {
        const auto n = static_cast<std::size_t>(i);
        if (is_stuff(static_cast<std::int32_t>(i))) continue;
        const auto end = vote.begin() + first[n + 1];
        std::sort(vote.begin() + first[n], end);
        std::ptrdiff_t most = 0;
        for (auto of = vote.begin() + first[n]; of != end;) {
          const auto behind = std::upper_bound(of, end, *of);
          if (behind - of > most) {
            most = behind - of;
            of_point[n] = *of;
          }
          of = behind;
        }
      }
    });
    return of_point;
  }

  // A point is of the cluster that most of its segments are of, and a group is what touches of one cluster.
  void grow() {
    take_means();
    const std::vector<std::int32_t> of_point = votes_of(cluster_segments());
    Joined joined(group_.size());
    for (const auto& [a, b] : near_)
      if (of_point[static_cast<std::size_t>(a)] >= 0 &&
          of_point[static_cast<std::size_t>(a)] == of_point[static_cast<std::size_t>(b)])
        joined.join(a, b);
    std::vector<std::int32_t> size(group_.size(), 0);
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (of_point[static_cast<std::size_t>(i)] >= 0) ++size[static_cast<std::size_t>(joined.of(i))];
    for (std::int32_t i = 0; i < std::ssize(group_); ++i)
      if (of_point[static_cast<std::size_t>(i)] >= 0 && size[static_cast<std::size_t>(joined.of(i))] >= kLeastPiece)
        group_[static_cast<std::size_t>(i)] = joined.of(i);
    number();
  }

  // Groups are numbered anew, the largest first.
  void number() {
    std::vector<std::int32_t> size(group_.size(), 0), to(group_.size(), -1);  // a group's number is below the points'
    for (const std::int32_t g : group_)
      if (g >= 0) ++size[static_cast<std::size_t>(g)];
    std::vector<std::pair<std::int32_t, std::int32_t>> order;
    for (std::size_t g = 0; g < size.size(); ++g)
      if (size[g] > 0) order.emplace_back(-size[g], static_cast<std::int32_t>(g));
    std::sort(order.begin(), order.end());
    for (std::size_t n = 0; n < order.size(); ++n)
      to[static_cast<std::size_t>(order[n].second)] = static_cast<std::int32_t>(n);
    for (std::int32_t& g : group_)
      if (g >= 0) g = to[static_cast<std::size_t>(g)];
    groups_ = static_cast<std::int32_t>(order.size());
  }

  std::vector<float> means() const {
    const auto width = static_cast<std::size_t>(points_.place.cols);
    std::vector<double> sum(static_cast<std::size_t>(groups_) * width, 0), count(static_cast<std::size_t>(groups_), 0);
    for (std::size_t i = 0; i < group_.size(); ++i) {
      if (group_[i] < 0) continue;
      const auto g = static_cast<std::size_t>(group_[i]);
      count[g] += 1;
      for (std::size_t d = 0; d < width; ++d)
        sum[g * width + d] += static_cast<double>(points_.place(static_cast<std::int64_t>(i), static_cast<int>(d)));
    }
    std::vector<float> mean(sum.size());
    for (std::size_t g = 0; g < count.size(); ++g)
      for (std::size_t d = 0; d < width; ++d)
        mean[g * width + d] = static_cast<float>(sum[g * width + d] / std::max(count[g], 1.0));
    return mean;
  }

  // Points without a group join that of a neighbour whose mean is nearest and within `reach` times the reach, in rings.
  void take_in(double reach) {
    const auto width = points_.place.cols;
    const std::vector<float> mean = means();
    const auto most = static_cast<float>(reach * reach * rules_.reach * rules_.reach);
    const auto waits = [&](std::int32_t point) {
      return group_[static_cast<std::size_t>(point)] < 0 && !is_stuff(point);
    };
    std::vector<CellPair> asks;  // a waits, b is its neighbour
    for (const CellPair& pair : near_) {
      if (waits(pair.a)) asks.push_back(pair);
      if (waits(pair.b)) asks.push_back({pair.b, pair.a});
    }
    std::vector<std::int32_t> next = group_;
    std::vector<float> best(group_.size(), INFINITY);
    for (int ring = 0; ring < 64 && !asks.empty(); ++ring) {
      for (const CellPair& pair : asks) {
        const auto i = static_cast<std::size_t>(pair.a);
        const std::int32_t g = group_[static_cast<std::size_t>(pair.b)];
        if (g < 0) continue;
        const float way = squared(points_.place.row(pair.a), &mean[static_cast<std::size_t>(g * width)], width);
        if (way > most || way > best[i] || (way == best[i] && g >= next[i])) continue;
        best[i] = way;
        next[i] = g;
      }
      bool some = false;
      for (const CellPair& pair : asks) {
        const auto i = static_cast<std::size_t>(pair.a);
        some |= group_[i] != next[i];
        group_[i] = next[i];
      }
      if (!some) break;
      std::erase_if(asks, [&](const CellPair& pair) { return !waits(pair.a); });
    }
  }

  // Sights of each group in each segment of a view, and in all of them; groups of the view by number.
  struct Counts {
    std::vector<std::map<std::int32_t, double>> segments;  // by group
    std::map<std::int32_t, double> total;
    void join(std::int32_t keep, std::int32_t gone) {
      const auto into = [&](std::map<std::int32_t, double>& of) {
        const auto found = of.find(gone);
        if (found == of.end()) return false;
        of[keep] += found->second;
        of.erase(found);
        return true;
      };
      if (!into(total)) return;
      for (auto& segment : segments) into(segment);
    }
  };
  std::vector<Counts> counts() const {
    std::vector<Counts> all(sights_.size());
    parallel_for(std::ssize(sights_), [&](std::int64_t v) {
      const SegmentSights& view = sights_[static_cast<std::size_t>(v)];
      Counts& of = all[static_cast<std::size_t>(v)];
      of.segments.resize(static_cast<std::size_t>(view.segments()));
      for (std::size_t i = 0; i < view.point.size(); ++i) {
        const std::int32_t g = group_[static_cast<std::size_t>(view.point[i])];
        if (g < 0) continue;
        of.segments[static_cast<std::size_t>(view.segment[i])][g] += 1;
        of.total[g] += 1;
      }
    });
    return all;
  }

  using Pair = std::pair<std::int32_t, std::int32_t>;
  // A view that sees n_a and n_b of two groups says same = sum_s n_as n_bs / (n_a n_b) with the weight of the smaller.
  static void add_evidence(const Counts& view, std::map<Pair, Evidence>& evidence, std::int32_t only) {
    const std::map<std::int32_t, double>& total = view.total;
    if (only >= 0 && !total.contains(only)) return;
    std::map<Pair, double> together;
    for (const auto& segment : view.segments)
      for (auto a = segment.begin(); a != segment.end() && (only < 0 || segment.contains(only)); ++a)
        for (auto b = std::next(a); b != segment.end(); ++b)
          if (only < 0 || a->first == only || b->first == only)
            together[{a->first, b->first}] += a->second * b->second / (total.at(a->first) * total.at(b->first));
    for (auto a = total.begin(); a != total.end(); ++a) {
      for (auto b = std::next(a); b != total.end(); ++b) {
        if (only >= 0 && a->first != only && b->first != only) continue;
        const double weight = std::min(a->second, b->second);
        if (weight < kLeastSights) continue;
        Evidence& e = evidence[{a->first, b->first}];
        e.weight += weight;
        e.views += 1;
        if (const auto found = together.find({a->first, b->first}); found != together.end())
          e.same += weight * found->second;
      }
    }
  }

  void join_by_views() {
    std::vector<Counts> views = counts();
    std::map<Pair, Evidence> evidence;
    for (const Counts& view : views) add_evidence(view, evidence, -1);
    touch_by_mean(evidence);
    Joined joined(static_cast<std::size_t>(groups_));
    for (;;) {
      const auto best = std::max_element(evidence.begin(), evidence.end(), [&](const auto& a, const auto& b) {
        return score(a.second) < score(b.second);
      });
      if (best == evidence.end() || score(best->second) <= rules_.agree) break;
      const auto [keep, gone] = best->first;
      joined.join(keep, gone);
      for (auto e = evidence.begin(); e != evidence.end();)
        e = e->first.first == gone || e->first.second == gone || e->first.first == keep || e->first.second == keep
                ? evidence.erase(e)
                : std::next(e);
      for (Counts& view : views) {
        view.join(keep, gone);
        add_evidence(view, evidence, keep);
      }
    }
    for (std::int32_t& g : group_)
      if (g >= 0) g = joined.of(g);
    number();
  }

  double score(const Evidence& e) const { return e.views >= rules_.least_views ? e.share() : 0; }

  // Pairs that no view tells apart, which touch and have one mean, are one for certain.
  void touch_by_mean(std::map<Pair, Evidence>& evidence) const {
    const std::vector<float> mean = means();
    const std::int32_t width = points_.place.cols;
    for (const auto& [a, b] : near_) {
      const std::int32_t g = group_[static_cast<std::size_t>(a)], h = group_[static_cast<std::size_t>(b)];
      if (g < 0 || h < 0 || g == h) continue;
      const Pair pair{std::min(g, h), std::max(g, h)};
      if (const auto found = evidence.find(pair); found != evidence.end() && found->second.views >= rules_.least_views)
        continue;
      const float way =
          squared(&mean[static_cast<std::size_t>(g * width)], &mean[static_cast<std::size_t>(h * width)], width);
      if (static_cast<double>(way) < rules_.reach * rules_.reach)
        evidence[pair] = {1, 1 - 1e-3 * static_cast<double>(way), rules_.least_views};
    }
  }

  void drop_small() {
    std::vector<std::int64_t> size(static_cast<std::size_t>(groups_), 0);
    for (const std::int32_t g : group_)
      if (g >= 0) ++size[static_cast<std::size_t>(g)];
    for (std::int32_t& g : group_)
      if (g >= 0 && size[static_cast<std::size_t>(g)] < rules_.least_points) g = -1;
    number();
  }

  static constexpr std::int64_t kBlock = 4096;  // points of a unit of work
  static constexpr double kLeastSights = 3;
  static constexpr std::int32_t kLeastPiece = 4;  // points of a group before groups are joined

  PlacedPoints points_;
  std::span<const SegmentSights> sights_;
  ClusterRules rules_;
  std::vector<CellPair> near_;
  std::vector<std::int32_t> group_;
  std::int32_t groups_ = 0;
  // Of the segments of all views, one behind another.
  std::vector<std::int32_t> first_segment_;  // of a view
  std::vector<double> segment_size_;
  std::vector<float> segment_mean_;
};

}  // namespace

std::vector<std::int32_t> cluster_points(const SurfacePool& pool, const PlacedPoints& points,
                                         std::span<const SegmentSights> sights, const ClusterRules& rules) {
  return Clustering(pool, points, sights, rules).run();
}

}  // namespace semfield
