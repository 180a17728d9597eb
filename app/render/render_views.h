// The views that `render` shows: of a split, of a trajectory file, or along a smooth path through the training cameras.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "app/app_context.h"
#include "app/json_output.h"
#include "eval/channel_query.h"
#include "eval/evaluator.h"
#include "scene/camera.h"
#include "session/session.h"
#include "surface/mesh/score/mesh_score.h"

namespace semfield::app {

struct ChannelWishes {
  std::string channel;  ///< of --channel; "": none
  std::string query;    ///< file of --query; "": none
};

class ChannelOutput {
 public:
  /// Throws Error(usage) for a run without such a head, and what read_queries throws.
  ChannelOutput(const ChannelWishes& wishes, const Session& session);

  /// Channels that frames must have.
  const std::vector<std::string>& channels() const { return channels_; }
  /// Files of the whole folder: the axes of the channel, where it has some.
  void write_axes(const std::string& folder) const;
  /// Files of a frame, whose names begin with `base`.
  void write(const std::string& base, const RenderedFrame& frame) const;

 private:
  std::vector<std::string> channels_;
  bool maps_ = false;  // the channel itself is written
  View<const float> axes_;
  std::vector<QueryVector> queries_;
};

struct RenderOptions {
  std::string run;
  std::string split = "test";
  std::string trajectory;  ///< file of cameras or of camera-to-world matrices, or "smooth"; replaces the split
  int frames = 240;        ///< of the smooth path
  std::string out;         ///< default: render/<split> of the run, or render/<split>.mp4
  bool npy = false;
  bool probability = false;
  ChannelWishes channels;
  bool video = false;
  std::vector<std::string> panels;  ///< of the video; none: all that the run has
  double fps = 24;
  int width = 0;  ///< pixels; 0: that of each camera
  std::vector<std::string> set;
};

struct NamedView {
  std::string name;
  RayCamera camera;
  RayLimits limits;
  int frame = -1;  ///< of the scene, where it is the view of one

  /// What the names of its files begin with: slashes are '_'.
  std::string file_name() const;
};

/// Throws Error(data) for a bad trajectory file and for nothing to render. Warnings about cameras go to the
/// diagnostics.
std::vector<NamedView> render_views(const Session& session, const RenderOptions& options, Diagnostics& diagnostics);

/// As read_cameras reads them back.
CameraSet cameras_of(const std::vector<NamedView>& views);

/// "test", "train", "smooth" or "trajectory": names the output.
std::string render_name(const RenderOptions& options);

// One rendered view as panels side by side: what a frame of a video shows.

enum class Panel : std::uint8_t { rgb, label, depth, entropy };

/// By panel.
const std::vector<std::string>& panel_names();
/// Of names that are in panel_names(); of none: all that the run has. Throws Error(usage) for label or entropy of a run
/// without semantics.
std::vector<Panel> panels_of(const std::vector<std::string>& names, bool semantics);

/// Colour; classes half over colour; depth and entropy in the house's colours over a range that is the same for every
/// frame of the run (near to far, 0 to ln K). [H * panels W * 3]
std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<Panel>& panels, const Session& s);

// The view in 3D at the top of a report.

/// ReportInput::scene of a run that has come to `step`: the page of a coarse mesh. As evaluation does, it keeps to a
/// tenth of the training: of its rays here. "" where those are too few to see a surface, and where there is none or it
/// cannot be shown, which a note says.
std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context);

// The score of a mesh against a scene's depth images, for `mesh --score`.

/// Depth images of a scene as views.
struct MeasuredDepth {
  std::vector<DepthView> training, held_out;
};
/// Of a session that keeps all depth. Throws Error(data) that names the run where no frame of the scene has a depth
/// image, or, with `training_needed`, no training frame.
MeasuredDepth measured_depth(const Session& session, const std::string& run, bool training_needed);

/// Scores of a run's mesh, and of what the same fusion makes of the depth images of its training frames.
struct MeshScores {
  double metre = 1;  ///< of distances, in units of the scene (usual_metre)
  std::size_t points = 0, held_out_points = 0;
  MeshScore mesh;
  std::optional<MeshScore> sensor;  ///< none without depth of training frames
};
Json scores_json(const MeshScores& scores);
/// A table with a line at each end. `metric`: the scene is in metres; distances are shown in centimetres, or else in
/// its own unit.
std::string scores_table(const MeshScores& scores, bool metric);

}  // namespace semfield::app
