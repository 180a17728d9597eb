// What other programs write into transforms.json and beside it: units of depth, lists of splits, masks of moving
// things, a lens as a matrix, depth as arrays, and names as other systems spell them.
#include <bit>

#include "datasets/transforms_json/transforms_json.h"
#include "formats/npz.h"
#include "formats/png_codec.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

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

// A parser keeps the last of two keys without a word.
TEST(TransformsDialects, AKeyTwiceIsRefused) {
  Scene s("s");
  s.image("a.png");
  s.index("\"fl_x\": 3, \"fl_x\": 30, ", {"\"file_path\": \"a.png\""});
  Diagnostics d;
  EXPECT_ERROR(s.open(d), "scene.index.twice", "'fl_x'", "transforms.json");
  s.index(kLens, {"\"file_path\": \"b.png\", \"file_path\": \"a.png\""});
  EXPECT_ERROR(s.open(d), "scene.index.twice", "'file_path'");
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
