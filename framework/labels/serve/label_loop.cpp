#include "labels/serve/label_loop.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <numbers>
#include <numeric>
#include <set>
#include <tuple>
#include <unordered_set>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/rng.h"
#include "eval/metrics.h"
#include "eval/photo_edges.h"
#include "execution/render_rays.h"

namespace semfield {

namespace {

constexpr const char* kChoice = "point_learner/choice";

// Labelled points by class.
class PointChoice {
 public:
  PointChoice(std::span<const std::int16_t> logit, std::span<const float> weight, std::int32_t classes, double power) {
    std::vector<std::vector<std::int32_t>> of(static_cast<std::size_t>(classes));
    for (std::size_t i = 0; i < logit.size(); ++i)
      if (logit[i] >= 0) of[static_cast<std::size_t>(logit[i])].push_back(static_cast<std::int32_t>(i));
    for (std::vector<std::int32_t>& points : of) {
      if (points.empty()) continue;
      Class entry;
      double sum = 0;
      for (const std::int32_t i : points) {
        sum += weight.empty() ? 1.0 : static_cast<double>(weight[static_cast<std::size_t>(i)]);
        entry.up_to.push_back(sum);
      }
      if (!(sum > 0)) continue;
      entry.points = std::move(points);
      classes_.push_back(std::move(entry));
      class_up_to_.push_back((class_up_to_.empty() ? 0 : class_up_to_.back()) + std::pow(sum, power));
    }
  }

  bool empty() const { return classes_.empty(); }

  std::int32_t draw(const RandomAddress& address, std::int64_t i) const {
    const auto index = 2 * static_cast<std::uint64_t>(i);
    const auto chosen = place_in(class_up_to_, static_cast<double>(uniform01(address, index)) * class_up_to_.back());
    const Class& from = classes_[chosen];
    const double at = static_cast<double>(uniform01(address, index + 1)) * from.up_to.back();
    return from.points[place_in(from.up_to, at)];
  }

 private:
  struct Class {
    std::vector<std::int32_t> points;
    std::vector<double> up_to;  // sum of weights
  };
  std::vector<Class> classes_;
  std::vector<double> class_up_to_;
};

}  // namespace

std::int32_t point_classes(const Pipeline<float>& pipeline) {
  SEMFIELD_CHECK(pipeline.has_semantics(), "points are learned by a network with semantics");
  return pipeline.passes().back().parts().head->width();
}

PointRows point_rows(Pipeline<float>& pipeline, std::span<const Vec3d> positions) {
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  PointRows rows;
  rows.dims = pipeline.passes().back().point_dims();
  rows.values.resize(positions.size() * static_cast<std::size_t>(rows.dims));
  if (!positions.empty())
    pipeline.executor().points().rows({&positions.data()->x, std::ssize(positions), 3}, rows.view());
  return rows;
}

void learn_points(Pipeline<float>& pipeline, const PointRows& rows, std::span<const std::int16_t> logit,
                  std::span<const float> weight, const PointLearning& options) {
  SEMFIELD_CHECK(rows.count() == std::ssize(logit), "a logit for every point");
  for (Tensor<float>* tensor : semantic_tensors(pipeline.store()))
    if (tensor->learned()) pipeline.store().restart(*tensor);
  const PointChoice choice(logit, weight, point_classes(pipeline), options.class_power);
  const std::int64_t steps = choice.empty() ? 0 : options.steps;
  std::vector<std::int32_t> points(static_cast<std::size_t>(steps * options.batch));
  std::vector<AdamStep> updates;
  for (std::int64_t n = 0; n < steps; ++n) {
    const RandomAddress address{options.seed, static_cast<std::uint64_t>(n), stream_id(kChoice)};
    for (std::int64_t b = 0; b < options.batch; ++b)
      points[static_cast<std::size_t>(n * options.batch + b)] = choice.draw(address, b);
    const double done = static_cast<double>(n) / static_cast<double>(options.steps);
    const double rate = options.learning_rate * (0.1 + 0.45 * (1 + std::cos(std::numbers::pi * done)));
    updates.push_back(adam_step(AdamParams{}, rate, n));
  }
  pipeline.executor().points().learn({.rows = rows.view(),
                                      .logit = logit,
                                      .choice = points,
                                      .batch = options.batch,
                                      .updates = updates,
                                      .weight_decay = options.weight_decay});
}

KeptSemantics keep_semantics(Pipeline<float>& pipeline) {
  pipeline.executor().points().read();
  KeptSemantics kept;
  for (const Tensor<float>* tensor : semantic_tensors(pipeline.store()))
    for (const auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2})
      kept.emplace_back(part->data(), part->data() + part->size());
  return kept;
}

