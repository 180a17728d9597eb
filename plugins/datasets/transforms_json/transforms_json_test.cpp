// transforms.json flavours: nerfstudio with a lens of its own a frame, Blender's splits, label and depth paths.
#include "datasets/transforms_json/transforms_json.h"

#include "formats/png_codec.h"
#include "scene/scene.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kEye = "\"transform_matrix\": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";

void write_image(const std::string& path) { write_png_rgb(path, 4, 2, std::vector<std::uint8_t>(24, 9)); }

TEST(TransformsJson, BlenderSplitsAndAngle) {
  const std::string folder = fresh_folder("b");
  std::filesystem::create_directories(folder + "/train");
  std::filesystem::create_directories(folder + "/test");
  write_image(folder + "/train/r_0.png");
  write_image(folder + "/test/r_0.png");
  const std::string head = "{\"camera_angle_x\": 1.5707963267948966, \"frames\": [{\"file_path\": \"./";
  write_file_atomic(folder + "/transforms_train.json", head + "train/r_0\", " + kEye + "}]}");
  write_file_atomic(folder + "/transforms_test.json", head + "test/r_0\", " + kEye + "}]}");
  TransformsJsonParams p{.root = folder};
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[0].split, Split::train);
  EXPECT_EQ(info.frames[1].split, Split::test);
  EXPECT_EQ(info.frames[1].name, "test_r_0");
  EXPECT_NEAR(info.frames[0].camera.fx, 2.0, 1e-12);
  EXPECT_NEAR(info.frames[0].camera.fy, 2.0, 1e-12);
  EXPECT_EQ(info.frames[0].camera.cy, 1.0);
  EXPECT_EQ(info.frames[0].world_from_camera.axis(2), (Vec3d{0, 0, -1}));
  EXPECT_EQ(info.frames[0].world_from_camera.t, (Vec3d{1, 2, 3}));
}

TEST(TransformsJson, OwnLensDepthAndLabels) {
  const std::string folder = fresh_folder("n");
  write_image(folder + "/a.png");
  write_image(folder + "/b.png");
  write_png_gray16(folder + "/d.png", 4, 2, std::vector<std::uint16_t>{0, 1, 65535, 4000, 1, 1, 1, 1});
  write_png_gray8(folder + "/l.png", 4, 2, std::vector<std::uint8_t>{0, 7, 7, 7, 0, 0, 0, 7});
  write_file_atomic(
      folder + "/transforms.json",
      std::string("{\"fl_x\": 3, \"fl_y\": 4, \"cx\": 1.5, \"k1\": 0.1, \"depth_unit_m\": 0.0005, \"classes\": "
                  "[{\"id\": 0, \"name\": \"void\", \"ignore\": "
                  "true}, {\"id\": 7, \"name\": \"cup\"}], \"frames\": [{\"file_path\": \"a.png\", ") +
          kEye + "}, {\"file_path\": \"b.png\", \"fl_x\": 5, \"depth_path\": \"d.png\", \"label_path\": \"l.png\", " +
          kEye + "}]}");
  TransformsJsonParams p{.root = folder, .test_every = 0};
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[0].camera.fx, 3.0);
  EXPECT_EQ(info.frames[1].camera.fx, 5.0);
  EXPECT_EQ(info.frames[1].camera.fy, 4.0);
  EXPECT_EQ(info.frames[1].camera.k1, 0.1);
  EXPECT_FALSE(info.frames[0].has_depth);
  FrameBuffer out;
  scene.read(1, out);
  EXPECT_EQ(out.depth_m, (std::vector<float>{0, 0.0005f, 0, 2, 0.0005f, 0.0005f, 0.0005f, 0.0005f}));
  EXPECT_EQ(out.label, (std::vector<std::int16_t>{kVoid, 0, 0, 0, kVoid, kVoid, kVoid, 0}));
}

