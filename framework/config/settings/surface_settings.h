// The sections `fuse`, `objects`, `objects.damage` and `propagate`, declared where sections are read.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "config/params.h"
#include "core/error.h"

namespace semfield {

enum class FusionMethod : std::uint8_t { monocular, bayesian, average };
SEMFIELD_CHOICES(FusionMethod, "monocular", "bayesian", "average");

enum class FusionDepth : std::uint8_t { truth, learned };
SEMFIELD_CHOICES(FusionDepth, "true", "learned");

enum class ViewChoice : std::uint8_t { nearest, even };
SEMFIELD_CHOICES(ViewChoice, "nearest", "even");

struct FusionParams {
  std::vector<std::string> methods{"monocular", "bayesian", "average"};
  FusionDepth depth = FusionDepth::truth;
  double min_opacity = 0.5;
  double tolerance = 0;
  double relative_tolerance = 0;
  double floor = 1e-4;
  int views = 0;
  ViewChoice choose = ViewChoice::nearest;
  int neighbourhood = 1;
  double hard_confidence = 0.7;

  /// Depths `a` and `b` belong to one surface: |a - b| <= tolerance + relative_tolerance * a.
  bool agree(double a, double b) const { return std::abs(a - b) <= tolerance + relative_tolerance * a; }
};

inline void describe(ParamVisitor& visit, FusionParams& p) {
  SEMFIELD_PARAM(visit, p, methods, "what is computed: monocular (a view's own prediction), bayesian, average");
  SEMFIELD_PARAM(visit, p, depth,
                 "depth that locates a point in other views: the scene's own, or that of a run's field");
  SEMFIELD_PARAM(visit, p, min_opacity, "learned depth: opacity of a rendered pixel below which it has no depth",
                 {0.01, 1});
  SEMFIELD_PARAM(visit, p, tolerance,
                 "length by which the depth of a point and of a view may differ; beyond it the point is hidden; 0: "
                 "1 cm, or 1/500 of the longest side without a metric scale",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, relative_tolerance, "share of the point's depth that is added to tolerance", {0, 1});
  SEMFIELD_PARAM(visit, p, floor, "bayesian: least probability of a class in one view", {1e-12, 0.5});
  SEMFIELD_PARAM(visit, p, views, "other views used for each frame; 0: all", {0, 1e6});
  SEMFIELD_PARAM(visit, p, choose,
                 "which views are used when `views` is not 0: those of the nearest cameras, or evenly spaced frames");
  SEMFIELD_PARAM(
      visit, p, neighbourhood,
      "side of the window of pixels whose predictions are averaged in another view; odd; 1: the nearest pixel",
      {1, 15});
  SEMFIELD_PARAM(visit, p, hard_confidence,
                 "probability of the label in a prediction without probabilities; other classes share the rest",
                 {1e-3, 1});
}

/// Methods by name, each once, in the order given. Throws Error(config) naming one that does not exist.
inline std::vector<FusionMethod> fusion_methods(const std::vector<std::string>& names) {
  constexpr auto& known = ChoiceNames<FusionMethod>::names;
  std::vector<FusionMethod> out;
  for (const std::string& name : names) {
    const auto found = std::find(known.begin(), known.end(), name);
    if (found == known.end()) {
      const std::vector<std::string> all(known.begin(), known.end());
      throw Error(ErrorKind::config, "config.value.choice", "fuse.methods: there is no method '" + name + "'",
                  near_name_remedy(name, all, "known: " + join(all)));
    }
    const auto method = static_cast<FusionMethod>(found - known.begin());
    if (std::find(out.begin(), out.end(), method) == out.end()) out.push_back(method);
  }
  return out;
}

inline void validate(const FusionParams& p, Diagnostics& diagnostics) {
  if (p.neighbourhood % 2 == 0) {
    diagnostics.error("config.value.range", "fuse.neighbourhood",
                      "a window of " + std::to_string(p.neighbourhood) + " pixels has no centre",
                      "write an odd number");
  }
  if (p.methods.empty())
    diagnostics.error("config.value.missing", "fuse.methods", "no method is named", "write for example [bayesian]");
  noting(diagnostics, "", [&] { (void)fusion_methods(p.methods); });
}

// How segments of images become objects (objects/).

struct ObjectsParams {
  std::int64_t steps = 1500;
  std::int64_t views = 8;
  std::int64_t view_points = 256;
  double learning_rate = 1e-2;
  std::int64_t frequencies = 9;
  std::int64_t hidden_width = 64;
  std::int64_t hidden_layers = 2;
  std::int64_t rays = 3'000'000;
  std::int64_t points = 400'000;
  double reach = 0.25;
  std::int64_t neighbours = 4;
  double agree = 0.5;
  std::int64_t least_views = 1;
  std::int64_t least_points = 20;
  std::vector<std::string> stuff{"wall", "floor", "ceiling"};
  std::uint32_t seed = 1;
};

inline void describe(ParamVisitor& visit, ObjectsParams& p) {
  SEMFIELD_PARAM(visit, p, steps, "steps of learning on points of the surface", {1, 1e6});
  SEMFIELD_PARAM(visit, p, views, "views of a step", {1, 256});
  SEMFIELD_PARAM(visit, p, view_points, "points of each view of a step", {4, 65536});
  SEMFIELD_PARAM(visit, p, learning_rate, "at the first step; it falls to a hundredth along half a cosine", {1e-6, 1});
  SEMFIELD_PARAM(visit, p, frequencies,
                 "octaves of sines of a position that the network reads, the lowest as long as the scene", {0, 16});
  SEMFIELD_PARAM(visit, p, hidden_width, "units of a hidden layer", {4, 512});
  SEMFIELD_PARAM(visit, p, hidden_layers, "hidden layers of the network", {1, 8});
  SEMFIELD_PARAM(visit, p, rays, "rays, over all training views, that find the surface", {1000, 1e9});
  SEMFIELD_PARAM(visit, p, points, "about how many points represent the surface; cells are sized for it", {100, 1e7});
  SEMFIELD_PARAM(visit, p, reach, "distance within which segments are of one object, in the units of the method",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, neighbours, "segments within reach that make a segment part of a cluster's core", {1, 1e6});
  SEMFIELD_PARAM(visit, p, agree,
                 "two groups of points are one object if at least this share of the views has them in one segment",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, least_views, "views that must see two groups before their segments decide", {1, 1e6});
  SEMFIELD_PARAM(visit, p, least_points, "fewest points of an object; smaller ones are dropped", {1, 1e9});
  SEMFIELD_PARAM(visit, p, stuff, "names of classes that have no objects");
  SEMFIELD_PARAM(visit, p, seed, "seed of every random value of this phase");
}

/// Shares from 0 to 1; all of it happens in each image for itself.
struct SegmentDamage {
  bool shuffle = false;        ///< segments get new numbers in random order
  double split = 0;            ///< segments cut in two along a random line through their middle
  double merge = 0;            ///< segments joined with a random neighbour
  double missing = 0;          ///< segments that are not there
  std::int64_t border_px = 0;  ///< borders are moved by up to so many pixels, in patches