void put_back(Pipeline<float>& pipeline, const KeptSemantics& kept) {
  std::size_t next = 0;
  for (Tensor<float>* tensor : semantic_tensors(pipeline.store()))
    for (auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2}) {
      std::copy(kept[next].begin(), kept[next].end(), part->data());
      ++next;
    }
  pipeline.executor().points().write();
}

std::vector<float> point_logits(Pipeline<float>& pipeline, const PointRows& rows) {
  const std::int32_t classes = point_classes(pipeline);
  std::vector<float> out(static_cast<std::size_t>(rows.count() * classes));
  if (!out.empty()) pipeline.executor().points().logits(rows.view(), {out.data(), rows.count(), classes});
  return out;
}

void softmax_live(std::span<float> logits, std::int32_t classes, const std::vector<bool>& live) {
  const auto width = static_cast<std::size_t>(classes);
  for (std::size_t begin = 0; begin < logits.size(); begin += width) {
    const std::span<float> row = logits.subspan(begin, width);
    float most = -INFINITY, sum = 0;
    for (std::size_t c = 0; c < width; ++c)
      if (live[c]) most = std::max(most, row[c]);
    for (std::size_t c = 0; c < width; ++c) {
      row[c] = live[c] ? std::exp(row[c] - most) : 0.0F;
      sum += row[c];
    }
    if (sum > 0)
      for (float& p : row) p /= sum;
  }
}

namespace {

constexpr int kLeastOfClass = 4;       // clicks of a class of which one may be held back
constexpr std::size_t kLeastHeld = 8;  // clicks that say something of the temperature
constexpr double kLowest = 0.25, kHighest = 5;
constexpr double kPriorWidth = 0.5;   // standard deviation of log T
constexpr double kWrongClicks = 0.1;  // fraction that says nothing: slips, and places that no other click resembles

// Of the clicks at a temperature: weighted log likelihoods, as many as there are in effect, less the prior.
double misfit(std::span<const HeldBack> held, double temperature) {
  double sum = 0, total = 0, squares = 0;
  for (const HeldBack& click : held) {
    double norm = 0;
    std::size_t live = 0;
    for (const float p : click.probability) {
      if (!(p > 0)) continue;
      norm += std::pow(static_cast<double>(p), 1 / temperature);
      ++live;
    }
    const auto own = static_cast<double>(click.probability[click.truth]);
    const double share = own > 0 && norm > 0 ? std::pow(own, 1 / temperature) / norm : 0;
    sum -= click.counts *
           std::log((1 - kWrongClicks) * share + kWrongClicks / static_cast<double>(std::max<std::size_t>(1, live)));
    total += click.counts;
    squares += click.counts * click.counts;
  }
  const double off = std::log(temperature) / kPriorWidth;
  return sum / total * (total * total / squares) + off * off / 2;
}

}  // namespace

std::vector<int> calibration_folds(std::span<const std::int16_t> classes) {
  std::map<std::int16_t, int> all, dealt;
  for (const std::int16_t c : classes) ++all[c];
  std::vector<int> folds;
  for (const std::int16_t c : classes)
    folds.push_back(all[c] < kLeastOfClass ? -1 : (dealt[c]++ + c) % kCalibrationFolds);
  return folds;
}

std::optional<double> fit_temperature(std::span<const HeldBack> held) {
  if (held.size() < kLeastHeld) return std::nullopt;
  // One minimum over log T: golden section.
  const double bottom = std::log(kLowest), top = std::log(kHighest), golden = (std::sqrt(5.0) - 1) / 2;
  double low = bottom, high = top;
  for (int i = 0; i < 40; ++i) {
    const double a = high - golden * (high - low), b = low + golden * (high - low);
    if (misfit(held, std::exp(a)) < misfit(held, std::exp(b))) {
      high = b;
    } else {
      low = a;
    }
  }
  const double found = (low + high) / 2;
  if (found - bottom < 0.01 || top - found < 0.01) return std::nullopt;
  return std::exp(found);
}

