#include "objects/object_score.h"

#include <algorithm>
#include <cmath>
#include <set>

namespace semfield {

ObjectScore::ObjectScore(std::span<const ObjectRow> rows, std::vector<bool> stuff, std::int64_t least_px)
    : rows_(rows.begin(), rows.end()), stuff_(std::move(stuff)), least_px_(least_px) {}

std::optional<ObjectScore::Segment> ObjectScore::true_segment(std::int16_t label, std::int32_t instance) const {
  if (label == kVoid) return std::nullopt;
  if (stuff_[static_cast<std::size_t>(label)]) return Segment{true, label};
  if (instance == 0) return std::nullopt;
  return Segment{false, instance};
}

std::optional<ObjectScore::Segment> ObjectScore::found_segment(std::int16_t rendered, std::int32_t object) const {
  if (object > 0) return Segment{false, object};
  if (rendered != kVoid && stuff_[static_cast<std::size_t>(rendered)]) return Segment{true, rendered};
  return std::nullopt;
}

std::int16_t ObjectScore::class_of(const Segment& found) const {
  return found.first ? static_cast<std::int16_t>(found.second)
                     : rows_[static_cast<std::size_t>(found.second) - 1].class_index;
}

void ObjectScore::add(const ScoredPixels& pixels) {
  for (std::size_t i = 0; i < pixels.label.size(); ++i) {
    const auto truth = true_segment(pixels.label[i], pixels.instance[i]);
    const auto found = found_segment(pixels.rendered.empty() ? kVoid : pixels.rendered[i], pixels.object[i]);
    if (found) ++found_[*found];
    if (!truth) {
      if (found) ++found_in_void_[*found];
      continue;
    }
    ++truth_[*truth][pixels.label[i]];
    if (found) ++both_[{*truth, *found}];
  }
}

ObjectFigures ObjectScore::figures() const {
  struct OfClass {
    double iou = 0;
    std::int64_t matched = 0, missed = 0, wrong = 0, truth = 0, found = 0;
  };
  std::map<std::int16_t, OfClass> classes;
  std::map<Segment, std::int64_t> size, in_void = found_in_void_;
  std::map<Segment, std::int16_t> true_class;
  for (const auto& [segment, of_class] : truth_) {
    std::int64_t all = 0;
    for (const auto& [c, n] : of_class) all += n;
    if (!segment.first && all < least_px_) {  // void
      for (const auto& [pair, n] : both_)
        if (pair.first == segment) in_void[pair.second] += n;
      continue;
    }
    size[segment] = all;
    true_class[segment] =
        std::max_element(of_class.begin(), of_class.end(), [](auto& a, auto& b) { return a.second < b.second; })->first;
  }
  const auto visible = [&](const Segment& found) {
    const auto v = in_void.find(found);
    return found_.at(found) - (v == in_void.end() ? 0 : v->second);
  };
  std::set<Segment> matched_truth, matched_found;
  std::map<Segment, double> cover;
  for (const auto& [pair, n] : both_) {
    const auto of_truth = size.find(pair.first);
    if (of_truth == size.end()) continue;
    const double iou = static_cast<double>(n) / static_cast<double>(of_truth->second + visible(pair.second) - n);
    if (!pair.first.first && !pair.second.first) cover[pair.first] = std::max(cover[pair.first], iou);
    if (pair.first.first != pair.second.first || iou <= 0.5) continue;
    const std::int16_t own = class_of(pair.second);
    if (own != true_class[pair.first] && own != kVoid) continue;
    OfClass& c = classes[true_class[pair.first]];
    c.iou += iou;
    ++c.matched;
    matched_truth.insert(pair.first);
    matched_found.insert(pair.second);
  }
  ObjectFigures out;
  for (const auto& [segment, n] : size) {
    OfClass& c = classes[true_class[segment]];
    ++c.truth;
    if (!segment.first) ++out.objects;
    if (!matched_truth.contains(segment)) ++c.missed;
    if (!segment.first) out.mcov += cover.contains(segment) ? cover[segment] : 0;
  }
  for (const auto& [segment, n] : found_) {
    const bool counts = visible(segment) >= least_px_ && 2 * visible(segment) > n;
    if (!matched_found.contains(segment) && !counts) continue;
    OfClass& c = classes[class_of(segment)];
    ++c.found;
    if (!segment.first) ++out.found;
    if (!matched_found.contains(segment)) ++c.wrong;
  }
  double things = 0, stuff = 0, miscounted = 0;
  for (const auto& [index, c] : classes) {
    const bool is_stuff = index != kVoid && stuff_[static_cast<std::size_t>(index)];
    const double matched = static_cast<double>(c.matched),
                 all = matched + 0.5 * static_cast<double>(c.wrong + c.missed);
    const double sq = c.matched > 0 ? c.iou / matched : 0, rq = all > 0 ? matched / all : 0;
    out.sq += sq;
    out.rq += rq;
    out.pq += sq * rq;
    (is_stuff ? out.pq_stuff : out.pq_things) += sq * rq;
    (is_stuff ? stuff : things) += 1;
    if (is_stuff) continue;
    out.matched += c.matched;
    miscounted += std::abs(static_cast<double>(c.found - c.truth));
  }
  const auto mean = [](double& sum, double count) { sum = count > 0 ? sum / count : 0; };
  mean(out.pq, things + stuff);
  mean(out.sq, things + stuff);
  mean(out.rq, things + stuff);
  mean(out.pq_things, things);
  mean(out.pq_stuff, stuff);
  mean(out.mcov, static_cast<double>(out.objects));
  out.count_error = miscounted / std::max(1.0, static_cast<double>(out.objects));
  return out;
}

}  // namespace semfield
