// Loading a scene: open, read in parallel, scale, count.
#include "scene/loading/frame_source.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <mutex>
#include <optional>
#include <set>

#include "compute/parallel.h"
#include "core/check.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"

namespace semfield {

namespace {

// Pixels of each class, the last entry void; empty without labels.
std::vector<std::int64_t> class_pixels_of(const std::vector<std::int16_t>& label, int classes) {
  if (label.empty()) return {};
  const auto valid = static_cast<std::size_t>(classes);
  std::vector<std::int64_t> counts(valid + 1);
  for (const std::int16_t c : label) ++counts[c < 0 ? valid : static_cast<std::size_t>(c)];
  return counts;
}

// A label that is no class would be counted, trained on and scored as one.
void check_labels(const FrameBuffer& b, int classes) {
  const auto bad = std::find_if(b.label.begin(), b.label.end(),
                                [classes](std::int16_t c) { return c != kVoid && (c < 0 || c >= classes); });
  if (bad == b.label.end()) return;
  const auto at = bad - b.label.begin();
  throw Error(ErrorKind::data, "plugin.dataset.label",
              fmt::format("label {} at x {}, y {} is not a class; classes are 0 to {} and void is {}", *bad,
                          at % b.width_px, at / b.width_px, classes - 1, kVoid),
              "this is a defect of the dataset plugin: it maps ids to classes");
}

// Pixels that do not count: masks at another size, and pixels through which a lens has no ray. A lens whose border
// pixels all have rays has one for every pixel: what it bends lies between the axis and the border.

// `used` [from.height * from.width] at a size of at most its own: a pixel is masked where any masked one falls into it,
// so that none of what is masked shines through. An empty mask stays empty.
std::vector<std::uint8_t> reduced_mask(const std::vector<std::uint8_t>& used, const ImageSize& from,
                                       const ImageSize& to) {
  if (used.empty()) return {};
  std::vector<std::uint8_t> out(pixel_at(0, to.height_px, to.width_px), 1);
  // Of the pixels `from`, those that pixel `at` of `to` covers a part of.
  const auto covered = [](std::int64_t at, std::int64_t size, std::int64_t many) {
    return std::pair{at * many / size, ((at + 1) * many + size - 1) / size};
  };
  parallel_for(to.height_px, [&](std::int64_t y) {
    const auto [top, bottom] = covered(y, to.height_px, from.height_px);
    for (std::int64_t x = 0; x < to.width_px; ++x) {
      const auto [left, right] = covered(x, to.width_px, from.width_px);
      for (std::int64_t row = top; row < bottom; ++row) {
        const auto begin = used.begin() + row * from.width_px;
        if (std::find(begin + left, begin + right, std::uint8_t{0}) != begin + right)
          out[pixel_at(x, y, to.width_px)] = 0;
      }
    }
  });
  return out;
}

bool has_ray(const Camera& camera, std::int64_t x, std::int64_t y) {
  return !(camera.direction(static_cast<double>(x) + 0.5, static_cast<double>(y) + 0.5) == Vec3d{0, 0, 0});
}

bool has_rays_along_border(const Camera& camera) {
  const std::int64_t right = camera.width_px - 1, bottom = camera.height_px - 1;
  for (std::int64_t x = 0; x <= right; ++x)
    if (!has_ray(camera, x, 0) || !has_ray(camera, x, bottom)) return false;
  for (std::int64_t y = 0; y <= bottom; ++y)
    if (!has_ray(camera, 0, y) || !has_ray(camera, right, y)) return false;
  return true;
}

// Pixels without a ray, of each lens that has any.
class LensMasks {
 public:
  // Cameras at the loaded size; one without a size is passed over.
  explicit LensMasks(const std::vector<Camera>& cameras) {
    std::vector<Camera> known;
    for (const Camera& camera : cameras) {
      if (camera.width_px == 0 || !camera.has_distortion() ||
          std::find(known.begin(), known.end(), camera) != known.end())
        continue;
      known.push_back(camera);
      if (has_rays_along_border(camera)) continue;
      std::vector<std::uint8_t> used(pixel_at(0, camera.height_px, camera.width_px));
      parallel_for(camera.height_px, [&](std::int64_t y) {
        for (std::int64_t x = 0; x < camera.width_px; ++x)
          used[pixel_at(x, y, camera.width_px)] = has_ray(camera, x, y) ? 1 : 0;
      });
      masks_.emplace_back(camera, std::move(used));
    }
  }
  // Masks them in a frame of that camera.
  void add_to(const Camera& camera, FrameBuffer& frame) const {
    const auto own = std::find_if(masks_.begin(), masks_.end(), [&](const auto& mask) { return mask.first == camera; });
    if (own == masks_.end()) return;
    if (frame.used.empty()) frame.used.assign(own->second.size(), 1);
    for (std::size_t i = 0; i < frame.used.size(); ++i) frame.used[i] = frame.used[i] & own->second[i];
  }

