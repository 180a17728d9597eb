// transforms.json flavours: nerfstudio with a lens of its own a frame, Blender's splits, label and depth paths.

#include "datasets/transforms_json/transforms_json.h"

#include <bit>

#include "formats/image_io.h"
#include "formats/npz.h"
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

// What other programs write into transforms.json and beside it: units of depth, lists of splits, masks of moving
// things, a lens as a matrix, depth as arrays, and names as other systems spell them.

constexpr const char* kPose = "\"transform_matrix\": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";

// Files of 4 x 2 pixels, and an index of them.
struct Scene {
  std::string folder;
  TransformsJsonParams params;

  explicit Scene(const std::string& name) : folder(fresh_folder(name)), params{.root = folder, .test_every = 0} {}
  void image(const std::string& name, std::uint8_t grey = 9) const {
    std::filesystem::create_directories(std::filesystem::path(folder + "/" + name).parent_path());
    write_png_rgb(folder + "/" + name, 4, 2, std::vector<std::uint8_t>(24, grey));
  }
  // `frames` are the keys of each but its pose.
  void index(const std::string& head, const std::vector<std::string>& frames) const {
    std::string all;
    for (const std::string& keys : frames) all += (all.empty() ? "{" : ", {") + keys + ", " + kPose + "}";
    plain_write(folder + "/transforms.json", "{" + head + "\"frames\": [" + all + "]}");
  }
  SceneInfo open(Diagnostics& d) const { return TransformsJson(params, {}).open(d); }
  FrameBuffer read(int frame = 0) const {
    TransformsJson scene(params, {});
    Diagnostics d;
    const SceneInfo info = scene.open(d);
    EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
    FrameBuffer out;
    if (frame < std::ssize(info.frames)) scene.read(frame, out);
    return out;
  }
};

constexpr const char* kLens = "\"fl_x\": 3, ";
const std::string kDepthFrame = "\"file_path\": \"a.png\", \"depth_file_path\": \"d.png\"";

TEST(TransformsDialects, UnitsOfDepth) {
  Scene s("s");
  s.image("a.png");
  s.image("b.png");
  write_png_gray16(s.folder + "/d.png", 4, 2, std::vector<std::uint16_t>(8, 2000));
  for (const auto& [keys, depth] : {std::pair{"", 2.0},
                                    {"\"depth_unit_m\": 0.0005, ", 1.0},
                                    {"\"integer_depth_scale\": 0.0001525902, ", 0.3051804},
                                    {"\"depth_unit_scale_factor\": 0.00025, ", 0.5},
                                    {"\"integer_depth_scale\": 0.002, \"depth_unit_m\": 0.002, ", 4.0}}) {
    s.index(std::string(kLens) + keys, {kDepthFrame});
    EXPECT_NEAR(s.read().depth_m.at(0), depth, 1e-6) << keys;
  }
  // A frame's own, and what the configuration says.
  s.index(std::string(kLens) + "\"integer_depth_scale\": 0.0005, ",
          {kDepthFrame, "\"file_path\": \"b.png\", \"depth_path\": \"d.png\", \"integer_depth_scale\": 0.004"});
  EXPECT_NEAR(s.read(0).depth_m.at(0), 1, 1e-6);
  EXPECT_NEAR(s.read(1).depth_m.at(0), 8, 1e-6);
  s.params.depth_unit_m = 0.01;
  EXPECT_NEAR(s.read(0).depth_m.at(0), 20, 1e-5);
  s.params.depth_unit_m = 0;
  for (const char* keys : {"\"integer_depth_scale\": -1, ", "\"depth_unit_scale_factor\": 1e300, ",
                           "\"integer_depth_scale\": 0.001, \"depth_unit_m\": 0.002, "}) {
    s.index(std::string(kLens) + keys, {kDepthFrame});
    Diagnostics d;
    s.open(d);
    EXPECT_FINDING(d, "scene.index.value", "transforms.json");
  }
  // Steps per metre, or metres per step? Only where there is depth, and nothing says.
  s.index(std::string(kLens) + "\"depth_scale\": 1000, ", {kDepthFrame});
  Diagnostics unclear;
  s.open(unclear);
  EXPECT_FINDING(unclear, "scene.depth.unit", "depth_scale", "scene.depth_unit_m");
  s.params.depth_unit_m = 0.001;
  EXPECT_NEAR(s.read().depth_m.at(0), 2, 1e-6);
  s.params.depth_unit_m = 0;
  s.index(std::string(kLens) + "\"depth_scale\": 1000, ", {"\"file_path\": \"a.png\""});
  Diagnostics none;
  s.open(none);
  EXPECT_TRUE(none.all().empty());
}