namespace {

using Clock = std::chrono::steady_clock;

// body(i) for every i below `count`, a thousand in a row by one thread.
template <class Body>
void for_each_index(std::size_t count, const Body& body) {
  constexpr std::size_t kBlock = 1024;
  parallel_for(static_cast<std::int64_t>((count + kBlock - 1) / kBlock), [&](std::int64_t block) {
    const std::size_t begin = static_cast<std::size_t>(block) * kBlock;
    for (std::size_t i = begin; i < std::min(count, begin + kBlock); ++i) body(i);
  });
}

constexpr double kMapRays = 400'000;  // of the coarse maps of all views together
constexpr std::int64_t kPoolPoints = 30'000;
constexpr double kGraphCost = 0.7;      // e-fold of a class by how much farther it is than the nearest
constexpr double kSpreadWeight = 0.05;  // of a point that clicks spread to, where a click is 1
constexpr double kFarCost = 3;          // what is this far from a click says 1/e as much as the click
constexpr double kDoubtCost = 0.5;      // difference of the ways to two classes that leaves no doubt (tanh 1)
constexpr std::int32_t kReach_px = 4;   // a click names the pixels around it that look alike; of an image 320 wide
constexpr std::int64_t kQuickSteps = 80;
constexpr double kAlikeColor = 24;        // of 255, a channel
constexpr double kAlikeDistance = 0.03;   // of the distance
constexpr std::size_t kMostPixels = 256;  // of a stroke

std::uint64_t key_of(const LabelledPixels& click) {
  std::uint64_t key = mix(0xcbf29ce484222325ull, static_cast<std::uint64_t>(click.view));
  for (const PixelPlace& p : click.pixels)
    key = mix(key, static_cast<std::uint64_t>(p.row) << 32 | static_cast<std::uint32_t>(p.column));
  return key;
}

constexpr float kMostLead = 6;           // of a way, beyond which it says no more
constexpr std::int64_t kCellPixels = 8;  // of maps, for a cell of the pool: with fewer, cells of a surface do not touch

std::int32_t pixel_in(double at, std::int32_t length_px) {
  return static_cast<std::int32_t>(std::clamp(std::floor(at), 0.0, static_cast<double>(length_px - 1)));
}

}  // namespace

std::vector<PixelPlace> pixels_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px,
                                  std::span<const std::int16_t> painted) {
  std::vector<PixelPlace> out;
  if (mark.points.empty()) return out;
  const auto take = [&](std::int32_t x, std::int32_t y) {
    if (painted.empty() || painted[static_cast<std::size_t>(std::int64_t{y} * width_px + x)] == mark.class_index)
      out.push_back({x, y});
  };
  const std::vector<PixelRun> runs = runs_of(mark, width_px, height_px);
  PixelPlace first{pixel_in(mark.points[0].x, width_px), pixel_in(mark.points[0].y, height_px)};
  if (mark.fill && !runs.empty()) {  // a corner may lie outside of what an outline holds
    const PixelRun& middle = runs[runs.size() / 2];
    first = {(middle.x0 + middle.x1) / 2, middle.y};
  }
  take(first.column, first.row);
  for (const PixelRun& run : runs)
    for (std::int32_t x = run.x0; x < run.x1; ++x)
      if (x != first.column || run.y != first.row) take(x, run.y);
  return out;
}

LabelLoop::LabelLoop(Trainer& training, std::span<const int> frames, const PointLearning& learning,
                     std::span<const int> held_out, std::vector<FrameSegments> segments)
    : training_(training),
      pipeline_(*training.session().pipeline),
      learning_(learning),
      segments_(std::move(segments)),
      logit_of_class_(training.session().logit_of_class()) {
  const Session& session = training.session();
  std::int64_t pixels = 0;
  std::int32_t shortest = 1 << 20;
  const auto add_view = [&](int f) -> const Camera& {
    const auto n = static_cast<std::size_t>(f);
    const FrameInfo& info = session.scene.info.frames[n];
    PoolView view;
    view.frame = f;
    view.camera = {info.camera, info.world_from_camera, session.plan.undistortion};
    view.photo = &session.scene.frames[n];
    if (n < segments_.size() && !segments_[n].empty()) view.segments = &segments_[n];
    views_.push_back(std::move(view));
    return info.camera;
  };
  for (const int f : frames) {
    const Camera& camera = add_view(f);
    pixels += std::int64_t{camera.width_px} * camera.height_px;
    shortest = std::min({shortest, camera.width_px, camera.height_px});
  }
  pooled_ = views_.size();
  for (const int f : held_out)
    shortest = std::min({shortest, add_view(f).width_px, views_.back().camera.camera.height_px});
  ignored_.resize(views_.size());
  const double stride = std::sqrt(static_cast<double>(pixels) / kMapRays);
  stride_ = std::clamp(static_cast<std::int32_t>(std::ceil(stride)), 2, std::max(2, shortest / 8));
  live_.assign(static_cast<std::size_t>(classes()), false);
}

