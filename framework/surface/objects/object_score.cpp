#include "surface/objects/object_score.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <set>

#include "compute/parallel.h"
#include "core/rng.h"
#include "labels/training_labels.h"

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

namespace {

constexpr std::int32_t kPatchPx = 16;

class FrameDamage {
 public:
  FrameDamage(FrameSegments& frame, const SegmentDamage& damage, std::uint64_t seed, std::uint64_t number)
      : frame_(frame), damage_(damage), seed_(seed), number_(number) {}

  void run() {
    if (damage_.border_px > 0) move_borders();
    if (damage_.merge > 0) merge();
    if (damage_.split > 0) split();
    if (damage_.missing > 0) leave_out();
    if (damage_.shuffle) shuffle();
  }

 private:
  RandomAddress address(std::string_view stream) const { return {seed_, number_, stream_id(stream)}; }

  std::vector<std::int32_t> ids() const {
    std::set<std::int32_t> all(frame_.id.begin(), frame_.id.end());
    all.erase(0);
    return {all.begin(), all.end()};
  }

  // All in a random order.
  std::vector<std::int32_t> shuffled(std::string_view stream) const {
    std::vector<std::int32_t> all = ids();
    const RandomAddress where = address(stream);
    for (std::size_t i = all.size(); i > 1; --i) std::swap(all[i - 1], all[uniform_below(where, i, i)]);
    return all;
  }
  std::vector<std::int32_t> drawn(std::string_view stream, double share) const {
    std::vector<std::int32_t> all = shuffled(stream);
    all.resize(static_cast<std::size_t>(rounded_share(share, std::ssize(all))));
    return all;
  }

  void move_borders() {
    const std::vector<std::int32_t> before = frame_.id;
    const RandomAddress where = address("objects/damage/border");
    const std::int32_t patches = frame_.width_px / kPatchPx + 1;
    const auto span = static_cast<std::uint64_t>(2 * damage_.border_px + 1);
    for (std::int32_t y = 0; y < frame_.height_px; ++y) {
      for (std::int32_t x = 0; x < frame_.width_px; ++x) {
        const auto patch = static_cast<std::uint64_t>(y / kPatchPx * patches + x / kPatchPx);
        const auto shift = [&](std::uint64_t axis) {
          return static_cast<std::int32_t>(uniform_below(where, 2 * patch + axis, span)) -
                 static_cast<std::int32_t>(damage_.border_px);
        };
        const std::int32_t from_x = std::clamp(x + shift(0), 0, frame_.width_px - 1),
                           from_y = std::clamp(y + shift(1), 0, frame_.height_px - 1);
        frame_.id[at(x, y)] = before[at(from_x, from_y)];
      }
    }
  }

  void merge() {
    const RandomAddress where = address("objects/damage/merge_with");
    std::map<std::int32_t, std::set<std::int32_t>> touching;
    for (std::int32_t y = 0; y < frame_.height_px; ++y) {
      for (std::int32_t x = 0; x < frame_.width_px; ++x) {
        const std::int32_t here = frame_.id[at(x, y)];
        for (const std::int32_t next : {x + 1 < frame_.width_px ? frame_.id[at(x + 1, y)] : here,
                                        y + 1 < frame_.height_px ? frame_.id[at(x, y + 1)] : here}) {
          if (here == 0 || next == 0 || next == here) continue;
          touching[here].insert(next);
          touching[next].insert(here);
        }
      }
    }
    std::map<std::int32_t, std::int32_t> becomes;
    for (const std::int32_t id : drawn("objects/damage/merge", damage_.merge)) {
      const std::set<std::int32_t>& others = touching[id];
      if (others.empty()) continue;
      auto other = others.begin();
      std::advance(other,
                   static_cast<std::ptrdiff_t>(uniform_below(where, static_cast<std::uint64_t>(id), others.size())));
      becomes[id] = *other;
    }
    for (std::int32_t& id : frame_.id)
      if (const auto found = becomes.find(id); found != becomes.end()) id = found->second;
  }

  void split() {
    const RandomAddress where = address("objects/damage/split_line");
    std::int32_t next = ids().empty() ? 1 : ids().back() + 1;
    for (const std::int32_t id : drawn("objects/damage/split", damage_.split)) {
      double sum_x = 0, sum_y = 0, count = 0;
      for_pixels(id, [&](std::int32_t x, std::int32_t y) {
        sum_x += x;
        sum_y += y;
        ++count;
      });
      const double angle = 2 * std::numbers::pi * static_cast<double>(uniform01(where, static_cast<std::uint64_t>(id)));
      for_pixels(id, [&](std::int32_t x, std::int32_t y) {
        if ((x - sum_x / count) * std::cos(angle) + (y - sum_y / count) * std::sin(angle) > 0)
          frame_.id[at(x, y)] = next;
      });
      if (const auto own = frame_.class_of.find(id); own != frame_.class_of.end()) frame_.class_of[next] = own->second;
      ++next;
    }
  }

  void leave_out() {
    const std::vector<std::int32_t> out = drawn("objects/damage/missing", damage_.missing);
    const std::set<std::int32_t> gone(out.begin(), out.end());
    for (std::int32_t& id : frame_.id)
      if (gone.contains(id)) id = 0;
  }

  void shuffle() {
    std::map<std::int32_t, std::int32_t> number;
    for (const std::int32_t id : shuffled("objects/damage/shuffle"))
      number.emplace(id, static_cast<std::int32_t>(number.size()) + 1);
    for (std::int32_t& id : frame_.id)
      if (id != 0) id = number.at(id);
    std::map<std::int32_t, std::int16_t> class_of;
    for (const auto& [id, index] : frame_.class_of)
      if (const auto found = number.find(id); found != number.end()) class_of[found->second] = index;
    frame_.class_of = std::move(class_of);
  }

  std::size_t at(std::int32_t x, std::int32_t y) const {
    return static_cast<std::size_t>(std::int64_t{y} * frame_.width_px + x);
  }
  template <class Body>
  void for_pixels(std::int32_t id, const Body& body) const {
    for (std::int32_t y = 0; y < frame_.height_px; ++y)
      for (std::int32_t x = 0; x < frame_.width_px; ++x)
        if (frame_.id[at(x, y)] == id) body(x, y);
  }

  FrameSegments& frame_;
  const SegmentDamage& damage_;
  std::uint64_t seed_, number_;
};

}  // namespace

void damage_segments(SegmentSet& segments, const SegmentDamage& damage, std::uint64_t seed) {
  if (!damage.any()) return;
  parallel_for(std::ssize(segments.frames), [&](std::int64_t f) {
    FrameSegments& frame = segments.frames[static_cast<std::size_t>(f)];
    if (!frame.empty()) FrameDamage(frame, damage, seed, static_cast<std::uint64_t>(f)).run();
  });
}

}  // namespace semfield