// Each of Blender's files has a unit of its own.
TEST(TransformsDialects, UnitsOfSeveralFiles) {
  Scene s("s");
  s.image("a.png");
  s.image("b.png");
  write_png_gray16(s.folder + "/d.png", 4, 2, std::vector<std::uint16_t>(8, 2000));
  for (const auto& [name, image, unit] : {std::tuple{"train", "a", "0.001"}, {"test", "b", "0.002"}})
    plain_write(s.folder + "/transforms_" + name + ".json", std::string("{\"fl_x\": 3, \"integer_depth_scale\": ") +
                                                                unit + ", \"frames\": [{\"file_path\": \"" + image +
                                                                "\", \"depth_path\": \"d.png\", " + kPose + "}]}");
  EXPECT_NEAR(s.read(0).depth_m.at(0), 2, 1e-6);
  EXPECT_NEAR(s.read(1).depth_m.at(0), 4, 1e-6);
}

template <class T>
std::string npy(const std::string& type, const std::vector<std::int64_t>& shape, const std::vector<T>& values) {
  return npy_header(type, shape) + std::string(reinterpret_cast<const char*>(values.data()), values.size() * sizeof(T));
}

// Real numbers are metres, integers are steps.
TEST(TransformsDialects, DepthAsArrays) {
  Scene s("s");
  s.image("a.png");
  const std::string frame = "\"file_path\": \"a.png\", \"depth_path\": \"d.npy\"";
  const auto read = [&](const std::string& bytes, const std::string& head = "") {
    plain_write(s.folder + "/d.npy", bytes);
    s.index(kLens + head, {frame});
    return s.read().depth_m;
  };
  const std::vector<float> reals{1.5, -1, INFINITY, NAN, 0, 2, 3, 4};
  EXPECT_EQ(read(npy("<f4", {2, 4}, reals)), (std::vector<float>{1.5, 0, 0, 0, 0, 2, 3, 4}));
  EXPECT_EQ(read(npy("<f8", {1, 2, 4, 1}, std::vector<double>(8, 2.5))), std::vector<float>(8, 2.5));
  EXPECT_EQ(read(npy("<u2", {2, 4}, std::vector<std::uint16_t>{500, 65535, 0, 1, 1, 1, 1, 1})).at(0), 0.5f);
  EXPECT_EQ(read(npy("<u2", {2, 4}, std::vector<std::uint16_t>(8, 65535))), std::vector<float>(8, 0)) << "the ceiling";
  EXPECT_EQ(read(npy("<i4", {2, 4}, std::vector<std::int32_t>(8, 70000)), "\"integer_depth_scale\": 0.0001, ").at(7),
            7.0f);
  plain_write(s.folder + "/d.npy", npy("<f4", {2, 4}, reals));
  s.index(std::string(kLens) + "\"integer_depth_scale\": 0.0001, ", {frame});
  Diagnostics told;
  s.open(told);
  EXPECT_FINDING(told, "scene.depth.real", "1 depth files hold real numbers");
  for (const auto& [bytes, code, says] :
       {std::tuple{npy("<f4", {4, 2}, reals), Code("scene.image.size"), "is 2 x 4 pixels"},
        {npy("<f4", {8}, reals), Code("scene.depth.shape"), "the shape is (8,)"},
        {npy("<f4", {2, 2, 2}, reals), Code("scene.depth.shape"), "[height, width]"},
        {std::string("no array"), Code("files.array.format"), "d.npy"}}) {
    plain_write(s.folder + "/d.npy", bytes);
    Diagnostics d;
    s.open(d);
    EXPECT_FINDING(d, code, "d.npy", says);
  }
}

