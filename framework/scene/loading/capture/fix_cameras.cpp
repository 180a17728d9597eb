#include "scene/loading/capture/fix_cameras.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <memory>
#include <numeric>
#include <set>
#include <unordered_map>

#include "compute/parallel.h"
#include "core/error.h"
#include "core/files.h"
#include "core/joined_sets.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "scene/loading/frame_files.h"
#include "scene/survey/geometry_survey.h"

namespace semfield {

namespace {

constexpr std::size_t kFewestFrames = 3;
constexpr std::size_t kNearest = 14, kBehind = 4;  // of the pairs of a frame
constexpr double kWidest = 75 * M_PI / 180;        // between two that may see the same
constexpr std::int32_t kDepthSide = 320;           // pixels of the longer side at which depth is held
constexpr std::size_t kHeldOut = 10;               // every tenth track judges
constexpr double kSameLens = 0.15;                 // relative difference of focal lengths of one camera
constexpr double kRoundsPx[] = {24, 10, 6, 4, 3};  // errors beyond are of wrong matches, at 1,024 pixels
constexpr std::size_t kDepthRound = 2;             // from which depth is looked at: lens and poses are roughly right
constexpr double kOutlierPx = 2;                   // at 1,024 pixels
constexpr double kBetter = 0.9;                    // of the given error, which a change has to beat
constexpr double kWorthPx = 0.1;                   // at 1,024 pixels
constexpr double kEdgesClearly = 1.003;            // times as strong, where depth has a camera of its own
constexpr std::size_t kEdgeFrames = 24;
constexpr double kDegree = M_PI / 180;

// Frames of one lens: the same kind and size, and nearly the same focal lengths.
std::vector<int> lenses_of(const std::vector<Camera>& cameras) {
  std::vector<Camera> kinds;
  std::vector<int> out;
  for (const Camera& c : cameras) {
    const auto same = [&](const Camera& k) {
      return k.lens == c.lens && k.width_px == c.width_px && k.height_px == c.height_px &&
             std::abs(k.fx / c.fx - 1) < kSameLens;
    };
    const auto found = std::find_if(kinds.begin(), kinds.end(), same);
    out.push_back(static_cast<int>(found - kinds.begin()));
    if (found == kinds.end()) kinds.push_back(c);
  }
  return out;
}

double longer_side(const Camera& c) { return std::max(c.width_px, c.height_px); }

BundleDepth depth_view(const FrameBuffer& frame, const Camera& camera) {
  BundleDepth out;
  if (frame.depth_m.empty()) return out;
  const auto step = static_cast<std::int32_t>(std::max(1.0, std::ceil(longer_side(camera) / kDepthSide)));
  const std::int32_t width = std::max(1, frame.width_px / step), height = std::max(1, frame.height_px / step);
  out.camera = camera.resized(width, height);
  out.depth_m = at_nearest_pixels(frame.depth_m, {frame.width_px, frame.height_px}, {width, height});
  return out;
}

// Cameras that this can fix, of frames enough.
void check_frames(const SceneInfo& info) {
  Diagnostics found;
  if (info.frames.size() < kFewestFrames)
    found.error("capture.photographs.few", info.name,
                fmt::format("{} frames are too few to fix cameras", info.frames.size()),
                "take at least 20, each sharing two thirds of what the one before shows");
  for (const FrameInfo& frame : info.frames) {
    if (frame.camera.lens == LensKind::equirectangular)
      found.error("capture.lens.panorama", frame.name, "a panorama has no lens to fix",
                  "cut them into perspective views, as with the filter v360 of ffmpeg, and prepare these");
  }
  found.throw_if_errors(ErrorKind::data, "the cameras cannot be fixed:");
}

// Of all that features and matches depend on.
std::string identity_of(const SceneInfo& info) {
  std::string text = info.name + "\n";
  for (const FrameInfo& frame : info.frames) {
    std::error_code unknown;
    const auto size = fs::file_size(frame.source, unknown);
    text += fmt::format("{} {} {}", frame.name, frame.source, unknown ? 0 : size);
    for (const auto& row : frame.world_from_camera.r) text += fmt::format(" {} {} {}", row[0], row[1], row[2]);
    const Camera& c = frame.camera;
    const Vec3d& t = frame.world_from_camera.t;
    text +=
        fmt::format(" {} {} {} {} {} {} {} {} {}\n", t.x, t.y, t.z, c.width_px, c.height_px, c.fx, c.fy, c.cx, c.cy);
  }
  return text;
}

class Fixing {
 public:
  Fixing(const PosedScene& scene, const PrepareFolder& folder, int threads, const Programs& programs,
         const CaptureProgress& progress, PrepareState& state)
      : scene_(scene),
        info_(scene.info),
        progress_(progress),
        state_(state),
        images_(fs::path(folder.work()) / "photographs"),
        colmap_(programs, progress, images_.string(), folder.work(), folder.logs(),
                threads > 0 ? threads : hardware_threads()) {
    for (const FrameInfo& frame : info_.frames) {
      bundle_.stated.push_back(frame.camera);
      bundle_.given.push_back(frame.world_from_camera);
    }
    bundle_.poses = bundle_.given;
    bundle_.lens_of = lenses_of(bundle_.stated);
    bundle_.lenses.resize(static_cast<std::size_t>(*std::max_element(bundle_.lens_of.begin(), bundle_.lens_of.end())) +
                          1);
  }

