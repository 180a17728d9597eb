#include "surface/fuse/fusion.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/error.h"
#include "core/small_math.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"
namespace semfield {

namespace {

void check_view(const FusionView& view, std::size_t index, int classes) {
  const std::size_t pixels = view.seen.pixel(0, view.seen.camera.height_px);
  SEMFIELD_CHECK(view.seen.depth_m.size() == pixels && view.prediction != nullptr &&
                     (view.prediction->empty() || view.prediction->size() == pixels),
                 "depth and prediction of a view have the size of its camera");
  const TrainingLabels::Frame& prediction = *view.prediction;
  SEMFIELD_CHECK(prediction.soft.empty() || prediction.soft.classes() == classes,
                 "a view's probabilities are of the scene's classes");
  for (std::size_t i = 0; i < prediction.hard.size(); ++i) {
    if (prediction.hard[i] >= kVoid && prediction.hard[i] < classes) continue;
    throw Error(
        ErrorKind::data, "labels.class.range",
        fmt::format("view {}: pixel {} has class index {}, there are {}", index, i, prediction.hard[i], classes),
        "predict with the scene's class table");
  }
}

FusedFrame blank_frame(std::size_t pixels) {
  FusedFrame out;
  for (std::vector<std::int16_t>& label : out.label) label.assign(pixels, kVoid);
  return out;
}

std::vector<std::int16_t>& map_of(FusedFrame& frame, FusionMethod method) {
  return frame.label[static_cast<std::size_t>(method)];
}

}  // namespace

void FusionCounts::merge(const FusionCounts& other) {
  pixels += other.pixels;
  without_depth += other.without_depth;
  unlabelled += other.unlabelled;
  filled += other.filled;
  votes += other.votes;
}

double FusionCounts::views_mean() const {
  const std::int64_t with_depth = pixels - without_depth;
  return with_depth == 0 ? 0 : static_cast<double>(votes) / static_cast<double>(with_depth);
}

// Of one row: sums of the current point, a pixel's probabilities as stored, and those of a view.
struct LabelFusion::Scratch {
  ClassVotes votes;
  std::vector<float> stored;
  std::vector<double> pixel, view;
  FusionCounts counts;
};

LabelFusion::LabelFusion(std::span<const FusionView> views, int classes, const FusionParams& params)
    : views_(views), classes_(classes), params_(params), hard_(params.hard_confidence, classes) {
  for (std::size_t i = 0; i < views.size(); ++i) {
    check_view(views[i], i, classes);
    seen_.push_back(views[i].seen);
  }
}

// Probabilities of one pixel into scratch.pixel; false without a prediction.
bool LabelFusion::prediction_at(const FusionView& view, std::size_t pixel, Scratch& s) const {
  const TrainingLabels::Frame& prediction = *view.prediction;
  if (prediction.empty() || prediction[pixel] < 0) return false;
  if (prediction.soft.empty()) {
    std::fill(s.pixel.begin(), s.pixel.end(), hard_.miss);
    s.pixel[static_cast<std::size_t>(prediction[pixel])] = hard_.hit;
  } else {
    prediction.soft.row(pixel, s.stored);
    std::copy(s.stored.begin(), s.stored.end(), s.pixel.begin());
  }
  return true;
}

void LabelFusion::add_prediction(const FusionView& view, const PixelHit& hit, Scratch& s) const {
  const int reach = params_.neighbourhood / 2;
  if (reach == 0) {
    const std::size_t pixel = view.seen.pixel(hit.column, hit.row);
    if (!view.prediction->hard.empty()) {
      if (const std::int16_t label = view.prediction->hard[pixel]; label >= 0) s.votes.add(label);
    } else if (prediction_at(view, pixel, s)) {
      s.votes.add(s.pixel);
    }
    return;
  }
  // The window's pixels on the same surface, each with the same weight.
  std::fill(s.view.begin(), s.view.end(), 0.0);
  int pixels = 0;
  const Camera& camera = view.seen.camera;
  for (int row = std::max(hit.row - reach, 0); row <= std::min(hit.row + reach, camera.height_px - 1); ++row) {
    for (int column = std::max(hit.column - reach, 0); column <= std::min(hit.column + reach, camera.width_px - 1);
         ++column) {
      const std::size_t pixel = view.seen.pixel(column, row);
      if (!same_surface(view.seen, pixel, hit.z_m, params_) || !prediction_at(view, pixel, s)) continue;
      for (std::size_t c = 0; c < s.view.size(); ++c) s.view[c] += s.pixel[c];
      ++pixels;
    }
  }
  if (pixels == 0) return;
  for (double& p : s.view) p /= pixels;
  s.votes.add(s.view);
}

void LabelFusion::fuse_pixel(int target, std::span<const int> others, std::int32_t column, std::int32_t row, Scratch& s,
                             FusedFrame& out) const {
  const FusionView& own = views_[static_cast<std::size_t>(target)];
  const std::size_t pixel = own.seen.pixel(column, row);
  const std::int16_t label = own.prediction->empty() ? kVoid : (*own.prediction)[pixel];
  map_of(out, FusionMethod::monocular)[pixel] = label;
  ++s.counts.pixels;
  if (label == kVoid) ++s.counts.unlabelled;
  const std::optional<Vec3d> point = surface_point(own.seen, column, row);
  if (!point) {
    ++s.counts.without_depth;
    map_of(out, FusionMethod::bayesian)[pixel] = map_of(out, FusionMethod::average)[pixel] = label;
    return;
  }
  s.votes.clear();
  if (own.prediction->soft.empty()) {
    if (label >= 0) s.votes.add(label);
  } else if (prediction_at(own, pixel, s)) {
    s.votes.add(s.pixel);
  }
  for (const int other : others) {
    const FusionView& view = views_[static_cast<std::size_t>(other)];
    if (const std::optional<PixelHit> hit = seen_at(view.seen, *point, params_)) add_prediction(view, *hit, s);
  }
  s.counts.votes += s.votes.views();
  if (label == kVoid && s.votes.views() > 0) ++s.counts.filled;
  map_of(out, FusionMethod::bayesian)[pixel] = s.votes.bayesian_label(label);
  map_of(out, FusionMethod::average)[pixel] = s.votes.average_label(label);
}

FusedFrame LabelFusion::fuse(int target) const {
  std::vector<int> others;
  for (int view = 0; view < static_cast<int>(views_.size()); ++view) {
    if (view != target && !views_[static_cast<std::size_t>(view)].prediction->empty()) others.push_back(view);
  }
  others = choose_views(seen_, target, std::move(others), params_);
  const Camera& camera = seen_[static_cast<std::size_t>(target)].camera;
  FusedFrame out = blank_frame(seen_[static_cast<std::size_t>(target)].depth_m.size());
  std::vector<FusionCounts> counts(static_cast<std::size_t>(camera.height_px));
  const auto classes = static_cast<std::size_t>(classes_);
  parallel_for(camera.height_px, [&](std::int64_t row) {
    Scratch scratch{ClassVotes(classes_, params_.floor, hard_),
                    std::vector<float>(classes),
                    std::vector<double>(classes),
                    std::vector<double>(classes),
                    {}};
    for (std::int32_t column = 0; column < camera.width_px; ++column)
      fuse_pixel(target, others, column, static_cast<std::int32_t>(row), scratch, out);
    counts[static_cast<std::size_t>(row)] = scratch.counts;
  });
  for (const FusionCounts& row : counts) out.counts.merge(row);
  return out;
}

namespace {
// Sums of the same terms in another order differ by less; predictions that differ by less count as equal.
constexpr double kTie = 1e-9;
}  // namespace

HardLikelihood::HardLikelihood(double confidence, int classes) : hit(confidence) {
  if (classes > 1) miss = (1 - confidence) / (classes - 1);
  if (classes > 1 && !(hit > miss)) {
    throw Error(ErrorKind::config, "config.value.range",
                fmt::format("fuse.hard_confidence: {} says nothing among {} classes, each has {:.3g}", confidence,
                            classes, miss),
                fmt::format("write more than {:.3g}", 1.0 / classes));
  }
}

ClassVotes::ClassVotes(int classes, double floor, HardLikelihood hard)
    : floor_(floor),
      hard_(hard),
      log_hit_less_miss_(std::log(std::max(hard.hit, floor)) - std::log(std::max(hard.miss, floor))),
      hit_less_miss_(hard.hit - hard.miss),
      log_sum_(static_cast<std::size_t>(classes)),
      sum_(static_cast<std::size_t>(classes)),
      label_views_(static_cast<std::size_t>(classes)) {}

void ClassVotes::clear() {
  std::fill(log_sum_.begin(), log_sum_.end(), 0.0);
  std::fill(sum_.begin(), sum_.end(), 0.0);
  std::fill(label_views_.begin(), label_views_.end(), 0);
  hard_views_ = views_ = 0;
}

void ClassVotes::add(std::span<const double> probability) {
  for (std::size_t c = 0; c < sum_.size(); ++c) {
    log_sum_[c] += std::log(std::max(probability[c], floor_));
    sum_[c] += probability[c];
  }
  ++views_;
}

void ClassVotes::add(std::int16_t label) {
  ++label_views_[static_cast<std::size_t>(label)];
  ++hard_views_;
  ++views_;
}

void ClassVotes::bayesian(std::span<double> out) const {
  std::fill(out.begin(), out.end(), 0.0);
  if (views_ == 0 || out.empty()) return;
  double most = log_sum(0);
  for (std::size_t c = 1; c < out.size(); ++c) most = std::max(most, log_sum(c));
  double total = 0;  // at least 1: the largest term is exp(0)
  for (std::size_t c = 0; c < out.size(); ++c) total += out[c] = std::exp(log_sum(c) - most);
  for (double& p : out) p /= total;
}

void ClassVotes::average(std::span<double> out) const {
  for (std::size_t c = 0; c < out.size(); ++c) out[c] = views_ == 0 ? 0 : sum(c) / views_;
}

template <class Score>
std::int16_t ClassVotes::best(std::int16_t preferred, double tie, Score&& score) const {
  if (views_ == 0 || sum_.empty()) return kVoid;
  double most = score(0);
  for (std::size_t c = 1; c < sum_.size(); ++c) most = std::max(most, score(c));
  if (preferred >= 0 && score(static_cast<std::size_t>(preferred)) >= most - tie) return preferred;
  for (std::size_t c = 0; c < sum_.size(); ++c) {
    if (score(c) >= most - tie) return static_cast<std::int16_t>(c);
  }
  return kVoid;
}

std::int16_t ClassVotes::bayesian_label(std::int16_t preferred) const {
  return best(preferred, kTie * views_, [this](std::size_t c) { return log_sum(c); });
}

std::int16_t ClassVotes::average_label(std::int16_t preferred) const {
  return best(preferred, kTie * views_, [this](std::size_t c) { return sum(c); });
}

namespace {

bool valid_depth(float z) { return z > 0 && std::isfinite(z); }

double median_depth(std::span<const float> depth_m) {
  std::vector<float> valid;
  for (const float z : depth_m) {
    if (valid_depth(z)) valid.push_back(z);
  }
  return valid.empty() ? 1 : median_of(std::move(valid));
}

}  // namespace

bool same_surface(const PosedDepth& view, std::size_t pixel, double z_m, const FusionParams& params) {
  const float z = view.depth_m[pixel];
  return valid_depth(z) && params.agree(z_m, z);
}

std::optional<PixelHit> seen_at(const PosedDepth& view, Vec3d point, const FusionParams& params) {
  const std::optional<PixelHit> hit = project_point(view.camera, view.world_from_camera, point);
  if (!hit || !same_surface(view, view.pixel(hit->column, hit->row), hit->z_m, params)) return std::nullopt;
  return hit;
}

std::vector<int> choose_views(std::span<const PosedDepth> views, int target, std::vector<int> others,
                              const FusionParams& params) {
  const auto wanted = static_cast<std::size_t>(params.views);
  if (wanted == 0 || wanted >= others.size()) return others;
  std::vector<int> chosen;
  if (params.choose == ViewChoice::even) {
    for (std::size_t k = 0; k < wanted; ++k) chosen.push_back(others[(2 * k + 1) * others.size() / (2 * wanted)]);
    return chosen;
  }
  const double reach = median_depth(views[static_cast<std::size_t>(target)].depth_m);
  const auto gaze = [&](const Pose& pose) { return pose.t + pose.axis(2) * reach; };
  const Pose& own = views[static_cast<std::size_t>(target)].world_from_camera;
  std::vector<std::pair<double, int>> by_distance;
  for (const int other : others) {
    const Pose& pose = views[static_cast<std::size_t>(other)].world_from_camera;
    by_distance.emplace_back(length(pose.t - own.t) + length(gaze(pose) - gaze(own)), other);
  }
  std::sort(by_distance.begin(), by_distance.end());
  for (std::size_t k = 0; k < wanted; ++k) chosen.push_back(by_distance[k].second);
  std::sort(chosen.begin(), chosen.end());
  return chosen;
}

namespace {

// Poses of one frame in two readings of a scene: text files round, so not bit for bit.
bool same_pose(const Pose& a, const Pose& b, double metre) {
  constexpr double kRotation = 1e-4, kShift = 1e-4;
  for (int i = 0; i < 3; ++i) {
    if (length(a.axis(i) - b.axis(i)) > kRotation) return false;
  }
  return length(a.t - b.t) <= kShift * (metre + length(a.t));
}

void check_frame(const FrameInfo& frame, const TrainedField& run) {
  const std::vector<FrameInfo>& known = run.session.scene.info.frames;
  const auto found =
      std::find_if(known.begin(), known.end(), [&](const FrameInfo& other) { return other.name == frame.name; });
  if (found == known.end()) {
    throw Error(ErrorKind::data, "fuse.depth.foreign",
                frame_place(frame) + ": the scene of " + run.run_dir + " has no frame of this name",
                "take depth from a run of this scene");
  }
  const double metre = usual_metre(run.session.scene.info.metric, run.session.extent.bounds.size());
  if (!same_pose(found->world_from_camera, frame.world_from_camera, metre)) {
    throw Error(ErrorKind::data, "fuse.depth.foreign",
                frame_place(frame) + ": the camera stands elsewhere in the scene of " + run.run_dir,
                "take depth from a run of this scene");
  }
}

bool same_classes(const ClassTable& a, const ClassTable& b) {
  const auto same = [](const ClassEntry& x, const ClassEntry& y) { return x.id == y.id && x.ignore == y.ignore; };
  return std::equal(a.entries().begin(), a.entries().end(), b.entries().begin(), b.entries().end(), same);
}

}  // namespace

FrameMaps true_depth(const LoadedScene& scene) {
  FrameMaps maps;
  bool any = false;
  for (const int f : scene.frames_of(Split::train)) {
    const StoredFrame& frame = scene.frames[static_cast<std::size_t>(f)];
    any = any || !frame.depth_m.empty();
    maps.frames.push_back(f);
    maps.depth_m.push_back(frame.depth_m.empty() ? std::vector<float>(frame.rgb.size() / 3) : frame.depth_m.expand());
  }
  if (!any) {
    throw Error(ErrorKind::data, "fuse.depth.none", "no training frame of the scene has depth",
                "train on the scene and take the depth of the run: --depth-from RUN");
  }
  maps.label.resize(maps.frames.size());
  return maps;
}

FrameMaps learned_depth(const TrainedField& run, const LoadedScene& scene, double min_opacity,
                        const std::function<void(int done)>& done) {
  const Session& s = run.session;
  const bool labels = s.pipeline->has_semantics() && same_classes(s.scene.info.classes, scene.info.classes);
  FrameMaps maps;
  maps.frames = scene.frames_of(Split::train);
  for (const int f : maps.frames) check_frame(scene.info.frames[static_cast<std::size_t>(f)], run);
  for (const int f : maps.frames) {
    const FrameInfo& info = scene.info.frames[static_cast<std::size_t>(f)];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    RenderedFrame frame = render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit);
    for (std::size_t i = 0; i < frame.depth_m.size(); ++i) {
      const float opacity = frame.opacity[i];
      frame.depth_m[i] = opacity >= static_cast<float>(min_opacity) ? frame.depth_m[i] / opacity : 0.0F;
    }
    maps.depth_m.push_back(std::move(frame.depth_m));
    maps.label.push_back(labels ? std::move(frame.label) : std::vector<std::int16_t>());
    if (done) done(static_cast<int>(maps.depth_m.size()));
  }
  return maps;
}