bool LabelLoop::due(const PoolView& view) const { return view.map.empty() || is_stale(view.map, training_.step()); }

SurfaceMap LabelLoop::map_of(int view, std::int32_t stride) {
  return make_surface_map(pipeline_, this->view(view).camera, training_.session().limits, stride, training_.step());
}

bool LabelLoop::update_surfaces(double budget_s) {
  const Clock::time_point start = Clock::now();
  for (std::size_t v = 0; v < pooled_; ++v) {
    if (!due(views_[v])) continue;
    views_[v].map = map_of(static_cast<int>(v), stride_);
    if (seconds_since(start) >= budget_s) return false;
  }
  const auto oldest = std::min_element(pooled().begin(), pooled().end(),
                                       [](const PoolView& a, const PoolView& b) { return a.map.step < b.map.step; });
  if (oldest == pooled().end() || (ready() && pool_step_ >= oldest->map.step)) return false;
  make_pool();
  pool_step_ = training_.step();
  return true;
}

void LabelLoop::make_pool() {
  std::int64_t pixels = 0;
  for (const PoolView& view : pooled()) pixels += std::ssize(view.map.distance_m);
  pool_ = make_surface_pool(pooled(), training_.session().limits,
                            std::clamp<std::int64_t>(pixels / kCellPixels, 1, kPoolPoints));
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : pool_.points) positions.push_back(point.position);
  pool_rows_ = point_rows(pipeline_, positions);
  graph_ = SurfaceGraph(pool_, {});
  renew_places();
  settle_seeds();
  predict_pool();
}

void LabelLoop::predict_pool() {
  pool_probability_.clear();
  if (!learned_) return;
  pool_probability_ = network_probabilities(pool_rows_);
  std::vector<std::int32_t> points(pool_.points.size());
  std::iota(points.begin(), points.end(), 0);
  weigh_by_way(points, temperature_, pool_probability_);
}

void LabelLoop::weigh_by_way(std::span<const std::int32_t> points, double temperature,
                             std::span<float> probability) const {
  const auto width = static_cast<std::size_t>(classes());
  const auto fold = static_cast<float>(1 / kGraphCost);
  const auto power = static_cast<float>(1 / temperature);
  for_each_index(points.size(), [&](std::size_t i) {
    const std::span<float> row = probability.subspan(i * width, width);
    if (points[i] >= 0) {
      const Settled& s = graph_.settled()[static_cast<std::size_t>(points[i])];
      const float factor = std::exp(-std::min(s.cost[1] - s.cost[0], kMostLead) * fold);
      for (std::size_t c = 0; c < width && s.class_index[0] != kVoid; ++c)
        if (static_cast<std::int16_t>(c) != s.class_index[0]) row[c] *= factor;
    }
    float sum = 0;
    for (float& p : row) sum += p = power == 1 || p == 0 ? p : std::pow(p, power);
    if (sum > 0)
      for (float& p : row) p /= sum;
  });
}

// Classes without labels have none.
std::vector<float> LabelLoop::network_probabilities(const PointRows& rows) const {
  std::vector<float> values = point_logits(pipeline_, rows);
  softmax_live(values, classes(), live_);
  return values;
}

std::vector<float> LabelLoop::probabilities(const PointRows& rows, std::span<const Vec3d> places, double temperature) {
  std::vector<float> out = network_probabilities(rows);
  std::vector<std::int32_t> points(places.size());
  const WorkScope scope(pipeline_.options().work);
  for_each_index(places.size(), [&](std::size_t i) { points[i] = pool_.cells.near(places[i]); });
  weigh_by_way(points, temperature, out);
  return out;
}

