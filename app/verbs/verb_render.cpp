// render: images, or a video, of a run's field for a split or a trajectory.
#include <fmt/format.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <functional>
#include <future>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "app/render/render_views.h"
#include "app/render/video.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "run/run_scores.h"
#include "system/files.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

using FrameSink = std::function<void(const NamedView& view, const RenderedFrame& frame)>;

constexpr double kToldBytes = 1e9;  // of probabilities; below, no note is needed

double depth_step_of(const Session& s) { return depth_step(s.scene.info.metric, s.extent.bounds.size()); }

// Returns how many pixels are too far for the depth picture.
std::int64_t write_frame(const std::string& base, const RenderedFrame& frame, const Session& s, bool npy) {
  const MapSize size{frame.width_px, frame.height_px};
  write_color(base + "_rgb.png", size, frame.rgb);
  const std::int64_t beyond = write_depth(base + "_depth.png", size, frame.depth_m, depth_step_of(s));
  const DepthRange range = robust_depth_range(frame.depth_m);
  write_png_rgb(base + "_depth_vis.png", size.width_px, size.height_px,
                depth_colors(frame.depth_m, range.near_m, range.far_m));
  if (npy) write_map_npy(base + "_depth.npy", size, frame.depth_m);
  if (frame.label.empty()) return beyond;
  const int logits = static_cast<int>(s.plan.class_of_logit.size());
  write_label_ids(base + "_label.png", size, frame.label, s.scene.info.classes);
  write_label_colors(base + "_label_vis.png", size, frame.label, s.scene.info.classes);
  write_entropy(base + "_entropy.png", size, frame.entropy, logits);
  write_png_rgb(base + "_entropy_vis.png", size.width_px, size.height_px, entropy_colors(frame.entropy, logits));
  if (npy) write_map_npy(base + "_entropy.npy", size, frame.entropy);
  if (frame.probability.empty()) return beyond;
  const std::array<std::int64_t, 3> shape{size.height_px, size.width_px, s.classes()};
  write_npy(base + "_probability.npy", shape, frame.probability);
  return beyond;
}

// Names of the classes in the order of the last axis of probabilities, as labels of type npz read them.
void write_class_order(const std::string& path, const ClassTable& classes) {
  nlohmann::json names = nlohmann::json::array();
  for (int c = 0; c < classes.valid_count(); ++c) names.push_back(classes.valid(c).name);
  write_file_atomic(path, names.dump(1, ' ', false, nlohmann::json::error_handler_t::replace) + "\n");
}

void check_probability(const RenderOptions& options, const Session& s, const std::vector<NamedView>& views,
                       const AppContext& context) {
  if (!s.pipeline->has_semantics())
    throw Error(ErrorKind::data, "run.semantics.none", "--probability: " + options.run + " has no semantics",
                "train with labels");
  double bytes = 0;
  for (const NamedView& view : views)
    bytes += 4.0 * s.classes() * view.camera.camera.width_px * view.camera.camera.height_px;
  if (bytes < kToldBytes) return;
  print_note(context, fmt::format("probabilities of {} view{} and {} classes take {:.1f} GB of disk", views.size(),
                                  views.size() == 1 ? "" : "s", s.classes(), bytes / 1e9));
}

void create_folder(const fs::path& folder) {
  std::error_code failed;
  if (!folder.empty()) fs::create_directories(folder, failed);
  if (failed)
    throw Error(ErrorKind::cannot_create, "files.output.create",
                folder.string() + ": cannot create the folder: " + failed.message(), "choose another --out");
}

struct Rendered {
  std::size_t frames = 0;
  double s_per_frame = 0;
  std::int32_t width_px = 0, height_px = 0;  ///< of the first picture, or of the video
  const char* what = "folder";
  std::string where;
};

