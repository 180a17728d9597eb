// Packed scenes as a dataset.
#include "scene/loading/packed_scene.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

TEST(Packed, PosesAreCheckedAndPathsStartAtTheConfig) {
  const std::string folder = fresh_folder("p");
  SceneInfo info{.name = "room"};
  FrameInfo f{.name = "a", .camera = room_camera()};
  info.frames = {f, f};
  info.frames[1].name = "b";
  info.frames[1].world_from_camera.r[0][0] = 2;
  write_packed_scene(folder + "/s", info, [&](int, FrameBuffer& out) {
    out = render_room(room_camera(), Pose{});
    out.label.clear();
  });
  NamedDataset packed("packed", {{"file", "s"}}, DatasetBuild{folder});
  Diagnostics d;
  EXPECT_EQ(packed.open(d).frames.size(), 2u);
  ASSERT_EQ(d.error_count(), 1);
  EXPECT_EQ(d.all()[0].where, "frame 'b'");
  EXPECT_EQ(packed.read(0).rgb, render_room(room_camera(), Pose{}).rgb);
}

}  // namespace
}  // namespace semfield
