#include "serve/label_loop.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <iterator>
#include <numeric>
#include <set>
#include <unordered_map>
#include <utility>

#include "compute/parallel.h"

namespace semfield {

namespace {

using Clock = std::chrono::steady_clock;

constexpr float kMostLead = 6;           // of a way, beyond which it says no more
constexpr std::int64_t kCellPixels = 8;  // of maps, for a cell of the pool: with fewer, cells of a surface do not touch

}  // namespace

LabelLoop::LabelLoop(Training& training, std::span<const int> frames, const LabelLoopOptions& options,
                     std::span<const int> held_out)
    : training_(training),
      pipeline_(*training.session().pipeline),
      options_(options),
      learner_(pipeline_),
      places_(options.reach_px),
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
  return make_surface_map(pipeline_, views_[static_cast<std::size_t>(view)].camera, training_.session().limits, stride,
                          training_.step());
}

bool LabelLoop::update_surfaces(double budget_s) {
  const Clock::time_point start = Clock::now();
  const auto spent = [&] { return std::chrono::duration<double>(Clock::now() - start).count(); };
  for (std::size_t v = 0; v < pooled_; ++v) {
    if (!due(views_[v])) continue;
    views_[v].map = map_of(static_cast<int>(v), stride_);
    if (spent() >= budget_s) return false;
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
  places_.renew();
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
  parallel_for((std::ssize(points) + 1023) / 1024, [&](std::int64_t block) {
    for (auto i = static_cast<std::size_t>(block * 1024);
         i < std::min(points.size(), static_cast<std::size_t>((block + 1) * 1024)); ++i) {
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
    }
  });
}

std::vector<float> LabelLoop::probabilities(const PointRows& rows, std::span<const Vec3d> places, double temperature) {
  std::vector<float> out = learner_.probabilities(rows, live_);
  std::vector<std::int32_t> points(places.size());
  const WorkScope scope(pipeline_.options().work);
  parallel_for((std::ssize(places) + 1023) / 1024, [&](std::int64_t block) {
    for (auto i = static_cast<std::size_t>(block * 1024);
         i < std::min(places.size(), static_cast<std::size_t>((block + 1) * 1024)); ++i)
      points[i] = pool_.cells.near(places[i]);
  });
  weigh_by_way(points, temperature, out);
  return out;
}

bool LabelLoop::find_places(std::span<const LabelledPixels> clicks, double budget_s) {
  return places_.find(clicks, surface(), budget_s);
}

void LabelLoop::refresh_places(std::span<const LabelledPixels> clicks, double budget_s) {
  places_.refresh(clicks, surface(), budget_s);
}

LabelLoop::Named LabelLoop::named_points(std::span<const LabelledPixels> clicks, const std::vector<bool>& left_out) {
  Named named;
  // By class: points of strokes in cells of the pool. What several strokes name counts once, with the weights of all.
  std::vector<std::unordered_map<std::int32_t, std::size_t>> stroked(static_cast<std::size_t>(classes()));
  SurfaceCells cells = ready() ? SurfaceCells(pool_.cell_m()) : SurfaceCells();
  answered_.clear();
  for (std::size_t k = 0; k < clicks.size(); ++k) {
    if (!left_out.empty() && left_out[k]) continue;
    const LabelledPixels& click = clicks[k];
    const std::span<const Vec3d> places = places_.of(k);
    if (places.empty()) continue;
    answered_.push_back(places.front());
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
  (void)places_.find(clicks, surface(), INFINITY);
  learn_from(named_points(clicks), quickly ? options_.quick_steps : options_.learning.steps);
  clicks_.clear();
  std::copy_if(clicks.begin(), clicks.end(), std::back_inserter(clicks_),
               [](const LabelledPixels& click) { return click.weight >= 1; });
  predict_pool();
}

void LabelLoop::set_temperature(double temperature) {
  temperature_ = temperature;
  predict_pool();
}

}  // namespace semfield