TEST(TransformsJson, MasksComeFromTheIndexAFolderOrAlpha) {
  const std::string folder = fresh_folder("m");
  const std::vector<std::uint8_t> index{0, 1, 2, 0, 0, 0, 0, 0}, grey(9, 9), alpha{255, 254, 0};
  const std::vector<std::uint8_t> palette = encode_png(4, 2, 3, 8, index, {grey, alpha});
  write_file_atomic(folder + "/a.png", std::as_bytes(std::span(palette)));
  write_image(folder + "/b.png");
  std::filesystem::create_directories(folder + "/masks");
  write_png_gray8(folder + "/m.png", 4, 2, std::vector<std::uint8_t>{0, 1, 2, 255, 0, 0, 0, 128});
  write_png_rgb(folder + "/masks/b.png", 4, 2, std::vector<std::uint8_t>(24, 0));
  write_file_atomic(folder + "/transforms.json",
                    std::string("{\"fl_x\": 3, \"frames\": [{\"file_path\": \"a.png\", \"mask_path\": \"m.png\", ") +
                        kEye + "}, {\"file_path\": \"b.png\", " + kEye + "}]}");
  const auto used = [&](const TransformsJsonParams& p) {
    Diagnostics d;
    TransformsJson scene(p, {});
    scene.open(d);
    EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
    std::vector<std::vector<std::uint8_t>> out;
    FrameBuffer frame;
    for (const int f : {0, 1}) {
      scene.read(f, frame);
      out.push_back(frame.used);
    }
    return out;
  };
  using Used = std::vector<std::vector<std::uint8_t>>;
  EXPECT_EQ(used({.root = folder}), (Used{{0, 1, 1, 1, 0, 0, 0, 1}, {}}));
  EXPECT_EQ(used({.root = folder, .masks = "masks"}), (Used{{0, 1, 1, 1, 0, 0, 0, 1}, {0, 0, 0, 0, 0, 0, 0, 0}}));
  EXPECT_EQ(used({.root = folder, .alpha_masks = true}), (Used{{0, 0, 0, 1, 0, 0, 0, 1}, {}}));
}

// NeRFCapture leaves the extension out, states the lens of each frame, and names a depth image whether it wrote one or
// not.
TEST(TransformsJson, ACaptureOfNeRFCaptureIsReadAsItIs) {
  const std::string folder = fresh_folder("c");
  std::filesystem::create_directories(folder + "/images");
  for (const char* name : {"/images/0.png", "/images/1.png"}) write_image(folder + name);
  const auto frame = [](const std::string& name) {
    return "{\"file_path\":\"images/" + name + "\",\"depth_path\":\"images/" + name +
           ".depth.png\",\"timestamp\":123.4,\"fl_x\":3.5,\"fl_y\":3.5,\"cx\":2.1,\"cy\":1,\"w\":4,\"h\":2," + kEye +
           "}";
  };
  write_file_atomic(
      folder + "/transforms.json",
      "{\"w\":4,\"h\":2,\"fl_x\":1,\"fl_y\":1,\"cx\":320,\"cy\":240,\"depth_integer_scale\":1,\"frames\":[" +
          frame("0") + "," + frame("1") + "]}");
  Diagnostics d;
  TransformsJson(TransformsJsonParams{.root = folder}, {}).open(d);
  EXPECT_FINDING(d, "scene.file.missing", "0.depth.png", "scene.missing=skip");
  Diagnostics without;
  const SceneInfo info =
      TransformsJson(TransformsJsonParams{.root = folder, .missing = MissingFiles::skip}, {}).open(without);
  EXPECT_FALSE(without.has_errors());
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[1].source, folder + "/images/1.png");
  EXPECT_EQ(info.frames[1].camera.fx, 3.5);
  EXPECT_EQ(info.frames[1].camera.cx, 2.1);
}

