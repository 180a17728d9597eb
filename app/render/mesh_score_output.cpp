#include "app/render/mesh_score_output.h"

#include <fmt/format.h>

namespace semfield::app {

namespace {

Json one_json(const MeshScore& score) {
  Json out{{"complete", score.complete}};
  out["complete_of_held_out"] = score.complete_of_held_out ? Json(*score.complete_of_held_out) : Json();
  out["accurate"] = score.accurate;
  out["f"] = score.f;
  out["judged"] = score.judged;
  return out;
}

ScoreShares distances_of(const MeshScores& scores) {
  ScoreShares out = kScoreDistances;
  for (double& distance : out) distance *= scores.metre;
  return out;
}

std::string cells(const std::optional<ScoreShares>& shares) {
  std::string out;
  for (std::size_t k = 0; k < kScoreDistances.size(); ++k)
    out += shares ? fmt::format("{:>8.1f} %", 100 * (*shares)[k]) : fmt::format("{:>10}", "-");
  return out;
}

std::vector<DepthView> views_of(const Session& s, Split split) {
  std::vector<DepthView> views;
  for (const int f : s.scene.frames_of(split)) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    const DepthMap& depth = s.scene.frames[static_cast<std::size_t>(f)].depth_m;
    if (!depth.empty())
      views.push_back(measured_view({info.camera, info.world_from_camera, s.plan.undistortion}, depth));
  }
  return views;
}

}  // namespace

MeasuredDepth measured_depth(const Session& session, const std::string& run, bool training_needed) {
  MeasuredDepth depth{views_of(session, Split::train), views_of(session, Split::test)};
  if (depth.training.empty() && (training_needed || depth.held_out.empty()))
    throw Error(
        ErrorKind::data, "mesh.depth.none",
        fmt::format("{}: no {} frame of the scene has a depth image", run, training_needed ? "training" : "single"),
        "leave out what asks for measured depth: --score, --surface sensor");
  return depth;
}

Json scores_json(const MeshScores& scores) {
  Json out{{"distances", distances_of(scores)}, {"points", scores.points}, {"held_out_points", scores.held_out_points}};
  out["mesh"] = one_json(scores.mesh);
  out["sensor"] = scores.sensor ? one_json(*scores.sensor) : Json();
  return out;
}

std::string scores_table(const MeshScores& scores, bool metric) {
  std::string head;
  for (const double distance : distances_of(scores))
    head += metric ? fmt::format("{:>7.4g} cm", 100 * distance) : fmt::format("{:>10.4g}", distance);
  std::string text = fmt::format("{:<24}{}   {} points of depth images, {} of held-out frames\n", "within", head,
                                 scores.points, scores.held_out_points);
  const auto rows = [&](const std::string& name, const MeshScore& score) {
    text += fmt::format("{:<24}{}\n", name + ": complete", cells(score.complete));
    text += fmt::format("{:<24}{}\n", "  of held-out frames", cells(score.complete_of_held_out));
    text += fmt::format("{:<24}{}   {:.1f} % of the mesh is judged\n", "  accurate", cells(score.accurate),
                        100 * score.judged);
    text += fmt::format("{:<24}{}\n", "  F", cells(score.f));
  };
  rows("mesh", scores.mesh);
  if (scores.sensor) rows("sensor", *scores.sensor);
  return text;
}

}  // namespace semfield::app
