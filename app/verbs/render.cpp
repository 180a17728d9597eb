// render: images, or a video, of a run's field for a split or a trajectory.
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <future>
#include <span>
#include <string_view>
#include <utility>

#include "app/child_process.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "eval/evaluator.h"
#include "eval/image_output.h"
#include "eval/photo_edges.h"
#include "formats/image_io.h"
#include "scene/camera.h"
#include "scene/scene.h"
#include "train/opened_run.h"
#include "train/session.h"

namespace semfield::app {

namespace {

const std::vector<std::string> kPanels{"rgb", "label", "depth", "entropy"};

struct RenderOptions : Options {
  explicit RenderOptions(const Declaration& at) : Options(at) {
    needs("--panels", "--video");
    excludes("--npy", "--video");
    excludes("--probability", "--video");
    excludes("--channel", "--video");
  }
  const std::string& run = operand("run", "run folder");
  const std::string& split = choice("--split SPLIT", "test", {"test", "train"}, "frames whose views are rendered");
  const std::string& trajectory =
      value("--trajectory FILE",
            "instead of a split: a cameras.json of an earlier render, a file with one camera-to-world matrix per line "
            "(12 or 16 numbers), or 'smooth' for a path through the training cameras",
            "", {"smooth"});
  const int& frames = value_in("--frames N", 240, 1, 100000, "number of frames of the smooth path");
  const int& width =
      value_in("--width PX", 0, 1, 16384,
               "width of the pictures or the video's panels, pixels; heights follow (default: that of the cameras)");
  const std::string& out =
      value("--out PATH", "folder for the images, or the video's file (default: render/ in the run folder)");
  const bool& video = flag("--video", "write a video through ffmpeg instead of images");
  const std::vector<std::string>& panels =
      list("--panels LIST", "panels side by side, with commas (default: all that the run has)", kPanels);
  const double& fps = value_in("--fps X", 24.0, 0.01, 1000, "frames per second of the video");
  const bool& npy = flag("--npy", "also write depth and entropy as float32 .npy");
  const bool& probability =
      flag("--probability", "also write the probability of every class as float32 .npy [height, width, classes]");
  const bool& field_labels = flag(
      "--field-labels",
      "labels as the field has them; without it they cling to the edges of the photograph, or of the rendered colour");
  const std::string& channel =
      value("--channel NAME", "also write this channel of a head as float32 .npy [height, width, columns]");
  const std::vector<std::string>& set = run_settings();
};

struct NamedView {
  std::string name;
  RayCamera camera;
  RayLimits limits;
  int frame = -1;  ///< of the scene, where it is the view of one
};

constexpr int kFramesPerKey = 36;  // of a smooth path: a training camera every one and a half seconds

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

// "test", "train", "smooth" or "trajectory": names the output.
std::string render_name(const RenderOptions& options) {
  if (options.trajectory.empty()) return options.split;
  return options.trajectory == "smooth" ? "smooth" : "trajectory";
}

// Throws Error(data) for a bad trajectory file and for nothing to render. Warnings about cameras go to the diagnostics.
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
      const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
      views.push_back({info.name, {info.camera, info.world_from_camera, s.plan.undistortion}, s.limits, f});
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

// As read_cameras reads them back.
CameraSet cameras_of(const std::vector<NamedView>& views) {
  CameraSet set;
  set.z_depth = views.front().limits.z_depth;
  for (const NamedView& view : views) {
    set.cameras.push_back(
        {view.name, view.camera.camera, view.camera.world_from_camera, view.limits.near_m, view.limits.far_m});
  }
  return set;
}

// Throws Error(usage) for a run without a head of that channel.
void check_channel(const std::string& channel, const Session& session) {
  std::vector<std::string> known;
  for (const HeadConfig& head : session.config.heads) {
    known.push_back(head.channel);
    if (head.channel == channel) return;
  }
  if (known.empty())
    throw Error(ErrorKind::usage, "render.channel.unknown", "the run has no head except that of class logits",
                "train with the lists `heads` and `losses`; docs/guide/features.md shows how");
  throw Error(ErrorKind::usage, "render.channel.unknown",
              "--channel: the run has no channel '" + channel + "'; it has " + join(known),
              near_name_remedy(channel, known));
}

std::vector<std::uint8_t> overlay(const RenderedFrame& frame, const ClassTable& classes) {
  std::vector<std::uint8_t> out = to_bytes(frame.rgb);
  const std::vector<std::uint8_t> colors = label_colors(frame.label, classes);
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (frame.label[i / 3] != kVoid) out[i] = static_cast<std::uint8_t>((out[i] + colors[i] + 1) / 2);
  }
  return out;
}

// One rendered view as panels side by side: what a frame of a video shows.

std::vector<std::uint8_t> panel_of(const RenderedFrame& frame, const std::string& panel, const Session& s) {
  if (panel == "rgb") return to_bytes(frame.rgb);
  if (panel == "label") return overlay(frame, s.scene.info.classes);
  if (panel == "depth") return depth_colors(frame.depth_m, s.limits.near_m, s.limits.far_m);
  return entropy_colors(frame.entropy, std::log(s.plan.class_of_logit.size()));
}

// Of names that are in kPanels; of none: all that the run has. Throws Error(usage) for label or entropy of a run
// without semantics.
std::vector<std::string> panels_of(const std::vector<std::string>& names, bool semantics) {
  if (names.empty()) return semantics ? kPanels : std::vector<std::string>{"rgb", "depth"};
  for (const std::string& name : names) {
    if (semantics || (name != "label" && name != "entropy")) continue;
    throw Error(ErrorKind::usage, "run.semantics.none",
                "--panels: this run has no semantics, so no panel '" + name + "'", "choose from rgb, depth");
  }
  return names;
}

// Colour; classes half over colour; depth and entropy in the house's colours over a range that is the same for every
// frame of the run (near to far, 0 to ln K). [H * panels W * 3]
std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<std::string>& panels,
                                      const Session& s) {
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

// Frames into a video file through the program ffmpeg: no shell, raw RGB over a pipe.

// Path of ffmpeg in PATH. Throws Error(unavailable) with how to get it.
std::string find_ffmpeg() {
  const std::string program = program_in_path("ffmpeg");
  if (!program.empty()) return program;
  throw Error(ErrorKind::unavailable, "render.video.ffmpeg", "--video: the program ffmpeg is not in PATH",
              "install it (Debian: apt-get install ffmpeg), or render images and join them elsewhere");
}

// ffmpeg's name for what the ending of `path` stands for. Throws Error(usage) for none and for one that is not known.
std::string video_format(const std::string& path) {
  constexpr std::pair<const char*, const char*> kFormats[] = {{".mp4", "mp4"},      {".m4v", "mp4"},   {".mov", "mov"},
                                                              {".mkv", "matroska"}, {".webm", "webm"}, {".avi", "avi"},
                                                              {".ogv", "ogg"},      {".gif", "gif"}};
  const std::string ending = lower_case(fs::path(path).extension().string());
  std::string known;
  for (const auto& [name, format] : kFormats) {
    if (ending == name) return format;
    known += (known.empty() ? "" : ", ") + std::string(name);
  }
  throw Error(ErrorKind::usage, "render.video.format",
              path + (ending.empty() ? ": no extension" : ": '" + ending + "' is no extension of a video file"),
              "name a file such as room.mp4; known: " + known);
}

/// One video. Frames go to ffmpeg as they come, into a temporary file of ours beside `path` (AtomicFile): the file of
/// that name is replaced when finish() has seen ffmpeg end well and the bytes on the disk. Without finish() ffmpeg is
/// stopped and nothing stays.
class VideoWriter : NonCopyable {
 public:
  /// Throws Error(unavailable) when ffmpeg cannot be started, write_error where no file can be made.
  VideoWriter(const std::string& ffmpeg, const std::string& path, std::int32_t width_px, std::int32_t height_px,
              double fps)
      : path_(path), file_(path) {
    // -xerror: without it ffmpeg ends well even where the disk took less than it wrote. Planes of half the size need
    // even sides.
    const std::string options = fmt::format(
        "-hide_banner -loglevel error -xerror -y -f rawvideo -pix_fmt rgb24 -s {}x{} -r {} -i pipe:0 -an "
        "-vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -pix_fmt yuv420p -f {} file:/proc/self/fd/{}",
        width_px, height_px, fps, video_format(path), file_.descriptor());
    std::vector<std::string> words{ffmpeg};
    for (const std::string_view word : words_of(options)) words.emplace_back(word);
    Pipe pipe = open_pipe(ffmpeg);
    // Our stdout is for results.
    child_.pid = start_child(words, ChildStreams{pipe.read, STDERR_FILENO, STDERR_FILENO},
                             [file = file_.descriptor()] { fcntl(file, F_SETFD, 0); });
    pipe_ = std::move(pipe.write);
  }

  /// rgb [height * width * 3]. Throws Error(io) when ffmpeg has ended, with the cause where the disk reports it. The
  /// program ignores SIGPIPE: a dead ffmpeg is an error of write().
  void add(std::span<const std::uint8_t> rgb) {
    while (!rgb.empty()) {
      const ssize_t n = write(pipe_, rgb.data(), rgb.size());
      if (n < 0 && errno == EINTR) continue;
      if (n <= 0) {
        const std::string cause = std::strerror(errno);
        fail("ffmpeg takes no more frames: " + cause, wait());
      }
      rgb = rgb.subspan(static_cast<std::size_t>(n));
    }
  }
  void finish() {
    if (const int code = wait(); code != 0) fail("ffmpeg could not finish the video", code);
    file_.count_written();
    if (file_.size() == 0) fail("ffmpeg wrote nothing", 0);
    file_.commit();
  }

 private:
  [[noreturn]] void fail(const std::string& what, int code) {
    // Where the disk is the cause it refuses us too, and then its words are ours.
    file_.count_written();
    const std::vector<std::byte> more(std::size_t{1} << 20);
    file_.append(more);
    throw Error(ErrorKind::io, "render.video.failed", fmt::format("{}: {} (exit code {})", path_, what, code),
                "its own message is above; try another file ending, or render images without --video");
  }
  int wait() {
    pipe_ = -1;
    return child_.wait();
  }
  std::string path_;
  AtomicFile file_;
  FileDescriptor pipe_;
  OwnedChild child_{SIGKILL};  // what it has written is thrown away
};

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
  write_png_rgb(base + "_entropy_vis.png", size.width_px, size.height_px,
                entropy_colors(frame.entropy, std::log(logits)));
  if (npy) write_map_npy(base + "_entropy.npy", size, frame.entropy);
  if (frame.probability.empty()) return beyond;
  const std::array<std::int64_t, 3> shape{size.height_px, size.width_px, s.classes()};
  write_npy(base + "_probability.npy", shape, frame.probability);
  return beyond;
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

struct Rendered {
  std::size_t frames = 0;
  double s_per_frame = 0;
  std::int32_t width_px = 0, height_px = 0;  ///< of the first picture, or of the video
  const char* what = "folder";
  std::string where;
};

// Seconds per frame. A frame's files are compressed and written while the next is rendered.
double render_all(const Session& s, const std::vector<NamedView>& views, const FrameOptions& wanted, bool field_labels,
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
  options.probability |= !field_labels && s.pipeline->has_semantics();
  for (const NamedView& view : views) {
    RenderedFrame frame =
        render_named_frame(*s.pipeline, view.name, view.camera, view.limits, s.plan.class_of_logit, {}, options);
    if (!frame.probability.empty() && !field_labels) {
      const FrameInfo* info = view.frame < 0 ? nullptr : &s.scene.info.frames[static_cast<std::size_t>(view.frame)];
      frame.label = clinging_labels(info, frame, options.classes, frame.width_px, frame.height_px);
    }
    if (!wanted.probability) frame.probability.clear();
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
  if (!options.channel.empty()) check_channel(options.channel, s);
  create_output_folder(folder);
  CameraSet cameras = cameras_of(views);
  cameras.depth_step = depth_step_of(s);
  write_cameras((folder / "cameras.json").string(), cameras);
  if (cameras.depth_step != 1e-3)
    print_note(context, fmt::format("a step of the depth pictures is {:g} {}, as cameras.json says", cameras.depth_step,
                                    s.scene.info.metric ? "m" : "units"));
  if (options.probability)
    write_file_atomic((folder / "classes.json").string(), class_order_json(s.scene.info.classes));
  FrameOptions wanted;
  wanted.probability = options.probability;
  if (!options.channel.empty()) {
    wanted.channels = {options.channel};
    const View<const float> axes = s.pipeline->passes().back().axes(options.channel);
    if (!axes.empty())
      write_npy((folder / (options.channel + "_axes.npy")).string(), std::array{axes.rows, std::int64_t{axes.cols}},
                {axes.data, static_cast<std::size_t>(axes.size())});
  }
  std::int64_t beyond = 0;
  const double seconds = render_all(
      s, views, wanted, options.field_labels,
      [&](const NamedView& view, const RenderedFrame& frame) {
        const std::string base = (folder / output_name(view.name)).string();
        beyond += write_frame(base, frame, s, options.npy);
        for (const FrameChannel& map : frame.channels)
          write_npy(base + "_" + map.name + ".npy", std::array<std::int64_t, 3>{map.height, map.width, map.cols},
                    map.values);
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
  const std::vector<std::string> panels = panels_of(options.panels, s.pipeline->has_semantics());
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
  create_output_folder(file.parent_path());
  const std::int32_t width_px = first.width_px * static_cast<std::int32_t>(panels.size());
  VideoWriter video(ffmpeg, file.string(), width_px, first.height_px, options.fps);
  const double seconds = render_all(
      s, views, {}, options.field_labels,
      [&](const NamedView&, const RenderedFrame& frame) { video.add(frame_strip(frame, panels, s)); }, context);
  video.finish();
  return {views.size(), seconds, width_px, first.height_px, "file", file.string()};
}

int run(const RenderOptions& options, AppContext& context) {
  // Before anything that takes time.
  if (options.video) (void)video_format(video_file(options).string());
  const std::string ffmpeg = options.video ? find_ffmpeg() : std::string();
  const OpenedRun run = run_of(options.run, options.set, OpenFor::rendering, context);
  Diagnostics of_cameras;
  const std::vector<NamedView> views = render_views(run.session, options, of_cameras);
  print_findings(context, of_cameras);
  const Rendered done = options.video ? render_video(options, ffmpeg, run.session, views, context)
                                      : render_images(options, run.session, views, context);
  print_results(context,
                {{"run", options.run},
                 {"step", run.step},
                 {"frames", done.frames},
                 {"s_per_frame", done.s_per_frame},
                 {"width_px", done.width_px},
                 {"height_px", done.height_px},
                 {done.what, done.where}},
                fmt::format("Rendered {0} view{6} of {1} x {2} pixels in {3:.2g} s each, into {5}.\n"
                            "render: frames={0} size={1}x{2} s_per_frame={3:.3f} {4}={5}",
                            done.frames, done.width_px, done.height_px, done.s_per_frame, done.what, done.where,
                            done.frames == 1 ? "" : "s"));
  print_next(context, next_of_run(options.run, false));
  return 0;
}

}  // namespace

Verb verb_render() {
  return make_verb<RenderOptions>("render", 30, "render colour, label, depth and entropy images from a run's field",
                                  {"runs/my_photos --split test", "runs/my_photos --trajectory smooth --video"}, run,
                                  Launch::ranks);
}

}  // namespace semfield::app