// 4 x 2 pixels of 16 bits and one value, in one strip without compression.
void write_steps_tiff(const std::string& path, std::uint16_t steps) {
  const std::uint16_t entries[][3] = {{256, 3, 4},   {257, 3, 2}, {258, 3, 16}, {259, 3, 1}, {262, 3, 1},
                                      {273, 4, 122}, {277, 3, 1}, {278, 3, 2},  {279, 4, 16}};
  std::string out("II\x2a\0\x08\0\0\0\x09\0", 10);
  const auto put = [&out](std::uint32_t value, int bytes) {
    for (int i = 0; i < bytes; ++i) out += static_cast<char>(value >> (8 * i));
  };
  for (const auto& [tag, type, value] : entries) {
    put(tag, 2);
    put(type, 2);
    put(1, 4);
    put(value, 4);
  }
  put(0, 4);
  for (int i = 0; i < 8; ++i) put(steps, 2);
  write_file_atomic(path, out);
}

TEST(TransformsDialects, DepthAsTiffOfSixteenBitsIsInSteps) {
  if (!images_available()) GTEST_SKIP() << "this build reads no TIFF (SEMFIELD_WITH_IMAGES=OFF)";
  Scene s("s");
  s.image("a.png");
  write_steps_tiff(s.folder + "/d.tif", 2000);
  s.index(std::string(kLens) + "\"depth_unit_m\": 0.0005, ", {"\"file_path\": \"a.png\", \"depth_path\": \"d.tif\""});
  EXPECT_EQ(s.read().depth_m, std::vector<float>(8, 1.0F));
}

std::string splits_of(const Scene& s, Diagnostics& d) {
  std::string out;
  for (const FrameInfo& f : s.open(d).frames) out += f.split == Split::test ? 'T' : f.split == Split::train ? '.' : '-';
  return out;
}

TEST(TransformsDialects, ListsOfSplits) {
  Scene s("s");
  std::vector<std::string> frames;
  for (const char* name : {"a", "b", "c", "d"}) {
    s.image("images/" + std::string(name) + ".png");
    frames.push_back(std::string("\"file_path\": \"./images/") + name + (*name == 'd' ? "\"" : ".png\""));
  }
  const std::string c = "[\"images/c.png\"], ", d_list = "[\"images/../images/d.png\"], ",
                    ab = "[\"images/a.png\", \".\\\\images\\\\b.png\"], ";
  for (const auto& [lists, splits] : std::vector<std::pair<std::string, std::string>>{
           {"\"test_filenames\": " + c, "..T."},
           {"\"val_filenames\": " + c, "..T."},
           {"\"test_filenames\": " + c + "\"val_filenames\": " + d_list, "..T"},
           {"\"train_filenames\": " + ab + "\"test_filenames\": " + c, "..T"},
           {"\"train_filenames\": " + ab + "\"val_filenames\": " + c, "..T"},
           {"\"train_filenames\": " + ab + "\"val_filenames\": " + c + "\"test_filenames\": " + d_list, "..T"},
           {"\"train_filenames\": [], \"test_filenames\": " + c, "..T."},
           {"\"train_filenames\": null, \"test_filenames\": [\"" + s.folder + "/images/a.png\"], ", "T..."}}) {
    s.index(kLens + lists, frames);
    Diagnostics d;
    EXPECT_EQ(splits_of(s, d), splits) << lists;
    EXPECT_FALSE(d.has_errors()) << lists << d.all()[0].text();
  }
  s.index(std::string(kLens) + "\"test_filenames\": [\"images/c.png\", \"images/e.png\"], ", frames);
  Diagnostics unknown;
  s.open(unknown);
  EXPECT_FINDING(unknown, "scene.split.unknown", "1 of 2 names of 'test_filenames'", "'images/e.png'");
  s.index(std::string(kLens) + "\"test_filenames\": " + c + "\"train_filenames\": " + c, frames);
  Diagnostics both;
  s.open(both);
  EXPECT_FINDING(both, "scene.split.overlap", "images/c.png");
  for (const char* list : {"\"images/c.png\", ", "[3], ", "{}, "}) {
    s.index(std::string(kLens) + "\"val_filenames\": " + list, frames);
    Diagnostics d;
    s.open(d);
    EXPECT_FINDING(d, "scene.index.value", "'val_filenames'");
  }
}

