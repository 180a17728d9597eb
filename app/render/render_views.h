// The views that `render` shows: of a split, of a trajectory file, or along a smooth path through the training cameras.
#pragma once

#include <string>
#include <vector>

#include "session/session.h"

namespace semfield::app {

struct RenderOptions {
  std::string run;
  std::string split = "test";
  std::string trajectory;  ///< file of camera-to-world matrices, or "smooth"; replaces the split
  int frames = 240;        ///< of the smooth path
  std::string out;         ///< default: render/<split> of the run, or render/<split>.mp4
  bool npy = false;
  bool video = false;
  std::string panels;  ///< of the video: "rgb,label,depth,entropy"; "" = all that the run has
  double fps = 24;
  std::vector<std::string> set;
};

struct NamedView {
  std::string name;  ///< of its files
  RayCamera camera;
};

/// Throws Error(usage) for an unknown split or a path without frames, Error(data) for a bad trajectory file and for
/// nothing to render.
std::vector<NamedView> render_views(const Session& session, const RenderOptions& options);

/// "test", "train", "smooth" or "trajectory": names the output.
std::string render_name(const RenderOptions& options);

}  // namespace semfield::app
