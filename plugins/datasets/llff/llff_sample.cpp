// A tiny scene with a poses_bounds.npy, made of images twice as large as those on disk.
#include <algorithm>
#include <filesystem>

#include "formats/image_io.h"
#include "tests/conformance/dataset_samples.h"
#include "tests/conformance/sample_files.h"

namespace semfield::testkit {

SEMFIELD_DATASET_SAMPLE(llff) {
  const SceneInfo scene = write_sample_images(folder, {"images/view_", "depth/view_", "labels/view_"});
  std::vector<float> rows;
  std::vector<const FrameInfo*> by_name;  // "view_10" comes before "view_2"
  for (const FrameInfo& frame : scene.frames) by_name.push_back(&frame);
  const auto name_of = [&](const FrameInfo* f) { return std::to_string(f - scene.frames.data()); };
  std::sort(by_name.begin(), by_name.end(),
            [&](const FrameInfo* a, const FrameInfo* b) { return name_of(a) < name_of(b); });
  for (const FrameInfo* frame : by_name) {
    const Camera camera = frame->camera.resized(2 * frame->camera.width_px, 2 * frame->camera.height_px);
    const double fifth[3] = {static_cast<double>(camera.height_px), static_cast<double>(camera.width_px), camera.fx};
    const Pose& pose = frame->world_from_camera;
    for (int r = 0; r < 3; ++r) {
      for (const double v : {pose.axis(1)[r], pose.axis(0)[r], -pose.axis(2)[r], pose.t[r], fifth[r]})
        rows.push_back(static_cast<float>(v));
    }
    rows.insert(rows.end(), {0.2f, 9.0f});
  }
  const std::int64_t shape[] = {static_cast<std::int64_t>(by_name.size()), 17};
  write_npy((std::filesystem::path(folder) / "poses_bounds.npy").string(), shape, rows);
  return image_sample({{"root", "."}, {"test_every", "4"}, {"label_dir", "labels"}}, false);
}

}  // namespace semfield::testkit