// Seconds per frame. A frame's files are compressed and written while the next is rendered.
double render_all(const Session& s, const std::vector<NamedView>& views, const FrameOptions& wanted,
                  const FrameSink& sink, const AppContext& context) {
  const auto begin = std::chrono::steady_clock::now();
  std::future<void> written;
  ProgressLine progress(context, "rendered");
  std::size_t done = 0;
  const auto part_done = [&](double share) {
    progress.show(static_cast<double>(done) + share, static_cast<double>(views.size()));
  };
  FrameOptions options = wanted;
  options.progress = part_done;
  options.classes = s.classes();
  for (const NamedView& view : views) {
    RenderedFrame frame =
        render_named_frame(*s.pipeline, view.name, view.camera, view.limits, s.plan.class_of_logit, {}, options);
    if (view.frame >= 0 && !frame.label.empty() && s.config.labels.clicks)
      s.config.labels.clicks->clear_ignored(view.frame, frame.width_px, frame.height_px, frame.label);
    if (written.valid()) written.get();
    written = std::async(std::launch::async, [&view, &sink, frame = std::move(frame)] { sink(view, frame); });
    ++done;
  }
  written.get();
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  return seconds / static_cast<double>(done);
}

Rendered render_images(const RenderOptions& options, const Session& s, const std::vector<NamedView>& views,
                       const AppContext& context) {
  const fs::path folder =
      options.out.empty() ? fs::path(options.run) / "render" / render_name(options) : fs::path(options.out);
  if (options.probability) check_probability(options, s, views, context);
  const ChannelOutput channels(options.channels, s);
  create_folder(folder);
  channels.write_axes(folder.string());
  CameraSet cameras = cameras_of(views);
  cameras.depth_step = depth_step_of(s);
  write_cameras((folder / "cameras.json").string(), cameras);
  if (cameras.depth_step != 1e-3)
    print_note(context, fmt::format("a step of the depth pictures is {:g} {}, as cameras.json says", cameras.depth_step,
                                    s.scene.info.metric ? "m" : "units"));
  if (options.probability) write_class_order((folder / "classes.json").string(), s.scene.info.classes);
  FrameOptions wanted;
  wanted.probability = options.probability;
  wanted.channels = channels.channels();
  std::int64_t beyond = 0;
  const double seconds = render_all(
      s, views, wanted,
      [&](const NamedView& view, const RenderedFrame& frame) {
        const std::string base = (folder / view.file_name()).string();
        beyond += write_frame(base, frame, s, options.npy);
        channels.write(base, frame);
      },
      context);
  if (beyond > 0)
    print_note(context,
               fmt::format("{} pixels lie farther than {:g} and have no depth in the pictures; --npy writes the "
                           "depth of all",
                           beyond, kMostDepthSteps * cameras.depth_step));
  const Camera& first = views.front().camera.camera;
  return {views.size(), seconds, first.width_px, first.height_px, "folder", folder.string()};
}

fs::path video_file(const RenderOptions& options) {
  return options.out.empty() ? fs::path(options.run) / "render" / (render_name(options) + ".mp4")
                             : fs::path(options.out);
}

Rendered render_video(const RenderOptions& options, const std::string& ffmpeg, const Session& s,
                      const std::vector<NamedView>& views, const AppContext& context) {
  const std::vector<Panel> panels = panels_of(options.panels, s.pipeline->has_semantics());
  const Camera& first = views.front().camera.camera;
  for (const NamedView& view : views) {
    const Camera& c = view.camera.camera;
    if (c.width_px == first.width_px && c.height_px == first.height_px) continue;
    throw Error(ErrorKind::data, "render.video.sizes",
                fmt::format("--video: view {} has {}x{} pixels and view {} has {}x{}", views.front().name,
                            first.width_px, first.height_px, view.name, c.width_px, c.height_px),
                "a video has one size: use --trajectory, whose views have the first frame's camera");
  }
  const fs::path file = video_file(options);
  create_folder(file.parent_path());
  const std::int32_t width_px = first.width_px * static_cast<std::int32_t>(panels.size());
  VideoWriter video(ffmpeg, file.string(), width_px, first.height_px, options.fps);
  const double seconds = render_all(
      s, views, {}, [&](const NamedView&, const RenderedFrame& frame) { video.add(frame_strip(frame, panels, s)); },
      context);
  video.finish();
  return {views.size(), seconds, width_px, first.height_px, "file", file.string()};
}