TEST(TransformsJson, WideLensesAreThoseOfNerfstudio) {
  const std::string folder = fresh_folder("w");
  write_image(folder + "/a.png");
  const auto camera_of = [&](const std::string& keys, const std::string& of_frame = "") {
    write_file_atomic(folder + "/transforms.json",
                      "{" + keys + "\"frames\": [{\"file_path\": \"a.png\", " + of_frame + kEye + "}]}");
    Diagnostics d;
    TransformsJson scene({.root = folder}, {});
    const SceneInfo info = scene.open(d);
    EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
    return info.frames.at(0).camera;
  };
  const std::string model = "\"camera_model\": \"OPENCV_FISHEYE\", \"fl_x\": 3, \"k4\": 0.01, ";
  EXPECT_EQ(camera_of(model).lens, LensKind::fisheye);
  EXPECT_EQ(camera_of(model).k4, 0.01);
  EXPECT_EQ(camera_of("\"fl_x\": 3, ", "\"is_fisheye\": \"true\", ").lens, LensKind::fisheye);
  EXPECT_EQ(camera_of("\"fl_x\": 3, \"is_fisheye\": 1, ", "\"camera_model\": \"OPENCV\", ").lens,
            LensKind::perspective);
  // Half the width and the height stand for the whole sphere, and so does no focal length.
  for (const char* focal : {"\"fl_x\": 2, \"fl_y\": 2, ", ""}) {
    const Camera c = camera_of(std::string("\"camera_model\": \"EQUIRECTANGULAR\", ") + focal);
    EXPECT_EQ(c.lens, LensKind::equirectangular);
    EXPECT_NEAR(c.direction(4, 1).z, -1, 1e-12) << "the right edge is behind";
    EXPECT_NEAR(c.direction(2, 0).y, -1, 1e-12) << "the top edge is above";
  }
}

TEST(TransformsJson, FurtherChannelsAreReadWhereTheyAreWanted) {
  const std::string folder = fresh_folder("n");
  write_image(folder + "/a.png");
  write_image(folder + "/b.png");
  write_npy(folder + "/n.npy", std::vector<std::int64_t>{1, 2, 3}, std::vector<float>{1, 2, 3, 4, 5, 6});
  write_npy(folder + "/flat.npy", std::vector<std::int64_t>{2, 3}, std::vector<float>{1, 2, 3, 4, 5, 6});
  const auto index = [&](const std::string& file) {
    write_file_atomic(folder + "/transforms.json",
                      "{\"fl_x\": 3, \"frames\": [{\"file_path\": \"a.png\", \"normal_path\": \"" + file + "\", " +
                          kEye + "}, {\"file_path\": \"b.png\", " + kEye + "}]}");
  };
  TransformsJsonParams p{.root = folder, .test_every = 0, .channels = {"normal"}};
  index("n.npy");
  TransformsJson scene(p, {});
  Diagnostics d;
  const SceneInfo info = scene.open(d);
  EXPECT_FALSE(d.has_errors());
  ASSERT_EQ(info.frames.at(0).channels.size(), 1u);
  EXPECT_EQ(info.frames[0].channels[0].width, 2);
  EXPECT_EQ(info.frames[0].channels[0].cols, 3);
  EXPECT_TRUE(info.frames.at(1).channels.empty());
  FrameBuffer plain, with;
  scene.read(0, plain);
  EXPECT_TRUE(plain.channels.empty());
  with.wanted = {"normal"};
  scene.read(0, with);
  ASSERT_EQ(with.channels.size(), 1u);
  EXPECT_EQ(with.channels[0].values, (std::vector<float>{1, 2, 3, 4, 5, 6}));
  const StoredFrame stored(with);
  std::vector<float> cell(3);
  stored.read_channel("normal", stored.width_px - 1, cell);
  EXPECT_EQ(cell, (std::vector<float>{4, 5, 6})) << "the right half of the image";
  Diagnostics unnamed;
  TransformsJsonParams none = p;
  none.channels.clear();
  TransformsJson(none, {}).open(unnamed);
  ASSERT_EQ(unnamed.all().size(), 1u);
  EXPECT_NE(unnamed.all()[0].message.find("scene.channels: [normal]"), std::string::npos);
  for (const auto& [file, says] : {std::pair{"flat.npy", "got (2, 3)"}, std::pair{"gone.npy", "gone.npy"}}) {
    index(file);
    Diagnostics wrong;
    TransformsJson(p, {}).open(wrong);
    ASSERT_EQ(wrong.error_count(), 1) << file;
    EXPECT_HAS(wrong.all()[0].text(), says);
  }
}