FusionParams settled(const FusionParams& params, const LoadedScene& scene) {
  FusionParams out = params;
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  if (params.tolerance == 0) out.tolerance = 0.01 * usual_metre(scene.info.metric, size);
  return out;
}

SceneFusion fuse_scene(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                       const FusionParams& given, const OnFused& on_fused) {
  const FusionParams params = settled(given, scene);
  const int classes = scene.info.classes.valid_count();
  std::vector<FusionView> views;
  for (std::size_t k = 0; k < maps.frames.size(); ++k) {
    const auto f = static_cast<std::size_t>(maps.frames[k]);
    const FrameInfo& info = scene.info.frames[f];
    views.push_back({{info.camera, info.world_from_camera, maps.depth_m[k]}, &labels.frames[f]});
  }
  const LabelFusion fusion(views, classes, params);
  const std::vector<FusionMethod> methods = fusion_methods(params.methods);
  SceneFusion out;
  for (const FusionMethod method : methods) out.scores.push_back({choice_name(method), ConfusionMatrix(classes), {}});
  const bool field =
      std::any_of(maps.label.begin(), maps.label.end(), [](const auto& label) { return !label.empty(); });
  if (field) out.scores.push_back({"field", ConfusionMatrix(classes), {}});
  for (std::size_t k = 0; k < maps.frames.size(); ++k) {
    const FusedFrame fused = fusion.fuse(static_cast<int>(k));
    out.counts.merge(fused.counts);
    const std::vector<std::int16_t> truth = scene.frames[static_cast<std::size_t>(maps.frames[k])].label.expand();
    for (std::size_t m = 0; m < out.scores.size(); ++m) {
      const std::vector<std::int16_t>& label =
          m < methods.size() ? fused.label[static_cast<std::size_t>(methods[m])] : maps.label[k];
      if (label.empty()) continue;
      if (!truth.empty()) out.scores[m].confusion.add(truth, label);
      if (on_fused) on_fused(out.scores[m].method, maps.frames[k], label);
    }
  }
  for (std::size_t m = 0; m < methods.size(); ++m)
    out.scores[m].views_mean = methods[m] == FusionMethod::monocular ? 1 : out.counts.views_mean();
  return out;
}