  bool any() const { return shuffle || split > 0 || merge > 0 || missing > 0 || border_px > 0; }
};

inline void describe(ParamVisitor& visit, SegmentDamage& p) {
  SEMFIELD_PARAM(visit, p, shuffle, "segments of an image get new numbers in random order");
  SEMFIELD_PARAM(visit, p, split, "share of an image's segments that a random line cuts in two", {0, 1});
  SEMFIELD_PARAM(visit, p, merge, "share of an image's segments that are joined with a random neighbour", {0, 1});
  SEMFIELD_PARAM(visit, p, missing, "share of an image's segments that are left out", {0, 1});
  SEMFIELD_PARAM(visit, p, border_px, "borders of segments move by up to so many pixels, in patches of 16", {0, 64});
}

// How labels spread over a learned surface (surface/fuse/).

enum class PropagationMethod : std::uint8_t { surface, vote };
SEMFIELD_CHOICES(PropagationMethod, "surface", "vote");

struct PropagationParams {
  PropagationMethod method = PropagationMethod::surface;
  double min_opacity = 0.5;
  double cell_m = 0;
  double color_sigma = 0.04;
  double normal_sigma = 0.25;
  double vote_weight = 1;
  double min_confidence = 0;
  std::vector<double> vote_cells_m;
  double least_votes = 8;
};

inline void describe(ParamVisitor& visit, PropagationParams& p) {
  SEMFIELD_PARAM(visit, p, method, "surface: diffusion over neighbouring cells; vote: labels pooled within a cell");
  SEMFIELD_PARAM(visit, p, min_opacity, "opacity of a rendered pixel below which it has no depth", {0.01, 1});
  SEMFIELD_PARAM(visit, p, cell_m,
                 "surface: edge of a cell, m; 0: three pixels at the scene's middle depth, at least 1/500 of its "
                 "longest side; the verb prints it",
                 {0, 1e12});
  SEMFIELD_PARAM(visit, p, color_sigma, "surface: difference of colour (0 to 1) at which a weight falls to exp(-1/2)",
                 {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, normal_sigma,
                 "surface: distance between unit normals (0 to 2) at which a weight falls to exp(-1/2)", {1e-3, 1e3});
  SEMFIELD_PARAM(visit, p, vote_weight,
                 "surface: how strongly one labelled pixel holds its cell, where an edge between equal cells is 1",
                 {1e-6, 1e6});
  SEMFIELD_PARAM(visit, p, min_confidence, "pixels whose most probable class is less probable than this stay void",
                 {0, 1});
  SEMFIELD_PARAM(visit, p, vote_cells_m,
                 "vote: edges of cells, ascending; the first with enough votes counts; []: 0.06, 0.12 and 0.2 m, or "
                 "1.2 %, 2.4 % and 4 % of the longest side without a metric scale",
                 {1e-12, 1e12});
  SEMFIELD_PARAM(visit, p, least_votes, "vote: how many votes are enough; the largest cell takes what there is",
                 {1, 1e9});
}

inline void validate(const PropagationParams& p, Diagnostics& diagnostics) {
  if (!std::is_sorted(p.vote_cells_m.begin(), p.vote_cells_m.end(), std::less_equal<>())) {
    diagnostics.error("config.value.order", "propagate.vote_cells_m", "the edges do not ascend",
                      "write the smallest first, each once");
  }
}

}  // namespace semfield
