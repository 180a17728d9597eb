// The laws of datasets.
#include <cmath>
#include <set>

#include "compute/parallel.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

std::string frame_text(const SceneInfo& scene, int frame) {
  return "frame '" + scene.frames[static_cast<std::size_t>(frame)].name + "'";
}

// R^T R = I within 1e-6 and det R = 1: a reflection would mirror the scene.
void check_pose(const std::string& where, const Pose& pose, Failures& failures) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if (!(std::abs(dot(pose.axis(i), pose.axis(j)) - (i == j ? 1 : 0)) < 1e-6)) {
        return note_failure(failures, where, "the rotation is not orthonormal");
      }
    }
    if (!std::isfinite(pose.t[i])) return note_failure(failures, where, "the camera centre is not finite");
  }
  if (dot(cross(pose.axis(0), pose.axis(1)), pose.axis(2)) < 0)
    note_failure(failures, where, "the camera axes are left-handed");
}

void check_manifest(const SceneInfo& scene, const DatasetExpectation& expected, Failures& failures) {
  if (scene.frames.empty()) failures.push_back("manifest: no frames");
  if (expected.frames >= 0 && static_cast<int>(scene.frames.size()) != expected.frames) {
    failures.push_back("manifest: " + std::to_string(scene.frames.size()) + " frames, expected " +
                       std::to_string(expected.frames));
  }
  std::set<std::string> names;
  bool depth = false;
  bool labels = false;
  for (std::size_t i = 0; i < scene.frames.size(); ++i) {
    const FrameInfo& frame = scene.frames[i];
    const std::string where = frame_text(scene, static_cast<int>(i));
    if (frame.name.empty() || !names.insert(frame.name).second)
      note_failure(failures, where, "the name is empty or not unique");
    const Camera& camera = frame.camera;
    if (camera.width_px <= 0 || camera.height_px <= 0 || !(camera.fx > 0) || !(camera.fy > 0)) {
      note_failure(failures, where, "the camera's size or focal length is not positive");
    }
    check_pose(where, frame.world_from_camera, failures);
    depth |= frame.has_depth;
    labels |= frame.has_labels;
  }
  if (expected.depth && !depth) failures.push_back("manifest: no frame has depth");
  if (expected.labels && !labels) failures.push_back("manifest: no frame has labels");
  if (labels && scene.classes.valid_count() == 0)
    failures.push_back("manifest: frames have labels but there are no classes");
}

void check_channel(const std::string& where, const char* channel, std::size_t size, bool stated, std::size_t pixels,
                   Failures& failures) {
  const std::size_t want = stated ? pixels : 0;
  if (size == want) return;
  note_failure(
      failures, where,
      std::string(channel) + " has " + std::to_string(size) + " values, the manifest implies " + std::to_string(want));
}

void check_pixels(const SceneInfo& scene, int index, const FrameBuffer& pixels, Failures& failures) {
  const FrameInfo& frame = scene.frames[static_cast<std::size_t>(index)];
  const std::string where = frame_text(scene, index);
  if (pixels.width_px != frame.camera.width_px || pixels.height_px != frame.camera.height_px) {
    return note_failure(failures, where, "the image has another size than its camera");
  }
  const auto count = static_cast<std::size_t>(pixels.width_px) * static_cast<std::size_t>(pixels.height_px);
  check_channel(where, "colour", pixels.rgb.size(), true, 3 * count, failures);
  check_channel(where, "depth", pixels.depth_m.size(), frame.has_depth, count, failures);
  check_channel(where, "label", pixels.label.size(), frame.has_labels, count, failures);
  check_channel(where, "instance", pixels.instance.size(), frame.has_instances, count, failures);
  for (const float depth : pixels.depth_m) {
    if (!(depth >= 0) || !std::isfinite(depth)) {
      note_failure(failures, where, "a depth is negative or not finite");
      break;
    }
  }
  for (const std::int16_t label : pixels.label) {
    if (label < kVoid || label >= scene.classes.valid_count()) {
      note_failure(failures, where, "label " + std::to_string(label) + " is outside the class table");
      break;
    }
  }
}

bool same_pixels(const FrameBuffer& a, const FrameBuffer& b) {
  return a.width_px == b.width_px && a.height_px == b.height_px && a.rgb == b.rgb && a.depth_m == b.depth_m &&
         a.label == b.label && a.instance == b.instance;
}

struct Agreement {
  std::int64_t seen = 0;   // pixels of one frame that land in the other, in front of it
  std::int64_t agree = 0;  // of these, with a depth within the tolerance
};