namespace {

constexpr double kLeastWeight = 1e-4;  // keeps the parts of a surface connected where colours or normals jump

// A pixel's label as votes for classes: one, or probabilities; void has none.
class LabelRow {
 public:
  explicit LabelRow(int classes) : row_(static_cast<std::size_t>(classes)) {}
  /// Empty for a pixel without a label. Valid until the next call.
  std::span<const float> of(const TrainingLabels::Frame& labels, std::size_t pixel) {
    if (labels.empty() || labels[pixel] == kVoid) return {};
    if (labels.soft.empty()) {
      std::fill(row_.begin(), row_.end(), 0.0F);
      row_[static_cast<std::size_t>(labels[pixel])] = 1;
    } else {
      labels.soft.row(pixel, row_);
    }
    return row_;
  }

 private:
  std::vector<float> row_;
};

// The frames of the maps with their cameras and labels.
struct Surface {
  const LoadedScene& scene;
  const TrainingLabels& labels;
  const FrameMaps& maps;
  int classes;

  std::size_t frames() const { return maps.frames.size(); }
  std::size_t frame(std::size_t k) const { return static_cast<std::size_t>(maps.frames[k]); }
  const TrainingLabels::Frame& given(std::size_t k) const { return labels.frames[frame(k)]; }
  PosedDepth view(std::size_t k) const {
    const FrameInfo& info = scene.info.frames[frame(k)];
    return {info.camera, info.world_from_camera, maps.depth_m[k]};
  }
};

// Sums of the votes of pixels by cell, [cells * classes], grown as cells are met.
struct CellVotes {
  std::vector<double> votes;
  void add(std::int32_t cell, std::span<const float> row) {
    const std::size_t begin = static_cast<std::size_t>(cell) * row.size();
    if (votes.size() < begin + row.size()) votes.resize(begin + row.size());
    for (std::size_t c = 0; c < row.size(); ++c) votes[begin + c] += static_cast<double>(row[c]);
  }
};

// Points of all pixels with depth, and the votes of their labels.
struct Pooled {
  SurfacePool pool;
  CellVotes votes;
};

// Cells are numbered, and sums added, in the order of frames and pixels: the same bits for any number of threads.
Pooled pooled(const Surface& surface, double edge_m) {
  Pooled out{SurfacePool(edge_m, surface.frames()), {}};
  LabelRow label(surface.classes);
  for (std::size_t k = 0; k < surface.frames(); ++k) {
    const PosedDepth view = surface.view(k);
    out.pool.add(k, seen_surface(surface_points(view), view.camera.width_px, view.world_from_camera.t),
                 surface.scene.frames[surface.frame(k)], 1);
    const std::vector<std::int32_t>& of_pixel = out.pool.point_of_pixel[k];
    for (std::size_t p = 0; p < of_pixel.size(); ++p) {
      if (of_pixel[p] < 0) continue;
      if (const auto row = label.of(surface.given(k), p); !row.empty()) out.votes.add(of_pixel[p], row);
    }
  }
  out.pool.finish();
  out.votes.votes.resize(out.pool.points.size() * static_cast<std::size_t>(surface.classes));
  return out;
}

std::vector<GraphEdge> edges_of(const SurfacePool& pool, const PropagationParams& params) {
  const std::vector<CellPair> pairs = pool.cells.neighbours();
  std::vector<GraphEdge> edges(pairs.size());
  parallel_for(std::ssize(edges), [&](std::int64_t i) {
    const CellPair& pair = pairs[static_cast<std::size_t>(i)];
    const PointDifference apart =
        difference(pool.points[static_cast<std::size_t>(pair.a)], pool.points[static_cast<std::size_t>(pair.b)],
                   params.color_sigma, params.normal_sigma);
    edges[static_cast<std::size_t>(i)] = {pair.a, pair.b,
                                          std::max(kLeastWeight, std::exp(-apart.color - apart.normal))};
  });
  return edges;
}

// Writes the rows of one frame: `row_of(pixel)` is the new distribution, or empty for a pixel without one, which keeps
// its label when it has no depth.
template <class RowOf>
TrainingLabels::Frame soft_frame(const Surface& surface, std::size_t k, double min_confidence, const RowOf& row_of) {
  const std::size_t pixels = surface.maps.depth_m[k].size();
  TrainingLabels::Frame out;
  out.soft = SoftMap(pixels, surface.classes);
  LabelRow label(surface.classes);
  for (std::size_t p = 0; p < pixels; ++p) {
    const std::span<const float> row = row_of(p, label);
    if (row.empty() || *std::max_element(row.begin(), row.end()) < static_cast<float>(min_confidence)) continue;
    out.soft.set_row(p, row);
  }
  return out;
}

std::int64_t pixels_without_depth(const Surface& surface) {
  std::int64_t out = 0;
  for (const std::vector<float>& depth : surface.maps.depth_m)
    out += std::count_if(depth.begin(), depth.end(), [](float z) { return !(z > 0 && std::isfinite(z)); });
  return out;
}

void require_labels_and_depth(const Surface& surface) {
  bool label = false, depth = false;
  for (std::size_t k = 0; k < surface.frames(); ++k) {
    const std::vector<std::int64_t>& counts = surface.labels.class_pixels[surface.frame(k)];
    label = label || (!counts.empty() && std::any_of(counts.begin(), counts.end() - 1, [](auto n) { return n > 0; }));
    const std::vector<float>& z = surface.maps.depth_m[k];
    depth = depth || std::any_of(z.begin(), z.end(), [](float v) { return v > 0 && std::isfinite(v); });
  }
  if (!label) {
    throw Error(ErrorKind::data, "labels.training.none",
                "no training pixel carries a label, so there is nothing to spread",
                "see scene.labels.frames, and `semfield inspect`");
  }
  if (!depth) {
    throw Error(ErrorKind::data, "fuse.depth.none",
                "no training pixel has depth: its rays meet no surface that is dense enough",
                "train the run longer, or lower propagate.min_opacity");
  }
}

void add_step(TrainingLabels& out, const Surface& surface, const char* method, StepFacts facts) {
  facts.emplace_back("pixels without depth", std::to_string(pixels_without_depth(surface)));
  out.steps.push_back({std::string("propagate ") + method, std::move(facts)});
}

void spread_over_surface(const Surface& surface, const PropagationParams& params, const PropagationProgress& done,
                         TrainingLabels& out) {
  const double edge_m = params.cell_m > 0 ? params.cell_m : default_cell_m(surface.scene);
  if (!(edge_m > 0)) {
    throw Error(ErrorKind::config, "fuse.cell.unknown",
                "the scene has no size from which a cell's edge could be chosen", "set propagate.cell_m");
  }
  const Pooled cells = pooled(surface, edge_m);
  const Diffusion spread =
      diffuse_votes(edges_of(cells.pool, params), cells.votes.votes, surface.classes, params.vote_weight, done);
  const auto width = static_cast<std::size_t>(surface.classes);
  parallel_for(std::ssize(surface.maps.frames), [&](std::int64_t index) {
    const auto k = static_cast<std::size_t>(index);
    const auto row_of = [&](std::size_t p, LabelRow& label) -> std::span<const float> {
      const std::int32_t cell = cells.pool.point_of_pixel[k][p];
      if (cell < 0) return label.of(surface.given(k), p);
      return std::span(spread.probability).subspan(static_cast<std::size_t>(cell) * width, width);
    };
    out.frames[surface.frame(k)] = soft_frame(surface, k, params.min_confidence, row_of);
  });
  std::int64_t voted = 0;
  for (std::size_t c = 0; c < cells.pool.points.size(); ++c) {
    const auto row = std::span(cells.votes.votes).subspan(c * width, width);
    voted += std::any_of(row.begin(), row.end(), [](double v) { return v > 0; }) ? 1 : 0;
  }
  add_step(out, surface, "surface",
           {{surface.scene.info.metric ? "edge of a cell, m" : "edge of a cell, units", fmt::format("{:.4g}", edge_m)},
            {"cells", std::to_string(cells.pool.points.size())},
            {"cells with votes", std::to_string(voted)},
            {"connected parts", std::to_string(spread.parts)},
            {"parts without a vote", std::to_string(spread.parts_without_vote)}});
}

// Votes of the labelled pixels in cells of one size, and the cell of each of them.
struct Pool {
  explicit Pool(double edge_m) : grid(edge_m) {}
  SurfaceCells grid;
  CellVotes votes;
  std::vector<std::vector<std::int32_t>> of_pixel;  // [frames][H * W]; empty: the frame has no labels
};

Pool pool_votes(const Surface& surface, double edge_m) {
  Pool pool(edge_m);
  LabelRow label(surface.classes);
  for (std::size_t k = 0; k < surface.frames(); ++k) {
    std::vector<std::int32_t>& of_pixel = pool.of_pixel.emplace_back();
    if (surface.given(k).empty()) continue;
    const std::vector<Vec3d> points = surface_points(surface.view(k));
    of_pixel.assign(points.size(), -1);
    for (std::size_t p = 0; p < points.size(); ++p) {
      const auto row = label.of(surface.given(k), p);
      if (row.empty() || (of_pixel[p] = pool.grid.add(points[p])) < 0) continue;
      pool.votes.add(of_pixel[p], row);
    }
  }
  return pool;
}

std::vector<double> vote_edges(const LoadedScene& scene, const PropagationParams& params) {
  std::vector<double> edges = params.vote_cells_m;
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  if (edges.empty())
    for (const double edge : {0.06, 0.12, 0.2}) edges.push_back(edge * usual_metre(scene.info.metric, size));
  return edges;
}

void pool_in_cells(const Surface& surface, const PropagationParams& params, const PropagationProgress& done,
                   TrainingLabels& out) {
  const auto width = static_cast<std::size_t>(surface.classes);
  StepFacts facts;
  std::vector<std::vector<char>> settled(surface.frames());
  for (std::size_t k = 0; k < surface.frames(); ++k) {
    settled[k].resize(surface.maps.depth_m[k].size());
    if (surface.given(k).empty()) continue;
    // What no cell holds keeps its label.
    out.frames[surface.frame(k)] = soft_frame(surface, k, params.min_confidence, [&](std::size_t p, LabelRow& label) {
      return label.of(surface.given(k), p);
    });
  }
  const std::vector<double> edges = vote_edges(surface.scene, params);
  for (std::size_t size = 0; size < edges.size(); ++size) {
    const bool last = size + 1 == edges.size();
    const Pool pool = pool_votes(surface, edges[size]);
    std::vector<std::int64_t> taken(surface.frames());
    parallel_for(std::ssize(taken), [&](std::int64_t index) {
      const auto k = static_cast<std::size_t>(index);
      SoftMap& soft = out.frames[surface.frame(k)].soft;
      std::vector<float> share(width);
      for (std::size_t p = 0; p < pool.of_pixel[k].size(); ++p) {
        const std::int32_t cell = pool.of_pixel[k][p];
        if (cell < 0 || settled[k][p] != 0) continue;
        const auto votes = std::span(pool.votes.votes).subspan(static_cast<std::size_t>(cell) * width, width);
        double sum = 0;
        for (const double vote : votes) sum += vote;
        if (!last && sum < params.least_votes) continue;
        for (std::size_t c = 0; c < width; ++c) share[c] = static_cast<float>(votes[c] / sum);
        if (*std::max_element(share.begin(), share.end()) < static_cast<float>(params.min_confidence))
          std::fill(share.begin(), share.end(), 0.0F);
        soft.set_row(p, share);
        settled[k][p] = 1;
        ++taken[k];
      }
    });
    std::int64_t pixels = 0;
    for (const std::int64_t n : taken) pixels += n;
    facts.emplace_back(
        fmt::format("pixels by cells of {:.4g} {}", edges[size], surface.scene.info.metric ? "m" : "units"),
        std::to_string(pixels));
    if (done) done(static_cast<int>(size) + 1, static_cast<int>(edges.size()));
  }
  add_step(out, surface, "vote", std::move(facts));
}

}  // namespace

double default_cell_m(const LoadedScene& scene) {
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  const double least = std::max({size.x, size.y, size.z}) / 500, edge = std::max(3 * scene.pixel_footprint_m, least);
  return std::isfinite(edge) ? edge : 0;
}

TrainingLabels propagate_labels(const LoadedScene& scene, const TrainingLabels& labels, const FrameMaps& maps,
                                const PropagationParams& params, const PropagationProgress& done) {
  const Surface surface{scene, labels, maps, scene.info.classes.valid_count()};
  require_labels_and_depth(surface);
  TrainingLabels out;
  out.frames.resize(labels.frames.size());
  out.soft = true;
  out.steps = labels.steps;
  if (params.method == PropagationMethod::surface) {
    spread_over_surface(surface, params, done, out);
  } else {
    pool_in_cells(surface, params, done, out);
  }
  return out;
}

}  // namespace semfield