// The first pixel of a stroke on each cell of the pool; where the view's map meets nothing, on each pixel of the map.
std::vector<PixelPlace> LabelLoop::one_a_cell(const LabelledPixels& stroke) const {
  const auto v = static_cast<std::size_t>(stroke.view);
  const SurfaceMap& map = views_[v].map;
  std::vector<PixelPlace> some;
  std::unordered_set<std::int64_t> taken;
  for (const PixelPlace& pixel : stroke.pixels) {
    if (!map.empty()) {
      const std::int64_t x = std::clamp(pixel.column / map.stride, 0, map.width_px - 1),
                         y = std::clamp(pixel.row / map.stride, 0, map.height_px - 1), at = y * map.width_px + x;
      const bool pooled = v < pool_.point_of_pixel.size() && !pool_.point_of_pixel[v].empty();
      const std::int32_t point = pooled ? pool_.point_of_pixel[v][static_cast<std::size_t>(at)] : -1;
      if (!taken.insert(point >= 0 ? point : -1 - at).second) continue;
    }
    some.push_back(pixel);
  }
  if (some.size() <= kMostPixels) return some;
  std::vector<PixelPlace> fewer;
  for (std::size_t i = 0; i < kMostPixels; ++i) fewer.push_back(some[i * some.size() / kMostPixels]);
  return fewer;
}

std::vector<PixelPlace> LabelLoop::pixels_of(const LabelledPixels& click) const {
  if (is_stroke(click)) return one_a_cell(click);
  const StoredFrame& photo = *view(click.view).photo;
  std::vector<PixelPlace> all = click.pixels;
  const PixelPlace center = click.pixels.front();
  const std::int32_t reach = std::max(1, kReach_px * photo.width_px / 320);
  const auto at = [&](std::int32_t x, std::int32_t y) {
    return 3 * static_cast<std::size_t>(std::int64_t{y} * photo.width_px + x);
  };
  const std::size_t own = at(center.column, center.row);
  for (std::int32_t y = center.row - reach; y <= center.row + reach; ++y) {
    for (std::int32_t x = center.column - reach; x <= center.column + reach; ++x) {
      const std::int32_t dx = x - center.column, dy = y - center.row;
      if (x < 0 || y < 0 || x >= photo.width_px || y >= photo.height_px || dx * dx + dy * dy > reach * reach) continue;
      if (dx == 0 && dy == 0) continue;
      bool alike = true;
      for (std::size_t c = 0; c < 3; ++c)
        alike = alike && std::abs(int{photo.rgb[at(x, y) + c]} - int{photo.rgb[own + c]}) <= kAlikeColor;
      if (alike) all.push_back({x, y});
    }
  }
  return all;
}

void LabelLoop::look_for(Known& known, const LabelledPixels& click) {
  const RayCamera& camera = view(click.view).camera;
  const std::vector<PixelPlace> pixels = pixels_of(click);
  const RayLimits& limits = training_.session().limits;
  const std::vector<float> distance = surface_distances(pipeline_, camera, limits, pixels);
  ++found_;
  known.age = age_;
  known.places.clear();
  for (std::size_t i = 0; i < pixels.size(); ++i) {
    const bool own = is_stroke(click) || i < click.pixels.size();
    if (!(distance[i] > 0)) continue;
    if (!own && !(std::abs(distance[i] - distance[0]) < kAlikeDistance * distance[0])) continue;
    known.places.push_back(point_at(camera, limits, pixels[i], static_cast<double>(distance[i])));
  }
}

bool LabelLoop::find_places(std::span<const LabelledPixels> clicks, double budget_s) {
  const Clock::time_point start = Clock::now();
  ++turn_;
  keys_.clear();
  bool all = true, first = true;
  for (const LabelledPixels& click : clicks) {
    keys_.push_back(key_of(click));
    Known& known = known_[keys_.back()];
    known.turn = turn_;
    if (known.age > 0) continue;
    if (!first && seconds_since(start) >= budget_s) {
      all = false;
      continue;
    }
    first = false;
    look_for(known, click);
  }
  std::erase_if(known_, [&](const auto& entry) { return entry.second.turn != turn_; });
  return all;
}

void LabelLoop::refresh_places(std::span<const LabelledPixels> clicks, double budget_s) {
  const Clock::time_point start = Clock::now();
  for (std::size_t i = 0; i < keys_.size() && seconds_since(start) < budget_s; ++i) {
    Known& known = known_.at(keys_[i]);
    if (known.age == 0 || known.age == age_) continue;
    look_for(known, clicks[i]);
  }
}

