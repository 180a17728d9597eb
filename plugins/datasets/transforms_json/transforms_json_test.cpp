// transforms.json: lenses, channels, masks, TIFF, lists of splits, and names as other systems spell them. Units and
// arrays of depth, a lens as a matrix and further dialects: tests/bad_files/scenes.cases.

#include "formats/image_io.h"
#include "formats/npz.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"
#include "tests/datasets/named_dataset.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using namespace testing_room;

constexpr const char* kPose = "\"transform_matrix\": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";
const std::string kLens = "\"fl_x\": 3, ";

// The index of frames whose keys but for the pose are these.
std::string index_of(const std::string& head, const std::vector<std::string>& frames) {
  std::string all;
  for (const std::string& keys : frames) all += (all.empty() ? "{" : ", {") + keys + ", " + kPose + "}";
  return "{" + head + "\"frames\": [" + all + "]}";
}

// A folder with the images a.png and b.png of 4 x 2 pixels, and an index of them.
struct Scene {
  std::string folder = fresh_folder("s");
  testkit::Settings params{{"root", folder}, {"test_every", "0"}};

  Scene() {
    for (const char* name : {"a.png", "b.png"}) image(name);
  }
  void image(const std::string& name) const {
    std::filesystem::create_directories(std::filesystem::path(folder + "/" + name).parent_path());
    write_png_rgb(folder + "/" + name, 4, 2, std::vector<std::uint8_t>(24, 9));
  }
  void gray(const std::string& name, const std::vector<std::uint8_t>& values) const {
    std::filesystem::create_directories(std::filesystem::path(folder + "/" + name).parent_path());
    write_png_gray8(folder + "/" + name, 4, 2, values);
  }
  void index(const std::string& head, const std::vector<std::string>& frames) const {
    plain_write(folder + "/transforms.json", index_of(head, frames));
  }
  // Without an error.
  SceneInfo open() const { return NamedDataset("transforms_json", params).open(); }
  Diagnostics findings() const {
    Diagnostics d;
    NamedDataset("transforms_json", params).open(d);
    return d;
  }
  FrameBuffer read(int frame = 0, const std::vector<std::string>& wanted = {}) const {
    NamedDataset scene("transforms_json", params);
    FrameBuffer out;
    out.wanted = wanted;
    if (frame < std::ssize(scene.open().frames)) scene.read(frame, out);
    return out;
  }
};

using Used = std::vector<std::uint8_t>;

TEST(TransformsJson, OwnLensDepthAndLabels) {
  const Scene s;
  write_png_gray16(s.folder + "/d.png", 4, 2, std::vector<std::uint16_t>{0, 1, 65535, 4000, 1, 1, 1, 1});
  s.gray("l.png", {0, 7, 7, 7, 0, 0, 0, 7});
  s.index(
      "\"fl_x\": 3, \"fl_y\": 4, \"cx\": 1.5, \"k1\": 0.1, \"depth_unit_m\": 0.0005, "
      "\"classes\": [{\"id\": 0, \"name\": \"void\", \"ignore\": true}, {\"id\": 7, \"name\": \"cup\"}], ",
      {"\"file_path\": \"a.png\"",
       "\"file_path\": \"b.png\", \"fl_x\": 5, \"depth_path\": \"d.png\", \"label_path\": \"l.png\""});
  const SceneInfo info = s.open();
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[0].camera.fx, 3.0);
  EXPECT_EQ(info.frames[1].camera.fx, 5.0);
  EXPECT_EQ(info.frames[1].camera.fy, 4.0);
  EXPECT_EQ(info.frames[1].camera.k1, 0.1);
  EXPECT_FALSE(info.frames[0].has_depth);
  const FrameBuffer out = s.read(1);
  EXPECT_EQ(out.depth_m, (std::vector<float>{0, 0.0005f, 0, 2, 0.0005f, 0.0005f, 0.0005f, 0.0005f}));
  EXPECT_EQ(out.label, (std::vector<std::int16_t>{kVoid, 0, 0, 0, kVoid, kVoid, kVoid, 0}));
}

