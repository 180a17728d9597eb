#include "app/scene/pack_scene.h"

#include <filesystem>

#include "scene/alpha.h"
#include "scene/pixel_mask.h"
#include "scene/scene_checks.h"

namespace semfield {

PackSummary pack_scene(Dataset& dataset, const std::string& path, const SceneLoadOptions& size,
                       const PackOptions& options, Diagnostics& diagnostics) {
  validate(size, diagnostics);
  SceneInfo info = dataset.open(diagnostics);
  diagnostics.throw_if_errors(ErrorKind::data, "the scene cannot be packed:");
  convert_info(info, size.convention);
  for (FrameInfo& frame : info.frames) {
    if (!scaled_camera(frame.camera, size, frame.camera)) {
      throw Error(ErrorKind::usage, "scene.load.size",
                  frame_place(frame) + ": frame is smaller than the size asked for", "ask for at most the stored size");
    }
  }
  if (size.near_m > 0) info.near_hint_m = size.near_m;
  if (size.far_m > 0) info.far_hint_m = size.far_m;
  if (size.bounds.size() == 6) {
    info.bounds.lo = {size.bounds[0], size.bounds[1], size.bounds[2]};
    info.bounds.hi = {size.bounds[3], size.bounds[4], size.bounds[5]};
  }
  write_packed_scene(
      path, info,
      [&](int frame, FrameBuffer& out) {
        FrameBuffer whole;
        for (const FrameChannelInfo& one : info.frames[static_cast<std::size_t>(frame)].channels)
          if (one.name == kAlphaChannel) whole.wanted.emplace_back(one.name);
        dataset.read(frame, whole);
        convert_depth(whole, size.convention);
        const Camera& camera = info.frames[static_cast<std::size_t>(frame)].camera;
        hide_masked(whole);  // before it is mixed into other pixels
        out = resize_frame(whole, camera.width_px, camera.height_px);
        hide_masked(out);
      },
      options);
  return {static_cast<int>(info.frames.size()), static_cast<std::uint64_t>(std::filesystem::file_size(path))};
}

}  // namespace semfield
