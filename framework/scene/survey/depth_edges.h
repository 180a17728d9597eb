// Whether depth lies on the colours: edges of depth are held against edges of the photograph, shifted each way.
#pragma once

#include <array>
#include <optional>
#include <vector>

#include "scene/scene.h"

namespace semfield {

inline constexpr int kEdgeReach = 8;  ///< pixels of the small picture, each way
/// How strong the photograph's edges are where depth has its edges, [2 kEdgeReach + 1][2 kEdgeReach + 1] by shift down
/// and right, their mean 1; empty where a frame has few edges.
using EdgeScores = std::vector<float>;
EdgeScores edge_scores(const Camera& camera, const FrameBuffer& frame);

/// Where depth lies best.
struct DepthShift {
  double right_px = 0, down_px = 0;  ///< by which edges of colour lie beside those of depth, pixels of the photograph
  double steps = 0;                  ///< how far that is, pixels of the small picture
  double gain = 1;                   ///< how much stronger edges are there than where they should be
};
/// Nothing where too few frames say the same.
std::optional<DepthShift> depth_shift(const std::vector<EdgeScores>& frames, const std::vector<Camera>& cameras);

}  // namespace semfield