LabelLoop::Named LabelLoop::named_points(std::span<const LabelledPixels> clicks, const std::vector<bool>& left_out) {
  Named named;
  // By class: points of strokes in cells of the pool. What several strokes name counts once, with the weights of all.
  std::vector<std::unordered_map<std::int32_t, std::size_t>> stroked(static_cast<std::size_t>(classes()));
  SurfaceCells cells = ready() ? SurfaceCells(pool_.cell_m()) : SurfaceCells();
  for (std::size_t k = 0; k < clicks.size(); ++k) {
    if (!left_out.empty() && left_out[k]) continue;
    const LabelledPixels& click = clicks[k];
    const std::span<const Vec3d> places = places_of(k);
    if (places.empty()) continue;
    const std::int16_t logit = logit_of_class_[static_cast<std::size_t>(click.class_index)];
    // A click weighs as one, and a stroke by the root of what it covers.
    const double own =
        click.weight * std::sqrt(static_cast<double>(std::max<std::size_t>(1, click.pixels.size() / kMostClickPixels)));
    const auto weight = static_cast<float>(own / static_cast<double>(places.size()));
    for (const Vec3d& place : places) {
      if (is_stroke(click) && ready()) {
        const std::int32_t cell = cells.add(place);
        const auto [entry, fresh] = stroked[static_cast<std::size_t>(logit)].try_emplace(cell, named.logit.size());
        if (!fresh) {
          named.weight[entry->second] += weight;
          continue;
        }
      }
      named.position.push_back(place);
      named.logit.push_back(logit);
      named.click.push_back(static_cast<std::int32_t>(k));
      named.weight.push_back(weight);
    }
  }
  named.rows = point_rows(pipeline_, named.position);
  return named;
}

void LabelLoop::settle_seeds() {
  std::vector<GraphSeed> seeds;
  std::set<std::int32_t> named_points;
  for (auto seed = seeds_.rbegin(); seed != seeds_.rend(); ++seed) {  // the latest says what a point is
    const std::int32_t point = pool_.cells.near(seed->position);
    if (point >= 0 && named_points.insert(point).second) seeds.push_back({point, seed->logit});
  }
  graph_.settle(seeds);
}

void LabelLoop::add_spread(Named& named) {
  const std::vector<Settled>& settled = graph_.settled();
  const auto dims = static_cast<std::size_t>(pool_rows_.dims);
  for (std::size_t i = 0; i < settled.size(); ++i) {
    const Settled& s = settled[i];
    if (s.class_index[0] == kVoid) continue;
    const double lead = static_cast<double>(s.cost[1] - s.cost[0]);
    const double weight =
        std::exp(-static_cast<double>(s.cost[0]) / kFarCost) * std::tanh(std::min(lead / kDoubtCost, 20.0));
    if (weight < 1e-3) continue;
    named.logit.push_back(s.class_index[0]);
    named.weight.push_back(static_cast<float>(weight * kSpreadWeight));
    const auto row = pool_rows_.values.begin() + static_cast<std::ptrdiff_t>(i * dims);
    named.rows.values.insert(named.rows.values.end(), row, row + static_cast<std::ptrdiff_t>(dims));
  }
}

void LabelLoop::learn_from(Named named, std::int64_t steps) {
  std::fill(live_.begin(), live_.end(), false);
  for (const std::int16_t logit : named.logit) live_[static_cast<std::size_t>(logit)] = true;
  seeds_.clear();
  for (std::size_t i = 0; i < named.logit.size(); ++i) seeds_.push_back({named.position[i], named.logit[i]});
  settle_seeds();
  add_spread(named);
  PointLearning learning = learning_;
  learning.steps = steps;
  learn_points(pipeline_, named.rows, named.logit, named.weight, learning);
  learned_ = !named.logit.empty();
}

void LabelLoop::learn(std::span<const LabelledPixels> clicks, bool quickly) {
  (void)find_places(clicks, INFINITY);
  learn_from(named_points(clicks), quickly ? kQuickSteps : learning_.steps);
  clicks_.clear();
  std::copy_if(clicks.begin(), clicks.end(), std::back_inserter(clicks_),
               [](const LabelledPixels& click) { return click.weight >= 1; });
  predict_pool();
}

double LabelLoop::most_entropy() const {
  return std::log(static_cast<double>(std::max<std::ptrdiff_t>(2, std::count(live_.begin(), live_.end(), true))));
}

void LabelLoop::set_temperature(double temperature) {
  temperature_ = temperature;
  predict_pool();
}

// What a labelling session returns between steps: labels of a view, the next question, clicks held back.