 private:
  std::vector<std::pair<Camera, std::vector<std::uint8_t>>> masks_;
};

// Whether a frame's depth stays in memory.
bool keeps_depth(const SceneLoadOptions& options, Split split) {
  return options.depth == DepthKept::all || (options.depth == DepthKept::test && split == Split::test);
}

// Further channels teach, so those of training frames alone are read.
bool wants_channel(const SceneLoadOptions& options, const FrameInfo& f, const std::string& name) {
  return f.split == Split::train &&
         std::find(options.channels.begin(), options.channels.end(), name) != options.channels.end();
}

// How many numbers a further channel has.
template <class Channel>
std::size_t values_of(const Channel& one) {
  return pixel_at(0, one.height, one.width) * static_cast<std::size_t>(one.cols);
}

// What StoredFrame will hold of a frame, if its depth is in whole millimetres.
std::size_t stored_bytes(const FrameInfo& f, const Camera& camera, const SceneLoadOptions& options, int classes) {
  const std::size_t pixels = pixel_at(0, camera.height_px, camera.width_px);
  std::size_t each = 3;
  if (f.has_labels) each += classes > 254 ? 2 : 1;
  if (f.has_depth && keeps_depth(options, f.split)) each += 2;
  if (f.has_instances && options.with_instances) each += 4;
  std::size_t bytes = pixels * each;
  for (const FrameChannelInfo& one : f.channels) {
    if (!wants_channel(options, f, one.name)) continue;
    bytes += one.name == kAlphaChannel ? pixels : values_of(one) * sizeof(float);
  }
  return bytes;
}

void check_alpha(const FrameChannel& alpha, const FrameInfo& f) {
  if (alpha.width != f.camera.width_px || alpha.height != f.camera.height_px || alpha.cols != 1)
    throw Error(
        ErrorKind::data, "scene.alpha.size",
        fmt::format("channel 'alpha' is {} with {} numbers, and the image {}", size_text(alpha.width, alpha.height),
                    alpha.cols, size_text(f.camera.width_px, f.camera.height_px)),
        "give one number for each pixel of the image, 0 to 1");
  const auto bad = std::find_if(alpha.values.begin(), alpha.values.end(), [](float a) { return a < 0 || a > 1; });
  if (bad == alpha.values.end()) return;
  const auto at = bad - alpha.values.begin();
  throw Error(ErrorKind::data, "scene.alpha.range",
              fmt::format("channel 'alpha' is {} at x {}, y {}", shortest_number(static_cast<double>(*bad)),
                          at % alpha.width, at / alpha.width),
              "scale it to 0 (nothing of the subject) to 1 (the subject alone)");
}

constexpr const char* kDefect = "this is a defect of the dataset plugin";

// Every channel that was asked for, as open() told, and finite.
void check_channels(const FrameBuffer& b, const FrameInfo& f, std::size_t wanted) {
  if (b.channels.size() != wanted)
    throw Error(ErrorKind::internal, "plugin.dataset.channels",
                "dataset delivered other channels than those that were wanted", kDefect);
  for (const FrameChannel& one : b.channels) {
    const auto told = std::find_if(f.channels.begin(), f.channels.end(),
                                   [&](const FrameChannelInfo& info) { return info.name == one.name; });
    if (told == f.channels.end() || told->height != one.height || told->width != one.width || told->cols != one.cols ||
        one.values.size() != values_of(one))
      throw Error(ErrorKind::internal, "plugin.dataset.channels",
                  "dataset delivered another channel '" + one.name + "' than open() told", kDefect);
    if (!std::all_of(one.values.begin(), one.values.end(), [](float v) { return std::isfinite(v); }))
      throw Error(ErrorKind::data, "scene.channel.not_finite",
                  "channel '" + one.name + "' holds a value that is not finite", "write 0 where nothing is known");
    if (one.name == kAlphaChannel) check_alpha(one, f);
  }
}

void check_buffer(const FrameBuffer& b, const FrameInfo& f) {
  const std::size_t pixels = pixel_at(0, f.camera.height_px, f.camera.width_px);
  const auto fits = [pixels](std::size_t size, bool wanted) { return size == (wanted ? pixels : 0); };
  if (b.width_px != f.camera.width_px || b.height_px != f.camera.height_px || b.rgb.size() != pixels * 3 ||
      !fits(b.depth_m.size(), f.has_depth) || !fits(b.label.size(), f.has_labels) ||
      !fits(b.instance.size(), f.has_instances) || !fits(b.used.size(), !b.used.empty()))
    throw Error(ErrorKind::internal, "plugin.dataset.channels",
                "dataset delivered other channels or sizes than open() told", kDefect);
}

constexpr double kMostDistance_m = 1e12, kMostCoordinate_m = 1e13;
constexpr double kStray = 1e5;  // times the distance of the others from their middle, or of what cameras see

struct StrayCamera {
  const FrameInfo* frame = nullptr;  // null: none is
  double away_m = 0;                 // from the middle of the others
  bool sees_too_near = false;        // the others may be as far away, for what they see
};

// The camera that stands so far from the others that bounds would be made for it alone, or that it shares nothing with
// them.
StrayCamera stray_camera(const LoadedScene& scene) {
  std::vector<const FrameInfo*> cameras;
  for (const FrameInfo& frame : scene.info.frames)
    if (frame.split != Split::unused && std::isfinite(length(frame.world_from_camera.t))) cameras.push_back(&frame);
  if (cameras.size() < 2) return {};
  std::vector<double> values(cameras.size());
  const auto median = [&](const auto& of) {
    std::transform(cameras.begin(), cameras.end(), values.begin(), of);
    return median_of(values);
  };
  Vec3d middle;
  for (int a = 0; a < 3; ++a) middle[a] = median([&](const FrameInfo* f) { return f->world_from_camera.t[a]; });
  const auto distance = [&](const FrameInfo* f) { return length(f->world_from_camera.t - middle); };
  const double usual = median(distance);
  const FrameInfo* farthest =
      *std::max_element(cameras.begin(), cameras.end(),
                        [&](const FrameInfo* a, const FrameInfo* b) { return distance(a) < distance(b); });
  const double away_m = distance(farthest);
  if (cameras.size() > 2 && usual > 0 && away_m > kStray * usual) return {farthest, away_m, false};
  // Where nothing tells what they see, unit_m is of the extent of the cameras themselves: none is so far away.
  return away_m > kStray * 2 * scene.unit_m ? StrayCamera{farthest, away_m, true} : StrayCamera{};
}

// What is derived keeps to the limits of what can be written: a run stores it as settings, and reads it again.
void check_extent(const LoadedScene& scene, Diagnostics& diagnostics) {
  double reach = 0;
  bool finite = std::isfinite(scene.far_m);
  for (int a = 0; a < 3; ++a) {
    finite = finite && std::isfinite(scene.bounds.lo[a]) && std::isfinite(scene.bounds.hi[a]);
    reach = std::max({reach, std::abs(scene.bounds.lo[a]), std::abs(scene.bounds.hi[a])});
  }
  if (!finite || scene.bounds.empty()) return;  // reported already
  const auto with_unit = [&](double value) { return shortest_number(value) + (scene.info.metric ? " m" : " units"); };
  if (const StrayCamera stray = stray_camera(scene); stray.frame != nullptr)
    return diagnostics.error("scene.pose.far", frame_place(*stray.frame),
                             fmt::format("its camera is {} from the middle of the others, more than {} times as far as "
                                         "{}",
                                         with_unit(stray.away_m), shortest_number(kStray),
                                         stray.sees_too_near ? "what cameras see" : "they are"),
                             "leave the stray pose out");
  if (scene.far_m <= kMostDistance_m && reach <= kMostCoordinate_m) return;
  std::string remedy = "leave a stray pose out, or divide all poses and depths by one factor";
  double camera_at = 0;
  const FrameInfo* farthest = nullptr;
  for (const FrameInfo& frame : scene.info.frames) {
    const double at = length(frame.world_from_camera.t);
    if (frame.split != Split::train || at < camera_at) continue;
    camera_at = at;
    farthest = &frame;
  }
  if (farthest != nullptr)
    remedy = fmt::format("the farthest camera is that of {}, {} from the origin: {}", frame_place(*farthest),
                         with_unit(camera_at), remedy);
  diagnostics.error("scene.pose.far", scene.info.name,
                    scene.far_m > kMostDistance_m
                        ? fmt::format("far is {} (from {}), at most {} are sampled", with_unit(scene.far_m),
                                      scene.near_far_from, shortest_number(kMostDistance_m))
                        : fmt::format("coordinates reach {} (bounds from {}), at most {} are used", with_unit(reach),
                                      scene.bounds_from, shortest_number(kMostCoordinate_m)),
                    remedy);
}

}  // namespace

void describe(ParamVisitor& visit, SceneLoadOptions& p) {
  SEMFIELD_PARAM(visit, p, width_px, "width to load frames at, pixels; 0 = as stored, or in proportion to height_px",
                 {0, 1 << 20});
  SEMFIELD_PARAM(visit, p, height_px, "height to load frames at, pixels; 0 = as stored, or in proportion to width_px",
                 {0, 1 << 20});
  SEMFIELD_PARAM(visit, p, downscale, "divides width and height of every frame", {1, 64});
  SEMFIELD_PARAM(visit, p, near_m,
                 "nearest distance along a ray that is sampled, metres; 0 = from the dataset or derived",
                 {0, kMostDistance_m});
  SEMFIELD_PARAM(visit, p, far_m,
                 "farthest distance along a ray that is sampled, metres; 0 = from the dataset or derived",
                 {0, kMostDistance_m});
  SEMFIELD_PARAM(visit, p, bounds, "world box of the content, metres: [x0, y0, z0, x1, y1, z1]; empty = derived",
                 {-kMostCoordinate_m, kMostCoordinate_m});
  SEMFIELD_PARAM(
      visit, p.convention, flip_camera_axes,
      "the files have OpenGL camera axes where the dataset expects OpenCV's, or the reverse: y and z are flipped");
  SEMFIELD_PARAM(
      visit, p.convention, invert_poses,
      "the poses in the files are the inverse of what the dataset expects, usually world-to-camera matrices: they "
      "are inverted");
  SEMFIELD_PARAM(visit, p.convention, pose_scale, "multiplies camera centres; 0.001 for poses in millimetres",
                 {1e-9, 1e9});
  SEMFIELD_PARAM(visit, p.convention, depth_scale,
                 "multiplies depth as read; 1000 for metres that were read as millimetres", {1e-9, 1e9});
  SEMFIELD_PARAM(visit, p, check_geometry,
                 "whether poses that contradict depth or photographs, and bounds that no ray meets, are refused");
  SEMFIELD_PARAM(
      visit, p, probe_steps,
      "steps of a short training whose depth replaces bounds and far that were guessed from the cameras; only "
      "in runs of at least four times as many steps; 0 = no probe",
      {0, 1e6});
  SEMFIELD_PARAM(visit, p, hold_out,
                 "every N-th training frame is held out for scores, and the scene's test frames are left out, so that "
                 "settings can be chosen without them; 0 = the scene's own test frames",
                 {0, 1e6});
}

void validate(const SceneLoadOptions& p, Diagnostics& diagnostics) {
  if (p.downscale != 1 && (p.width_px > 0 || p.height_px > 0))
    diagnostics.error("config.value.conflict", "scene.load.downscale",
                      "downscale and width_px or height_px exclude each other", "keep one of them");
  if (p.near_m > 0 && p.far_m > 0 && p.near_m >= p.far_m)
    diagnostics.error("config.value.order", "scene.load.near_m", "near_m must be below far_m", "swap them");
  if (!p.bounds.empty() && p.bounds.size() != 6)
    diagnostics.error("config.value.length", "scene.load.bounds",
                      "expected 6 numbers, got " + std::to_string(p.bounds.size()), "write [x0, y0, z0, x1, y1, z1]");
  for (std::size_t i = 0; i < 3 && p.bounds.size() == 6; ++i)
    if (!(p.bounds[i] < p.bounds[i + 3]))
      diagnostics.error("config.value.order", "scene.load.bounds",
                        "the first corner must be below the second on every axis", "swap them");
}

namespace {

// Scores come from training frames, evenly spaced in their order, and the test frames are not looked at.
void hold_out_training_frames(std::vector<FrameInfo>& frames, std::int32_t every, Diagnostics& diagnostics) {
  const auto trains = [](const FrameInfo& frame) { return frame.split == Split::train; };
  const auto count = static_cast<std::int32_t>(std::count_if(frames.begin(), frames.end(), trains));
  const std::int32_t apart = std::min(every, count);
  if (apart < 2)
    diagnostics.error("scene.split.empty", "scene.load.hold_out", "leaves no frame to train on", "set 2 or more");
  std::int32_t rank = 0;
  for (FrameInfo& frame : frames) {
    if (trains(frame)) {
      if (rank++ % apart == apart / 2) frame.split = Split::test;
    } else {
      frame.split = Split::unused;
    }
  }
}

}  // namespace

bool scaled_camera(const Camera& camera, const SceneLoadOptions& options, Camera& out) {
  double width = camera.width_px / options.downscale, height = camera.height_px / options.downscale;
  if (options.width_px > 0) width = options.width_px;
  if (options.height_px > 0) height = options.height_px;
  if (options.width_px > 0 && options.height_px == 0) height = width * camera.height_px / camera.width_px;
  if (options.height_px > 0 && options.width_px == 0) width = height * camera.width_px / camera.height_px;
  const auto w = static_cast<std::int32_t>(std::max(1L, std::lround(width)));
  const auto h = static_cast<std::int32_t>(std::max(1L, std::lround(height)));
  if (w > camera.width_px || h > camera.height_px) return false;
  out = camera.resized(w, h);
  return true;
}

FrameBuffer resize_frame(const FrameBuffer& frame, std::int32_t width, std::int32_t height) {
  if (width == frame.width_px && height == frame.height_px) return frame;
  FrameBuffer out;
  out.width_px = width;
  out.height_px = height;
  out.rgb = resize_area({frame.width_px, frame.height_px, 3, frame.rgb}, width, height).pixels;
  const ImageSize from{frame.width_px, frame.height_px}, to{width, height};
  out.depth_m = at_nearest_pixels(frame.depth_m, from, to);
  out.label = at_nearest_pixels(frame.label, from, to);
  out.instance = at_nearest_pixels(frame.instance, from, to);
  out.used = reduced_mask(frame.used, from, to);
  out.channels = frame.channels;  // their grids are their own, but that of alpha
  for (FrameChannel& one : out.channels)
    if (one.name == kAlphaChannel)
      one =
          alpha_channel(width, height, resize_area({one.width, one.height, 1, alpha_bytes(one)}, width, height).pixels);
  return out;
}

std::vector<int> LoadedScene::frames_of(Split split) const {
  std::vector<int> out;
  for (std::size_t i = 0; i < info.frames.size(); ++i)
    if (info.frames[i].split == split) out.push_back(static_cast<int>(i));
  return out;
}

LoadedScene load_scene(const SceneReader& reader, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  LoadedScene scene;
  const struct AtTheEnd {
    ~AtTheEnd() { tell_load_progress("read", 0, 0); }
  } whatever_happens;
  validate(options, diagnostics);
  SEMFIELD_CHECK(options.pixels || (options.bounds.size() == 6 && options.near_m > 0 && options.far_m > 0),
                 "without pixels, bounds and distances must be given");
  SceneInfo as_opened = reader.open(diagnostics);
  if (options.hold_out > 0 && !as_opened.frames.empty())
    hold_out_training_frames(as_opened.frames, options.hold_out, diagnostics);
  scene.info = as_opened;
  convert_info(scene.info, options.convention);
  check_manifest_numbers(scene.info, diagnostics);
  check_poses_differ(scene.info, diagnostics);
  check_output_names(scene.info, diagnostics);
  std::vector<FrameInfo>& frames = scene.info.frames;
  check_input_limit(std::ssize(frames), input_limits().frames, "scene '" + scene.info.name + "': ", "frames", "frames");
  if (frames.empty() && !diagnostics.has_errors())
    diagnostics.error("scene.frames.none", scene.info.name, "the scene has no frames", "check the path");
  if (frames.size() == 1 && options.pixels && !diagnostics.has_errors())
    diagnostics.error("scene.frames.single", frame_place(frames[0]),
                      "is the only frame of the scene; shape needs views from several places",
                      "give two frames at least, better some dozens");
  scene.frames.resize(frames.size());
  scene.depth_pixels.resize(frames.size());
  // Why there are no classes is told already; every labelled frame would only tell it again.
  const bool labels_can_be_read = !scene.info.classes.empty() || !diagnostics.has_errors();
  for (FrameInfo& frame : frames) frame.has_labels = frame.has_labels && labels_can_be_read;

  // A frame whose files already failed a check would only fail again.
  std::set<std::string> failed;
  for (const Diagnostic& d : diagnostics.all())
    if (d.severity == Severity::error) failed.insert(d.where);
  std::vector<std::optional<Error>> errors(frames.size());
  std::vector<std::optional<UnknownLabelError>> unknown(frames.size());
  bool stretched = false;
  std::vector<Camera> cameras(frames.size());
  for (std::size_t i = 0; i < frames.size(); ++i) {
    const std::string place = frame_place(frames[i]);
    if (failed.count(place) > 0) continue;
    if (!scaled_camera(frames[i].camera, options, cameras[i])) {
      diagnostics.error("scene.load.size", place,
                        fmt::format("frame is {} x {} pixels, smaller than the size asked for",
                                    frames[i].camera.width_px, frames[i].camera.height_px),
                        "ask for at most the stored size");
      continue;
    }
    const double stretch = cameras[i].fx / frames[i].camera.fx * frames[i].camera.fy / cameras[i].fy;
    stretched = stretched || std::abs(stretch - 1) > 0.01;
  }
  if (stretched)
    diagnostics.warning("scene.load.aspect", "scene.load.width_px",
                        "the size asked for changes the aspect ratio; cameras follow it",
                        "give scene.load.width_px or scene.load.height_px alone");

  if (!options.pixels) {
    for (std::size_t i = 0; i < frames.size(); ++i)
      if (cameras[i].width_px > 0) frames[i].camera = cameras[i];
    scene.class_pixels.resize(frames.size());
    scene.near_m = options.near_m;
    scene.far_m = options.far_m;
    scene.bounds = box_of(options.bounds);
    scene.bounds_from = scene.near_far_from = "the configuration";
    return scene;
  }
  std::int64_t train_pixels = 0;
  for (std::size_t i = 0; i < frames.size(); ++i)
    if (frames[i].split == Split::train) train_pixels += std::int64_t{cameras[i].width_px} * cameras[i].height_px;
  if (options.before_pixels) {
    std::size_t bytes = 0;
    for (std::size_t i = 0; i < frames.size(); ++i)
      bytes += stored_bytes(frames[i], cameras[i], options, scene.info.classes.valid_count());
    options.before_pixels(bytes, frames.size());
  }
  const std::int32_t step = survey_step(train_pixels);
  std::vector<SurveyPoints> surveyed(frames.size());
  const int classes = scene.info.classes.valid_count();
  scene.class_pixels.assign(frames.size(), {});
  std::optional<GeometrySurvey> geometry;
  if (options.check_geometry) geometry.emplace(as_opened, cameras, options.convention, options.exposure);
  const LensMasks without_ray(cameras);
  std::atomic<std::size_t> read{0};
  parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    tell_load_progress("reading", ++read, frames.size());
    if (cameras[i].width_px == 0) return;
    try {
      FrameBuffer frame;
      for (const FrameChannelInfo& one : frames[i].channels)
        if (wants_channel(options, frames[i], one.name)) frame.wanted.push_back(one.name);
      const std::size_t wanted = frame.wanted.size();
      reader.read(static_cast<int>(i), frame);
      check_channels(frame, frames[i], wanted);
      if (!labels_can_be_read) frame.label = std::vector<std::int16_t>();
      check_buffer(frame, frames[i]);
      convert_depth(frame, options.convention);
      check_labels(frame, classes);
      // A vector assigned {} keeps its memory; one that is moved from another does not.
      if (!options.with_instances) frame.instance = std::vector<std::int32_t>();
      const bool same = cameras[i].width_px == frame.width_px && cameras[i].height_px == frame.height_px;
      hide_masked(frame);
      if (!same) frame = resize_frame(frame, cameras[i].width_px, cameras[i].height_px);
      without_ray.add_to(cameras[i], frame);
      hide_masked(frame);
      scene.class_pixels[i] = class_pixels_of(frame.label, classes);
      scene.depth_pixels[i] = std::count_if(frame.depth_m.begin(), frame.depth_m.end(), [](float z) { return z > 0; });
      if (frames[i].split == Split::train && !frame.depth_m.empty())
        surveyed[i] = survey_frame(cameras[i], frames[i].world_from_camera, frame, step);
      if (geometry) geometry->look_at(i, cameras[i], frame);
      if (!keeps_depth(options, frames[i].split)) frame.depth_m = std::vector<float>();
      scene.frames[i] = StoredFrame(std::move(frame));
    } catch (const UnknownLabelError& e) {
      unknown[i] = e;
    } catch (const Error& e) {
      errors[i] = e;
    }
  });
  for (std::size_t i = 0; i < frames.size(); ++i) {
    if (errors[i])
      diagnostics.error(errors[i]->code(), frame_place(frames[i]), errors[i]->message(), errors[i]->remedy());
    if (cameras[i].width_px > 0) frames[i].camera = cameras[i];
    if (!options.with_instances) frames[i].has_instances = false;
  }
  report_unknown_labels(frames, unknown, diagnostics);
  const std::vector<int> train = scene.frames_of(Split::train);
  const auto is_masked = [&](int f) {
    const StoredFrame& frame = scene.frames[static_cast<std::size_t>(f)];
    return !frame.mask.empty() && frame.is_unusable();
  };
  if (!train.empty() && std::all_of(train.begin(), train.end(), is_masked))
    diagnostics.error("scene.mask.all", scene.info.name, "every pixel of the training frames is masked",
                      "check which value of the masks means 'use': black (0) is masked, anything else counts");
  const int before = diagnostics.error_count();
  if (geometry) {
    GeometryVerdict verdict = geometry->conclude(diagnostics);
    scene.geometry = std::move(verdict.text);
    scene.corners = std::move(verdict.corners);
    scene.exposure = verdict.exposure;
    scene.cameras = std::move(verdict.cameras);
    scene.depth_beside = verdict.depth_beside;
  }
  // What poses of another convention do to bounds and distances would hide the cause.
  Diagnostics consequences;
  Diagnostics& heard = diagnostics.error_count() > before ? consequences : diagnostics;
  derive_extent(scene, std::move(surveyed), options, heard);
  check_extent(scene, heard);
  return scene;
}