int run(const RenderOptions& options, AppContext& context) {
  // Before anything that takes time.
  if (options.video) (void)video_format(video_file(options).string());
  const std::string ffmpeg = options.video ? find_ffmpeg() : std::string();
  Diagnostics diagnostics;
  const OpenedRun run =
      open_run(options.run, options.set, context.registry, diagnostics, OpenFor::rendering, context.ranks.get());
  context.adopt(run.session.config);
  for (const Diagnostic& finding : folded(diagnostics)) print_note(context, finding.shown());
  Diagnostics of_cameras;
  const std::vector<NamedView> views = render_views(run.session, options, of_cameras);
  for (const Diagnostic& finding : folded(of_cameras)) print_note(context, finding.shown());
  const Rendered done = options.video ? render_video(options, ffmpeg, run.session, views, context)
                                      : render_images(options, run.session, views, context);
  if (context.json) {
    print_json(context, {{"run", options.run},
                         {"step", run.step},
                         {"frames", done.frames},
                         {"s_per_frame", done.s_per_frame},
                         {"width_px", done.width_px},
                         {"height_px", done.height_px},
                         {done.what, done.where}});
    return 0;
  }
  std::printf("render: frames=%zu size=%dx%d s_per_frame=%.3f %s=%s\n", done.frames, done.width_px, done.height_px,
              done.s_per_frame, done.what, done.where.c_str());
  print_next(context, next_of_run(options.run, false));
  return 0;
}

void words(VerbWords& verb, RenderOptions& options) {
  verb.operand("run", options.run, "run folder");
  verb.choice("--split SPLIT", options.split, {"test", "train"}, "frames whose views are rendered");
  verb.value("--trajectory FILE", options.trajectory,
             "instead of a split: a cameras.json of an earlier render, a file with one camera-to-world matrix per line "
             "(12 or 16 numbers), or 'smooth' for a path through the training cameras",
             {"smooth"});
  verb.value_in("--frames N", options.frames, 1, 100000, "number of frames of the smooth path");
  verb.value_in("--width PX", options.width, 1, 16384,
                "width of the pictures or the video's panels, pixels; heights follow (default: that of the cameras)");
  verb.value("--out PATH", options.out,
             "folder for the images, or the video's file (default: render/ in the run folder)");
  verb.flag("--video", options.video, "write a video through ffmpeg instead of images");
  verb.list("--panels LIST", options.panels, "panels side by side, with commas (default: all that the run has)",
            panel_names());
  verb.needs("--panels", "--video");
  verb.value_in("--fps X", options.fps, 0.01, 1000, "frames per second of the video");
  verb.flag("--npy", options.npy, "also write depth and entropy as float32 .npy");
  verb.excludes("--npy", "--video");
  verb.flag("--probability", options.probability,
            "also write the probability of every class as float32 .npy [height, width, classes]");
  verb.excludes("--probability", "--video");
  verb.value("--channel NAME", options.channels.channel,
             "also write this channel of a head as float32 .npy [height, width, columns]");
  verb.excludes("--channel", "--video");
  verb.value(
      "--query FILE", options.channels.query,
      "also write how well a head's channel agrees with each vector of this file, as cosines and pictures: .json, "
      "a map from words to vectors, or .npy");
  verb.excludes("--query", "--video");
  verb.run_settings(options.set);
}

}  // namespace

Verb verb_render() {
  return with_launch(
      Launch::ranks,
      with_json(make_verb<RenderOptions>(
          "render", 30, "render colour, label, depth and entropy images from a run's field", words, run)));
}

}  // namespace semfield::app