  FixedCameras run() {
    read_frames();
    find_tracks();
    return fix();
  }

 private:
  // Links to the photographs under names that COLMAP takes, or copies of what is no file; depth and masks.
  void read_frames() {
    const std::size_t count = info_.frames.size();
    names_.resize(count);
    used_.resize(count);
    bundle_.depth.resize(count);
    for (std::size_t g = 0; g < bundle_.lenses.size(); ++g) create_folders((images_ / fmt::format("{}", g)).string());
    for (std::size_t i = 0; i < count; ++i) {
      progress_({"reading", "frames"}, static_cast<double>(i), static_cast<double>(count));
      const FrameInfo& frame = info_.frames[i];
      const bool is_file = is_photograph_file(frame);
      const std::string end = is_file ? fs::path(frame.source).extension().string() : ".png";
      names_[i] = fmt::format("{}/{:06}{}", bundle_.lens_of[i], i, end);
      const fs::path to = images_ / names_[i];
      FrameBuffer pixels;
      scene_.read(static_cast<int>(i), pixels);
      std::error_code unknown, failed;
      if (!fs::exists(fs::symlink_status(to, unknown))) {
        if (is_file)
          fs::create_symlink(fs::absolute(frame.source), to, failed);
        else
          write_png_rgb(to.string(), pixels.width_px, pixels.height_px, pixels.rgb);
        if (failed) throw write_error("link", to.string(), failed.value());
      }
      bundle_.depth[i] = depth_view(pixels, frame.camera);
      used_[i] = std::move(pixels.used);
      has_depth_ = has_depth_ || !pixels.depth_m.empty();
    }
    if (!has_depth_) bundle_.depth.clear();
  }

  // What a mask hides moves by itself: a person, or the robot that carries the camera.
  bool is_hidden(const Sighting& s) const {
    const auto f = static_cast<std::size_t>(s.frame);
    const Camera& c = bundle_.stated[f];
    if (used_[f].empty() || !(s.u >= 0 && s.v >= 0 && s.u < c.width_px && s.v < c.height_px)) return false;
    return used_[f][pixel_at(static_cast<std::int64_t>(s.u), static_cast<std::int64_t>(s.v), c.width_px)] == 0;
  }

  void find_tracks() {
    const Camera& first = bundle_.stated.front();
    FeatureSettings settings{"posed",
                             first.lens == LensKind::fisheye ? "OPENCV_FISHEYE" : "OPENCV",
                             first.fx / longer_side(first),
                             1024,
                             2048,
                             1,
                             0.0067};
    colmap_.need_matches(
        settings, names_, true, [&] { return pairs_by_pose(bundle_.given); }, state_, "");
    for (Track& track : feature_tracks(colmap_.database(settings), names_)) {
      std::erase_if(track.seen, [&](const Sighting& s) { return is_hidden(s); });
      ((track_number_++ % kHeldOut == 0) ? judges_ : all_).push_back(std::move(track));
    }
  }

