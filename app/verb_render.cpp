// render: images of a run's field for a split or a trajectory.
#include <fmt/format.h>

#include <chrono>
#include <cstdio>
#include <filesystem>
#include <future>

#include "core/parallel.h"
#include "scene/camera_path.h"
#include "train/image_output.h"
#include "train/run_folder.h"
#include "train/train_run.h"
#include "verbs.h"

namespace semfield::app {

namespace {

struct View3d {
  std::string name;
  RayCamera camera;
};

std::vector<View3d> views_of_split(const Session& s, const std::string& split) {
  if (split != "test" && split != "train")
    throw Error(ErrorKind::usage, "--split " + split + ": expected train or test");
  std::vector<View3d> views;
  for (const int f : s.scene.frames_of(split == "test" ? Split::test : Split::train)) {
    const FrameInfo& info = s.scene.info.frames[static_cast<std::size_t>(f)];
    views.push_back({info.name, {info.camera, info.world_from_camera, s.plan.undistortion}});
  }
  return views;
}

std::vector<View3d> views_of_trajectory(const Session& s, const std::string& path) {
  const Camera& camera = s.scene.info.frames.front().camera;
  std::vector<View3d> views;
  int number = 0;
  for (const Pose& pose : read_camera_file(path, CameraAxes::right_down_forward)) {
    views.push_back({fmt::format("{:05}", number++), {camera, pose, s.plan.undistortion}});
  }
  return views;
}

void write_frame(const std::string& base, const RenderedFrame& frame, const Session& s, bool npy) {
  const MapSize size{frame.width_px, frame.height_px};
  write_color(base + "_rgb.png", size, frame.rgb);
  write_depth_mm(base + "_depth.png", size, frame.depth_m);
  if (npy) write_map_npy(base + "_depth.npy", size, frame.depth_m);
  if (frame.label.empty()) return;
  const int logits = static_cast<int>(s.plan.class_of_logit.size());
  write_label_ids(base + "_label.png", size, frame.label, s.scene.info.classes);
  write_label_colors(base + "_label_vis.png", size, frame.label, s.scene.info.classes);
  write_entropy(base + "_entropy.png", size, frame.entropy, logits);
  if (npy) write_map_npy(base + "_entropy.npy", size, frame.entropy);
}

}  // namespace

int run_render(const RenderOptions& options, AppContext& context) {
  Diagnostics diagnostics;
  OpenedRun run = open_run(options.run, options.set, context.registry, diagnostics, OpenFor::rendering);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.text());
  Session& s = run.session;
  const std::vector<View3d> views =
      options.trajectory.empty() ? views_of_split(s, options.split) : views_of_trajectory(s, options.trajectory);
  if (views.empty())
    throw Error(ErrorKind::data, options.run + ": nothing to render in split '" + options.split + "'",
                "see `semfield inspect`");
  const std::string name = options.trajectory.empty() ? options.split : "trajectory";
  const std::filesystem::path folder =
      options.out.empty() ? std::filesystem::path(options.run) / "render" / name : std::filesystem::path(options.out);
  std::error_code failed;
  std::filesystem::create_directories(folder, failed);
  if (failed)
    throw Error(ErrorKind::cannot_create, folder.string() + ": cannot create the folder: " + failed.message(),
                "choose another --out");
  int done = 0;
  const auto begin = std::chrono::steady_clock::now();
  std::future<void> written;  // one frame's files are compressed and synced while the next is rendered
  for (const View3d& view : views) {
    RenderedFrame frame = render_frame(*s.pipeline, view.camera, s.limits, s.plan.class_of_logit);
    std::string stem = view.name;
    for (char& c : stem) c = c == '/' ? '_' : c;
    if (written.valid()) written.get();
    written = std::async(std::launch::async, [base = (folder / stem).string(), frame = std::move(frame), &s, &options] {
      write_frame(base, frame, s, options.npy);
    });
    ++done;
    if (context.terminal && !context.quiet) std::fprintf(stderr, "\r\033[Krendered %d/%zu", done, views.size());
  }
  written.get();
  const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  if (context.terminal && !context.quiet) std::fputs("\n", stderr);
  std::printf("render: frames=%d s_per_frame=%.3f folder=%s\n", done, seconds / done, folder.string().c_str());
  return 0;
}

}  // namespace semfield::app
