#include "surface/fuse/propagation.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "core/small_math.h"
#include "surface/surface_graph.h"

namespace semfield {

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
