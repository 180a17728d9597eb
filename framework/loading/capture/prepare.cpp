#include "loading/capture/prepare.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <set>

#include "compute/parallel.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "loading/capture/photographs.h"
#include "loading/capture/reconstruct.h"
#include "scene/survey/bundle.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

struct Folders {
  fs::path images, logs, work, model;
};

// A sum of all that the steps depend on.
std::string identity_of(const CaptureSource& source, const PrepareOptions& options) {
  std::string out = source.path + "\nframes " + std::to_string(options.frames) + "\n";
  const auto add = [&](const std::string& name, const std::string& path) {
    std::error_code unknown;
    out += name + " " + std::to_string(fs::file_size(path, unknown)) + " " +
           std::to_string(fs::last_write_time(path, unknown).time_since_epoch().count()) + "\n";
  };
  if (options.lens != LensAsked::automatic) out += options.lens == LensAsked::fisheye ? "fisheye\n" : "panoramas\n";
  if (source.video) add("video", source.path);
  for (const Photograph& one : source.photographs) add(one.name, one.path);
  Sha256 sum;
  sum.add(std::as_bytes(std::span<const char>(out)));
  return sum.hex();
}

// Lists of COLMAP part names by blanks and begin a comment with '#'.
std::string plain_name(std::string name) {
  for (std::size_t i = 0; i < name.size();) {
    const std::size_t length = utf8_length(name, i);
    if (length < 1 || (length == 1 && (static_cast<unsigned char>(name[i]) <= ' ' || name[i] == '#' || name[i] == 127)))
      name[i] = '_';
    i += std::max<std::size_t>(length, 1);
  }
  return name;
}

// Two folders stay two, because each is a camera.
std::vector<std::string> plain_names(const std::vector<Photograph>& photographs) {
  std::set<fs::path> taken;
  const auto free_name = [&](const fs::path& wanted) {
    fs::path name = wanted;
    for (int k = 2; !taken.insert(name).second; ++k)
      name = wanted.parent_path() / (wanted.stem().string() + "_" + std::to_string(k) + wanted.extension().string());
    return name;
  };
  std::map<fs::path, fs::path> folders{{"", ""}};
  std::vector<std::string> out;
  for (const Photograph& one : photographs) {
    const fs::path name(one.name), folder = name.parent_path();
    if (!folders.contains(folder)) folders[folder] = free_name(plain_name(folder.string()));
    out.push_back(free_name(folders[folder] / plain_name(name.filename().string())).string());
  }
  return out;
}

void copy_whole(const std::string& from, const std::string& to) {
  AtomicFile file(to);
  const std::string bytes = read_text_file(from, std::size_t{1} << 32);
  file.append(std::as_bytes(std::span<const char>(bytes)));
  file.commit();
}

std::string cut_text(const VideoFrames& cut) {
  return fmt::format(
      "{} frames of {:.1f} s, the sharpest of each of {} intervals; {} intervals were left out because nothing had "
      "moved, {} because they were blurred",
      cut.names.size(), cut.seconds, cut.intervals, cut.still, cut.blurred);
}

// Names of the images that are brought into `folders.images`, in the order in which they were taken.
std::vector<std::string> bring_images(const CaptureSource& source, const PrepareOptions& options,
                                      const Folders& folders, PrepareState& state, const Programs& programs,
                                      const CaptureProgress& progress) {
  if (source.video) {
    if (state.done("frames") == nullptr) {
      const std::string cut_folder = (folders.work / "frames").string();
      const VideoFrames cut =
          cut_video({source.path, cut_folder, folders.logs.string(), options.frames}, programs, progress);
      fs::remove_all(folders.images);
      fs::rename(cut_folder, folders.images);
      state.mark("frames", join(cut.names, "\n"));
      state.mark("cut", cut_text(cut));
    }
    return state.lines("frames");
  }
  std::vector<std::string> names = plain_names(source.photographs);
  if (state.done("images") != nullptr) return names;
  for (std::size_t i = 0; i < names.size(); ++i) {
    progress({"copying", "photographs"}, static_cast<double>(i), static_cast<double>(names.size()));
    const fs::path to = folders.images / names[i];
    create_folders(to.parent_path().string());
    if (!fs::exists(to)) copy_whole(source.photographs[i].path, to.string());
  }
  state.mark("images");
  return names;
}

// The same of the scene: of panoramas, their views.
std::vector<std::string> bring_views(const CaptureSource& source, const PrepareOptions& options, const Folders& folders,
                                     PrepareState& state, const Programs& programs, const CaptureProgress& progress) {
  if (options.lens != LensAsked::equirectangular)
    return bring_images(source, options, folders, state, programs, progress);
  if (state.done("views") == nullptr) {
    Folders whole = folders;
    whole.images = folders.work / "panoramas";
    const std::string views = (folders.work / "views").string();
    const std::vector<std::string> names =
        cut_panoramas({bring_images(source, options, whole, state, programs, progress), whole.images.string(), views,
                       folders.logs.string()},
                      programs, progress);
    fs::remove_all(folders.images);
    fs::rename(views, folders.images);
    state.mark("views", join(names, "\n"));
    fs::remove_all(whole.images);
  }
  return state.lines("views");
}

