// Interfaces of label readers and degradations, the plugins that `scene.labels.from` and `scene.labels.degrade` name.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "loading/frame_source.h"
#include "scene/classes/soft_map.h"

namespace semfield {

/// Labels of one frame, row-major, at the size of the loaded frame: either hard or soft is set, or neither.
struct FrameLabels {
  std::vector<std::int16_t> hard;  ///< [H * W] internal class index, kVoid = void
  SoftMap soft;                    ///< [H * W, C]
  bool empty() const { return hard.empty() && soft.empty(); }
};

/// Training labels of a scene: one entry per frame of SceneInfo; empty for test frames and unlabelled ones.
using LabelSet = std::vector<FrameLabels>;

/// Facts of a step for the manifest, in the order of writing: ("pixels changed", "12345").
using StepFacts = std::vector<std::pair<std::string, std::string>>;

/// What both kinds are: an object that holds its own parameters, so it needs no parameter struct beside it. A copy of
/// an object that nobody has used is what Registry::add_label_reader and add_degradation make.
class LabelStep {
 public:
  virtual ~LabelStep() = default;
  virtual void describe(ParamVisitor& visit) = 0;
  virtual void validate(Diagnostics&) const {}
};

/// A seeded change of training labels [Zhi21, section 4]. Randomness is addressed by (seed, frame's index in SceneInfo
/// or instance, stream "labels/..."), so a frame's result depends neither on other frames nor on threads.
class Degradation : public LabelStep {
 public:
  /// True: scene.frames[i].instance is filled in for apply().
  virtual bool needs_instances() const { return false; }
  /// True: scene.frames[i].depth_m of training frames is kept for apply(), where the scene has depth.
  virtual bool wants_depth() const { return false; }
  /// Changes `labels`; `scene` gives sizes, instances, depth (training frames: when kept) and the class table. Throws
  /// Error(data), naming the frame, for labels it cannot work on (soft ones, no instances).
  virtual StepFacts apply(const LoadedScene& scene, std::uint64_t seed, LabelSet& labels) const = 0;
};

/// Labels of a frame as a file holds them, at the file's own size.
struct LabelRaster {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::int16_t> hard;  ///< [H * W] internal class index, kVoid = void; or empty
  std::vector<float> soft;         ///< [H * W * C] probabilities; or empty
  bool as_stored = false;          ///< of the pixels as the image file stores them, not of the picture as it is shown
};

/// Label files beside a scene: polygons, palettes, predictions.
class LabelReader : public LabelStep {
 public:
  /// Opens what there is to open, reports every problem (file, line or entry, cause, remedy) and returns the class
  /// table that the files bring, empty without one. `known` is the table of the scene, which wins where both exist;
  /// paths in the parameters are absolute.
  virtual ClassTable open(const ClassTable& known, Diagnostics& diagnostics) = 0;
  /// Called once after open() without errors, before has() and read(): the frames of the scene, for readers that find
  /// out which of their labels are whose (labels/frame_match.h) and report those of none.
  virtual void match(const std::vector<FrameInfo>& /*frames*/, Diagnostics& /*diagnostics*/) {}
  /// True: the table that open() returns is `known` with classes behind its own, and takes its place.
  virtual bool adds_classes() const { return false; }
  /// Whether the frame has labels here; frames are told apart by FrameInfo::name.
  virtual bool has(const FrameInfo& frame) const = 0;
  /// Thread-safe. The frame's camera has the size of the picture as viewers show it, which labels are drawn over.
  /// `classes` is the table that holds for the run; names or ids that it lacks throw Error(data) naming
  /// file, place and remedy.
  virtual LabelRaster read(const FrameInfo& frame, const ClassTable& classes) const = 0;
};

/// Throws Error(data): "<place>: <message>".
[[noreturn]] inline void refuse_labels(Code code, const std::string& place, const std::string& message,
                                       const std::string& remedy = {}) {
  throw Error(ErrorKind::data, code, place + ": " + message, remedy);
}

}  // namespace semfield