namespace {

// Of the process, since several sessions may report to one listener.
std::mutex g_telling;

}  // namespace

void tell_load_progress(std::string_view doing, std::size_t done, std::size_t total) {
  const std::lock_guard lock(g_telling);
  if (const LoadProgress* told = work_settings().load_progress; told != nullptr && *told) (*told)(doing, done, total);
}

// Bounds, near, far and pixel footprint of a scene, from what it holds.

namespace {

struct DepthSurvey {
  Box box;                       ///< of the back-projected points, metres
  std::vector<float> distances;  ///< along the ray
  std::int64_t looked_at = 0, valid = 0;
};

// The outermost `lost` of a coordinate over all frames are dropped. `parts` is emptied.
DepthSurvey survey_depth(std::vector<SurveyPoints>& parts, double lost = 0.001) {
  DepthSurvey out;
  for (const SurveyPoints& p : parts) out.looked_at += p.looked_at;
  std::vector<float> SurveyPoints::*const columns[4] = {&SurveyPoints::x, &SurveyPoints::y, &SurveyPoints::z,
                                                        &SurveyPoints::distance};
  parallel_for(4, [&](std::int64_t column) {
    std::vector<float> all;
    for (SurveyPoints& p : parts) {
      std::vector<float>& part = p.*columns[column];
      all.insert(all.end(), part.begin(), part.end());
      part = std::vector<float>();
    }
    if (column == 3) {
      out.distances = std::move(all);
    } else if (!all.empty()) {
      out.box.lo[static_cast<int>(column)] = quantile(all, lost);
      out.box.hi[static_cast<int>(column)] = quantile(all, 1 - lost);
    }
  });
  out.valid = static_cast<std::int64_t>(out.distances.size());
  return out;
}

void include_frustum(Box& box, const FrameInfo& frame, double distance_m) {
  box.include(frame.world_from_camera.t);
  if (frame.camera.is_wide()) {  // it may see all around
    for (const double side : {-distance_m, distance_m})
      box.include(frame.world_from_camera.t + Vec3d{side, side, side});
    return;
  }
  for (int corner = 0; corner < 5; ++corner) {
    const double u = corner == 4 ? 0.5 : corner % 2, v = corner == 4 ? 0.5 : corner / 2;
    const Vec3d d = frame.camera.direction(u * frame.camera.width_px, v * frame.camera.height_px);
    box.include(frame.world_from_camera.apply(d * distance_m));
  }
}

// `away`: how far off it is seen, which stands for the size of a single point.
void grow(Box& box, double share, double away) {
  const Vec3d size = box.size();
  const double longest = std::max({size.x, size.y, size.z});
  const double least = 0.01 * (longest > 0 ? longest : away);  // a flat scene still gets a thickness
  for (int a = 0; a < 3; ++a) {
    const double margin = std::max(size[a] * share, least);
    box.lo[a] -= margin;
    box.hi[a] += margin;
  }
}

}  // namespace