  double scale_of(std::size_t frame) const { return longer_side(bundle_.stated[frame]) / 1024; }

  // Of all tracks, what fits the cameras to `most_px`.
  void choose(double most_px) {
    bundle_.tracks.clear();
    for (Track track : all_) {
      for (int pass = 0; pass < 2; ++pass) {
        if (track.seen.size() < 2 || !settle_point(bundle_, track)) {
          track.seen.clear();
          break;
        }
        std::erase_if(track.seen, [&](const Sighting& s) {
          return !(error_px(bundle_, track, s) < most_px * scale_of(static_cast<std::size_t>(s.frame)));
        });
      }
      if (track.seen.size() >= 2) bundle_.tracks.push_back(std::move(track));
    }
  }

  // The median error over the tracks that took no part, in pixels of 1,024.
  double judged(const Bundle& cameras) const {
    std::vector<double> errors;
    for (Track track : judges_) {
      if (!settle_point(cameras, track)) continue;
      for (const Sighting& s : track.seen)
        errors.push_back(error_px(cameras, track, s) / scale_of(static_cast<std::size_t>(s.frame)));
    }
    return median_of(std::move(errors));
  }

  FixedCameras fix() {
    FixedCameras out;
    const Bundle given = bundle_;
    choose(kRoundsPx[0]);
    bundle_.measure();
    out.given_on_depth = share_on_depth(bundle_);
    for (std::size_t round = 0; round < std::size(kRoundsPx); ++round) {
      progress_({"adjusting all poses,", "rounds"}, static_cast<double>(round),
                static_cast<double>(std::size(kRoundsPx)));
      if (round > 0) choose(kRoundsPx[round]);
      if (round == kDepthRound && has_depth_) registered_ = depth_is_registered();
      const bool with_depth = round >= kDepthRound && has_depth_;
      adjust(bundle_, {.outlier_px = (round == 0 ? 2 : 1) * kOutlierPx * scale_of(0),
                       .move_lens = round > 0,
                       .move_depth_camera = with_depth && !registered_,
                       .use_depth = with_depth});
      bundle_.measure();
      if (registered_ && with_depth) depth_follows();
    }
    out.points = bundle_.tracks.size();
    out.judges = judges_.size();
    out.given_px = judged(given);
    out.fixed_px = judged(bundle_);
    out.fixed_on_depth = share_on_depth(bundle_);
    // Where the photographs ask for hardly anything, noise would be all that changes.
    if (!(out.fixed_px < kBetter * out.given_px && out.given_px - out.fixed_px > kWorthPx)) {
      out.kept = true;
      bundle_ = given;
      choose(kRoundsPx[2]);
      bundle_.measure();
      if (has_depth_) registered_ = depth_is_registered();
      out.fixed_px = out.given_px;
    }
    settle_depth(out);
    out.poses = bundle_.poses;
    for (std::size_t i = 0; i < bundle_.poses.size(); ++i) out.cameras.push_back(bundle_.camera(i));
    if (!out.kept) tell_changes(out);
    return out;
  }

  // Depth that was brought into the colour image has its lens and its place, as wrong as they were stated; depth as the
  // sensor took it has its own. Edges say which: of a plain wall, points would lie on the depth of either.
  bool depth_is_registered() {
    align_depth(bundle_);
    const double own = edge_score(bundle_.depth_from_color, false);
    const double registered = edge_score({}, true);
    if (own > kEdgesClearly * registered) return false;
    bundle_.depth_from_color = {};
    depth_follows();
    return true;
  }
  // How strong photographs are at the edges of depth, over what they are around; higher is better.
  double edge_score(const Pose& depth_from_color, bool registered) const {
    std::vector<double> scores(kEdgeFrames);
    parallel_for(static_cast<std::int64_t>(kEdgeFrames), [&](std::int64_t k) {
      const std::size_t i = static_cast<std::size_t>(k) * info_.frames.size() / kEdgeFrames;
      if (!info_.frames[i].has_depth) return;
      FrameBuffer pixels;
      scene_.read(static_cast<int>(i), pixels);
      const Camera camera = bundle_.camera(i);
      if (!registered)
        pixels.depth_m = drawn_depth({pixels.width_px, pixels.height_px, 1, std::move(pixels.depth_m)},
                                     {bundle_.stated[i], depth_from_color}, camera);
      const EdgeScores found = edge_scores(camera, pixels);
      if (!found.empty()) scores[static_cast<std::size_t>(k)] = static_cast<double>(found[found.size() / 2]);
    });
    return std::accumulate(scores.begin(), scores.end(), 0.0);
  }
  void depth_follows() {
    for (std::size_t i = 0; i < bundle_.depth.size(); ++i) {
      Camera& c = bundle_.depth[i].camera;
      if (c.width_px > 0) c = bundle_.camera(i).resized(c.width_px, c.height_px);
    }
  }

