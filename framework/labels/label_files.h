// What readers of label files share: frames by the names of files, places in patterns, and a bounded list of problems.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "config/params.h"
#include "core/error.h"
#include "core/non_copyable.h"
#include "scene/classes/class_table.h"
#include "scene/loading/frame_source.h"

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

/// File name without folder and extension; '\' counts as a slash, as in files from Windows.
std::string file_stem(std::string_view path);

/// The frame with a camera of the size of its picture as viewers show it; the other way round too.
FrameInfo as_shown(FrameInfo frame);

/// "{name}" and "{stem}" are the frame's name and the stem of its source, "{number}" the digits at the end of its name,
/// with or without zeros before them. Reports any other place in braces, and a pattern without one.
void check_pattern(const std::string& pattern, Diagnostics& diagnostics);
/// Path of the frame's file, or "" for a frame whose name ends in no digit where the pattern asks for a number.
std::string path_of(const std::string& folder, const std::string& pattern, const FrameInfo& frame);
bool has_file(const std::string& folder, const std::string& pattern, const FrameInfo& frame);

/// Throws Error(data) for labels of another shape than the frame's image (half a pixel of rounding an axis is allowed),
/// or of over 64 times its width, the most that frames are made smaller by: labels of another image. Readers call it
/// with the size that a file states before they make a raster of that size.
void check_label_shape(std::int64_t width, std::int64_t height, const Camera& frame);

/// Whether the folder of the file has a cameras.json, as maps that `semfield render` wrote: they are of the cameras'
/// pixels, which are those of images as stored.
bool folder_has_cameras(const std::string& path);

/// Reports a folder that is not named or is none; true when it is one.
bool check_folder(const std::string& folder, Diagnostics& diagnostics);
/// The same, and reports a folder in which no file can belong to the pattern, with a name that is there.
bool check_folder(const std::string& folder, const std::string& pattern, Diagnostics& diagnostics);

/// Passes problems on to `diagnostics`, the first 20 of them; the rest are counted in one line at the end.
class ProblemList : NonCopyable {
 public:
  explicit ProblemList(Diagnostics& diagnostics) : diagnostics_(diagnostics) {}
  ~ProblemList();

  void error(Code code, const std::string& where, const std::string& message, const std::string& remedy);
  /// Runs `body`; an Error that it throws becomes a problem.
  void collect(const std::function<void()>& body);
  int count() const { return count_; }

 private:
  Diagnostics& diagnostics_;
  int count_ = 0;
};

/// The table for names found in files, each with the place where it stood first: names that `known` lacks are problems;
/// without a known table one is built from the names in sorted order.
ClassTable table_for(const std::map<std::string, std::string>& place_of_name, const ClassTable& known,
                     ProblemList& problems);

// Which training frames keep their labels; colour of all frames is always used.

enum class LabelMode { even, random, named, coverage };
SEMFIELD_CHOICES(LabelMode, "even", "random", "named", "coverage");

struct LabelParams {
  std::string frames = "all";
  LabelMode mode = LabelMode::even;
  std::int64_t seed = 1;
  std::vector<std::string> names;
  std::string clicks;  ///< label events (labels/clicks) painted over the labels; see LabelConfig::click_file
  int class_room = 0;
};
void describe(ParamVisitor& visit, LabelParams& params);
void validate(const LabelParams& params, Diagnostics& diagnostics);

/// How many of `available` labelled frames "all", "none", "10%" or "12" keeps: a share is rounded to the nearest whole
/// number, at least 1 where the share is above 0. Throws Error(config) for any other text, a share above 100 % and a
/// number above `available`.
int label_frame_count(const std::string& frames, int available);

/// Indices into info.frames, ascending, of the training frames whose labels train: N key-frames at ranks floor(k * n /
/// N) (`even`), N drawn without replacement from the address (seed, "labels/selection") (`random`), or the frames of
/// the given names (`named`), or one by one the frame that shows most classes not yet seen (`coverage`; of equals the
/// one with most labelled pixels, then the first), as an annotator would choose key-frames. Only frames with labels
/// count. `class_pixels` [frames][C + 1] as in LoadedScene, for `coverage` alone. Throws Error(config) naming a frame
/// that is missing, is no training frame or has no labels.
std::vector<int> select_label_frames(const SceneInfo& info, const LabelParams& params,
                                     const std::vector<std::vector<std::int64_t>>& class_pixels = {});

}  // namespace semfield