TEST(TransformsJson, MasksComeFromTheIndexAFolderOrAlpha) {
  Scene s;
  const std::vector<std::uint8_t> index{0, 1, 2, 0, 0, 0, 0, 0}, grey(9, 9), alpha{255, 254, 0};
  const std::vector<std::uint8_t> palette = encode_png(4, 2, 3, 8, index, {grey, alpha});
  write_file_atomic(s.folder + "/a.png", std::as_bytes(std::span(palette)));
  s.gray("m.png", {0, 1, 2, 255, 0, 0, 0, 128});
  s.gray("masks/b.png", Used(8, 0));
  s.index(kLens, {"\"file_path\": \"a.png\", \"mask_path\": \"m.png\"", "\"file_path\": \"b.png\""});
  EXPECT_EQ(s.read(0).used, (Used{0, 1, 1, 1, 0, 0, 0, 1}));
  EXPECT_TRUE(s.read(1).used.empty());
  s.params["masks"] = "masks";
  EXPECT_EQ(s.read(1).used, Used(8, 0));
  s.params["masks"] = "";
  s.params["alpha_masks"] = "true";
  EXPECT_EQ(s.read(0).used, (Used{0, 0, 0, 1, 0, 0, 0, 1}));
}

TEST(TransformsJson, WideLensesAreThoseOfNerfstudio) {
  const Scene s;
  const auto camera_of = [&](const std::string& head, const std::string& of_frame = "") {
    s.index(head, {"\"file_path\": \"a.png\"" + of_frame});
    return s.open().frames.at(0).camera;
  };
  const Camera fisheye = camera_of("\"camera_model\": \"OPENCV_FISHEYE\", \"fl_x\": 3, \"k4\": 0.01, ");
  EXPECT_EQ(fisheye.lens, LensKind::fisheye);
  EXPECT_EQ(fisheye.k4, 0.01);
  EXPECT_EQ(camera_of(kLens, ", \"is_fisheye\": \"true\"").lens, LensKind::fisheye);
  EXPECT_EQ(camera_of(kLens + "\"is_fisheye\": 1, ", ", \"camera_model\": \"OPENCV\"").lens, LensKind::perspective);
  // Half the width and the height stand for the whole sphere, and so does no focal length.
  for (const char* focal : {"\"fl_x\": 2, \"fl_y\": 2, ", ""}) {
    const Camera c = camera_of(std::string("\"camera_model\": \"EQUIRECTANGULAR\", ") + focal);
    EXPECT_EQ(c.lens, LensKind::equirectangular);
    EXPECT_NEAR(c.direction(4, 1).z, -1, 1e-12) << "the right edge is behind";
    EXPECT_NEAR(c.direction(2, 0).y, -1, 1e-12) << "the top edge is above";
  }
}

TEST(TransformsJson, FurtherChannelsAreReadWhereTheyAreWanted) {
  Scene s;
  s.params["channels"] = "normal";
  const std::vector<float> values{1, 2, 3, 4, 5, 6};
  write_npy(s.folder + "/n.npy", std::vector<std::int64_t>{1, 2, 3}, values);
  write_npy(s.folder + "/flat.npy", std::vector<std::int64_t>{2, 3}, values);
  const auto index = [&](const std::string& file) {
    s.index(kLens, {"\"file_path\": \"a.png\", \"normal_path\": \"" + file + "\"", "\"file_path\": \"b.png\""});
  };
  index("n.npy");
  const SceneInfo info = s.open();
  ASSERT_EQ(info.frames.at(0).channels.size(), 1u);
  EXPECT_EQ(info.frames[0].channels[0].width, 2);
  EXPECT_EQ(info.frames[0].channels[0].cols, 3);
  EXPECT_TRUE(info.frames.at(1).channels.empty());
  EXPECT_TRUE(s.read().channels.empty());
  const FrameBuffer with = s.read(0, {"normal"});
  ASSERT_EQ(with.channels.size(), 1u);
  EXPECT_EQ(with.channels[0].values, values);
  const StoredFrame stored(with);
  std::vector<float> cell(3);
  stored.read_channel("normal", stored.width_px - 1, cell);
  EXPECT_EQ(cell, (std::vector<float>{4, 5, 6})) << "the right half of the image";
  for (const auto& [file, says] : {std::pair{"flat.npy", "got (2, 3)"}, std::pair{"gone.npy", "gone.npy"}}) {
    index(file);
    EXPECT_HAS(all_said(s.findings()), says);
  }
  s.params.erase("channels");
  EXPECT_HAS(all_said(s.findings()), "scene.channels: [normal]");
}