  void settle_depth(FixedCameras& out) const {
    if (!has_depth_) return;
    out.fixed_on_depth = share_on_depth(bundle_);
    out.depth_apart = !registered_;
    if (registered_) return;
    out.depth_from_color = bundle_.depth_from_color;
    out.depth_cameras = bundle_.stated;
    out.changes.push_back(
        fmt::format("depth has its own camera, {:.3g} {} from the colour camera and turned by {:.2f} degrees, with the "
                    "lens that was stated",
                    length(bundle_.depth_from_color.t), unit(), angle_deg(Pose{}, bundle_.depth_from_color)));
  }

  const char* unit() const { return info_.metric ? "m" : "units"; }

  void tell_changes(FixedCameras& out) const {
    for (std::size_t g = 0; g < bundle_.lenses.size(); ++g) {
      const auto frame = static_cast<std::size_t>(
          std::find(bundle_.lens_of.begin(), bundle_.lens_of.end(), static_cast<int>(g)) - bundle_.lens_of.begin());
      const Camera &a = bundle_.stated[frame], b = bundle_.camera(frame);
      std::string text =
          fmt::format("focal length {:.1f} -> {:.1f} x {:.1f} pixels, centre ({:.1f}, {:.1f}) -> ({:.1f}, {:.1f})",
                      a.fx, b.fx, b.fy, a.cx, a.cy, b.cx, b.cy);
      text += fmt::format(", k1 {:.3f} -> {:.3f}, k2 {:.3f} -> {:.3f}", a.k1, b.k1, a.k2, b.k2);
      if (bundle_.lenses.size() > 1) text += fmt::format(" (frames like '{}')", info_.frames[frame].name);
      out.changes.push_back(text);
    }
    double turn = 0, shift = 0;
    for (std::size_t i = 0; i < bundle_.poses.size(); ++i) {
      const Pose &a = bundle_.given[i], &b = bundle_.poses[i];
      turn += std::pow(angle_deg(a, b), 2);
      shift += dot(a.t - b.t, a.t - b.t);
    }
    const auto count = static_cast<double>(bundle_.poses.size());
    out.changes.push_back(fmt::format("poses by {:.2f} degrees and {:.3g} {} (rms)", std::sqrt(turn / count),
                                      std::sqrt(shift / count), unit()));
  }

  const PosedScene& scene_;
  const SceneInfo& info_;
  const CaptureProgress& progress_;
  PrepareState& state_;
  fs::path images_;
  ColmapSteps colmap_;
  std::vector<std::string> names_;
  std::vector<std::vector<std::uint8_t>> used_;  // of each frame as its masks say; empty: every pixel
  Bundle bundle_;
  std::vector<Track> all_, judges_;
  std::size_t track_number_ = 0;
  bool has_depth_ = false, registered_ = true;
};

}  // namespace

bool is_photograph_file(const FrameInfo& frame) {
  const std::string end = ending_of(frame.source);
  return (end == ".jpg" || end == ".jpeg" || end == ".png") && is_file(frame.source);
}

std::vector<Pair> pairs_by_pose(const std::vector<Pose>& poses) {
  const std::size_t count = poses.size();
  std::vector<double> distances;
  for (std::size_t i = 0; i < count; ++i)
    for (std::size_t j = i + 1; j < count; j += 1 + count / 64) distances.push_back(length(poses[i].t - poses[j].t));
  const double usual = std::max(1e-300, distances.empty() ? 1 : median_of(distances));
  std::set<Pair> found;
  std::vector<std::pair<double, std::size_t>> near;
  for (std::size_t i = 0; i < count; ++i) {
    near.clear();
    for (std::size_t j = 0; j < count; ++j) {
      if (j == i) continue;
      const double angle = std::acos(std::clamp(dot(poses[i].axis(2), poses[j].axis(2)), -1.0, 1.0));
      if (angle < kWidest) near.emplace_back(length(poses[i].t - poses[j].t) / usual + angle / (30 * kDegree), j);
    }
    const std::size_t kept = std::min(kNearest, near.size());
    std::partial_sort(near.begin(), near.begin() + static_cast<std::ptrdiff_t>(kept), near.end());
    for (std::size_t k = 0; k < kept; ++k) found.insert(std::minmax(i, near[k].second));
    for (std::size_t k = 1; k <= kBehind && i + k < count; ++k) found.insert({i, i + k});
  }
  return {found.begin(), found.end()};
}

FixedCameras fix_cameras(const PosedScene& scene, const std::string& out, int threads, const Programs& programs,
                         const CaptureProgress& progress) {
  check_frames(scene.info);
  (void)program_file(programs, "colmap");
  const PrepareFolder folder(fs::absolute(out).lexically_normal().string());
  PrepareState state = folder.steps(identity_of(scene.info));
  return Fixing(scene, folder, threads, programs, progress, state).run();
}

}  // namespace semfield

