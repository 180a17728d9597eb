// A dataset from outside: a camera that slides along a flat wall two metres away.
#include "plugin/module.h"

namespace outside {

struct CorridorParams {
  int frames = 4;
};
void describe(semfield::ParamVisitor& visit, CorridorParams& p) {
  SEMFIELD_PARAM(visit, p, frames, "number of frames", {1, 100});
}
void validate(const CorridorParams&, semfield::Diagnostics&) {}

class Corridor final : public semfield::Dataset {
 public:
  Corridor(const CorridorParams& params, const semfield::DatasetBuild&) : frames_(params.frames) {}
  semfield::SceneInfo open(semfield::Diagnostics&) override {
    semfield::SceneInfo scene;
    scene.name = "corridor";
    scene.classes = semfield::ClassTable({{1, "left", {255, 0, 0}, false}, {2, "right", {0, 0, 255}, false}});
    for (int i = 0; i < frames_; ++i) {
      semfield::FrameInfo frame;
      frame.name = "slide_" + std::to_string(i);
      frame.camera.width_px = kWidth;
      frame.camera.height_px = kHeight;
      frame.camera.fx = frame.camera.fy = 20;
      frame.camera.cx = kWidth / 2.0;
      frame.camera.cy = kHeight / 2.0;
      frame.world_from_camera.t = {kStep * i, 0, 0};
      frame.has_depth = frame.has_labels = true;
      scene.frames.push_back(frame);
    }
    return scene;
  }
  void read(int frame, semfield::FrameBuffer& out) const override {
    out = {};
    out.width_px = kWidth;
    out.height_px = kHeight;
    for (int row = 0; row < kHeight; ++row) {
      for (int col = 0; col < kWidth; ++col) {
        const double x = kStep * frame + (col + 0.5 - kWidth / 2.0) / 20 * kWall;
        const bool right = x > 0;
        out.rgb.insert(out.rgb.end(),
                       {static_cast<std::uint8_t>(right ? 0 : 255), 0, static_cast<std::uint8_t>(right ? 255 : 0)});
        out.depth_m.push_back(static_cast<float>(kWall));
        out.label.push_back(right ? 1 : 0);
      }
    }
  }

 private:
  static constexpr int kWidth = 24, kHeight = 18;
  static constexpr double kWall = 2.0, kStep = 0.1;
  int frames_;
};

void register_into(semfield::Registry& registry) {
  registry.add_dataset<Corridor, CorridorParams>("corridor", "A slide along a wall.");
}

}  // namespace outside

SEMFIELD_PLUGIN_MODULE(corridor, "0.1", outside::register_into)