// nerfstudio's list has the coefficients in this order, and a frame's own takes the place of the file's.
TEST(TransformsJson, DistortionParamsAreTheLens) {
  const Scene s;
  s.index(kLens + "\"distortion_params\": [0.01, 0.02, 0.03, 0.04, 0.05, 0.06], ",
          {"\"file_path\": \"a.png\"", "\"file_path\": \"b.png\", \"distortion_params\": [0.1, 0, 0, 0, 0, 0]"});
  const SceneInfo info = s.open();
  const Camera &a = info.frames.at(0).camera, &b = info.frames.at(1).camera;
  EXPECT_EQ((std::vector<double>{a.k1, a.k2, a.k3, a.k4, a.p1, a.p2}),
            (std::vector<double>{0.01, 0.02, 0.03, 0.04, 0.05, 0.06}));
  EXPECT_EQ(b.k1, 0.1);
  EXPECT_EQ(b.p2, 0.0);
}

// An uncompressed TIFF of one strip, 4 x 2 pixels of 1 or 3 samples, with an orientation as EXIF has it.
void write_tiff(const std::string& path, std::uint32_t samples, std::uint32_t bits, std::uint32_t orientation,
                const std::string& pixels) {
  const std::uint32_t bytes = static_cast<std::uint32_t>(pixels.size());
  const std::uint32_t entries[][4] = {{256, 3, 1, 4},
                                      {257, 3, 1, 2},
                                      {258, 3, samples, samples == 3 ? 134 : bits},
                                      {259, 3, 1, 1},
                                      {262, 3, 1, samples - samples / 2},
                                      {273, 4, 1, 140},
                                      {274, 3, 1, orientation},
                                      {277, 3, 1, samples},
                                      {278, 3, 1, 2},
                                      {279, 4, 1, bytes}};
  std::string out("II\x2a\0\x08\0\0\0", 8);
  const auto put = [&out](std::uint32_t value, int count) {
    for (int i = 0; i < count; ++i) out += static_cast<char>(value >> (8 * i));
  };
  put(10, 2);
  for (const auto& [tag, type, count, value] : entries) {
    put(tag, 2);
    put(type, 2);
    put(count, 4);
    put(value, 4);
  }
  put(0, 4);
  for (int i = 0; i < 3; ++i) put(bits, 2);
  plain_write(path, out + pixels);
}

// Pixels count as they are stored. Where the camera is that of the picture as viewers turn it, that is said.
TEST(TransformsJson, ExifOrientationIsNamed) {
  if (!images_available()) GTEST_SKIP() << "this build reads no TIFF (SEMFIELD_WITH_IMAGES=OFF)";
  const Scene s;
  const auto said = [&](std::uint32_t orientation, const std::string& size) {
    write_tiff(s.folder + "/a.tif", 3, 8, orientation, std::string(24, 'g'));
    s.index(kLens + size, {"\"file_path\": \"a.tif\""});
    return all_said(s.findings());
  };
  const std::string stored = "\"w\": 4, \"h\": 2, ", turned = "\"w\": 2, \"h\": 4, ";
  EXPECT_EQ(said(1, stored), "");
  EXPECT_HAS(said(3, stored), "1 of 1 images have an EXIF orientation");
  EXPECT_HAS(said(6, turned), "is 4 x 2 pixels, the camera 2 x 4", "EXIF orientation says (6)", "mogrify");
  EXPECT_HAS(said(1, turned), "one is turned by a quarter against the other");
}

// Comparisons, not seconds: a list of names is looked up, not walked, and equal stems get numbers without new tries.
TEST(TransformsJson, AHundredThousandFramesOfListsAndOfOneName) {
  Scene s;
  s.params["missing"] = "skip";
  s.image("99999/rgb/image.png");
  std::string names;
  std::vector<std::string> frames;
  for (int i = 0; i < 100'000; ++i) {
    const std::string path = "\"" + std::to_string(i) + "/rgb/image.png\"";
    frames.push_back("\"file_path\":" + path);
    names += (i > 0 ? "," : "") + path;
  }
  s.index("\"fl_x\":4,\"w\":4,\"h\":2,\"train_filenames\":[" + names + "],", frames);
  const SceneInfo info = s.open();
  ASSERT_EQ(info.frames.size(), 1u) << "the only image that is there";
  EXPECT_EQ(info.frames[0].split, Split::train);
  EXPECT_EQ(info.frames[0].name, "rgb_image_99999");
}