TEST(TransformsDialects, MasksOfMovingThings) {
  Scene s("s");
  for (const char* name : {"a.png", "b.png"}) s.image(std::string("images/") + name);
  write_png_gray8(s.folder + "/images/dynamic_mask_a.png", 4, 2, std::vector<std::uint8_t>{0, 255, 0, 0, 0, 1, 0, 0});
  s.index(kLens, {"\"file_path\": \"images/a.png\"", "\"file_path\": \"images/b.png\""});
  EXPECT_EQ(s.read(0).used, (std::vector<std::uint8_t>{1, 0, 1, 1, 1, 0, 1, 1}));
  EXPECT_TRUE(s.read(1).used.empty());
  Diagnostics d;
  s.open(d);
  EXPECT_FINDING(d, "scene.mask.moving", "1 of 2 images", "dynamic_mask_NAME.png");
  // Both masks leave out.
  std::filesystem::create_directories(s.folder + "/masks");
  for (const char* name : {"a.png", "b.png"})
    write_png_gray8(s.folder + "/masks/" + name, 4, 2, std::vector<std::uint8_t>{0, 9, 9, 9, 9, 9, 9, 9});
  s.params.masks = "masks";
  EXPECT_EQ(s.read(0).used, (std::vector<std::uint8_t>{0, 0, 1, 1, 1, 0, 1, 1}));
  EXPECT_EQ(s.read(1).used, (std::vector<std::uint8_t>{0, 1, 1, 1, 1, 1, 1, 1}));
  write_png_gray8(s.folder + "/images/dynamic_mask_a.png", 2, 2, std::vector<std::uint8_t>(4, 0));
  Diagnostics other;
  s.open(other);
  EXPECT_FINDING(other, "scene.image.size", "mask of moving things", "2 x 2");
}