std::vector<double> LabelLoop::areas_of(std::size_t clicks, const Named& named) const {
  std::vector<double> area(clicks, 1);
  for (const PoolPoint& point : pool_.points) {
    double least = INFINITY;
    std::size_t nearest = 0;
    for (std::size_t i = 0; i < named.position.size(); ++i) {
      if (i > 0 && named.click[i] == named.click[i - 1]) continue;  // a click's first point stands for it
      const Vec3d way = point.position - named.position[i];
      const double square = dot(way, way);
      if (square >= least) continue;
      least = square;
      nearest = static_cast<std::size_t>(named.click[i]);
    }
    if (std::isfinite(least)) area[nearest] += 1;
  }
  return area;
}

std::vector<HeldBack> LabelLoop::hold_back(std::span<const LabelledPixels> clicks, int fold) {
  (void)find_places(clicks, INFINITY);
  std::vector<std::int16_t> of_clicks;  // classes; given labels are never held back
  for (const LabelledPixels& click : clicks)
    if (click.weight >= 1) of_clicks.push_back(click.class_index);
  const std::vector<int> folds = calibration_folds(of_clicks);
  std::vector<bool> left_out(clicks.size(), false);
  auto next = folds.begin();
  for (std::size_t k = 0; k < clicks.size(); ++k)
    if (clicks[k].weight >= 1) left_out[k] = *next++ == fold;
  std::vector<HeldBack> held;
  if (std::count(left_out.begin(), left_out.end(), true) == 0) return held;
  const Named named = named_points(clicks);
  // Clicks lie where there was doubt: each counts for the surface that it stands for.
  const std::vector<double> area = areas_of(clicks.size(), named);
  const KeptSemantics kept = keep_semantics(pipeline_);
  const auto before = std::tuple(live_, seeds_, learned_);
  learn_from(named_points(clicks, left_out), learning_.steps);
  std::vector<Vec3d> places;
  for (std::size_t i = 0; i < named.logit.size(); ++i) {
    const auto click = static_cast<std::size_t>(named.click[i]);
    const bool first = i == 0 || named.click[i] != named.click[i - 1];  // a click's first point stands for it
    if (!first || !left_out[click]) continue;
    if (!live_[static_cast<std::size_t>(named.logit[i])]) continue;  // nobody else has named its class
    places.push_back(named.position[i]);
    held.push_back({{}, static_cast<std::size_t>(named.logit[i]), area[click]});
  }
  const std::vector<float> found = probabilities(point_rows(pipeline_, places), places, 1);
  for (std::size_t i = 0; i < held.size(); ++i) {
    const auto row = found.begin() + static_cast<std::ptrdiff_t>(i) * classes();
    held[i].probability.assign(row, row + classes());
  }
  put_back(pipeline_, kept);
  std::tie(live_, seeds_, learned_) = before;
  settle_seeds();
  return held;
}