// nerfstudio's list has the coefficients in this order, and a frame's own takes the place of the file's.
TEST(TransformsJson, DistortionParamsAreTheLens) {
  const std::string folder = fresh_folder("d");
  write_image(folder + "/a.png");
  write_image(folder + "/b.png");
  write_file_atomic(folder + "/transforms.json",
                    std::string("{\"fl_x\": 3, \"distortion_params\": [0.01, 0.02, 0.03, 0.04, 0.05, 0.06], "
                                "\"frames\": [{\"file_path\": \"a.png\", ") +
                        kEye + "}, {\"file_path\": \"b.png\", \"distortion_params\": [0.1, 0, 0, 0, 0, 0], " + kEye +
                        "}]}");
  Diagnostics d;
  const TransformsIndex index = read_transforms(folder, "", {}, d);
  EXPECT_FALSE(d.has_errors());
  const TransformsLens& a = index.frames.at(0).lens;
  EXPECT_EQ((std::vector<double>{a.k1, a.k2, a.k3, a.k4, a.p1, a.p2}),
            (std::vector<double>{0.01, 0.02, 0.03, 0.04, 0.05, 0.06}));
  EXPECT_EQ(index.frames.at(1).lens.k1, 0.1);
  EXPECT_EQ(index.frames.at(1).lens.p2, 0.0);
}

// An uncompressed TIFF of one strip, 4 x 2 pixels, with an orientation as EXIF has it.
void write_tiff(const std::string& path, int orientation) {
  const std::uint32_t entries[][4] = {{256, 3, 1, 4}, {257, 3, 1, 2},   {258, 3, 3, 134}, {259, 3, 1, 1},
                                      {262, 3, 1, 2}, {273, 4, 1, 140}, {274, 3, 1, 1},   {277, 3, 1, 3},
                                      {278, 3, 1, 2}, {279, 4, 1, 24}};
  std::string out("II\x2a\0\x08\0\0\0", 8);
  const auto put = [&out](std::uint32_t value, int bytes) {
    for (int i = 0; i < bytes; ++i) out += static_cast<char>(value >> (8 * i));
  };
  put(10, 2);
  for (const auto& [tag, type, count, value] : entries) {
    put(tag, 2);
    put(type, 2);
    put(count, 4);
    put(tag == 274 ? static_cast<std::uint32_t>(orientation) : value, 4);
  }
  put(0, 4);
  for (int i = 0; i < 3; ++i) put(8, 2);
  write_file_atomic(path, out + std::string(24, 'g'));
}

