// A scene in memory: every frame decoded, at the size asked for, with bounds, near and far.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "core/workspace.h"
#include "scene/camera_rig.h"
#include "scene/scene.h"
#include "scene/survey/geometry_survey.h"

namespace semfield {

/// Whose depth a loaded scene keeps; bounds and distances are derived from all of it in any case.
enum class DepthKept : std::uint8_t { all, test, none };

/// How frames come into memory; the keys stand in the `scene` section beside the dataset's own.
struct SceneLoadOptions {
  std::int32_t width_px = 0;
  std::int32_t height_px = 0;
  double downscale = 1;
  double near_m = 0;
  double far_m = 0;
  std::vector<double> bounds;
  PoseConvention convention;
  bool check_geometry = true;
  std::int64_t probe_steps = 128;
  std::int32_t hold_out = 0;          ///< every N-th training frame is a test frame, and the scene's own are unused
  DepthKept depth = DepthKept::all;   ///< not a key
  bool with_instances = false;        ///< not a key
  std::vector<std::string> channels;  ///< not a key: further channels of training frames that are wanted, by name
  /// Not a key: told what all frames will take in memory before the first is read; may throw.
  std::function<void(std::size_t bytes, std::size_t frames)> before_pixels = {};
  /// Not a key: space outside the bounds is contracted (rendering.outside), so that they are those of the subject and
  /// far lies beyond all that could be told from infinity.
  bool contracted = false;
  bool exposure = false;  ///< not a key: with check_geometry, brightness of overlapping frames is compared
  bool pixels = true;     ///< not a key; false: cameras and classes only, bounds and distances as given here
};
void describe(ParamVisitor& visit, SceneLoadOptions& options);
void validate(const SceneLoadOptions& options, Diagnostics& diagnostics);

/// What training and rendering start from.
struct LoadedScene {
  SceneInfo info;                   ///< cameras at the loaded size; has_depth as in the data, kept or not
  std::vector<StoredFrame> frames;  ///< as info.frames; empty where a frame could not be read
  Box bounds;                       ///< never empty after a load without errors
  double near_m = 0, far_m = 0;     ///< along the ray
  double unit_m = 1;                ///< rendering.unit_m, unless it is given
  double pixel_footprint_m = 0;     ///< world size of one pixel at the scene's middle depth (training frames)
  /// Corners of photographs without depth, where the poses put them: world points that tell where the scene is.
  SurveyPoints corners;
  std::string geometry;                    ///< what the check of poses against pixels found; empty = not asked
  CameraCheck cameras;                     ///< whether they fit the photographs, where that was asked for
  bool depth_beside = false;               ///< edges of depth lie beside those of the photographs
  std::optional<double> exposure;          ///< as GeometryVerdict
  std::string bounds_from, near_far_from;  ///< one phrase each: "depth of 35 training frames", "the configuration", ...
  CameraRig rig;                           ///< of the training cameras
  /// Of scenes whose extent no depth and no dataset tells, where the frames show an object before one colour.
  std::optional<PlainBackground> plain_background;
  bool extent_is_guessed = false;  ///< bounds and far are the view cones' and a multiple of the cameras' walk
  /// Pixels of each class in each frame: [frames][C + 1], the last entry is void; empty for a frame without labels.
  std::vector<std::vector<std::int64_t>> class_pixels;
  /// Pixels of each frame with a valid depth: [frames]; counted of all frames, whosever depth is kept.
  std::vector<std::int64_t> depth_pixels;

  /// Cameras or depth do not fit the photographs, and `prepare` can fix them.
  bool cameras_are_off() const { return cameras.off || depth_beside; }
  std::vector<int> frames_of(Split split) const;
};

/// The two calls of a dataset that loading needs, for tests' own classes too.
struct SceneReader {
  std::function<SceneInfo(Diagnostics&)> open;
  std::function<void(int, FrameBuffer&)> read;  ///< thread-safe
};

/// Opens the dataset, reads all frames in parallel (one decoded frame a thread in memory beside the result), scales
/// them - colour and alpha by area, labels, depth and instances by the nearest pixel, camera by Camera::resized; a
/// pixel that any masked one falls into is masked, and so is one without a ray - hides what is masked, counts their
/// classes, surveys their depth and packs them, all in the same turn. Every problem of every frame goes into
/// `diagnostics`; the caller decides with throw_if_errors. Throws what open() throws. The result is the same for any
/// number of threads.
LoadedScene load_scene(const SceneReader& reader, const SceneLoadOptions& options, Diagnostics& diagnostics);
/// The same for any class with open() and read(): semfield::Dataset, or a test's own.
template <class AnyDataset>
requires requires(AnyDataset& d, Diagnostics& g, FrameBuffer& b) {
  d.open(g);
  d.read(0, b);
}
LoadedScene load_scene(AnyDataset& dataset, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  return load_scene(SceneReader{[&](Diagnostics& found) { return dataset.open(found); },
                                [&](int frame, FrameBuffer& out) { dataset.read(frame, out); }},
                    options, diagnostics);
}

/// The frame at another size (at most its own); used by load_scene.
FrameBuffer resize_frame(const FrameBuffer& frame, std::int32_t width, std::int32_t height);

/// The camera at the size that `options` ask for; false (out unchanged) when the frame would have to grow.
bool scaled_camera(const Camera& camera, const SceneLoadOptions& options, Camera& out);

/// [x0, y0, z0, x1, y1, z1] as a box.
Box box_of(const std::vector<double>& corners);

/// Fills bounds, near, far and footprint from what is trusted most: the configuration, the dataset,
/// depth (`surveyed`, of the training frames), an object before a plain background, at last the view cones up to far.
/// load_scene calls it; whoever learns the depth of a scene without any calls it again.
void derive_extent(LoadedScene& scene, std::vector<SurveyPoints> surveyed, const SceneLoadOptions& options,
                   Diagnostics& diagnostics);

// How far the opening of a scene is, for whoever shows it.

/// Tells WorkSettings::load_progress of this thread. From any thread; one call is passed on at a time.
void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total);

}  // namespace semfield
