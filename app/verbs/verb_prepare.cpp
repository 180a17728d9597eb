// prepare: a scene out of a video or of photographs.
#include <fmt/format.h>

#include <cstdio>
#include <optional>
#include <set>

#include "app/child_process.h"
#include "app/json_output.h"
#include "app/scene/folder_scene.h"
#include "app/scene/inspect_report.h"
#include "app/signals.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "core/text.h"
#include "loading/capture/fix_cameras.h"
#include "loading/capture/prepare.h"
#include "scene/camera_rig.h"

namespace semfield::app {

namespace {

struct PrepareVerbOptions : Options {
  using Options::Options;
  const std::string& source =
      operand("source",
              "video, or folder of photographs; folders in it are one camera each. Or a scene that has poses, or its "
              "configuration: its lens, poses and depth camera are fixed");
  const std::string& out = required("--out FOLDER", "scene to write; what was interrupted continues there");
  const long long& frames =
      value_in("--frames N", 0LL, 0, 10000, "frames to keep of a video at most; 0: three a second, 30 to 300");
  const std::string& lens =
      choice("--lens KIND", "auto", {"auto", "fisheye", "equirectangular"},
             "of the camera; auto: perspective, and a fisheye where that does not fit. equirectangular: panoramas, "
             "which are cut into eight views each");
  const int& attempts =
      value_in("--attempts N", 0, 0, kMostAttempts,
               "attempts to give every photograph a pose, at most; each takes longer than the one before. 0: 4, or as "
               "many as a finished scene was given; more than that continue it");
  const int& threads = value_in("--threads N", 0, 0, 4096, "threads of COLMAP; 0: every core");
};

struct Stopped {};

LensAsked lens_of(const std::string& word) {
  return word == "fisheye"           ? LensAsked::fisheye
         : word == "equirectangular" ? LensAsked::equirectangular
                                     : LensAsked::automatic;
}

// Programs and steps end at the first stop signal; the folder's steps remember what is done. False where it came.
template <class Work>
bool stoppable(AppContext& context, const Work& work) {
  const auto stop_if_asked = [] {
    if (stop_signal() != 0) throw Stopped{};
  };
  const Programs programs{program_in_path, [&](const std::vector<std::string>& words, const std::string& log,
                                               const std::function<void()>& tick) {
                            const int code = run_logged_child(words, log, tick);
                            stop_if_asked();
                            return code;
                          }};
  std::optional<ProgressLine> line;
  std::string shown;
  const CaptureProgress progress = [&](const CaptureStep& step, double done, double total) {
    stop_if_asked();
    if (shown != step.doing) line.emplace(context, step.doing, step.unit);
    shown = step.doing;
    line->show(done, total);
  };
  const auto note = [&](const std::string& text) {
    line.reset();
    shown.clear();
    print_note(context, text);
  };
  try {
    work(programs, progress, note);
    return true;
  } catch (const Stopped&) {
    line.reset();
    print_note(context, "stopped; the same command continues");
    return false;
  }
}

// The scene that was written, as the verb's results, with what `inspect` would say of it. `print` says it for people.
int written(const PrepareVerbOptions& options, Diagnostics& found, Json results, const std::function<void()>& print,
            AppContext& context) {
  const FolderScene scene = find_scene(options.out, "", context);
  OpenedDataset opened = dataset_of(config_of(scene, kUsualPreset), {}, context);
  const std::string geometry = load_for_labels(opened, found).geometry;
  print_findings(context, found);
  results["folder"] = options.out;
  if (context.json) {
    print_json(context, results);
  } else {
    print();
    if (!geometry.empty()) std::printf("geometry    %s\n", geometry.c_str());
  }
  if (!found.has_errors()) print_next(context, next_of_scene(scene.path, scene.name));
  return found.has_errors() ? static_cast<int>(ErrorKind::data) : 0;
}

// What a scene that has poses is fixed to.
void print_fixed(const FixedCameras& fixed, const SceneInfo& info) {
  std::printf("frames      %zu, %zu points found in several of them\n", info.frames.size(), fixed.points);
  const std::string judges = fmt::format("median over {} points that took no part", fixed.judges);
  if (fixed.kept) {
    std::printf("cameras     right: the photographs ask for no change (%.2f pixels, %s)\n", fixed.given_px,
                judges.c_str());
  } else {
    std::printf("cameras     %.2f -> %.2f pixels (%s)\n", fixed.given_px, fixed.fixed_px, judges.c_str());
  }
  if (fixed.given_on_depth >= 0)
    std::printf("depth       %.0f %% -> %.0f %% of points lie on the depth shown\n", 100 * fixed.given_on_depth,
                100 * fixed.fixed_on_depth);
  for (const std::string& change : fixed.changes) std::printf("changed     %s\n", change.c_str());
}

bool names_a_config(const std::string& source) { return source.ends_with(".yaml") || source.ends_with(".yml"); }

// The scene that a dataset reads in the folder; nothing of a video and of photographs without poses.
std::optional<FolderScene> posed_scene_in(const std::string& source, AppContext& context) {
  if (names_a_config(source)) return {};
  try {
    return find_scene(source, "", context);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::no_input) throw;
    return {};
  }
}

// Poses are there: what asks how to find them would be ignored.
void refuse_other_options(const PrepareVerbOptions& options) {
  if (options.frames == 0 && options.attempts == 0 && lens_of(options.lens) == LensAsked::automatic) return;
  throw Error(ErrorKind::usage, "capture.options.poses",
              "'" + options.source +
                  "' has poses, which are corrected; --frames, --lens and --attempts are for those "
                  "without",
              "leave them out; or copy the photographs alone into another folder, to find poses again");
}

int run_posed(const PrepareVerbOptions& options, const std::optional<FolderScene>& folder, AppContext& context) {
  refuse_other_options(options);
  OpenedDataset opened =
      folder ? dataset_of(config_of(*folder, kUsualPreset), {}, context) : dataset_of(options.source, {}, context);
  const PoseConvention convention = opened.config.load.convention;
  Diagnostics found;
  PosedScene scene;
  scene.info = opened.dataset->open(found);
  found.throw_if_errors(ErrorKind::data, "the scene cannot be prepared:");
  convert_info(scene.info, convention);
  scene.read = [&](int frame, FrameBuffer& out) {
    opened.dataset->read(frame, out);
    convert_depth(out, convention);
  };
  std::optional<FixedCameras> fixed;
  const bool whole = stoppable(context, [&](const Programs& programs, const CaptureProgress& progress, const auto&) {
    fixed = fix_cameras(scene, options.out, options.threads, programs, progress);
    write_fixed_scene(scene, *fixed, options.out, progress);
  });
  if (!whole) return 128 + stop_signal();
  std::set<std::string> left;
  for (const FrameInfo& frame : scene.info.frames) {
    for (const FrameChannelInfo& one : frame.channels) left.insert(one.name);
  }
  for (const std::string& name : left)
    found.note(
        "scene.channel.left", options.out,
        "maps of '" + name + "' are not in it: copy their files, and name them in each frame as " + name + "_path");
  return written(
      options, found,
      {{"frames", scene.info.frames.size()},
       {"points", fixed->points},
       {"kept", fixed->kept},
       {"given_px", fixed->given_px},
       {"fixed_px", fixed->fixed_px},
       {"given_on_depth", fixed->given_on_depth},
       {"fixed_on_depth", fixed->fixed_on_depth},
       {"changes", fixed->changes}},
      [&] { print_fixed(*fixed, scene.info); }, context);
}

void print_report(const PrepareReport& report) {
  if (!report.cut.empty()) std::printf("video       %s\n", report.cut.c_str());
  std::printf("photographs %zu of %d x %d pixels\n", report.photographs, report.width_px, report.height_px);
  std::printf("registered  %zu of %zu (%.0f %%), reprojection error %.2f pixels, %zu points, %d %s\n",
              report.registered, report.photographs,
              100.0 * static_cast<double>(report.registered) / static_cast<double>(report.photographs), report.error_px,
              report.points, report.attempts, report.attempts == 1 ? "attempt" : "attempts");
  for (const Missing& one : report.missing) std::printf("missing     %s\n", one.text.c_str());
}

int run(const PrepareVerbOptions& options, AppContext& context) {
  install_stop_signals(!context.quiet);
  const std::optional<FolderScene> posed = posed_scene_in(options.source, context);
  if (posed || names_a_config(options.source)) return run_posed(options, posed, context);
  PrepareReport report;
  const bool whole =
      stoppable(context, [&](const Programs& programs, const CaptureProgress& progress, const auto& note) {
        report = prepare_scene({options.source, options.out, static_cast<std::size_t>(options.frames), options.threads,
                                lens_of(options.lens), options.attempts, note},
                               programs, progress);
      });
  if (!whole) return 128 + stop_signal();
  print_findings(context, report.findings);
  std::vector<std::string> missing;
  for (const Missing& one : report.missing) missing.push_back(one.text);
  Diagnostics found;
  return written(
      options, found,
      {{"photographs", report.photographs},
       {"registered", report.registered},
       {"error_px", report.error_px},
       {"points", report.points},
       {"attempts", report.attempts},
       {"missing", missing}},
      [&] { print_report(report); }, context);
}

}  // namespace

Verb verb_prepare() {
  return make_verb<PrepareVerbOptions>("prepare", 7,
                                       "make a scene from a video or photographs, or fix the cameras of a scene", run);
}

}  // namespace semfield::app
