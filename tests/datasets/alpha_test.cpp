// Alpha of transparent images: offered, read where it is wanted, scaled with the colours, packed, and refused where it
// is none.
#include "app/scene/folder_scene.h"
#include "datasets/packed/packed.h"
#include "datasets/transforms_json/transforms_json.h"
#include "formats/png_codec.h"
#include "scene/scene.h"
#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr std::int32_t kSide = 4;

// Frame a: red, alpha 16 times the pixel's number; frame b: the same without alpha.
std::string two_images(const std::string& name) {
  const std::string folder = fresh_folder(name);
  std::vector<std::uint8_t> with, without;
  for (std::uint8_t i = 0; i < kSide * kSide; ++i) {
    with.insert(with.end(), {200, 0, 0, static_cast<std::uint8_t>(16 * i)});
    without.insert(without.end(), {200, 0, 0});
  }
  const auto write = [&](const char* file, int color_type, const std::vector<std::uint8_t>& rows) {
    const std::vector<std::uint8_t> png = encode_png(kSide, kSide, color_type, 8, rows);
    write_file_atomic(folder + file, std::as_bytes(std::span(png)));
  };
  write("/a.png", 6, with);
  write("/b.png", 2, without);
  const std::string pose = R"("transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]])";
  write_file_atomic(folder + "/transforms.json", R"({"fl_x": 4, "frames": [{"file_path": "a.png", )" + pose +
                                                     R"(}, {"file_path": "b.png", )" + pose + "}]}");
  return folder;
}

SceneLoadOptions load(double downscale, bool wanted) {
  SceneLoadOptions options{.downscale = downscale, .near_m = 1, .far_m = 2, .bounds = {-1, -1, -1, 1, 1, 1}};
  options.check_geometry = false;
  if (wanted) options.channels = {std::string(kAlphaChannel)};
  return options;
}

TEST(Alpha, IsReadWhereItIsWantedAndScaledWithTheColours) {
  TransformsJson scene({.root = two_images("s"), .test_every = 0}, {});
  Diagnostics d;
  const LoadedScene plain = load_scene(scene, load(1, false), d), whole = load_scene(scene, load(1, true), d),
                    half = load_scene(scene, load(2, true), d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(plain.frames.size(), 2U);
  EXPECT_TRUE(plain.frames[0].alpha.empty());
  ASSERT_EQ(whole.frames[0].alpha.size(), 16U);
  for (std::size_t i = 0; i < 16; ++i) EXPECT_EQ(whole.frames[0].alpha[i], 16 * i);
  EXPECT_TRUE(whole.frames[0].channels.empty()) << "kept in bytes alone";
  EXPECT_EQ(whole.frames[0].bytes(), plain.frames[0].bytes() + 16);
  EXPECT_EQ(half.frames[0].alpha, (std::vector<std::uint8_t>{40, 72, 168, 200})) << "means of four";
  EXPECT_TRUE(whole.frames[1].alpha.empty()) << "an image without";
}

TEST(Alpha, IsNotOfferedWhereItIsDropped) {
  TransformsJson scene({.root = two_images("s"), .test_every = 0, .alpha_background = -1}, {});
  Diagnostics d;
  EXPECT_TRUE(scene.open(d).frames.at(0).channels.empty());
}

TEST(Alpha, APackedSceneHasIt) {
  const std::string folder = two_images("s");
  TransformsJson scene({.root = folder, .test_every = 0}, {});
  Diagnostics d;
  (void)pack_scene(scene, folder + "/packed", load(2, false), {}, d);
  Packed packed(PackedParams{"packed"}, DatasetBuild{folder});
  const LoadedScene a = load_scene(scene, load(2, true), d), b = load_scene(packed, load(1, true), d);
  EXPECT_FALSE(d.has_errors());
  EXPECT_EQ(a.frames[0].alpha, b.frames[0].alpha);
  EXPECT_FALSE(b.frames[0].alpha.empty());
  EXPECT_TRUE(b.frames[1].alpha.empty());
  EXPECT_TRUE(load_scene(packed, load(1, false), d).frames[0].alpha.empty());
  EXPECT_EQ(read_text_file(folder + "/packed").at(8), 2) << "a build that knows no alpha says so by the version";
}

TEST(Alpha, IsAShareOfEachPixelOfTheImage) {
  FrameChannelInfo told{std::string(kAlphaChannel), kSide, kSide, 1};
  std::vector<float> values(kSide * kSide, 0.5F);
  const auto refusal = [&] {
    TransformsJson images({.root = two_images("s"), .test_every = 0}, {});
    Diagnostics d;
    const SceneReader reader{[&](Diagnostics& found) {
                               SceneInfo info = images.open(found);
                               for (FrameInfo& frame : info.frames) frame.channels = {told};
                               return info;
                             },
                             [&](int frame, FrameBuffer& out) {
                               out.wanted.clear();
                               images.read(frame, out);
                               out.channels.push_back({told.name, told.height, told.width, told.cols, values});
                             }};
    (void)load_scene(reader, load(1, true), d);
    return d;
  };
  EXPECT_FALSE(refusal().has_errors());
  values[6] = 1.5F;
  EXPECT_FINDING(refusal(), "scene.alpha.range", "1.5", "x 2, y 1", "frame 'a'");
  told.width = 2;
  values.assign(kSide * 2, 0.5F);
  EXPECT_FINDING(refusal(), "scene.alpha.size", "2 x 4", "4 x 4");
}

}  // namespace
}  // namespace semfield
