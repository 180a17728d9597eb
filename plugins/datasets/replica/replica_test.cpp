// Replica layout in a program that took over its user's locale. What it makes of files: tests/bad_files/scenes.cases.
#include <clocale>

#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

// There a number's fraction stands behind a comma.
TEST(Replica, PosesDoNotDependOnTheLocale) {
  const std::string folder = fresh_folder("room");
  write_replica(folder, 6);
  const auto open = [&] { return NamedDataset("replica", {{"root", folder}}).open(); };
  const SceneInfo plain = open();
  if (std::setlocale(LC_ALL, "de_DE.UTF-8") == nullptr)
    GTEST_SKIP() << "the locale de_DE.UTF-8 is not installed here: no comma was tried";
  const SceneInfo german = open();
  std::setlocale(LC_ALL, "C");
  ASSERT_EQ(german.frames.size(), plain.frames.size());
  for (std::size_t i = 0; i < plain.frames.size(); ++i) {
    const Pose &a = german.frames[i].world_from_camera, &b = plain.frames[i].world_from_camera;
    EXPECT_EQ(a.r, b.r);
    EXPECT_EQ((std::array{a.t.x, a.t.y, a.t.z}), (std::array{b.t.x, b.t.y, b.t.z}));
  }
}

}  // namespace
}  // namespace semfield