TEST(TransformsDialects, DepthAsTiffOfSixteenBitsIsInSteps) {
  if (!images_available()) GTEST_SKIP() << "this build reads no TIFF (SEMFIELD_WITH_IMAGES=OFF)";
  const Scene s;
  std::string steps;
  for (int i = 0; i < 8; ++i) steps += "\xD0\x07";  // 2000
  write_tiff(s.folder + "/d.tif", 1, 16, 1, steps);
  s.index(kLens + "\"depth_unit_m\": 0.0005, ", {"\"file_path\": \"a.png\", \"depth_path\": \"d.tif\""});
  EXPECT_EQ(s.read().depth_m, std::vector<float>(8, 1.0F));
}

std::string splits_of(const Scene& s) {
  std::string out;
  for (const FrameInfo& f : s.open().frames) out += f.split == Split::test ? 'T' : f.split == Split::train ? '.' : '-';
  return out;
}

TEST(TransformsDialects, ListsOfSplits) {
  Scene s;
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
    EXPECT_EQ(splits_of(s), splits) << lists;
  }
}

TEST(TransformsDialects, MasksOfMovingThings) {
  Scene s;
  for (const char* name : {"a.png", "b.png"}) s.image(std::string("images/") + name);
  s.gray("images/dynamic_mask_a.png", {0, 255, 0, 0, 0, 1, 0, 0});
  s.index(kLens, {"\"file_path\": \"images/a.png\"", "\"file_path\": \"images/b.png\""});
  EXPECT_EQ(s.read(0).used, (Used{1, 0, 1, 1, 1, 0, 1, 1}));
  EXPECT_TRUE(s.read(1).used.empty());
  EXPECT_FINDING(s.findings(), "scene.mask.moving", "1 of 2 images", "dynamic_mask_NAME.png");
  // Both masks leave out.
  for (const char* name : {"masks/a.png", "masks/b.png"}) s.gray(name, {0, 9, 9, 9, 9, 9, 9, 9});
  s.params["masks"] = "masks";
  EXPECT_EQ(s.read(0).used, (Used{0, 0, 1, 1, 1, 0, 1, 1}));
  EXPECT_EQ(s.read(1).used, (Used{0, 1, 1, 1, 1, 1, 1, 1}));
  write_png_gray8(s.folder + "/images/dynamic_mask_a.png", 2, 2, std::vector<std::uint8_t>(4, 0));
  EXPECT_FINDING(s.findings(), "scene.image.size", "mask of moving things", "2 x 2");
}

// Drives of Windows: tests/bad_files/scenes.cases.
TEST(TransformsDialects, NamesOfOtherSystems) {
  Scene s;
  const std::string composed = "caf\xC3\xA9", apart = "cafe\xCC\x81";
  s.image("images/" + apart + "/1.png");
  s.image("images/" + apart + "/2.png");
  write_png_gray16(s.folder + "/images/" + apart + "/d.png", 4, 2, std::vector<std::uint16_t>(8, 2000));
  s.index(kLens + "\"test_filenames\": [\"images/" + composed + "/2.png\"], ",
          {"\"file_path\": \".\\\\images\\\\" + composed + "\\\\1.png\", \"depth_path\": \"images\\\\" + composed +
               "\\\\d.png\"",
           "\"file_path\": \"images/" + composed + "/2\""});
  const SceneInfo info = s.open();
  ASSERT_EQ(info.frames.size(), 2u);
  EXPECT_EQ(info.frames[0].name, "1");
  EXPECT_TRUE(info.frames[0].has_depth);
  EXPECT_EQ(info.frames[1].split, Split::test);
  EXPECT_EQ(info.frames[1].source, s.folder + "/images/" + apart + "/2.png");
}

}  // namespace
}  // namespace semfield