ViewLabels LabelLoop::labels_of(int v, const SurfaceMap* fine, const Image<std::uint8_t>* photo) {
  PoolView& view = views_[static_cast<std::size_t>(v)];
  if (static_cast<std::size_t>(v) >= pooled_ && ready() && due(view)) view.map = map_of(v, stride_);
  const SurfaceMap& map = fine != nullptr ? *fine : view.map;
  const Camera& camera = view.camera.camera;
  ViewLabels labels{camera.width_px, camera.height_px, {}, {}};
  std::span<const std::uint8_t> rgb = view.photo->rgb;
  if (photo != nullptr) {
    labels.width_px = photo->width_px;
    labels.height_px = photo->height_px;
    rgb = photo->pixels;
  }
  const auto size = static_cast<std::size_t>(std::int64_t{labels.width_px} * labels.height_px);
  labels.label.assign(size, kVoid);
  labels.entropy.assign(size, 0);
  if (learned_ && !map.empty()) {
    // A last column says that the view meets nothing.
    const auto width = static_cast<std::size_t>(classes());
    std::vector<float> rows((width + 1) * map.distance_m.size(), 0);
    std::vector<Vec3d> positions;
    std::vector<std::size_t> where;
    for (std::size_t i = 0; i < map.distance_m.size(); ++i) {
      if (map.distance_m[i] > 0) {
        where.push_back(i);
      } else {
        rows[(width + 1) * i + width] = 1;
      }
    }
    positions.resize(where.size());
    for_each_index(where.size(), [&](std::size_t k) {
      const PixelPlace pixel = strided_place(static_cast<std::int64_t>(where[k]), map.width_px, map.stride);
      positions[k] =
          point_at(view.camera, training_.session().limits, pixel, static_cast<double>(map.distance_m[where[k]]));
    });
    const std::vector<float> probability = probabilities(point_rows(pipeline_, positions), positions, temperature_);
    for_each_index(where.size(), [&](std::size_t k) {
      std::copy_n(probability.begin() + static_cast<std::ptrdiff_t>(k * width), width,
                  rows.begin() + static_cast<std::ptrdiff_t>((width + 1) * where[k]));
    });
    ClassEvidence evidence{map.stride, map.width_px, map.height_px, rows, {}, camera.width_px, camera.height_px};
    for (const int c : training_.session().plan.class_of_logit) evidence.label.push_back(static_cast<std::int16_t>(c));
    evidence.label.push_back(kVoid);
    PhotoLabels found = labels_on_photo(evidence, rgb, labels.width_px, labels.height_px);
    labels.label = std::move(found.label);
    const double most = most_entropy();
    for (std::size_t i = 0; i < size; ++i)
      if (labels.label[i] != kVoid)
        labels.entropy[i] =
            static_cast<std::uint8_t>(std::lround(255 * std::min(1.0, static_cast<double>(found.entropy[i]) / most)));
  }
  // Pixels of the frame in those of the picture.
  const auto paint = [&](std::int64_t column, std::int64_t row, std::int16_t label) {
    const auto first = [](std::int64_t at, std::int32_t picture, std::int32_t frame) { return at * picture / frame; };
    for (std::int64_t y = first(row, labels.height_px, camera.height_px);
         y < std::max(first(row, labels.height_px, camera.height_px) + 1,
                      first(row + 1, labels.height_px, camera.height_px));
         ++y)
      for (std::int64_t x = first(column, labels.width_px, camera.width_px);
           x < std::max(first(column, labels.width_px, camera.width_px) + 1,
                        first(column + 1, labels.width_px, camera.width_px));
           ++x) {
        const auto at = static_cast<std::size_t>(y * labels.width_px + x);
        labels.label[at] = label;
        labels.entropy[at] = 0;
      }
  };
  for (const LabelledPixels& click : clicks_)
    for (const PixelPlace& pixel : click.view == v ? click.pixels : std::vector<PixelPlace>())
      paint(pixel.column, pixel.row, click.class_index);
  const std::vector<bool>& ignored = ignored_[static_cast<std::size_t>(v)];
  for (std::size_t p = 0; p < ignored.size(); ++p)
    if (ignored[p])
      paint(static_cast<std::int64_t>(p) % camera.width_px, static_cast<std::int64_t>(p) / camera.width_px, kVoid);
  return labels;
}

std::optional<Asked> LabelLoop::propose(std::uint64_t seed, std::uint64_t round) const {
  std::vector<std::int32_t> passed;
  for (const Vec3d& place : skipped_)
    if (const std::int32_t point = pool_.cells.near(place); point >= 0) passed.push_back(point);
  std::vector<bool> barred;
  if (std::any_of(ignored_.begin(), ignored_.end(), [](const auto& pixels) { return !pixels.empty(); })) {
    for (const PoolPoint& point : pool_.points) {
      const auto v = static_cast<std::size_t>(point.view);
      const std::int64_t pixel = std::int64_t{point.pixel.row} * views_[v].photo->width_px + point.pixel.column;
      barred.push_back(!ignored_[v].empty() && ignored_[v][static_cast<std::size_t>(pixel)]);
    }
  }
  const WorkScope scope(pipeline_.options().work);
  return choose_click({.pool = &pool_,
                       .graph = &graph_,
                       .probability = pool_probability_,
                       .classes = classes(),
                       .clicks = clicks_.size(),
                       .passed = passed,
                       .barred = &barred,
                       .seed = seed,
                       .round = round});
}

void LabelLoop::set_skipped(std::vector<LabelledPixels> skipped) {
  skipped_.clear();
  const RayLimits& limits = training_.session().limits;
  for (const LabelledPixels& place : skipped) {
    const RayCamera& camera = view(place.view).camera;
    const std::vector<float> distance = surface_distances(pipeline_, camera, limits, place.pixels);
    if (!distance.empty() && distance[0] > 0)
      skipped_.push_back(point_at(camera, limits, place.pixels[0], static_cast<double>(distance[0])));
  }
}

}  // namespace semfield