TEST(TransformsDialects, LensAsAMatrix) {
  Scene s("s");
  s.image("a.png");
  const std::string frame = "\"file_path\": \"a.png\"";
  const auto lens_of = [&](const std::string& head, const std::string& keys, Diagnostics& d) {
    s.index(head, {frame + keys});
    const SceneInfo info = s.open(d);
    const Camera c = info.frames.empty() ? Camera{} : info.frames[0].camera;
    return std::vector<double>{c.fx, c.fy, c.cx, c.cy};
  };
  const std::vector<double> wanted{3, 4, 2.5, 1};
  for (const char* matrix :
       {"[[3, 0, 2.5], [0, 4, 1], [0, 0, 1]]", "[3, 0, 2.5, 0, 4, 1, 0, 0, 1]", "[3, 0, 0, 0, 4, 0, 2.5, 1, 1]",
        "[[3, 0, 2.5, 0], [0, 4, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "[[3, 0, 2.5, 0], [0, 4, 1, 0], [0, 0, 1, 0]]"}) {
    for (const char* key : {"K", "intrinsics", "camera_matrix"}) {
      Diagnostics d;
      const std::string pair = std::string("\"") + key + "\": " + matrix;
      EXPECT_EQ(lens_of("", ", " + pair, d), wanted) << pair;
      EXPECT_EQ(lens_of(pair + ", ", "", d), wanted) << pair;
      EXPECT_EQ(lens_of("\"fl_x\": 7, ", ", " + pair, d), wanted) << "a frame's own";
      EXPECT_TRUE(d.all().empty()) << d.all()[0].text();
    }
  }
  for (const char* matrix : {"[[3, 0.5, 2.5], [0, 4, 1], [0, 0, 1]]", "[[3, 0, 2.5], [0, 4, 1], [0, 0, 2]]", "[3, 4]",
                             "[[3, 0, 2.5], [0, 4, 1]]", "[[3, 0, 2.5], [0, \"4\", 1], [0, 0, 1]]", "\"K.txt\""}) {
    Diagnostics d;
    lens_of("", std::string(", \"K\": ") + matrix, d);
    EXPECT_FINDING(d, "scene.camera.format", "'K'", "fl_x");
  }
  Diagnostics two;
  lens_of("", ", \"fl_x\": 5, \"K\": [[3, 0, 2.5], [0, 4, 1], [0, 0, 1]]", two);
  EXPECT_FINDING(two, "scene.index.value", "'fl_x'", "'K'");
  Diagnostics none;
  lens_of("", "", none);
  EXPECT_FINDING(none, "scene.camera.missing", "a.png", "'fl_x'");
}

TEST(TransformsDialects, NamesOfOtherSystems) {
  Scene s("s");
  const std::string composed = "caf\xC3\xA9", apart = "cafe\xCC\x81";
  s.image("images/" + apart + "/1.png");
  s.image("images/" + apart + "/2.png");
  write_png_gray16(s.folder + "/images/" + apart + "/d.png", 4, 2, std::vector<std::uint16_t>(8, 2000));
  s.index(std::string(kLens) + "\"test_filenames\": [\"images/" + composed + "/2.png\"], ",
          {"\"file_path\": \".\\\\images\\\\" + composed + "\\\\1.png\", \"depth_path\": \"images\\\\" + composed +
               "\\\\d.png\"",
           "\"file_path\": \"images/" + composed + "/2\""});
  Diagnostics d;
  const SceneInfo info = s.open(d);
  ASSERT_EQ(info.frames.size(), 2u) << d.all()[0].text();
  EXPECT_FALSE(d.has_errors()) << d.all()[0].text();
  EXPECT_EQ(info.frames[0].name, "1");
  EXPECT_TRUE(info.frames[0].has_depth);
  EXPECT_EQ(info.frames[1].split, Split::test);
  EXPECT_EQ(info.frames[1].source, s.folder + "/images/" + apart + "/2.png");
  s.index(kLens, {"\"file_path\": \"C:\\\\scene\\\\1.png\""});
  Diagnostics drive;
  s.open(drive);
  EXPECT_FINDING(drive, "scene.file.missing", "C:/scene/1.png", "a drive of Windows");
}

// Depth of a camera of its own is drawn into the colour image, whatever its size; what is not one is refused.
TEST(TransformsDialects, DepthOfACameraOfItsOwn) {
  Scene s("apart");
  s.image("a.png");
  s.image("b.png");
  write_png_gray16(s.folder + "/d.png", 8, 6, std::vector<std::uint16_t>(48, 2000));
  const std::string lens = "\"depth_camera\": {\"w\": 8, \"h\": 6, \"fl_x\": 3, \"fl_y\": 3, \"cx\": 4, \"cy\": 3, ";
  const std::string still = "\"depth_from_color\": [[1,0,0,0],[0,1,0,0],[0,0,1,0.5],[0,0,0,1]]}, ";
  s.index(kLens + lens + still, {kDepthFrame, "\"file_path\": \"b.png\""});
  const FrameBuffer read = s.read();
  ASSERT_EQ(read.depth_m.size(), 8u);
  for (const float z : read.depth_m) EXPECT_NEAR(z, 1.5f, 1e-5f) << "the depth camera stands half a metre behind";
  for (const std::string& bad : {lens + "\"depth_from_color\": [[1,0,0,0]]}, ",
                                 std::string("\"depth_camera\": {") + still, std::string("\"depth_camera\": 7, "),
                                 lens + "\"depth_from_color\": [[1,0,0,0],[0,1,0,0],[0,0,null,0],[0,0,0,1]]}, "}) {
    s.index(kLens + bad, {kDepthFrame});
    Diagnostics d;
    (void)s.open(d);
    EXPECT_TRUE(d.has_errors()) << bad;
    std::string said;
    for (const Diagnostic& one : d.all()) said += one.text();
    EXPECT_HAS(said, "depth_camera");
  }
}

}  // namespace
}  // namespace semfield