// Points of frame `from` projected into frame `to`: z there against the depth stored there.
Agreement reproject(const FrameInfo& from, const FrameBuffer& a, const FrameInfo& to, const FrameBuffer& b,
                    double tolerance) {
  Agreement result;
  constexpr int kStepPx = 2;
  for (int row = 0; row < a.height_px; row += kStepPx) {
    for (int col = 0; col < a.width_px; col += kStepPx) {
      const double z = a.depth_m[static_cast<std::size_t>(row * a.width_px + col)];
      const Vec3d unit = from.camera.direction(col + 0.5, row + 0.5);
      const double share = from.camera.depth_of(unit);
      if (!(z > 0) || !(share > 0)) continue;
      const Vec3d there = to.world_from_camera.apply_inverse(from.world_from_camera.apply(unit * (z / share)));
      if (!to.camera.sees(there)) continue;
      const double own = to.camera.depth_of(there);
      double u = 0;
      double v = 0;
      to.camera.project(there, u, v);
      const double col_there = std::floor(u);
      const double row_there = std::floor(v);
      if (!(col_there >= 0 && col_there < b.width_px && row_there >= 0 && row_there < b.height_px)) continue;
      const double stored = b.depth_m[static_cast<std::size_t>(row_there) * static_cast<std::size_t>(b.width_px) +
                                      static_cast<std::size_t>(col_there)];
      if (!(stored > 0)) continue;
      ++result.seen;
      if (std::abs(stored - own) <= tolerance * own) ++result.agree;
    }
  }
  return result;
}

void check_depth(const SceneInfo& scene, const std::vector<FrameBuffer>& pixels, const DatasetExpectation& expected,
                 Failures& failures) {
  constexpr std::int64_t kEnough = 50;
  std::int64_t pairs = 0;
  for (std::size_t i = 0; i + 1 < scene.frames.size(); ++i) {
    if (pixels[i].depth_m.empty() || pixels[i + 1].depth_m.empty()) continue;
    const Agreement found =
        reproject(scene.frames[i], pixels[i], scene.frames[i + 1], pixels[i + 1], expected.depth_tolerance);
    if (found.seen < kEnough) continue;  // the two views hardly overlap
    ++pairs;
    if (2 * found.agree < found.seen) {  // occlusion explains some, never most
      note_failure(failures, frame_text(scene, static_cast<int>(i)),
                   "only " + std::to_string(found.agree) + " of " + std::to_string(found.seen) +
                       " reprojected depths agree with the next frame; check the pose convention and the depth unit");
    }
  }
  if (expected.depth && pairs == 0)
    failures.push_back("depth: no two neighbouring frames overlap, nothing was compared");
}

}  // namespace

Failures dataset_laws(Dataset& dataset, const DatasetExpectation& expected) {
  Failures failures;
  Diagnostics diagnostics;
  const SceneInfo scene = dataset.open(diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) {
    if (finding.severity == Severity::error) failures.push_back("open: " + finding.text());
  }
  check_manifest(scene, expected, failures);
  if (!failures.empty()) return failures;
  std::vector<FrameBuffer> serial(scene.frames.size());
  for (std::size_t i = 0; i < serial.size(); ++i) {
    dataset.read(static_cast<int>(i), serial[i]);
    check_pixels(scene, static_cast<int>(i), serial[i], failures);
  }
  if (!failures.empty()) return failures;
  check_depth(scene, serial, expected, failures);
  std::vector<FrameBuffer> parallel(scene.frames.size());
  const int kept = thread_count();
  set_thread_count(4);
  parallel_for(static_cast<std::int64_t>(parallel.size()),
               [&](std::int64_t i) { dataset.read(static_cast<int>(i), parallel[static_cast<std::size_t>(i)]); });
  set_thread_count(kept);
  for (std::size_t i = 0; i < serial.size(); ++i) {
    if (!same_pixels(serial[i], parallel[i]))
      note_failure(failures, frame_text(scene, static_cast<int>(i)), "parallel reading gives other pixels");
  }
  return failures;
}

Failures dataset_laws(const Registry& registry, const std::string& name, const Settings& settings,
                      const DatasetBuild& build, const DatasetExpectation& expected) {
  const PluginEntry& entry = registry.get(PluginKind::dataset, name);
  const std::unique_ptr<PluginParams> params = make_params(entry, settings);
  const std::unique_ptr<Dataset> dataset = entry.dataset(*params, build);
  return dataset_laws(*dataset, expected);
}

}  // namespace semfield::testkit
