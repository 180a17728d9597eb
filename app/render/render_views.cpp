#include "app/render/render_views.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "app/render/run_surface.h"
#include "app/render/scene_page.h"
#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "scene/camera_path.h"
#include "scene/scene.h"

namespace semfield::app {

namespace {

constexpr int kFramesPerKey = 36;  // of a smooth path: a training camera every one and a half seconds

NamedView view_of(const Session& s, int frame) {
  const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(frame)];
  return {info.name, {info.camera, info.world_from_camera, s.plan.undistortion}, s.limits, frame};
}

std::vector<NamedView> views_of_poses(const Session& s, const std::vector<Pose>& poses) {
  const Camera& camera = s.scene.info.frames.front().camera;
  std::vector<NamedView> views;
  for (const Pose& pose : poses)
    views.push_back({fmt::format("{:05}", views.size()), {camera, pose, s.plan.undistortion}, s.limits});
  return views;
}

// Each with its own lens and limits; bounds are the run's.
std::vector<NamedView> views_of_cameras(const Session& s, const CameraSet& set) {
  std::vector<NamedView> views;
  for (const PlacedCamera& placed : set.cameras) {
    NamedView view{placed.name, {placed.camera, placed.world_from_camera, placed.camera.has_distortion()}, s.limits};
    if (placed.far_m > 0) {
      view.limits.near_m = placed.near_m;
      view.limits.far_m = placed.far_m;
      view.limits.z_depth = set.z_depth;
    }
    views.push_back(std::move(view));
  }
  return views;
}

std::vector<Pose> smooth_path(const Session& s, int frames) {
  std::vector<Pose> keys;
  for (const int f : evenly_spaced(s.scene.frames_of(Split::train), 2 + frames / kFramesPerKey)) {
    keys.push_back(s.scene.info.frames[static_cast<std::size_t>(f)].world_from_camera);
  }
  return keys.empty() ? keys : make_smooth_path(keys, frames);
}

}  // namespace

std::string NamedView::file_name() const { return output_name(name); }

std::string render_name(const RenderOptions& options) {
  if (options.trajectory.empty()) return options.split;
  return options.trajectory == "smooth" ? "smooth" : "trajectory";
}

std::vector<NamedView> render_views(const Session& s, const RenderOptions& options, Diagnostics& diagnostics) {
  std::vector<NamedView> views;
  if (options.trajectory == "smooth") {
    views = views_of_poses(s, smooth_path(s, options.frames));
  } else if (!options.trajectory.empty() && is_camera_set(options.trajectory)) {
    views = views_of_cameras(s, read_cameras(options.trajectory, diagnostics));
  } else if (!options.trajectory.empty()) {
    views = views_of_poses(s, read_camera_file(options.trajectory, CameraAxes::right_down_forward));
  } else {
    for (const int f : s.scene.frames_of(options.split == "test" ? Split::test : Split::train)) {
      views.push_back(view_of(s, f));
    }
  }
  if (views.empty()) {
    throw Error(ErrorKind::data, "scene.split.empty",
                options.run + ": nothing to render in '" + render_name(options) + "'", "see `semfield inspect`");
  }
  for (NamedView& view : views) {
    Camera& camera = view.camera.camera;
    const double height = static_cast<double>(options.width) * camera.height_px / camera.width_px;
    if (options.width > 0)
      camera = camera.resized(options.width, static_cast<std::int32_t>(std::max(1L, std::lround(height))));
  }
  return views;
}

CameraSet cameras_of(const std::vector<NamedView>& views) {
  CameraSet set;
  set.z_depth = views.front().limits.z_depth;
  for (const NamedView& view : views) {
    set.cameras.push_back(
        {view.name, view.camera.camera, view.camera.world_from_camera, view.limits.near_m, view.limits.far_m});
  }
  return set;
}

namespace {

// Between the 2nd and the 98th percentile of the picture: cosines of words and pictures differ by little.
std::vector<std::uint8_t> contrast_colors(const std::vector<float>& values) {
  std::vector<float> sorted = values;
  std::sort(sorted.begin(), sorted.end());
  const std::size_t last = sorted.size() - 1;
  const double low = static_cast<double>(sorted[last / 50]), high = static_cast<double>(sorted[last - last / 50]);
  std::vector<std::uint8_t> rgb;
  rgb.reserve(3 * values.size());
  for (const float value : values) {
    const double t = high > low ? (static_cast<double>(value) - low) / (high - low) : 0;
    const auto color = perceptual_color(t);
    rgb.insert(rgb.end(), color.begin(), color.end());
  }
  return rgb;
}

const HeadConfig& head_of(const ChannelWishes& wishes, const Session& session) {
  const std::vector<HeadConfig>& heads = session.config.heads;
  std::vector<std::string> known;
  for (const HeadConfig& head : heads) {
    known.push_back(head.channel);
    if (head.channel == wishes.channel || (wishes.channel.empty() && heads.size() == 1)) return head;
  }
  if (known.empty())
    throw Error(ErrorKind::usage, "render.channel.unknown", "the run has no head except that of class logits",
                "train with the lists `heads` and `losses`; docs/guide/features.md shows how");
  if (wishes.channel.empty())
    throw Error(ErrorKind::usage, "render.channel.unknown", "the run has several channels: " + join(known),
                "name one with --channel");
  const std::string near = did_you_mean(wishes.channel, known);
  throw Error(ErrorKind::usage, "render.channel.unknown",
              "--channel: the run has no channel '" + wishes.channel + "'; it has " + join(known),
              near.empty() ? "" : "did you mean '" + near + "'?");
}

}  // namespace