Box box_of(const std::vector<double>& corners) {
  Box box;
  box.lo = {corners[0], corners[1], corners[2]};
  box.hi = {corners[3], corners[4], corners[5]};
  return box;
}

std::int32_t survey_step(std::int64_t pixels) {
  constexpr std::int64_t kMostPoints = std::int64_t{1} << 20;
  std::int32_t step = 4;
  while (pixels / (std::int64_t{step} * step) > kMostPoints) step *= 2;
  return step;
}

SurveyPoints survey_frame(const Camera& camera, const Pose& world_from_camera, const FrameBuffer& frame,
                          std::int32_t step) {
  SurveyPoints out;
  for (std::int32_t y = step / 2; y < frame.height_px; y += step) {
    for (std::int32_t x = step / 2; x < frame.width_px; x += step) {
      ++out.looked_at;
      const float depth = frame.depth_m[pixel_at(x, y, frame.width_px)];
      if (!(depth > 0) || !std::isfinite(depth)) continue;
      const Vec3d d = camera.direction(x + 0.5, y + 0.5);
      const double share = camera.depth_of(d);
      if (!(share > 0)) continue;
      const double t = depth / share;
      out.add(world_from_camera.apply(d * t), t);
    }
  }
  return out;
}

namespace {

// Rays of the training frames against bounds, near and far.

constexpr std::size_t kFrames = 64;
constexpr int kColumns = 12, kRows = 9;
constexpr double kFew = 0.05;

std::string box_text(const Box& box) {
  const auto& [lo, hi] = box;
  return fmt::format("[{:.4g},{:.4g},{:.4g},{:.4g},{:.4g},{:.4g}]", lo.x, lo.y, lo.z, hi.x, hi.y, hi.z);
}

struct RayCounts {
  int rays = 0, meet_box = 0, sampled = 0;
  double nearest = 1e300, farthest = 0;  ///< where rays are inside of the box
};

RayCounts count_rays(const LoadedScene& scene, const std::vector<int>& usable) {
  RayCounts out;
  const std::size_t frames = std::min(usable.size(), kFrames);
  for (std::size_t k = 0; k < frames; ++k) {
    const FrameInfo& frame = scene.info.frames[static_cast<std::size_t>(usable[k * usable.size() / frames])];
    for (int i = 0; i < kColumns * kRows; ++i) {
      const Vec3d local = frame.camera.direction((i % kColumns + 0.5) * frame.camera.width_px / kColumns,
                                                 (i / kColumns + 0.5) * frame.camera.height_px / kRows);
      if (!(frame.camera.depth_of(local) > 0)) continue;  // no ray
      ++out.rays;
      double enters = 0, leaves = 0;
      if (!intersect(scene.bounds, frame.world_from_camera.t, frame.world_from_camera.rotate(local), enters, leaves))
        continue;
      ++out.meet_box;
      out.nearest = std::min(out.nearest, enters);
      out.farthest = std::max(out.farthest, leaves);
      if (std::max(enters, scene.near_m) < std::min(leaves, scene.far_m)) ++out.sampled;
    }
  }
  return out;
}

// An error where the share is 0, else a warning.
void report(Code code, double share, const std::string& key, const std::string& what, const std::string& remedy,
            Diagnostics& diagnostics) {
  if (share == 0) return diagnostics.error(code, key, "none of " + what, remedy);
  diagnostics.warning(code, key, fmt::format("only {:.4g} % of {}", std::max(0.1, std::round(1000 * share) / 10), what),
                      remedy);
}

std::string set_near_far(double near, double far) {
  return fmt::format("add --set scene.load.near_m={:.4g} --set scene.load.far_m={:.4g}", near, far);
}

// What the pixels themselves tell.
struct SeenExtent {
  const Box& box;                       ///< that the data suggest
  const std::vector<float>& distances;  ///< of depth along its rays; empty without depth
  bool taken;                           ///< the bounds of the scene are that box: nobody gave others
};

// Rays of the training frames `usable` (a sparse grid of at most 64 of them) against bounds, near and far, and depth
// against near and far: an error where nothing lies in what would be sampled, a warning where less than 5 % does.
void check_rays(const LoadedScene& scene, const std::vector<int>& usable, const SeenExtent& seen,
                Diagnostics& diagnostics) {
  const RayCounts counts = count_rays(scene, usable);
  const auto share = [&](int some) { return static_cast<double>(some) / std::max(1, counts.rays); };
  const std::string span =
      fmt::format("near {:.4g} and far {:.4g} (from {})", scene.near_m, scene.far_m, scene.near_far_from);
  const bool box_met = share(counts.meet_box) >= kFew;
  if (counts.rays > 0 && !box_met && !seen.taken)
    return report("scene.bounds.missed", share(counts.meet_box), "scene.load.bounds",
                  fmt::format("the rays of the training cameras can meet the bounds {} (from {})",
                              box_text(scene.bounds), scene.bounds_from),
                  "the data suggest --set 'scene.load.bounds=" + box_text(seen.box) + "'", diagnostics);
  if (!seen.distances.empty()) {
    const auto inside = std::count_if(seen.distances.begin(), seen.distances.end(),
                                      [&](float t) { return t >= scene.near_m && t <= scene.far_m; });
    const double part = static_cast<double>(inside) / static_cast<double>(seen.distances.size());
    const auto [nearest, farthest] = std::minmax_element(seen.distances.begin(), seen.distances.end());
    if (part < kFew)
      return report("scene.bounds.near_far", part, "scene.load.near_m",
                    "the depth of the training frames is between " + span,
                    fmt::format("depth lies from {:.4g} to {:.4g}: ", *nearest, *farthest) +
                        set_near_far(0.5 * *nearest, 1.05 * *farthest),
                    diagnostics);
  }
  if (box_met && share(counts.sampled) < kFew)
    report("scene.bounds.near_far", share(counts.sampled), "scene.load.near_m",
           "the rays of the training cameras can be inside the bounds between " + span,
           fmt::format("rays are inside from {:.4g} to {:.4g}: ", counts.nearest, counts.farthest) +
               set_near_far(std::max(counts.nearest, 0.01 * counts.farthest), counts.farthest),
           diagnostics);
}

constexpr std::size_t kFewestCorners = 100;
constexpr double kCornerMargin = 0.15;  // they are sparse: too small costs more than too large
constexpr const char* kDepthFrom = "depth of the training frames";
constexpr const char* kCornersFrom = "corners found again in training frames";

double middle_of(const SurveyPoints& points) {
  std::vector<float> distances = points.distance;
  return quantile(distances, 0.5);
}

// What the derivation of one scene knows.
struct Evidence {
  std::vector<int> usable;  ///< training frames that could be read
  Cameras cameras;          ///< theirs
  DepthSurvey survey;
  bool has_depth = false;
  double covered = 0;                     ///< share of the pixels looked at that have depth
  std::optional<SurveyedExtent> corners;  ///< of scenes that neither depth nor a plain background tells of
};

// Distances along rays, and what tells them.
struct Reach {
  double near_m = 0, far_m = 0;  ///< near 0: not told
  const char* from = "";
};

Box box_of_cameras(const Cameras& cameras) {
  Box box;
  for (const FrameInfo* camera : cameras) box.include(camera->world_from_camera.t);
  return box;
}

// From the cameras to the nearest and the farthest of an object's box; near 0 where one stands in it.
Reach reach_of(const Box& object, const Cameras& cameras) {
  double nearest = 1e300, farthest = 0;
  for (const FrameInfo* camera : cameras) {
    const Vec3d eye = camera->world_from_camera.t;
    Vec3d out, across;
    for (int a = 0; a < 3; ++a) {
      out[a] = std::max({object.lo[a] - eye[a], eye[a] - object.hi[a], 0.0});
      across[a] = std::max(eye[a] - object.lo[a], object.hi[a] - eye[a]);
    }
    nearest = std::min(nearest, length(out));
    farthest = std::max(farthest, length(across));
  }
  return {0.8 * nearest, 1.05 * farthest, "the object's silhouettes"};
}

// Seen in depth, about the object, between corners, or a multiple of the cameras' walk: too far costs less than too
// near, which cuts the scene.
Reach seen_reach(const LoadedScene& scene, Evidence& seen) {
  constexpr double kWalks = 4;
  if (seen.has_depth)
    return {0.5 * quantile(seen.survey.distances, 0.001), 1.05 * quantile(seen.survey.distances, 0.999), kDepthFrom};
  if (scene.plain_background) return reach_of(scene.plain_background->object, seen.cameras);
  if (seen.corners) return {seen.corners->near_m, seen.corners->far_m, kCornersFrom};
  const double walk = length(box_of_cameras(seen.cameras).size());
  if (walk > 0) return {0, kWalks * walk, "four times the extent of the cameras"};
  return {0, 10.0, "a guess (one camera place, no depth)"};
}

// With space outside contracted: about what the cameras see together or, where they look outward, where they stand.
// About forward-facing cameras as far as the nearest that they see: from there on cells grow with the distance, as what
// a pixel shows does.
struct SubjectCube {
  Box box;
  std::string from;
};
SubjectCube cube_of_subject(const LoadedScene& scene, const Evidence& seen) {
  constexpr double kNearest = 0.05;  // of the corners
  const CameraRig& rig = scene.rig;
  const Box around = rig.inward ? rig.seen : box_of_cameras(seen.cameras);
  const Vec3d size = around.size();
  const double widest = std::max({size.x, size.y, size.z});
  double half = widest > 0 ? 0.5 * widest : 1;
  std::string from = rig.inward ? "what nine in ten cameras see together" : "where the cameras stand";
  if (rig.forward && seen.corners) {
    std::vector<float> distances = scene.corners.distance;
    half = std::max(half, static_cast<double>(quantile(distances, kNearest)));
    from += ", up to the nearest corners seen";
  }
  return {{around.center() - Vec3d{half, half, half}, around.center() + Vec3d{half, half, half}}, from};
}

// Asked for, told by the dataset, or seen.
void derive_distances(LoadedScene& scene, Evidence& seen, const SceneLoadOptions& options) {
  constexpr double kReach = 64;
  scene.near_m = options.near_m > 0 ? options.near_m : scene.info.near_hint_m;
  scene.far_m = options.far_m > 0 ? options.far_m : scene.info.far_hint_m;
  if (options.contracted && !(options.far_m > 0)) {
    const Vec3d size = cube_of_subject(scene, seen).box.size();
    scene.far_m = kReach * size.x;
    if (scene.near_m <= 0) scene.near_m = 0.05 * (scene.rig.inward ? scene.rig.distance_m : size.x);
    scene.near_far_from = fmt::format("contraction: far is {:.3g} times the bounds", kReach);
    return;
  }
  scene.near_far_from = options.near_m > 0 && options.far_m > 0 ? "the configuration"
                        : scene.near_m > 0 && scene.far_m > 0   ? "the dataset"
                                                                : "";
  const Reach reach = seen_reach(scene, seen);
  if (scene.far_m <= 0) {
    scene.far_m = reach.far_m;
    scene.near_far_from = reach.from;
  }
  if (scene.near_m > 0) return;
  scene.near_m = reach.near_m > 0 ? std::min(reach.near_m, 0.5 * scene.far_m) : 0.01 * scene.far_m;
  if (scene.near_far_from.empty()) scene.near_far_from = seen.has_depth || seen.corners ? reach.from : "1 % of far";
}

// All that the cameras may see up to far.
Box box_of_cones(const LoadedScene& scene, const Cameras& cameras, std::string& from) {
  Box box;
  for (const FrameInfo* camera : cameras) include_frustum(box, *camera, scene.far_m);
  from = "the view cones of " + std::to_string(cameras.size()) + " training cameras up to far";
  grow(box, 0.02, scene.far_m);
  return box;
}

// What the training frames show: the points of their depth, the object before a plain background, or their view cones
// up to far. `from` says which.
Box box_of_data(const LoadedScene& scene, Evidence& seen, std::string& from) {
  const std::string frames = std::to_string(seen.cameras.size()) + " training frames";
  if (seen.has_depth) {
    Box box = seen.survey.box;
    from = "depth of " + frames;
    if (seen.covered < 0.5) {
      // Too much of the picture has no depth for the points to stand for the scene: what the cameras see counts as
      // well.
      const double reach = quantile(seen.survey.distances, 0.98);
      for (const FrameInfo* camera : seen.cameras) include_frustum(box, *camera, reach);
      from += " (valid on " + std::to_string(std::lround(seen.covered * 100)) + " % of pixels) and the view cones";
    }
    grow(box, 0.02, quantile(seen.survey.distances, 0.5));
    return box;
  }
  if (seen.corners) {
    from = std::to_string(seen.corners->points) + " corners found again in " + frames;
    Box box = box_of_cameras(seen.cameras);
    box.include(seen.corners->bounds.lo);
    box.include(seen.corners->bounds.hi);
    return box;
  }
  if (!scene.plain_background) return box_of_cones(scene, seen.cameras, from);
  from = "the object's silhouettes in " + frames;
  Box box = scene.plain_background->object;
  grow(box, 0.02, scene.far_m);
  return box;
}

// The configuration, the subject under contraction, the dataset, or what the data show: the first that there is.
void derive_bounds(LoadedScene& scene, Evidence& seen, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  std::string seen_in;
  const Box data = box_of_data(scene, seen, seen_in);
  bool from_data = false;
  if (options.bounds.size() == 6) {
    scene.bounds = box_of(options.bounds);
    scene.bounds_from = "the configuration";
  } else if (options.contracted) {
    const SubjectCube cube = cube_of_subject(scene, seen);
    scene.bounds = cube.box;
    scene.bounds_from = cube.from;
  } else if (!scene.info.bounds.empty()) {
    scene.bounds = scene.info.bounds;
    scene.bounds_from = "the dataset";
  } else {
    scene.bounds = data;
    scene.bounds_from = seen_in;
    from_data = true;
  }
  scene.extent_is_guessed = from_data && !seen.has_depth && !scene.plain_background && !seen.corners;
  // Where space goes on beyond the bounds, rays may miss them.
  if (options.check_geometry && !options.contracted && scene.near_m < scene.far_m)
    check_rays(scene, seen.usable, {data, seen.survey.distances, from_data}, diagnostics);
}

void warn_of_coarse_positions(const LoadedScene& scene, Diagnostics& diagnostics) {
  // Float positions have a step of 2^-24 of their size: far from the origin that step eats into a pixel.
  double largest = 0;
  for (int a = 0; a < 3; ++a) largest = std::max({largest, std::abs(scene.bounds.lo[a]), std::abs(scene.bounds.hi[a])});
  if (largest * 0x1p-24 <= 1e-3 * scene.pixel_footprint_m) return;
  diagnostics.warning("scene.coordinates.precision", "scene",
                      fmt::format("coordinates reach {:.3g}, where single precision steps by {:.3g} against a pixel of "
                                  "{:.3g}",
                                  largest, largest * 0x1p-23, scene.pixel_footprint_m),
                      "move the origin of the poses near the scene");
}

// What a guess costs, and what to do about it here.
void tell_of_guess(const LoadedScene& scene, const SceneLoadOptions& options, Diagnostics& diagnostics) {
  const Vec3d size = scene.bounds.size();
  const std::string guess = fmt::format(
      "bounds of {:.3g} x {:.3g} x {:.3g} and far {:.3g} are a guess: no depth, no points, no plain background", size.x,
      size.y, size.z, scene.far_m);
  if (scene.rig.inward) {
    const auto& [lo, hi] = scene.rig.seen;
    diagnostics.warning(
        "scene.bounds.guessed", "scene.load.bounds",
        fmt::format("{}; the cameras stand around one place and see it together within [{:.3g}, {:.3g}, {:.3g}, "
                    "{:.3g}, {:.3g}, {:.3g}]",
                    guess, lo.x, lo.y, lo.z, hi.x, hi.y, hi.z),
        "where the background matters include presets/unbounded.yaml; where only the subject does, set "
        "scene.load.bounds to that box");
  } else if (options.probe_steps == 0) {
    diagnostics.warning("scene.bounds.guessed", "scene.load.bounds", guess,
                        "let a probe find them with scene.load.probe_steps: 128, or set scene.load.bounds and far_m: "
                        "smaller where space is wasted, larger where parts of the scene are missing");
  }
}

}  // namespace