// Of the images without a pose, those that are much less sharp than those with one.
std::vector<std::string> blurred_among_missing(const std::vector<std::string>& names, const FoundModel& model,
                                               const fs::path& images) {
  if (model.images.size() == names.size()) return {};
  std::vector<double> sharp(names.size());
  parallel_for(static_cast<std::int64_t>(names.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    try {
      sharp[i] = sharpness_of((images / names[i]).string());
    } catch (const Error&) {
      sharp[i] = 0;  // what cannot be decoded has no sharpness
    }
  });
  const auto has_pose = [&](const std::string& name) {
    return std::binary_search(model.images.begin(), model.images.end(), name);
  };
  std::vector<double> of_posed;
  for (std::size_t i = 0; i < names.size(); ++i) {
    if (has_pose(names[i])) of_posed.push_back(sharp[i]);
  }
  const double least = kBlurredShare * median_of(of_posed);
  std::vector<std::string> out;
  for (std::size_t i = 0; i < names.size(); ++i) {
    if (!has_pose(names[i]) && sharp[i] < least) out.push_back(names[i]);
  }
  return out;
}

// The model appears whole or not at all; one of fewer attempts makes room for it.
void publish(const FoundModel& model, const Folders& folders) {
  const fs::path fresh = folders.work / "model";
  fs::remove_all(fresh);
  create_folders(fresh.string());
  for (const char* name : {"cameras.bin", "images.bin", "points3D.bin"})
    copy_whole((fs::path(model.folder) / name).string(), (fresh / name).string());
  create_folders(folders.model.parent_path().string());
  const fs::path old = folders.work / "model_before";
  fs::remove_all(old);
  std::error_code failed;
  if (fs::exists(folders.model)) fs::rename(folders.model, old, failed);
  if (failed) throw write_error("rename", folders.model.string(), failed.value());
  fs::rename(fresh, folders.model, failed);
  if (failed) throw write_error("rename", folders.model.string(), failed.value());
  sync_folder_of(folders.model.string());
}

}  // namespace

PrepareReport prepare_scene(const PrepareOptions& options, const Programs& programs, const CaptureProgress& progress) {
  PrepareReport report;
  const CaptureSource source = look_at_source(options.source);
  check_photographs(source, report.findings);
  report.findings.throw_if_errors(ErrorKind::data, "the photographs cannot be one scene:");
  for (const char* name : {"colmap", "ffmpeg", "ffprobe"}) {
    const bool cuts = source.video || options.lens == LensAsked::equirectangular;
    if (cuts || std::string_view(name) == "colmap") (void)program_file(programs, name);
  }
  const std::string scene = fs::absolute(options.out).lexically_normal().string();
  if (!source.video && (scene + "/").starts_with(source.path + "/"))
    throw Error(ErrorKind::cannot_create, "capture.scene.inside",
                "the scene '" + scene + "' would lie in the folder of the photographs, which is never written to",
                "name a folder next to it with --out");
  const PrepareFolder folder(scene);
  const Folders folders{fs::path(scene) / "images", folder.logs(), folder.work(), fs::path(scene) / "sparse" / "0"};
  PrepareState state = folder.steps(identity_of(source, options));
  if (const std::string* refined = state.done("refined");
      refined != nullptr && state.done("published") == nullptr && fs::exists(folders.model))
    state.mark("published", std::string(*refined));

  const std::vector<std::string> names = bring_views(source, options, folders, state, programs, progress);
  if (const std::string* cut = state.done("cut")) report.cut = *cut;
  report.photographs = names.size();
  const ImageSize size = image_size((folders.images / names.front()).string());
  report.width_px = size.width_px;
  report.height_px = size.height_px;
  const ColmapSteps colmap(programs, progress, folders.images.string(), folders.work.string(), folders.logs.string(),
                           options.threads > 0 ? options.threads : hardware_threads());
  const Reconstruction found =
      reconstruct({.names = names,
                   .in_order = source.video,
                   .camera_per_folder = source.camera_per_folder && options.lens != LensAsked::equirectangular,
                   .work = folders.work.string(),
                   .lens = options.lens,
                   .attempts = options.attempts,
                   .note = options.note},
                  colmap, state);
  report.registered = found.best.images.size();
  report.points = found.best.points;
  report.error_px = found.best.error_px;
  report.attempts = found.attempts;
  report.missing = missing_images(names, found, blurred_among_missing(names, found.best, folders.images));
  const std::string refined = *state.done("refined"), *const published = state.done("published");
  if (!fs::exists(folders.model) || published == nullptr || *published != refined) {
    publish(found.best, folders);
    state.mark("published", refined);
  }
  for (const fs::directory_entry& entry : sorted_folder(folders.work.string())) {
    if (entry.path().extension() == ".db") fs::remove(entry.path());
  }
  return report;
}

}  // namespace semfield