// Pixels count as they are stored. Where the camera is that of the picture as viewers turn it, that is said.
TEST(TransformsJson, ExifOrientationIsNamed) {
  if (!images_available()) GTEST_SKIP() << "this build reads no TIFF (SEMFIELD_WITH_IMAGES=OFF)";
  const std::string folder = fresh_folder("e");
  const auto said = [&](int orientation, const std::string& size) {
    write_tiff(folder + "/a.tif", orientation);
    write_file_atomic(folder + "/transforms.json",
                      "{\"fl_x\": 3, " + size + ", \"frames\": [{\"file_path\": \"a.tif\", " + kEye + "}]}");
    TransformsJsonParams p{.root = folder};
    Diagnostics d;
    TransformsJson(p, {}).open(d);
    return d.all().empty() ? std::string() : d.all().front().text();
  };
  EXPECT_EQ(said(1, "\"w\": 4, \"h\": 2"), "");
  EXPECT_HAS(said(3, "\"w\": 4, \"h\": 2"),
             "1 of 1 images have an EXIF orientation by which viewers turn them; here "
             "pixels count as they are stored");
  EXPECT_HAS(said(6, "\"w\": 2, \"h\": 4"),
             "is 4 x 2 pixels, the camera 2 x 4, which is that of the picture turned as the file's EXIF "
             "orientation says (6); pixels are read as they are stored: turn them, for example with `mogrify "
             "-auto-orient FILES`");
  EXPECT_HAS(said(1, "\"w\": 2, \"h\": 4"), "one is turned by a quarter against the other");
}

// Comparisons, not seconds: a list of names is looked up, not walked, and equal stems get numbers without new tries.
TEST(TransformsJson, AHundredThousandFramesOfListsAndOfOneName) {
  const std::string folder = fresh_folder("m");
  std::string frames, names;
  for (int i = 0; i < 100'000; ++i) {
    const std::string path = "\"" + std::to_string(i) + "/rgb/image.png\"";
    frames += std::string(i > 0 ? "," : "") + "{\"file_path\":" + path + "," + kEye + "}";
    names += (i > 0 ? "," : "") + path;
  }
  write_file_atomic(folder + "/transforms.json",
                    "{\"fl_x\":4,\"w\":4,\"h\":2,\"train_filenames\":[" + names + "],\"frames\":[" + frames + "]}");
  Diagnostics d;
  const TransformsIndex index = read_transforms(folder, "label_path", {}, d);
  ASSERT_EQ(index.frames.size(), 100'000u);
  EXPECT_EQ(index.frames.back().split, Split::train);
  FrameNames given;
  std::string last;
  for (const TransformsFrame& frame : index.frames) last = given.of(frame.file_path);
  EXPECT_EQ(last, "rgb_image_99999");
}

// instant-ngp's box in the axes of the poses: (0.5 -+ aabb_scale / 2 - offset) / scale.
TEST(TransformsJson, AabbScaleIsALimitOfTheBounds) {
  const std::string folder = fresh_folder("a");
  write_image(folder + "/a.png");
  const auto limit_of = [&](const std::string& keys, Diagnostics& d) {
    write_file_atomic(folder + "/transforms.json",
                      "{" + keys + " \"fl_x\": 3, \"frames\": [{\"file_path\": \"a.png\", " + kEye + "}]}");
    TransformsJsonParams p{.root = folder};
    return TransformsJson(p, {}).open(d).limit;
  };
  Diagnostics d;
  EXPECT_TRUE(limit_of("", d).empty());
  const Box usual = limit_of("\"aabb_scale\": 4,", d);
  EXPECT_NEAR(usual.lo.x, -2 / 0.33, 1e-12);
  EXPECT_NEAR(usual.hi.z, 2 / 0.33, 1e-12);
  const Box moved = limit_of("\"aabb_scale\": 1, \"scale\": 0.5, \"offset\": [0.5, 0.25, 1],", d);
  EXPECT_NEAR(moved.lo.x, -1, 1e-12);
  EXPECT_NEAR(moved.lo.y, -0.5, 1e-12);
  EXPECT_NEAR(moved.hi.z, 0, 1e-12);
  EXPECT_FALSE(d.has_errors());
  for (const char* bad : {"\"aabb_scale\": 0,", "\"aabb_scale\": -1,", "\"aabb_scale\": \"big\",",
                          "\"aabb_scale\": 1, \"scale\": 0,", "\"aabb_scale\": 1, \"offset\": \"x\","}) {
    Diagnostics refused;
    limit_of(bad, refused);
    EXPECT_EQ(refused.error_count(), 1) << bad;
  }
}

}  // namespace
}  // namespace semfield