std::optional<SurveyedExtent> extent_of_points(std::vector<SurveyPoints> parts, double margin) {
  constexpr double kLost = 0.005;
  DepthSurvey survey = survey_depth(parts, kLost);
  if (survey.valid == 0) return std::nullopt;
  grow(survey.box, margin, quantile(survey.distances, 0.5));
  return SurveyedExtent{survey.box, 0.5 * quantile(survey.distances, kLost),
                        1.1 * quantile(survey.distances, 1 - kLost), survey.valid};
}

void derive_extent(LoadedScene& scene, std::vector<SurveyPoints> surveyed, const SceneLoadOptions& options,
                   Diagnostics& diagnostics) {
  Evidence seen;
  std::vector<const StoredFrame*> pixels;
  for (const int i : scene.frames_of(Split::train)) {
    const auto f = static_cast<std::size_t>(i);
    if (scene.frames[f].width_px == 0) continue;
    seen.usable.push_back(i);
    seen.cameras.push_back(&scene.info.frames[f]);
    pixels.push_back(&scene.frames[f]);
  }
  if (seen.cameras.empty()) {
    if (!diagnostics.has_errors())
      diagnostics.error("scene.split.empty", scene.info.name, "no training frame",
                        "check the split parameters of the dataset");
    return;
  }
  seen.survey = survey_depth(surveyed);
  seen.has_depth = seen.survey.valid > 0;
  if (seen.has_depth)
    seen.covered = static_cast<double>(seen.survey.valid) / static_cast<double>(seen.survey.looked_at);
  if (!seen.has_depth || options.contracted)
    scene.rig = find_rig(seen.cameras);
  else
    scene.rig.forward = look_one_way(seen.cameras);
  if (!seen.has_depth && !options.contracted)
    scene.plain_background = find_plain_background(seen.cameras, pixels, scene.rig);
  if (!seen.has_depth && !scene.plain_background && scene.corners.x.size() >= kFewestCorners)
    seen.corners = extent_of_points({scene.corners}, kCornerMargin);
  derive_distances(scene, seen, options);
  // Where both are asked for, validate() compares them. Where one is, it may lie beyond what the other was derived to
  // be.
  const bool both_given = options.near_m > 0 && options.far_m > 0;
  if (!both_given && (!(scene.near_m < scene.far_m) || !std::isfinite(scene.far_m)))
    diagnostics.error("scene.bounds.near_far", "scene.load.near_m",
                      fmt::format("near is {:.3g} m and far is {:.3g} m: no part of a ray lies between them",
                                  scene.near_m, scene.far_m),
                      "set scene.load.near_m below scene.load.far_m");
  derive_bounds(scene, seen, options, diagnostics);
  std::vector<float> focal;
  for (const FrameInfo* camera : seen.cameras) focal.push_back(static_cast<float>(camera->camera.fx));
  const Vec3d size = scene.bounds.empty() ? Vec3d{} : scene.bounds.size();
  const double longest = std::max({size.x, size.y, size.z});
  const double middle = seen.has_depth     ? quantile(seen.survey.distances, 0.5)
                        : seen.corners     ? middle_of(scene.corners)
                        : scene.rig.inward ? scene.rig.distance_m
                        // Of contracted space far is as good as infinity, and tells nothing of where things are.
                        : options.contracted ? 0.5 * longest
                                             : 0.5 * (scene.near_m + scene.far_m);
  scene.pixel_footprint_m = middle / quantile(focal, 0.5);
  // docs/decisions.md, 0043: an object fills less than what lies between it and its cameras.
  const double unit_m = options.contracted ? middle : std::min(middle / 2, longest / 4);
  scene.unit_m = unit_m > 0 ? unit_m : 1;
  warn_of_coarse_positions(scene, diagnostics);
  if (scene.extent_is_guessed) tell_of_guess(scene, options, diagnostics);
}

}  // namespace semfield