#ifdef SEMFIELD_WITH_IMAGES
#include <sqlite3.h>
#endif

namespace semfield {

#ifdef SEMFIELD_WITH_IMAGES

namespace {

constexpr std::int64_t kPairBase = 2147483647;  // pair_id = kPairBase * smaller id + larger id

struct Closer {
  void operator()(sqlite3* base) const { sqlite3_close(base); }
  void operator()(sqlite3_stmt* statement) const { sqlite3_finalize(statement); }
};

class Database {
 public:
  explicit Database(const std::string& file) : file_(file) {
    sqlite3* opened = nullptr;
    const int code = sqlite3_open_v2(file.c_str(), &opened, SQLITE_OPEN_READONLY, nullptr);
    base_.reset(opened);
    if (code != SQLITE_OK) fail();
  }
  /// Calls `row(statement)` for each row.
  template <class Row>
  void each(const char* query, const Row& row) {
    sqlite3_stmt* prepared = nullptr;
    if (sqlite3_prepare_v2(base_.get(), query, -1, &prepared, nullptr) != SQLITE_OK) fail();
    const std::unique_ptr<sqlite3_stmt, Closer> statement(prepared);
    for (;;) {
      const int code = sqlite3_step(prepared);
      if (code == SQLITE_DONE) return;
      if (code != SQLITE_ROW) fail();
      row(prepared);
    }
  }
  [[noreturn]] void fail() const {
    throw Error(ErrorKind::data, "capture.database",
                "COLMAP's database '" + file_ + "' cannot be read: " + sqlite3_errmsg(base_.get()),
                "remove the file; the same command makes it again");
  }

 private:
  std::string file_;
  std::unique_ptr<sqlite3, Closer> base_;
};

// Rows of `cols` numbers of a blob in column `at`; empty where it does not hold them.
template <class T>
std::vector<T> numbers(sqlite3_stmt* row, int at, std::int64_t count) {
  const void* data = sqlite3_column_blob(row, at);
  const auto bytes = static_cast<std::size_t>(sqlite3_column_bytes(row, at));
  if (count <= 0 || data == nullptr || bytes != static_cast<std::size_t>(count) * sizeof(T)) return {};
  std::vector<T> out(static_cast<std::size_t>(count));
  std::memcpy(out.data(), data, bytes);
  return out;
}

// Sets of features, each with the frames that it has a feature of.
class Joined {
 public:
  explicit Joined(const std::vector<Sighting>& features) : sets_(features.size()) {
    for (const Sighting& s : features) frames_.push_back({s.frame});
  }
  std::size_t root(std::size_t i) { return sets_.of(i); }
  void join(std::size_t a, std::size_t b) {
    a = root(a);
    b = root(b);
    if (a == b) return;
    std::vector<std::int32_t> both;
    std::set_union(frames_[a].begin(), frames_[a].end(), frames_[b].begin(), frames_[b].end(),
                   std::back_inserter(both));
    if (both.size() < frames_[a].size() + frames_[b].size()) return;
    sets_.join(a, b);
    frames_[a] = frames_[b] = {};
    frames_[root(a)] = std::move(both);
  }

