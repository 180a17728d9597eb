// A scene out of a video or of photographs: images, and a COLMAP model of their poses.
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "loading/capture/photographs.h"
#include "loading/capture/reconstruct.h"

namespace semfield {

struct PrepareOptions {
  std::string source;      ///< a video, or a folder of photographs; never written to
  std::string out;         ///< folder of the scene
  std::size_t frames = 0;  ///< of a video, at most; 0: as VideoCut
  int threads = 0;         ///< 0: every core
  LensAsked lens = LensAsked::automatic;
  int attempts = 0;  ///< to give every photograph a pose, at most; 0: as ReconstructTask
  std::function<void(const std::string&)> note = [](const std::string&) {};  ///< of an attempt that was not enough
};

struct PrepareReport {
  std::size_t photographs = 0, registered = 0, points = 0;  ///< of panoramas, their views
  std::int32_t width_px = 0, height_px = 0;                 ///< of the first
  double error_px = 0;                                      ///< mean reprojection error
  int attempts = 0;
  std::string cut;  ///< what was kept of a video; empty of photographs
  std::vector<Missing> missing;
  Diagnostics findings;  ///< of the photographs; no errors
};

/// Writes `out`: images/ with copies of the photographs under plain names, and sparse/0/, which appears when all is
/// done. prepare/ holds the steps that are done, by which a run that was ended goes on, and the logs of all programs.
/// Throws Error for a source that cannot be used, a folder of others, a program that is missing or fails.
PrepareReport prepare_scene(const PrepareOptions& options, const Programs& programs, const CaptureProgress& progress);

}  // namespace semfield
