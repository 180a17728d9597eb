// Scenes whose poses were written in another convention, and what must be said of them.
#pragma once

#include <gtest/gtest.h>

#include "scene/loading/frame_source.h"

namespace semfield {

/// A dataset whose files keep another convention.
template <class Real>
struct Rewritten {
  Real& dataset;
  PoseConvention how;
  SceneInfo open(Diagnostics& diagnostics) {
    SceneInfo info = dataset.open(diagnostics);
    for (FrameInfo& f : info.frames) f.world_from_camera = converted_pose(f.world_from_camera, how, info.opengl_files);
    return info;
  }
  void read(int frame, FrameBuffer& out) const { dataset.read(frame, out); }
};

/// What is said of a scene as it is, and of its poses in each other convention.
template <class Real>
void expect_conventions_told(Real& dataset, const std::string& agrees) {
  SceneLoadOptions load{.depth = DepthKept::none};
  Diagnostics right;
  EXPECT_NE(load_scene(dataset, load, right).geometry.find(agrees), std::string::npos);
  for (const Diagnostic& d : right.all()) {
    EXPECT_EQ(d.text().find("add --set scene.load"), std::string::npos) << d.text();
    EXPECT_EQ(d.text().find("do not agree"), std::string::npos) << d.text();
  }
  struct {
    PoseConvention how;
    const char *named, *remedy;
  } const breaks[] = {{{.flip_camera_axes = true}, "OpenGL axes", "add --set scene.load.flip_camera_axes=true "},
                      {{.invert_poses = true}, "world-to-camera", "add --set scene.load.invert_poses=true "}};
  for (const auto& b : breaks) {
    Rewritten<Real> broken{dataset, b.how};
    Diagnostics d;
    (void)load_scene(broken, load, d);
    std::string errors;
    for (const Diagnostic& x : d.all()) errors += x.severity == Severity::error ? x.text() : "";
    EXPECT_NE(errors.find(b.named), std::string::npos) << errors;
    EXPECT_NE(errors.find(b.remedy), std::string::npos) << errors;
    load.convention = b.how;
    Diagnostics mended;
    EXPECT_NE(load_scene(broken, load, mended).geometry.find(agrees), std::string::npos);
    EXPECT_FALSE(mended.has_errors());
    load.convention = {};
  }
}

}  // namespace semfield
