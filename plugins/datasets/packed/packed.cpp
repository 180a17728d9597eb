// Packed scenes: one file written by `semfield pack`; needs no image library.
#include <memory>
#include <string>

#include "config/params.h"
#include "core/check.h"
#include "core/files.h"
#include "plugin/module.h"
#include "scene/dataset.h"
#include "scene/loading/packed_scene.h"
#include "scene/scene.h"

namespace semfield {

struct PackedParams {
  std::string file;
};

void describe(ParamVisitor& visit, PackedParams& p) {
  SEMFIELD_PARAM(visit, p, file, "the packed scene, as `semfield pack` wrote it");
}

void validate(const PackedParams& p, Diagnostics& diagnostics) {
  if (p.file.empty())
    diagnostics.error("scene.root.unnamed", "file", "the packed scene is not given", "set scene.file");
}

namespace {

// A file that cannot be read is none.
bool begins_as_pack(const std::string& path) {
  try {
    return is_packed_scene(path);
  } catch (const Error&) {
    return false;
  }
}

}  // namespace

std::string recognise(const std::string& path, PackedParams& p) {
  std::error_code unknown;
  std::vector<std::string> found;
  if (is_file(path)) {
    if (begins_as_pack(path)) found.push_back(path);
  } else {
    for (fs::directory_iterator it(path, unknown), end; !unknown && it != end; it.increment(unknown)) {
      if (it->is_regular_file(unknown) && begins_as_pack(it->path().string())) found.push_back(it->path().string());
    }
  }
  if (found.size() != 1) return "";  // of several, the user names one
  p.file = found[0];
  return "a packed scene";
}

class Packed final : public Dataset {
 public:
  Packed(const PackedParams& params, const DatasetBuild& build)
      : path_((fs::path(build.config_dir) / params.file).string()) {}

  SceneInfo open(Diagnostics& diagnostics) override {
    scene_.reset();  // before another is opened
    scene_ = std::make_unique<PackedScene>(path_);
    SceneInfo info = scene_->info();
    // A checksum proves that the bytes arrived, not that a writer was sane: poses and cameras are checked as
    // everywhere.
    for (FrameInfo& frame : info.frames) {
      check_camera(frame.camera, frame_place(frame), diagnostics);
      if (check_pose(frame.world_from_camera, frame_place(frame), diagnostics) == PoseState::not_finite) {
        diagnostics.error("scene.pose.not_finite", frame_place(frame), "pose is not finite", "pack the scene again");
      }
    }
    return info;
  }

  void read(int frame, FrameBuffer& out) const override {
    SEMFIELD_CHECK(scene_ != nullptr, "open() comes before read()");
    scene_->read(frame, out);
  }

 private:
  std::string path_;
  std::unique_ptr<PackedScene> scene_;
};

SEMFIELD_PLUGIN_MODULE(packed, "1.0", [](Registry& registry) {
  registry.add_dataset<Packed, PackedParams>("packed",
                                             "One-file scenes written by `semfield pack`; need no image library.");
})

}  // namespace semfield
