// A sweep as written: experiments, each a grid of differences over a base configuration, on scenes, with seeds.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "config/compose.h"

namespace semfield {

/// Fusing the training labels over views instead of training a field.
struct FuseCell {
  std::string method;  ///< monocular, bayesian or average
  std::string field;   ///< variant whose field gives the depth; empty: the scene's true depth
};

/// Metrics of the labels that trained, as in metrics.jsonl.
inline constexpr std::string_view kGivenPrefix = "given_";
/// Other metrics of training frames, in experiments that score held-out ones.
inline constexpr std::string_view kTrainingPrefix = "training_";

/// A row of an experiment's table.
struct SweepVariant {
  std::string name;
  std::string base;  ///< replaces the scene's configuration file; empty: it does not
  std::vector<ConfigOverride> set;
  std::optional<double> x;      ///< abscissa of the experiment's plot
  std::optional<double> paper;  ///< figure to print beside, of the experiment's paper metric
  std::optional<FuseCell> fuse;
  std::string objects;  ///< variant in whose run objects are found instead of training; empty: this one trains

  bool trains() const { return !fuse && objects.empty(); }
};

struct SweepScene {
  std::string name;
  std::string base;                   ///< configuration file, absolute
  std::vector<ConfigOverride> set;    ///< before the variant's
  std::vector<ConfigOverride> after;  ///< after them: what a variant's step needs to know of this scene
  bool pack = false;  ///< cells read the scene from one packed file, made once: where opening it costs time
};

struct Experiment {
  std::string name, title, note;
  std::string split = "test";        ///< whose frames are scored: test or train
  std::vector<std::string> metrics;  ///< of the table, the first one is plotted
  std::string paper;                 ///< where the paper's figures come from: "Tab. 2, mIoU"
  std::string x_label;
  std::vector<SweepScene> scenes;
  std::vector<ConfigOverride> set;  ///< for every variant
  std::vector<SweepVariant> variants;
  std::vector<std::int64_t> seeds;

  /// Whether a metric is of training frames beside held-out ones: `training_...`, `given_...`.
  bool wants_training_frames() const;
};

struct Sweep {
  std::string name;
  std::vector<Experiment> experiments;
};

/// Reads a sweep file (docs/guide/sweeps.md), or one with a list `sweeps:` of such files whose other keys are merged
/// over each. Throws Error(config) with every error on its own line.
Sweep read_sweep(const std::string& path);

}  // namespace semfield
