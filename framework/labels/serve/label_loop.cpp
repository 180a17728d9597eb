#include "labels/serve/label_loop.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <iterator>
#include <numbers>
#include <numeric>
#include <set>
#include <unordered_map>
#include <unordered_set>
#include <utility>

#include "core/check.h"
#include "core/rng.h"
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

PointLearner::PointLearner(Pipeline<float>& pipeline) : pipeline_(pipeline) {
  SEMFIELD_CHECK(pipeline.has_semantics(), "points are learned by a network with semantics");
  classes_ = pipeline.passes().back().parts().head->width();
  tensors_ = semantic_tensors(pipeline.store());
}

PointRows PointLearner::rows_at(std::span<const Vec3d> positions) {
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  PointRows rows;
  rows.dims = pipeline_.passes().back().point_dims();
  rows.values.resize(positions.size() * static_cast<std::size_t>(rows.dims));
  if (!positions.empty())
    pipeline_.executor().points().rows({&positions.data()->x, std::ssize(positions), 3}, rows.view());
  return rows;
}

void PointLearner::learn(const PointRows& rows, std::span<const std::int16_t> logit, std::span<const float> weight,
                         const PointLearning& options) {
  SEMFIELD_CHECK(rows.count() == std::ssize(logit), "a logit for every point");
  for (Tensor<float>* tensor : tensors_)
    if (tensor->learned()) pipeline_.store().restart(*tensor);
  const PointChoice choice(logit, weight, classes_, options.class_power);
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
  PointLessons<float> lessons;
  lessons.rows = rows.view();
  lessons.logit = logit;
  lessons.choice = points;
  lessons.batch = options.batch;
  lessons.updates = updates;
  lessons.weight_decay = options.weight_decay;
  pipeline_.executor().points().learn(lessons);
}

PointLearner::Kept PointLearner::keep() const {
  pipeline_.executor().points().read();
  Kept kept;
  for (const Tensor<float>* tensor : tensors_)
    for (const auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2})
      kept.emplace_back(part->data(), part->data() + part->size());
  return kept;
}

void PointLearner::put_back(const Kept& kept) {
  std::size_t next = 0;
  for (Tensor<float>* tensor : tensors_)
    for (auto* part : {&tensor->value, &tensor->moment1, &tensor->moment2}) {
      std::copy(kept[next].begin(), kept[next].end(), part->data());
      ++next;
    }
  pipeline_.executor().points().write();
}

std::vector<float> PointLearner::logits(const PointRows& rows) {
  std::vector<float> out(static_cast<std::size_t>(rows.count() * classes_));
  if (!out.empty()) pipeline_.executor().points().logits(rows.view(), {out.data(), rows.count(), classes_});
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

std::vector<float> PointLearner::probabilities(const PointRows& rows, const std::vector<bool>& live) {
  std::vector<float> values = logits(rows);
  softmax_live(values, classes_, live);
  return values;
}

namespace {

using Clock = std::chrono::steady_clock;

constexpr double kAlikeColor = 24;        // of 255, a channel
constexpr double kAlikeDistance = 0.03;   // of the distance
constexpr std::size_t kMostPixels = 256;  // of a stroke

std::uint64_t key_of(const LabelledPixels& click) {
  std::uint64_t hash = 0xcbf29ce484222325ull;
  const auto mix = [&](std::uint64_t value) {
    hash = (hash ^ value) * 0x100000001B3ull;
    hash ^= hash >> 29;
  };
  mix(static_cast<std::uint64_t>(click.view));
  for (const PixelPlace& p : click.pixels)
    mix(static_cast<std::uint64_t>(p.row) << 32 | static_cast<std::uint32_t>(p.column));
  return hash;
}

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

namespace {

constexpr float kMostLead = 6;           // of a way, beyond which it says no more
constexpr std::int64_t kCellPixels = 8;  // of maps, for a cell of the pool: with fewer, cells of a surface do not touch

}  // namespace

LabelLoop::LabelLoop(Trainer& training, std::span<const int> frames, const LabelLoopOptions& options,
                     std::span<const int> held_out)
    : training_(training),
      pipeline_(*training.session().pipeline),
      options_(options),
      learner_(pipeline_),
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
  const double stride = std::sqrt(static_cast<double>(pixels) / static_cast<double>(options.map_rays));
  stride_ = std::clamp(static_cast<std::int32_t>(std::ceil(stride)), 2, std::max(2, shortest / 8));
  live_.assign(static_cast<std::size_t>(learner_.classes()), false);
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
                            std::clamp<std::int64_t>(pixels / kCellPixels, 1, options_.pool_points));
  std::vector<Vec3d> positions;
  for (const PoolPoint& point : pool_.points) positions.push_back(point.position);
  pool_rows_ = learner_.rows_at(positions);
  graph_ = SurfaceGraph(pool_, options_.graph);
  renew_places();
  settle_seeds();
  predict_pool();
}

void LabelLoop::predict_pool() {
  pool_probability_.clear();
  if (!learned_) return;
  pool_probability_ = learner_.probabilities(pool_rows_, live_);
  std::vector<std::int32_t> points(pool_.points.size());
  std::iota(points.begin(), points.end(), 0);
  weigh_by_way(points, temperature_, pool_probability_);
}

void LabelLoop::weigh_by_way(std::span<const std::int32_t> points, double temperature,
                             std::span<float> probability) const {
  const auto width = static_cast<std::size_t>(classes());
  const auto fold = static_cast<float>(options_.graph_cost > 0 ? 1 / options_.graph_cost : 0);
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

std::vector<float> LabelLoop::probabilities(const PointRows& rows, std::span<const Vec3d> places, double temperature) {
  std::vector<float> out = learner_.probabilities(rows, live_);
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
  if (options_.reach_px == 0) return click.pixels;
  const StoredFrame& photo = *view(click.view).photo;
  std::vector<PixelPlace> all = click.pixels;
  const PixelPlace center = click.pixels.front();
  const std::int32_t reach = std::max(1, options_.reach_px * photo.width_px / 320);
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
  named.rows = learner_.rows_at(named.position);
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
    const double weight = std::exp(-static_cast<double>(s.cost[0]) / options_.far_cost) *
                          std::tanh(std::min(lead / options_.doubt_cost, 20.0));
    if (weight < 1e-3) continue;
    named.logit.push_back(s.class_index[0]);
    named.weight.push_back(static_cast<float>(weight * options_.spread_weight));
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
  PointLearning learning = options_.learning;
  learning.steps = steps;
  learner_.learn(named.rows, named.logit, named.weight, learning);
  learned_ = !named.logit.empty();
}

void LabelLoop::learn(std::span<const LabelledPixels> clicks, bool quickly) {
  (void)find_places(clicks, INFINITY);
  learn_from(named_points(clicks), quickly ? options_.quick_steps : options_.learning.steps);
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

}  // namespace semfield
