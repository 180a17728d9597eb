// The views that `render` shows: of a split, of a trajectory file, or along a smooth path through the training cameras.
#pragma once

#include <string>
#include <vector>

#include "app/render/channel_output.h"
#include "scene/camera_set.h"
#include "session/session.h"

namespace semfield::app {

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

}  // namespace semfield::app