ChannelOutput::ChannelOutput(const ChannelWishes& wishes, const Session& session) : maps_(!wishes.channel.empty()) {
  if (wishes.channel.empty() && wishes.query.empty()) return;
  const HeadConfig& head = head_of(wishes, session);
  channels_.push_back(head.channel);
  axes_ = session.pipeline->passes().back().axes(head.channel);
  if (!wishes.query.empty())
    queries_ = read_queries(wishes.query, head.source_width > 0 ? head.source_width : head.width);
  maps_ = maps_ && wishes.query.empty();
}

void ChannelOutput::write_axes(const std::string& folder) const {
  if (!maps_ || axes_.empty()) return;
  const std::vector<std::int64_t> shape{axes_.rows, axes_.cols};
  write_npy(folder + "/" + channels_.front() + "_axes.npy", shape,
            {axes_.data, static_cast<std::size_t>(axes_.size())});
}

void ChannelOutput::write(const std::string& base, const RenderedFrame& frame) const {
  for (const FrameChannel& map : frame.channels) {
    if (maps_) {
      const std::vector<std::int64_t> shape{map.height, map.width, map.cols};
      write_npy(base + "_" + map.name + ".npy", shape, map.values);
    }
    for (const QueryVector& query : queries_) {
      const std::vector<float> cosines = cosine_map(map, query.values, axes_);
      const std::string file = base + "_query_" + query.name;
      write_map_npy(file + ".npy", {map.width, map.height}, cosines);
      write_png_rgb(file + ".png", map.width, map.height, contrast_colors(cosines));
    }
  }
}

namespace {

std::vector<std::uint8_t> overlay(const RenderedFrame& frame, const ClassTable& classes) {
  std::vector<std::uint8_t> out = to_bytes(frame.rgb);
  const std::vector<std::uint8_t> colors = label_colors(frame.label, classes);
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (frame.label[i / 3] != kVoid) out[i] = static_cast<std::uint8_t>((out[i] + colors[i] + 1) / 2);
  }
  return out;
}

std::vector<std::uint8_t> panel_of(const RenderedFrame& frame, Panel panel, const Session& s) {
  switch (panel) {
    case Panel::rgb:
      return to_bytes(frame.rgb);
    case Panel::label:
      return overlay(frame, s.scene.info.classes);
    case Panel::depth:
      return depth_colors(frame.depth_m, s.limits.near_m, s.limits.far_m);
    default:
      return entropy_colors(frame.entropy, static_cast<int>(s.plan.class_of_logit.size()));
  }
}

}  // namespace

const std::vector<std::string>& panel_names() {
  static const std::vector<std::string> names{"rgb", "label", "depth", "entropy"};
  return names;
}

std::vector<Panel> panels_of(const std::vector<std::string>& names, bool semantics) {
  if (names.empty()) {
    if (!semantics) return {Panel::rgb, Panel::depth};
    return {Panel::rgb, Panel::label, Panel::depth, Panel::entropy};
  }
  std::vector<Panel> panels;
  for (const std::string& name : names) {
    const auto found = std::find(panel_names().begin(), panel_names().end(), name);
    panels.push_back(static_cast<Panel>(found - panel_names().begin()));
    if (!semantics && (panels.back() == Panel::label || panels.back() == Panel::entropy)) {
      throw Error(ErrorKind::usage, "run.semantics.none",
                  "--panels: this run has no semantics, so no panel '" + name + "'", "choose from rgb, depth");
    }
  }
  return panels;
}

std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<Panel>& panels, const Session& s) {
  const std::size_t row = 3 * static_cast<std::size_t>(frame.width_px);
  const auto height = static_cast<std::size_t>(frame.height_px);
  std::vector<std::uint8_t> strip(row * height * panels.size());
  for (std::size_t p = 0; p < panels.size(); ++p) {
    const std::vector<std::uint8_t> panel = panel_of(frame, panels[p], s);
    for (std::size_t y = 0; y < height; ++y) {
      std::copy_n(panel.begin() + static_cast<std::ptrdiff_t>(y * row), row,
                  strip.begin() + static_cast<std::ptrdiff_t>((y * panels.size() + p) * row));
    }
  }
  return strip;
}

namespace {

constexpr long long kCells = 64;  // along the longest side
constexpr std::int64_t kMostRays = 60'000, kLeastRays = 15'000;
constexpr std::int64_t kShare = 10;  // of the rays of training: one of so many

}  // namespace

std::string report_scene(const Session& session, const std::string& run_dir, std::int64_t step,
                         const AppContext& context) {
  const std::int64_t rays = std::min(kMostRays, step * session.config.train.rays / kShare);
  if (rays < kLeastRays) return {};
  SurfaceWishes wishes;
  wishes.resolution = kCells;
  wishes.depth_rays = rays;
  try {
    const RunSurface found = make_run_surface(session, run_dir, wishes, {}, {});
    return scene_page_text(found.surface, session.scene.info.classes,
                           scene_page_of(session, run_dir, step, upright_of(session).value_or(Vec3d{0, 1, 0})));
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::data && e.kind() != ErrorKind::no_input) throw;
    print_note(context, "no view in 3D in the report: " + e.message());
    return {};
  }
}

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