 private:
  JoinedSets sets_;
  std::vector<std::vector<std::int32_t>> frames_;
};

}  // namespace

std::vector<Track> feature_tracks(const std::string& file, const std::vector<std::string>& names) {
  Database database(file);
  std::map<std::string, std::int32_t> place;
  for (std::size_t i = 0; i < names.size(); ++i) place[names[i]] = static_cast<std::int32_t>(i);
  std::map<std::int64_t, std::int32_t> frame_of;  // by COLMAP's id
  database.each("SELECT image_id, name FROM images", [&](sqlite3_stmt* row) {
    const auto* name = reinterpret_cast<const char*>(sqlite3_column_text(row, 1));
    if (const auto found = place.find(name == nullptr ? "" : name); found != place.end())
      frame_of[sqlite3_column_int64(row, 0)] = found->second;
  });
  std::vector<Sighting> features;
  std::map<std::int64_t, std::pair<std::size_t, std::size_t>> range;  // first feature and number of each id
  database.each("SELECT image_id, rows, cols, data FROM keypoints ORDER BY image_id", [&](sqlite3_stmt* row) {
    const std::int64_t id = sqlite3_column_int64(row, 0), rows = sqlite3_column_int64(row, 1),
                       cols = sqlite3_column_int64(row, 2);
    const auto found = frame_of.find(id);
    if (found == frame_of.end() || cols < 2 || rows < 0 || rows > 1000000 || cols > 16) return;
    const std::vector<float> values = numbers<float>(row, 3, rows * cols);
    range[id] = {features.size(), values.size() / static_cast<std::size_t>(cols)};
    for (std::size_t i = 0; i < values.size(); i += static_cast<std::size_t>(cols))
      features.push_back({found->second, static_cast<double>(values[i]), static_cast<double>(values[i + 1])});
  });
  struct Matches {
    std::size_t a, b;  // first features
    std::vector<std::uint32_t> pairs;
  };
  std::vector<Matches> all;
  database.each("SELECT pair_id, rows, cols, data FROM two_view_geometries ORDER BY pair_id", [&](sqlite3_stmt* row) {
    const std::int64_t id = sqlite3_column_int64(row, 0), rows = sqlite3_column_int64(row, 1),
                       cols = sqlite3_column_int64(row, 2);
    const auto a = range.find(id / kPairBase), b = range.find(id % kPairBase);
    if (a == range.end() || b == range.end() || rows <= 0 || rows > 1000000 || cols != 2) return;
    Matches found{a->second.first, b->second.first, numbers<std::uint32_t>(row, 3, rows * cols)};
    for (std::size_t i = 0; i < found.pairs.size(); i += 2) {
      if (found.pairs[i] >= a->second.second || found.pairs[i + 1] >= b->second.second) return;
    }
    all.push_back(std::move(found));
  });
  // Pairs that share most are joined first: they are the surest.
  std::stable_sort(all.begin(), all.end(),
                   [](const Matches& x, const Matches& y) { return x.pairs.size() > y.pairs.size(); });
  Joined joined(features);
  for (const Matches& pair : all)
    for (std::size_t i = 0; i < pair.pairs.size(); i += 2)
      joined.join(pair.a + pair.pairs[i], pair.b + pair.pairs[i + 1]);
  std::unordered_map<std::size_t, std::size_t> track_of;
  std::vector<Track> out;
  for (std::size_t i = 0; i < features.size(); ++i) {
    const auto [at, fresh] = track_of.emplace(joined.root(i), out.size());
    if (fresh) out.emplace_back();
    out[at->second].seen.push_back(features[i]);
  }
  std::erase_if(out, [](const Track& track) { return track.seen.size() < 2; });
  return out;
}

#else

std::vector<Track> feature_tracks(const std::string&, const std::vector<std::string>&) {
  throw Error(ErrorKind::unavailable, "build.images.off", "this build does not read COLMAP's database",
              "build with SEMFIELD_WITH_IMAGES=ON");
}

#endif

}  // namespace semfield
